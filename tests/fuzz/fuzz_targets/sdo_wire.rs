//! Client and server over a wire that loses and repeats frames according to the input, and later
//! none.
//!
//! Must hold: a successful transfer has moved the data unchanged; every transfer ends; and the
//! server becomes idle.
#![cfg_attr(fuzzing, no_main)]

use std::collections::VecDeque;

use canopen::node::{Config, Node};
use canopen::sdo::client::{Block, Config as ClientConfig, Download, Step, Transfer, Upload};
use canopen::sdo::server::Config as SdoConfig;
use canopen::sdo::SdoError;
use canopen::{Address, Frame};
use coboot_fuzz::Input;
use kit::bus::{at, node, Device};

const AT: Address = Address::new(0x2000, 0);

coboot_fuzz::target!(|bytes: &[u8]| {
    let mut input = Input::new(bytes);
    let Some([kind, low, high, blksize, client_blksize, pst]) = input.array() else { return };
    let len = usize::from(u16::from_le_bytes([low, high]) % 2048);
    let data: Vec<u8> = (0..len).map(|i| (i * 7 + i / 251) as u8).collect();
    let sdo = SdoConfig { blksize: blksize % 127 + 1, ..SdoConfig::default() };
    let mut slave = Node::new(node(), Config { sdo, ..Config::default() });
    let mut device = Device { tells_size: kind & 4 != 0, ..Device::default() };
    let _ = slave.poll(at(0), &mut device);
    let block = Block { blksize: client_blksize % 127 + 1, pst, repeat_ms: 300 };
    let config = ClientConfig::default();
    match kind & 3 {
        kind @ 0..=1 => {
            let mut download = match kind {
                0 => Download::new(node(), AT, &data, config),
                _ => Download::as_blocks(node(), AT, &data, config),
            };
            if drive(&mut download, &mut slave, &mut device, input).is_ok() {
                assert_eq!(device.domain, data);
            }
        }
        kind => {
            device.domain.clone_from(&data);
            let mut upload = match kind {
                2 => Upload::new(node(), AT, Vec::new(), config),
                _ => Upload::as_blocks(node(), AT, Vec::new(), config, block),
            };
            if drive(&mut upload, &mut slave, &mut device, input).is_ok() {
                assert_eq!(upload.into_sink(), data);
            }
        }
    }
    assert!(device.incoming.is_none(), "the server is stuck");
});

fn drive(
    transfer: &mut impl Transfer,
    slave: &mut Node,
    device: &mut Device,
    mut input: Input<'_>,
) -> Result<(), SdoError> {
    let mut fate = |wire: &mut VecDeque<Frame>, frame: Frame| match input.byte() {
        Some(0..=15) => {}
        Some(16..=31) => wire.extend([frame, frame]),
        _ => wire.push_back(frame),
    };
    let (mut up, mut down) = (VecDeque::new(), VecDeque::new());
    let mut now = 0;
    let mut outcome = None;
    for _ in 0..50_000 {
        let mut quiet = true;
        match transfer.poll(at(now)) {
            Step::Send(frame) => {
                fate(&mut up, frame);
                quiet = false;
            }
            Step::Wait(_) => {}
            Step::Done(result) => outcome = Some(result),
        }
        if let Some(frame) = up.pop_front() {
            slave.handle(&frame, at(now), device);
            quiet = false;
        }
        if let Some(frame) = slave.poll(at(now), device) {
            fate(&mut down, frame);
            quiet = false;
        }
        if let Some(frame) = down.pop_front() {
            transfer.handle(&frame, at(now));
            quiet = false;
        }
        if quiet {
            match outcome {
                Some(result) if slave.is_sdo_idle() => return result,
                _ => now += 50,
            }
        }
    }
    panic!("the transfer never ends");
}
