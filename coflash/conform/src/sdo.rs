//! Checks of the SDO server: refusals, expedited and segmented transfers.

use std::time::Duration;

use canopen::{CobId, Frame};

use super::bench::{abort_of, ensure, failed, need, request, skipped, Bench, Stop};
use super::check::{Check, Run};

const UP: u8 = 0x40;
pub(super) const TOGGLE: u32 = 0x0503_0000;
const TIME_OUT: u32 = 0x0504_0000;
pub(super) const COMMAND: u32 = 0x0504_0001;
pub(super) const WRITE_ONLY: u32 = 0x0601_0001;
pub(super) const READ_ONLY: u32 = 0x0601_0002;
pub(super) const NO_OBJECT: u32 = 0x0602_0000;
pub(super) const NO_SUB_INDEX: u32 = 0x0609_0011;
pub(super) const INVALID: u32 = 0x0609_0030;
pub(super) const NO_DATA: u32 = 0x0800_0024;

/// How long an abandoned transfer is watched for the server's time-out.
const ABANDONED: Duration = Duration::from_secs(5);

const ABORT: &str = "CiA 301 4.2, SDO abort transfer";
const SEGMENT: &str = "CiA 301 4.2, SDO upload segment";

/// A request that is refused.
const fn refused(id: &'static str, title: &'static str, asked: [u8; 8], code: u32) -> Check {
    Check::of(id, title, ABORT, Run::Refused(asked, code))
}

const fn up(index: u16, sub: u8) -> [u8; 8] {
    request(UP, index, sub, [0; 4])
}

/// An expedited download of four bytes, all zero.
const fn down(index: u16, sub: u8) -> [u8; 8] {
    request(0x23, index, sub, [0; 4])
}

const fn bare(command: u8) -> [u8; 8] {
    [command, 0, 0, 0, 0, 0, 0, 0]
}

