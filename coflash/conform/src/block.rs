//! Checks of SDO block upload, with the device name, 1008h. Block transfer is optional.

use std::time::Duration;

use canopen::CobId;
use crc::{Crc, CRC_16_XMODEM};

use super::bench::{abort_of, ensure, failed, need, request, Bench, Stop};
use super::check::{Check, Step};
use super::sdo::{text, COMMAND, NO_OBJECT, NO_SUB_INDEX};

const BLOCK_SIZE: u32 = 0x0504_0002;
const SEQUENCE: u32 = 0x0504_0003;

const INITIATE: &str = "CiA 301 4.2, SDO block upload initiate";
const SUB_BLOCK: &str = "CiA 301 4.2, SDO block upload sub-block";
const ABORT: &str = "CiA 301 4.2, SDO abort transfer";

const START: [u8; 8] = [0xA3, 0, 0, 0, 0, 0, 0, 0];
/// The most segments that a name may have here.
const MOST: usize = 127;

const fn acknowledge(last: u8, block_size: u8) -> [u8; 8] {
    [0xA2, last, block_size, 0, 0, 0, 0, 0]
}

const fn initiate(command: u8, sub: u8, index: u16, block_size: u8, threshold: u8) -> [u8; 8] {
    request(command, index, sub, [block_size, threshold, 0, 0])
}

const fn check(id: &'static str, title: &'static str, clause: &'static str, run: Step) -> Check {
    Check::new(id, title, clause, run).needs(has_block_upload)
}

#[rustfmt::skip]
pub(super) const CHECKS: &[Check] = &[
    check("BLK-001", "block upload with 0 segments a block: 05040002h", INITIATE, |b| {
        b.refuses(initiate(0xA4, 0, 0x1008, 0, 0), BLOCK_SIZE)
    }),
    check("BLK-002", "block upload with 128 segments a block: 05040002h", INITIATE, |b| {
        b.refuses(initiate(0xA4, 0, 0x1008, 128, 0), BLOCK_SIZE)
    }),
    check("BLK-003", "block upload with CRC brings what the segmented upload brings", SUB_BLOCK, |b| {
        whole(b, true, 127)
    }),
    check("BLK-004", "block upload without CRC brings the same", SUB_BLOCK, |b| whole(b, false, 127)),
    check("BLK-005", "block upload with one segment a block brings the same", SUB_BLOCK, |b| whole(b, true, 1)),
    check("BLK-006", "segments that were not acknowledged come again", SUB_BLOCK, |b| {
        start(b, true, 127)?;
        let first = sub_block(b, 127)?;
        // The sub-block is lost as a whole.
        b.send_sdo(acknowledge(0, 127))?;
        ensure!(sub_block(b, 127)? == first, "other segments came");
        Ok(())
    }),
    check("BLK-007", "an acknowledgement of a part: the rest comes again, numbered from 1", SUB_BLOCK, |b| {
        start(b, true, 127)?;
        let first = sub_block(b, 127)?;
        need!(first.len() >= 2, "1008h has one segment");
        b.send_sdo(acknowledge(1, 127))?;
        let rest = sub_block(b, 127)?;
        ensure!(rest[..] == first[1..], "{} of {} segments came again", rest.len(), first.len() - 1);
        Ok(())
    }),
    check("BLK-008", "an acknowledgement of more than was sent: 05040003h", SUB_BLOCK, |b| {
        start(b, true, 127)?;
        let count = sub_block(b, 127)?.len() as u8;
        b.refuses(acknowledge(count + 1, 127), SEQUENCE)
    }),
    check("BLK-009", "block size 0 in an acknowledgement: 05040002h", SUB_BLOCK, |b| {
        start(b, true, 1)?;
        sub_block(b, 1)?;
        b.refuses(acknowledge(1, 0), BLOCK_SIZE)
    }),
    check("BLK-010", "no start after the client's abort: 05040001h", ABORT, |b| {
        b.ask(initiate(0xA4, 0, 0x1008, 127, 0))?;
        b.abort(0x1008, 0)?;
        b.refuses(START, COMMAND)
    }),
    check("BLK-011", "no acknowledgement after the client's abort: 05040001h", ABORT, |b| {
        start(b, true, 127)?;
        sub_block(b, 127)?;
        b.abort(0x1008, 0)?;
        b.refuses(acknowledge(1, 127), COMMAND)
    }),
    check("BLK-012", "an upload segment in place of the start: 05040001h", ABORT, |b| {
        b.ask(initiate(0xA4, 0, 0x1008, 127, 0))?;
        b.refuses([0x60, 0, 0, 0, 0, 0, 0, 0], COMMAND)
    }),
    check("BLK-013", "start without a transfer: 05040001h", ABORT, |b| b.refuses(START, COMMAND)),
    check("BLK-014", "acknowledgement without a transfer: 05040001h", ABORT, |b| {
        b.refuses(acknowledge(1, 127), COMMAND)
    }),
    check("BLK-015", "end of block upload without a transfer: 05040001h", ABORT, |b| {
        b.refuses([0xA1, 0, 0, 0, 0, 0, 0, 0], COMMAND)
    }),
    check("BLK-016", "block upload of an absent object: 06020000h", ABORT, |b| {
        b.refuses(initiate(0xA4, 0, 0x0FFF, 127, 0), NO_OBJECT)
    }),
    check("BLK-017", "block upload of an absent sub-index: 06090011h", ABORT, |b| {
        b.refuses(initiate(0xA4, 0xC8, 0x1018, 127, 0), NO_SUB_INDEX)
    }),
    check("BLK-018", "under the switch threshold, 1018h/1 comes by block or by ordinary upload", INITIATE, |b| {
        let answer = b.ask(initiate(0xA4, 1, 0x1018, 127, 255))?;
        match answer[0] {
            0x43 | 0x41 => Ok(()),
            byte if byte & 0xF9 == 0xC0 => Ok(()),
            byte => failed(format!("command byte {byte:02X}h")),
        }
    }),
];

