//! A node with its SDO server against any frames at any time, with answers fetched or not, and a
//! receiver of any speed.
//!
//! Must hold: a domain gets start, data, and exactly one of end and cancel (the device of the tests
//! asserts it); an answer has the server's identifier and 8 bytes; and afterwards the next correct
//! transfers work, without and with blocks, at once after an abort by the client or after the
//! time-out.
#![cfg_attr(fuzzing, no_main)]

use canopen::node::{Config, NmtPolicy, Node};
use canopen::sdo::client::{Block, Config as ClientConfig, Download, Upload};
use canopen::sdo::server::Config as SdoConfig;
use canopen::{Address, CobId};
use coboot_fuzz::{drain, run, Input};
use kit::bus::{at, node, request, Device};

/// Existing objects of every type and access, for frames that pass the first checks.
const INDICES: [u16; 10] = [0x1000, 0x1008, 0x1017, 0x1018, 0x1F50, 0x1F51, 0x2000, 0x2001, 0x2002, 0x2003];
const DOMAIN: Address = Address::new(0x2000, 0);

coboot_fuzz::target!(|bytes: &[u8]| {
    let mut input = Input::new(bytes);
    let Some([blksize, space, flags]) = input.array() else { return };
    let sdo = SdoConfig { blksize, ..SdoConfig::default() };
    let mut slave =
        Node::new(node(), Config { nmt: NmtPolicy::StayPreOperational, sdo, ..Config::default() });
    let mut device = Device { tells_size: flags & 1 != 0, ..Device::default() };
    device.space = (flags & 2 != 0).then_some(space.into());
    device.domain = vec![0x5A; usize::from(flags) * 4];
    let mut now = 0_u32;
    let _ = slave.poll(at(now), &mut device);

    while let Some(action) = input.byte() {
        match action {
            // Any bytes for the server.
            0..=79 => match input.array() {
                Some(frame) => drop(slave.handle(&request(frame), at(now), &mut device)),
                None => break,
            },
            // A command for an existing object.
            80..=159 => {
                let Some([command, which, sub, a, b, c, d]) = input.array() else { break };
                let [low, high] = INDICES[usize::from(which) % INDICES.len()].to_le_bytes();
                let frame = request([command, low, high, sub & 3, a, b, c, d]);
                slave.handle(&frame, at(now), &mut device);
            }
            // Any frame of any length.
            160..=179 => {
                let Some(frame) = input.frame() else { break };
                slave.handle(&frame, at(now), &mut device);
            }
            180..=209 => {
                if let Some(frame) = slave.poll(at(now), &mut device) {
                    let is_sdo = frame.cob_id() == Some(CobId::sdo_response(node()));
                    assert!(is_sdo && frame.exactly::<8>().is_some(), "{frame:?}");
                }
            }
            210..=229 => drain(&mut slave, at(now), &mut device),
            230..=244 => now += u32::from(action - 229) * 50,
            245..=255 => device.space = device.space.map(|space| space + usize::from(action)),
        }
    }

    // The receiver finishes, and the client aborts or is silent.
    device.space = None;
    if flags & 4 != 0 {
        slave.handle(&request([0x80, 0, 0, 0, 0, 0, 0, 8]), at(now), &mut device);
        // A waiting frame may be an earlier answer.
        drain(&mut slave, at(now), &mut device);
    } else {
        now += 10_000;
        drain(&mut slave, at(now), &mut device);
        now += 10_000;
        drain(&mut slave, at(now), &mut device);
    }
    assert!(slave.is_sdo_idle(), "left alone, the server does not come to rest");
    assert!(device.incoming.is_none(), "a download neither ended nor was cancelled");

    let data: Vec<u8> = (0..=flags).collect();
    let (config, block) = (ClientConfig::default(), Block::default());
    let mut download = Download::new(node(), DOMAIN, &data, config);
    assert_eq!(run(&mut download, &mut slave, &mut device, at(now)), Ok(()));
    assert_eq!(device.domain, data);
    let mut upload = Upload::as_blocks(node(), DOMAIN, Vec::new(), config, block);
    assert_eq!(run(&mut upload, &mut slave, &mut device, at(now)), Ok(()));
    assert_eq!(upload.into_sink(), data);
    let data: Vec<u8> = (0..u16::from(flags) * 3).map(|i| i as u8).collect();
    let mut download = Download::as_blocks(node(), DOMAIN, &data, config);
    assert_eq!(run(&mut download, &mut slave, &mut device, at(now)), Ok(()));
    assert_eq!(device.domain, data);
});