#[rustfmt::skip]
pub(super) const CHECKS: &[Check] = &[
    refused("SDO-001", "upload of an object that is absent: 06020000h", up(0x0FFF, 0), NO_OBJECT),
    refused("SDO-002", "upload of a sub-index that is absent: 06090011h", up(0x1018, 0xC8), NO_SUB_INDEX),
    refused("SDO-003", "upload of 1000h/1: 06090011h", up(0x1000, 1), NO_SUB_INDEX),
    refused("SDO-004", "download to 1000h: 06010002h", down(0x1000, 0), READ_ONLY),
    refused("SDO-005", "download to 1018h/1: 06010002h", down(0x1018, 1), READ_ONLY),
    refused("SDO-006", "download to an object that is absent: 06020000h", down(0x0FFF, 0), NO_OBJECT),
    refused("SDO-007", "command specifier 7: 05040001h", request(0xE0, 0x1000, 0, [0; 4]), COMMAND),
    refused("SDO-008", "upload segment without a transfer: 05040001h", bare(0x60), COMMAND),
    refused("SDO-009", "download segment without a transfer: 05040001h", bare(0x01), COMMAND),
    Check::new("SDO-010", "an abort from the client is not answered", ABORT, |b| {
        let abort = request(0x80, 0x1000, 0, 0x0800_0000_u32.to_le_bytes());
        let node = b.node;
        b.ignores(&Frame::full(CobId::sdo_request(node), abort), CobId::sdo_response(node))
    }),
    Check::new("SDO-011", "each service is aborted with the object of its request, and not of the one before", ABORT, |b| {
        for command in [UP, 0x23, 0x21, 0xA4, 0xC6] {
            b.works()?;
            let answer = b.ask(request(command, 0x1018, 0xC8, [127, 0, 0, 0]))?;
            ensure!(abort_of(&answer).is_some(), "{command:02X}h is answered with {:02X}h in place of an abort", answer[0]);
        }
        Ok(())
    }),
    refused("SDO-012", "upload of 1001h/1: 06090011h", up(0x1001, 1), NO_SUB_INDEX),
    refused("SDO-013", "upload of index 0000h: 06020000h", up(0, 0), NO_OBJECT),
    refused("SDO-014", "upload of index FFFFh: 06020000h", up(0xFFFF, 0), NO_OBJECT),
    refused("SDO-015", "download to 1001h: 06010002h", request(0x2F, 0x1001, 0, [0; 4]), READ_ONLY),
    refused("SDO-016", "download to 1018h/0: 06010002h", request(0x2F, 0x1018, 0, [4, 0, 0, 0]), READ_ONLY),
    refused("SDO-017", "download to 1018h/200: 06090011h", down(0x1018, 0xC8), NO_SUB_INDEX),
    refused("SDO-018", "download to 1000h/1: 06090011h", down(0x1000, 1), NO_SUB_INDEX),
    refused("SDO-019", "segmented download to an absent object: 06020000h", request(0x21, 0x0FFF, 0, [8, 0, 0, 0]), NO_OBJECT),
    refused("SDO-020", "segmented download to 1018h/200: 06090011h", request(0x21, 0x1018, 0xC8, [4, 0, 0, 0]), NO_SUB_INDEX),
    refused("SDO-021", "segmented download to 1000h: 06010002h", request(0x21, 0x1000, 0, [4, 0, 0, 0]), READ_ONLY),
    refused("SDO-022", "segmented download without size to 1000h: 06010002h", request(0x20, 0x1000, 0, [0; 4]), READ_ONLY),
    refused("SDO-023", "command byte FFh: 05040001h", request(0xFF, 0x1000, 0, [0; 4]), COMMAND),
    refused("SDO-024", "upload segment, toggle set, without a transfer: 05040001h", bare(0x70), COMMAND),
    refused("SDO-025", "download segment, toggle set, without a transfer: 05040001h", bare(0x10), COMMAND),
    Check::new("SDO-026", "fifty uploads in a row are answered", "CiA 301 4.2, SDO upload", |b| {
        (0..50).try_for_each(|_| b.works())
    }),
    Check::new("SDO-027", "the same object is read after each kind of refusal", ABORT, |b| {
        let kind = b.value(0x1000, 0, 4)?;
        for (asked, code) in [(up(0x0FFF, 0), NO_OBJECT), (down(0x1000, 0), READ_ONLY), (bare(0x60), COMMAND)] {
            b.refuses(asked, code)?;
            let now = b.value(0x1000, 0, 4)?;
            ensure!(now == kind, "1000h is {now:08X}h after {code:08X}h");
        }
        Ok(())
    }),
    Check::new("SEG-001", "segmented upload of 1008h with the size that was told", SEGMENT, |b| {
        begin_segmented(b)?;
        text(b, 0x1008).map(drop)
    }),
    Check::new("SEG-002", "upload segment with the toggle bit wrong: 05030000h", SEGMENT, |b| {
        begin_segmented(b)?;
        b.refuses(bare(0x70), TOGGLE)
    }),
    Check::new("SEG-003", "no segment after the client's abort: 05040001h", ABORT, |b| {
        begin_segmented(b)?;
        b.abort(0x1008, 0)?;
        b.refuses(bare(0x60), COMMAND)
    }),
    Check::new("SEG-004", "no segment after a wrong toggle bit: 05040001h", SEGMENT, |b| {
        begin_segmented(b)?;
        b.ask(bare(0x70))?;
        b.refuses(bare(0x60), COMMAND)
    }),
    Check::new("SEG-005", "the second segment with the first one's toggle bit: 05030000h", SEGMENT, |b| {
        need!(begin_segmented(b)? > 7, "1008h has one segment");
        b.takes(bare(0x60), 0x00)?;
        b.refuses(bare(0x60), TOGGLE)
    }),
    Check::new("SEG-006", "download segment within an upload: 05040001h", ABORT, |b| {
        begin_segmented(b)?;
        b.refuses(bare(0x00), COMMAND)
    }),
    Check::new("SEG-007", "no segment after the last one: 05040001h", SEGMENT, |b| {
        begin_segmented(b)?;
        b.abort(0x1008, 0)?;
        let segments = text(b, 0x1008)?.len().div_ceil(7);
        b.refuses(bare(0x60 | (segments as u8 & 1) << 4), COMMAND)
    }),
    Check::new("SEG-008", "1008h is the same when it is read again", SEGMENT, |b| {
        begin_segmented(b)?;
        b.abort(0x1008, 0)?;
        ensure!(text(b, 0x1008)? == text(b, 0x1008)?, "1008h has changed");
        Ok(())
    }),
    Check::new("SEG-009", "the server's abort of an abandoned upload is 05040000h", ABORT, |b| {
        begin_segmented(b)?;
        let id = CobId::sdo_response(b.node);
        match b.hear(id, ABANDONED)? {
            None => skipped("the server waits for longer than 5 s, as it may"),
            Some(frame) => match frame.exactly().filter(|answer| abort_of(answer) == Some(TIME_OUT)) {
                Some(answer) => b.names_its_object(*answer).map(drop),
                None => failed(format!("{frame}")),
            },
        }
    }),
    Check::new("SEG-010", "a client's abort in mid-transfer ends the upload", ABORT, |b| {
        need!(begin_segmented(b)? > 7, "1008h has one segment");
        b.takes(bare(0x60), 0x00)?;
        b.abort(0x1008, 0)?;
        b.refuses(bare(0x70), COMMAND)?;
        b.works()
    }),
];

