//! An LSS slave against any frames at any time.
//!
//! Must hold: it answers with 8 bytes under the slave's identifier; it is silent while a bit rate
//! is being activated; it stores what was configured; and afterwards a correct master finds,
//! configures and stores it.
#![cfg_attr(fuzzing, no_main)]

use core::task::Poll;

use canopen::lss::{BitRate, Config, Lss, LssAddress, LssDevice, Output, StoreError};
use canopen::{CobId, Frame, NodeId};
use coboot_fuzz::{Input, ENDLESS};
use kit::bus::at;

const ADDRESS: LssAddress = LssAddress {
    vendor_id: 0x0000_0123,
    product_code: 0x1122_3344,
    revision: 0x0001_0002,
    serial_number: 0xDEAD_BEEF,
};
const PARTS: [u32; 4] = [0x0000_0123, 0x1122_3344, 0x0001_0002, 0xDEAD_BEEF];

#[derive(Default)]
struct Device {
    stored: Option<(Option<NodeId>, Option<BitRate>)>,
    fails: bool,
}

impl LssDevice for Device {
    fn supports(&mut self, rate: BitRate) -> bool {
        rate != BitRate::K800
    }

    fn store(&mut self, node: Option<NodeId>, rate: Option<BitRate>) -> Poll<Result<(), StoreError>> {
        assert_ne!(rate, Some(BitRate::K800), "a bit rate that the device does not support");
        if self.fails {
            return Poll::Ready(Err(StoreError::Failed));
        }
        self.stored = Some((node, rate));
        Poll::Ready(Ok(()))
    }
}

coboot_fuzz::target!(|bytes: &[u8]| {
    let mut input = Input::new(bytes);
    let Some([id, flags]) = input.array() else { return };
    let config = Config { start_in_configuration: flags & 1 != 0, announce: flags & 2 != 0 };
    let mut lss = Lss::new(ADDRESS, NodeId::new(id), config);
    let mut device = Device { stored: None, fails: flags & 4 != 0 };
    let mut now = 0_u32;
    while let Some(action) = input.byte() {
        match action {
            0..=79 => {
                let Some(frame) = input.array::<8>() else { break };
                lss.handle(&request(frame), at(now), &mut device);
            }
            // A request with the device's own address, as from a master that has nearly found it.
            80..=149 => {
                let Some([command, part, bits, next]) = input.array() else { break };
                let number = PARTS[usize::from(part) % 4] & u32::MAX << (bits % 33).min(31);
                let [a, b, c, d] = number.to_le_bytes();
                lss.handle(&request([command, a, b, c, d, bits, part, next]), at(now), &mut device);
            }
            150..=159 => {
                let Some(frame) = input.frame() else { break };
                lss.handle(&frame, at(now), &mut device);
            }
            160..=199 => fetch(&mut lss, now),
            200..=210 => {
                let before = lss.node_id();
                let after = lss.reset_communication();
                assert_eq!(after, lss.node_id(), "it was {before:?}");
            }
            _ => now += u32::from(action - 210) * 100,
        }
    }

    // Two delays of at most 65.5 s, then the slave answers again.
    now += 140_000;
    fetch(&mut lss, now);
    assert!(!lss.is_silent(at(now)));
    device.fails = false;

    // A selective switch finds it in any state.
    ask(&mut lss, &mut device, now, [0x04, 0, 0, 0, 0, 0, 0, 0], None);
    for (i, part) in (0_u8..).zip(PARTS) {
        let [a, b, c, d] = part.to_le_bytes();
        let found = (i == 3).then_some([0x44, 0, 0, 0, 0, 0, 0, 0]);
        ask(&mut lss, &mut device, now, [0x40 + i, a, b, c, d, 0, 0, 0], found);
    }
    let done = |command| Some([command, 0, 0, 0, 0, 0, 0, 0]);
    ask(&mut lss, &mut device, now, [0x11, 0x2A, 0, 0, 0, 0, 0, 0], done(0x11));
    ask(&mut lss, &mut device, now, [0x13, 0, 2, 0, 0, 0, 0, 0], done(0x13));
    ask(&mut lss, &mut device, now, [0x17, 0, 0, 0, 0, 0, 0, 0], done(0x17));
    assert_eq!(device.stored, Some((NodeId::new(0x2A), Some(BitRate::K500))));
    for (i, part) in (0_u8..).zip(PARTS) {
        let [a, b, c, d] = part.to_le_bytes();
        let reported = Some([0x5A + i, a, b, c, d, 0, 0, 0]);
        ask(&mut lss, &mut device, now, [0x5A + i, 0, 0, 0, 0, 0, 0, 0], reported);
    }
    assert_eq!(lss.reset_communication(), NodeId::new(0x2A));
});

fn request(bytes: [u8; 8]) -> Frame {
    Frame::of(CobId::LSS_REQUEST, &bytes)
}

/// Fetches all frames that it has to send.
fn fetch(lss: &mut Lss, now: u32) {
    for _ in 0..ENDLESS {
        let silent = lss.is_silent(at(now));
        match lss.poll(at(now)) {
            None => return,
            Some(Output::Send(frame)) => {
                assert!(!lss.is_silent(at(now)), "a word while a bit rate is being activated");
                let is_lss = frame.cob_id() == Some(CobId::LSS_RESPONSE);
                assert!(is_lss && frame.exactly::<8>().is_some(), "{frame:?}");
            }
            Some(Output::BitRate(_)) => assert!(silent, "a bit rate out of the blue"),
            Some(Output::NodeId(id)) => assert_eq!(lss.node_id(), Some(id)),
        }
    }
    panic!("it never stops talking");
}

/// Sends a request of a correct master; `expected` is the answer, other outputs are ignored.
fn ask(lss: &mut Lss, device: &mut Device, now: u32, bytes: [u8; 8], expected: Option<[u8; 8]>) {
    lss.handle(&request(bytes), at(now), device);
    let mut answers = Vec::new();
    while let Some(output) = lss.poll(at(now)) {
        if let Output::Send(frame) = output {
            answers.push(*frame.exactly::<8>().expect("8 bytes"));
        }
    }
    assert_eq!(answers, Vec::from_iter(expected), "to {bytes:02X?}");
}
