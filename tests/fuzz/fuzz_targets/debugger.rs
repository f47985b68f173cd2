//! The debugger interface, 1025h, against any frames: commands, data of any length by segments and
//! blocks, aborted anywhere, on a device that is sometimes secured.
//!
//! Must hold: memory is only accessed with permission, and never while the device is secured (the
//! memory of the tests asserts it); and afterwards a correct write and read work.
#![cfg_attr(fuzzing, no_main)]

use canopen::debugger::{Command, Kind, COMMAND, DATA};
use canopen::sdo::client::{Block, Config, Download, Step, Transfer, Upload};
use canopen::sdo::SdoError;
use canopen::{AbortCode, Address};
use coboot_fuzz::{Input, ENDLESS};
use kit::bus::{at, node, request};
use kit::memory::{Target, RAM, SIZE};

const REFUSALS: [Option<AbortCode>; 3] =
    [None, Some(AbortCode::LOCAL_CONTROL), Some(AbortCode::INVALID_VALUE)];

fn drain(target: &mut Target, now: u32) {
    let sent = std::iter::from_fn(|| target.poll(now)).take(ENDLESS).count();
    assert!(sent < ENDLESS, "the node never stops sending");
}

fn run(target: &mut Target, transfer: &mut impl Transfer, now: u32) -> Result<(), SdoError> {
    for _ in 0..100 * ENDLESS {
        match transfer.poll(at(now)) {
            Step::Send(frame) => {
                target.handle(&frame, now);
                while let Some(answer) = target.poll(now) {
                    transfer.handle(&answer, at(now));
                }
            }
            // An answer to an earlier request has confused the client, which then waits for another
            // one in vain.
            Step::Wait(_) => return Err(SdoError::NoAnswer),
            Step::Done(result) => return result,
        }
    }
    panic!("the transfer never ends");
}

fn write(target: &mut Target, address: Address, data: &[u8], now: u32) {
    assert_eq!(run(target, &mut Download::new(node(), address, data, Config::default()), now), Ok(()));
}

coboot_fuzz::target!(|bytes: &[u8]| {
    let mut input = Input::new(bytes);
    let mut target = Target::new();
    let mut now = 0;
    while let Some(action) = input.byte() {
        match action {
            // Any request for the object, and any bytes.
            0..=79 => {
                let Some([command, sub, a, b, c, d]) = input.array() else { break };
                target.handle(&request([command, 0x25, 0x10, sub % 6, a, b, c, d]), now);
            }
            80..=119 => match input.array() {
                Some(frame) => target.handle(&request(frame), now),
                None => break,
            },
            // A complete command, near the existing memory.
            120..=179 => {
                let Some([kind, low, high, a, b]) = input.array() else { break };
                let offset = u32::from(u16::from_le_bytes([a, b]) % 0x3000);
                let kind = if kind & 1 == 0 { Kind::Read } else { Kind::Write };
                let (address, len) = (RAM - SIZE + offset, u16::from_le_bytes([low, high % 8]));
                let data = Command { kind, address, len }.emit();
                let _ = run(&mut target, &mut Download::new(node(), COMMAND, &data, Config::default()), now);
            }
            // Complete data, by blocks or by segments.
            180..=209 => {
                let Some([low, high, byte]) = input.array() else { break };
                let data = vec![byte; usize::from(u16::from_le_bytes([low, high % 8]))];
                let config = Config::default();
                let _ = if byte & 1 == 0 {
                    run(&mut target, &mut Download::new(node(), DATA, &data, config), now)
                } else {
                    run(&mut target, &mut Download::as_blocks(node(), DATA, &data, config), now)
                };
            }
            210..=229 => {
                let mut upload = Upload::new(node(), DATA, Vec::new(), Config::default());
                let _ = run(&mut target, &mut upload, now);
            }
            230..=239 => drain(&mut target, now),
            240..=244 => now += u32::from(action - 239) * 500,
            245..=249 => target.model().locked = action & 1 == 0,
            250..=255 => target.model().refuse = REFUSALS[usize::from(action) % REFUSALS.len()],
        }
    }

    target.model().locked = false;
    target.model().refuse = None;
    drain(&mut target, now);
    target.handle(&request([0x80, 0, 0, 0, 0, 0, 0, 8]), now);
    drain(&mut target, now);
    let data: Vec<u8> = (0..300_u16).map(|n| n as u8).collect();
    let len = data.len() as u16;
    write(&mut target, COMMAND, &Command { kind: Kind::Write, address: RAM + 1, len }.emit(), now);
    write(&mut target, DATA, &data, now);
    assert_eq!(target.model().ram[1..=data.len()], data);
    write(&mut target, COMMAND, &Command { kind: Kind::Read, address: RAM + 1, len }.emit(), now);
    let mut upload = Upload::as_blocks(node(), DATA, Vec::new(), Config::default(), Block::default());
    assert_eq!(run(&mut target, &mut upload, now), Ok(()));
    assert_eq!(upload.into_sink(), data);
});