/// Begins an upload of 1008h and returns its size. The object is optional.
fn begin_segmented(b: &mut Bench<'_>) -> Result<u32, Stop> {
    let answer = b.ask(up(0x1008, 0))?;
    match answer[0] {
        0x41 => told_size(0x1008, &answer),
        0x40 => skipped("1008h comes without a size"),
        0x80 => skipped("the device has no 1008h"),
        byte if byte & 0xE2 == 0x42 => skipped("1008h has at most 4 bytes"),
        byte => failed(format!("1008h: command byte {byte:02X}h")),
    }
}

fn told_size(index: u16, answer: &[u8; 8]) -> Result<u32, Stop> {
    match u32::from_le_bytes([answer[4], answer[5], answer[6], answer[7]]) {
        // A name; more would be no name, and the check would not end.
        size @ 1..=1024 => Ok(size),
        size => failed(format!("{index:04X}h has {size} bytes")),
    }
}

/// A text of sub-index 0 by ordinary upload, with all fields of the answers checked.
pub(super) fn text(b: &mut Bench<'_>, index: u16) -> Result<Vec<u8>, Stop> {
    let answer = b.ask(up(index, 0))?;
    if let Some(code) = abort_of(&answer) {
        return failed(format!("{index:04X}h is refused: abort {code:08X}h"));
    }
    if answer[0] & 0xE3 == 0x43 {
        return Ok(answer[4..8 - usize::from(answer[0] >> 2 & 3)].to_vec());
    }
    need!(answer[0] != 0x40, "{index:04X}h comes without a size");
    ensure!(answer[0] == 0x41, "{index:04X}h: command byte {:02X}h", answer[0]);
    let size = told_size(index, &answer)? as usize;
    let count = size.div_ceil(7);
    let mut got = Vec::new();
    for number in 0..count {
        let toggle = (number as u8 & 1) << 4;
        let answer = b.ask(bare(0x60 | toggle))?;
        ensure!(answer[0] & 0xF0 == toggle, "segment {number}: command byte {:02X}h", answer[0]);
        got.extend_from_slice(&answer[1..8 - usize::from(answer[0] >> 1 & 7)]);
        ensure!(
            (answer[0] & 1 == 1) == (number + 1 == count),
            "segment {number}: the bit for the last segment is wrong"
        );
    }
    ensure!(got.len() == size, "{} bytes came, {size} were told", got.len());
    Ok(got)
}
