//! What holds for every sequence of frames and every content.

mod common;

use canopen::nmt::NmtState;
use canopen::node::{Config, NmtPolicy, Node};
use canopen::sdo::client::{Config as ClientConfig, Download, Step, Transfer, Upload};
use canopen::{Address, Frame};
use common::{at, node, request, Device};
use proptest::collection::vec;
use proptest::prelude::*;

/// Frames as an unkind bus brings them: SDO requests of every command to objects that exist and that do not, noise,
/// other lengths, and NMT.
fn any_frame() -> impl Strategy<Value = Frame> {
    let index = prop_oneof![
        Just(0x1000_u16),
        Just(0x1008),
        Just(0x1017),
        Just(0x1018),
        Just(0x1F50),
        Just(0x1F51),
        Just(0x2000),
        Just(0x2001),
        Just(0x2003),
        any::<u16>()
    ];
    let command = (any::<u8>(), index, 0_u8..3, any::<[u8; 4]>()).prop_map(|(command, index, sub, field)| {
        let [low, high] = index.to_le_bytes();
        let [a, b, c, d] = field;
        request([command, low, high, sub, a, b, c, d])
    });
    let noise = any::<[u8; 8]>().prop_map(request);
    let odd = (0_u16..0x800, vec(any::<u8>(), 0..=8))
        .prop_map(|(id, data)| Frame::of(canopen::CobId::new(id).unwrap(), &data));
    let nmt = (any::<u8>(), 0_u8..8).prop_map(|(command, id)| Frame::of(canopen::CobId::NMT, &[command, id]));
    prop_oneof![6 => command, 4 => noise, 1 => odd, 1 => nmt]
}

fn slave() -> (Node, Device) {
    let mut slave = Node::new(node(), Config { nmt: NmtPolicy::StayPreOperational, ..Config::default() });
    let mut device = Device { tells_size: true, ..Device::default() };
    let _ = slave.poll(at(0), &mut device);
    (slave, device)
}

/// Runs a transfer to its end over a wire that loses nothing.
fn run(
    transfer: &mut impl Transfer,
    slave: &mut Node,
    device: &mut Device,
) -> Result<(), canopen::sdo::SdoError> {
    loop {
        match transfer.poll(at(0)) {
            Step::Send(frame) => {
                slave.handle(&frame, at(0), device);
                while let Some(answer) = slave.poll(at(0), device) {
                    transfer.handle(&answer, at(0));
                }
            }
            Step::Wait(_) => panic!("the transfer stands still"),
            Step::Done(result) => return result,
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, failure_persistence: None, ..ProptestConfig::default() })]

    /// Whatever came before, with answers fetched or not: the next correct transfers are served.
    #[test]
    fn any_frames_leave_a_server_that_serves(frames in vec((any_frame(), any::<bool>(), 0_u32..400), 0..60)) {
        let (mut slave, mut device) = slave();
        let mut now = 0;
        for (frame, fetch, pause) in frames {
            now += pause;
            slave.handle(&frame, at(now), &mut device);
            if fetch {
                while slave.poll(at(now), &mut device).is_some() {}
            }
        }
        // Left alone it comes to rest by itself.
        let later = now + 10_000;
        while slave.poll(at(later), &mut device).is_some() {}
        prop_assert!(slave.is_sdo_idle());
        prop_assert!(device.incoming.is_none());
        prop_assert_eq!(slave.state(), NmtState::PreOperational);
        let data: Vec<u8> = (0..100).collect();
        let mut download = Download::new(node(), Address::new(0x2000, 0), &data, ClientConfig::default());
        prop_assert_eq!(run(&mut download, &mut slave, &mut device), Ok(()));
        prop_assert_eq!(&device.domain, &data);
    }

    /// A transfer need not wait for the old one to time out.
    #[test]
    fn any_frames_do_not_delay_the_next_transfer(frames in vec(any_frame(), 0..20)) {
        let (mut slave, mut device) = slave();
        for frame in frames {
            slave.handle(&frame, at(0), &mut device);
            while slave.poll(at(0), &mut device).is_some() {}
        }
        let mut upload = Upload::new(node(), Address::new(0x1008, 0), Vec::new(), ClientConfig::default());
        prop_assert_eq!(run(&mut upload, &mut slave, &mut device), Ok(()));
        prop_assert_eq!(upload.into_sink(), b"coboot bootloader");
    }

    #[test]
    fn any_content_goes_there_and_back(data in vec(any::<u8>(), 0..600), tells_size: bool) {
        let (mut slave, mut device) = slave();
        device.tells_size = tells_size;
        let mut download = Download::new(node(), Address::new(0x2000, 0), &data, ClientConfig::default());
        prop_assert_eq!(run(&mut download, &mut slave, &mut device), Ok(()));
        prop_assert_eq!(&device.domain, &data);
        prop_assert_eq!(download.progress(), data.len() as u32);
        let mut upload = Upload::new(node(), Address::new(0x2000, 0), Vec::new(), ClientConfig::default());
        prop_assert_eq!(run(&mut upload, &mut slave, &mut device), Ok(()));
        prop_assert_eq!(upload.into_sink(), data);
    }

    /// A client survives every answer, and ends when its time is up at the latest.
    #[test]
    fn any_answers_leave_a_client_that_ends(answers in vec((any::<[u8; 8]>(), 0_u32..300), 0..40), up: bool) {
        let mut now = 0;
        let mut drive = |transfer: &mut dyn Transfer| {
            for (bytes, pause) in &answers {
                while let Step::Send(_) = transfer.poll(at(now)) {}
                now += pause;
                transfer.handle(&common::response(*bytes), at(now));
            }
            now += 1000;
            while let Step::Send(_) = transfer.poll(at(now)) {}
            now += 1000;
            while let Step::Send(_) = transfer.poll(at(now)) {}
            matches!(transfer.poll(at(now)), Step::Done(_))
        };
        let ended = if up {
            drive(&mut Upload::new(node(), Address::new(0x2000, 0), Vec::new(), ClientConfig::default()))
        } else {
            drive(&mut Download::new(node(), Address::new(0x2000, 0), [7; 50], ClientConfig::default()))
        };
        prop_assert!(ended);
    }
}