fn has_block_upload(b: &mut Bench<'_>) -> Result<(), Stop> {
    let answer = b.ask(initiate(0xA4, 0, 0x1008, 127, 0))?;
    if abort_of(&answer).is_none() {
        b.abort(0x1008, 0)?;
    }
    need!(answer[0] & 0xE1 == 0xC0, "the device has no block upload of 1008h");
    Ok(())
}

/// Begins a block upload of 1008h and starts it. Returns whether the device sends a CRC.
fn start(b: &mut Bench<'_>, crc: bool, block_size: u8) -> Result<bool, Stop> {
    let command = if crc { 0xA4 } else { 0xA0 };
    let answer = b.ask(initiate(command, 0, 0x1008, block_size, 0))?;
    ensure!(answer[0] & 0xF9 == 0xC0, "command byte {:02X}h to the initiate", answer[0]);
    b.send_sdo(START)?;
    Ok(answer[0] & 4 != 0)
}

/// The segments of one sub-block.
fn sub_block(b: &mut Bench<'_>, block_size: u8) -> Result<Vec<[u8; 7]>, Stop> {
    let mut segments = Vec::new();
    loop {
        let [number, data @ ..] = b.heard()?;
        segments.push(data);
        ensure!(
            usize::from(number & 0x7F) == segments.len(),
            "segment {} has number {}",
            segments.len(),
            number & 0x7F
        );
        if number & 0x80 != 0 || segments.len() == usize::from(block_size) {
            break;
        }
    }
    // A server that sends more than the block is long is heard here.
    match b.hear(CobId::sdo_response(b.node), Duration::from_millis(20))? {
        Some(frame) => failed(format!("{frame} after the sub-block of {} segments", segments.len())),
        None => Ok(segments),
    }
}

fn whole(b: &mut Bench<'_>, crc: bool, block_size: u8) -> Result<(), Stop> {
    let expected = text(b, 0x1008)?;
    let count = expected.len().div_ceil(7);
    need!(count <= MOST, "1008h is too long");
    let sends_crc = start(b, crc, block_size)?;
    let mut got = Vec::new();
    let mut left = count;
    while left > 0 {
        let segments = sub_block(b, block_size.min(left as u8))?;
        left -= segments.len().min(left);
        got.extend(segments.concat());
        let last = acknowledge(segments.len() as u8, block_size);
        if left > 0 {
            b.send_sdo(last)?;
            continue;
        }
        let end = b.ask(last)?;
        ensure!(end[0] & 0xE3 == 0xC1, "command byte {:02X}h at the end", end[0]);
        let unused = usize::from(end[0] >> 2 & 7);
        got.truncate(got.len() - unused);
        ensure!(got == expected, "{got:02X?} in place of {expected:02X?}");
        let reported = u16::from_le_bytes([end[1], end[2]]);
        let right = Crc::<u16>::new(&CRC_16_XMODEM).checksum(&got);
        ensure!(!crc || !sends_crc || reported == right, "CRC {reported:04X}h in place of {right:04X}h");
    }
    b.send_sdo([0xA1, 0, 0, 0, 0, 0, 0, 0])?;
    b.works()
}
