//! A transfer of the SDO client against any answers at any time.
//!
//! Must hold: it only sends requests of 8 bytes; a successful upload has delivered the announced
//! data; without answers it ends; and its result does not change.
#![cfg_attr(fuzzing, no_main)]

use canopen::sdo::client::{Block, Config, Download, Sink, Step, Transfer, Upload};
use canopen::{AbortCode, Address, CobId};
use coboot_fuzz::{Input, ENDLESS};
use kit::bus::{at, node, response};

const AT: Address = Address::new(0x2000, 0);

/// The data that an upload delivers.
#[derive(Default)]
struct Delivered {
    announced: Option<u32>,
    len: u64,
}

impl Sink for &mut Delivered {
    fn announce(&mut self, size: u32) -> Result<(), AbortCode> {
        assert!(self.announced.is_none() && self.len == 0, "announced behind data, or twice");
        self.announced = Some(size);
        Ok(())
    }

    fn write(&mut self, data: &[u8]) -> Result<(), AbortCode> {
        self.len += data.len() as u64;
        Ok(())
    }
}

coboot_fuzz::target!(|bytes: &[u8]| {
    let mut input = Input::new(bytes);
    let Some([kind, len, blksize, pst]) = input.array() else { return };
    let data = vec![0xA5; usize::from(len)];
    let block = Block { blksize: blksize % 127 + 1, pst, repeat_ms: 300 };
    let mut delivered = Delivered::default();
    match kind & 3 {
        0 => drop(drive(&mut Download::new(node(), AT, &data, Config::default()), input)),
        1 => drop(drive(&mut Download::as_blocks(node(), AT, &data, Config::default()), input)),
        2 => {
            let result = drive(&mut Upload::new(node(), AT, &mut delivered, Config::default()), input);
            check(result, &delivered);
        }
        _ => {
            let mut upload = Upload::as_blocks(node(), AT, &mut delivered, Config::default(), block);
            let result = drive(&mut upload, input);
            check(result, &delivered);
        }
    }
});

fn check((good, progress): (bool, u32), delivered: &Delivered) {
    if good {
        assert_eq!(u64::from(progress), delivered.len);
        if let Some(size) = delivered.announced {
            assert_eq!(u64::from(size), delivered.len, "less or more than was announced");
        }
    }
}

/// Runs the transfer; returns whether it was successful, and its progress.
fn drive(transfer: &mut impl Transfer, mut input: Input<'_>) -> (bool, u32) {
    let mut now = 0_u32;
    let mut ended = None;
    while let Some(action) = input.byte() {
        match action {
            0..=99 => match input.array() {
                Some(frame) => transfer.handle(&response(frame), at(now)),
                None => break,
            },
            // An answer for the right object.
            100..=149 => {
                let Some([command, a, b, c, d]) = input.array() else { break };
                transfer.handle(&response([command, 0x00, 0x20, 0, a, b, c, d]), at(now));
            }
            150..=159 => {
                let Some(frame) = input.frame() else { break };
                transfer.handle(&frame, at(now));
            }
            160..=239 => send(transfer, now, &mut ended),
            240..=254 => now += u32::from(action - 239) * 20,
            255 => transfer.abort(AbortCode::GENERAL),
        }
    }
    // A repetition of a sub-block, and the time-out.
    for _ in 0..3 {
        now += 1000;
        send(transfer, now, &mut ended);
    }
    let Step::Done(result) = transfer.poll(at(now)) else { panic!("left alone, it does not end") };
    assert!(ended.is_none_or(|before| before == result), "the end changed");
    (result.is_ok(), transfer.progress())
}

/// Fetches the frames that it has to send.
fn send(transfer: &mut impl Transfer, now: u32, ended: &mut Option<Result<(), canopen::sdo::SdoError>>) {
    for _ in 0..ENDLESS {
        match transfer.poll(at(now)) {
            Step::Send(frame) => {
                let is_sdo = frame.cob_id() == Some(CobId::sdo_request(node()));
                assert!(is_sdo && frame.exactly::<8>().is_some(), "{frame:?}");
            }
            Step::Wait(_) => return assert!(ended.is_none(), "it goes on behind its end"),
            Step::Done(result) => {
                assert!(ended.is_none_or(|before| before == result), "the end changed");
                *ended = Some(result);
                return;
            }
        }
    }
    panic!("it never stops sending");
}
