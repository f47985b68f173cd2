//! Checks of the SDO server and of the objects that each device has.

use canopen::{CobId, Frame};

use super::bench::{abort_of, failed, request, skipped, Bench, Stop};
use super::Check;

const UP: u8 = 0x40;
const TOGGLE: u32 = 0x0503_0000;
const COMMAND: u32 = 0x0504_0001;
const BLOCK_SIZE: u32 = 0x0504_0002;
const READ_ONLY: u32 = 0x0601_0002;
const NO_OBJECT: u32 = 0x0602_0000;
const NO_SUB_INDEX: u32 = 0x0609_0011;

pub(super) const CHECKS: &[Check] = &[
    Check::new("OD-001", "device type, 1000h, is 4 bytes, expedited", "CiA 301, 7.5.2.1", |b| {
        b.value(0x1000, 0, 4).map(drop)
    }),
    Check::new("OD-002", "error register, 1001h, is 1 byte, expedited", "CiA 301, 7.5.2.2", |b| {
        b.value(0x1001, 0, 1).map(drop)
    }),
    Check::new("OD-003", "1018h/0 is 1 to 4", "CiA 301, 7.5.2.18", |b| match b.value(0x1018, 0, 1)? {
        1..=4 => Ok(()),
        other => failed(format!("1018h/0 is {other}")),
    }),
    Check::new("OD-004", "vendor-ID, 1018h/1, is 4 bytes", "CiA 301, 7.5.2.18", |b| {
        b.value(0x1018, 1, 4).map(drop)
    }),
    Check::new("OD-005", "every sub-index up to 1018h/0 can be read", "CiA 301, 7.5.2.18", |b| {
        let highest = b.value(0x1018, 0, 1)?.min(4) as u8;
        (1..=highest).try_for_each(|sub| b.value(0x1018, sub, 4).map(drop))
    }),
    Check::new("OD-006", "the same value is read twice from 1018h/1", "CiA 301, 7.5.2.18", |b| {
        let (first, second) = (b.value(0x1018, 1, 4)?, b.value(0x1018, 1, 4)?);
        if first == second {
            Ok(())
        } else {
            failed(format!("{first:08X}h, then {second:08X}h"))
        }
    }),
    Check::new("SDO-001", "upload of an object that is absent: 06020000h", "CiA 301, 7.2.4.3.17", |b| {
        b.refuses(request(UP, 0x0FFF, 0, [0; 4]), NO_OBJECT)
    }),
    Check::new("SDO-002", "upload of a sub-index that is absent: 06090011h", "CiA 301, 7.2.4.3.17", |b| {
        b.refuses(request(UP, 0x1018, 0xC8, [0; 4]), NO_SUB_INDEX)
    }),
    Check::new("SDO-003", "upload of 1000h/1: 06090011h", "CiA 301, 7.2.4.3.17", |b| {
        b.refuses(request(UP, 0x1000, 1, [0; 4]), NO_SUB_INDEX)
    }),
    Check::new("SDO-004", "download to 1000h: 06010002h", "CiA 301, 7.2.4.3.17", |b| {
        b.refuses(request(0x23, 0x1000, 0, [0; 4]), READ_ONLY)
    }),
    Check::new("SDO-005", "download to 1018h/1: 06010002h", "CiA 301, 7.2.4.3.17", |b| {
        b.refuses(request(0x23, 0x1018, 1, [0; 4]), READ_ONLY)
    }),
    Check::new("SDO-006", "download to an object that is absent: 06020000h", "CiA 301, 7.2.4.3.17", |b| {
        b.refuses(request(0x23, 0x0FFF, 0, [0; 4]), NO_OBJECT)
    }),
    Check::new("SDO-007", "command specifier 7: 05040001h", "CiA 301, 7.2.4.3.17", |b| {
        b.refuses(request(0xE0, 0x1000, 0, [0; 4]), COMMAND)
    }),
    Check::new("SDO-008", "upload segment without a transfer: 05040001h", "CiA 301, 7.2.4.3.17", |b| {
        b.refuses([0x60, 0, 0, 0, 0, 0, 0, 0], COMMAND)
    }),
    Check::new("SDO-009", "download segment without a transfer: 05040001h", "CiA 301, 7.2.4.3.17", |b| {
        b.refuses([0x01, 0, 0, 0, 0, 0, 0, 0], COMMAND)
    }),
    Check::new("SDO-010", "an abort from the client is not answered", "CiA 301, 7.2.4.3.17", |b| {
        let abort = request(0x80, 0x1000, 0, 0x0800_0000_u32.to_le_bytes());
        let node = b.node;
        b.ignores(&Frame::full(CobId::sdo_request(node), abort), CobId::sdo_response(node))
    }),
    Check::new("SDO-011", "an abort answer names the object of the request", "CiA 301, 7.2.4.3.17", |b| {
        let asked = request(UP, 0x1018, 0xC8, [0; 4]);
        let answer = b.ask(asked)?;
        if answer[1..4] == asked[1..4] {
            Ok(())
        } else {
            failed("the abort is for another object")
        }
    }),
    Check::new(
        "SEG-001",
        "segmented upload of 1008h with the size that was told",
        "CiA 301, 7.2.4.3.6",
        |b| {
            let size = begin_segmented(b)?;
            let mut got = 0;
            for number in 0..size.div_ceil(7) {
                let toggle = (number as u8 & 1) << 4;
                let answer = b.ask([0x60 | toggle, 0, 0, 0, 0, 0, 0, 0])?;
                if answer[0] & 0xF0 != toggle {
                    return failed(format!("segment {number}: command byte {:02X}h", answer[0]));
                }
                got += 7 - u32::from(answer[0] >> 1 & 7);
                if (answer[0] & 1 == 1) != (number + 1 == size.div_ceil(7)) {
                    return failed(format!("segment {number}: the bit for the last segment is wrong"));
                }
            }
            if got == size {
                Ok(())
            } else {
                failed(format!("{got} bytes came, {size} were told"))
            }
        },
    ),
    Check::new("SEG-002", "upload segment with the toggle bit wrong: 05030000h", "CiA 301, 7.2.4.3.6", |b| {
        begin_segmented(b)?;
        b.refuses([0x70, 0, 0, 0, 0, 0, 0, 0], TOGGLE)
    }),
    Check::new("SEG-003", "no segment after the client's abort: 05040001h", "CiA 301, 7.2.4.3.17", |b| {
        begin_segmented(b)?;
        let abort = request(0x80, 0x1008, 0, 0x0800_0000_u32.to_le_bytes());
        let id = CobId::sdo_request(b.node);
        b.send(&Frame::full(id, abort))?;
        b.refuses([0x60, 0, 0, 0, 0, 0, 0, 0], COMMAND)
    }),
    Check::new("BLK-001", "block upload with 0 segments a block: 05040002h", "CiA 301, 7.2.4.3.13", |b| {
        has_block_upload(b)?;
        b.refuses(request(0xA4, 0x1008, 0, [0, 0, 0, 0]), BLOCK_SIZE)
    }),
    Check::new("BLK-002", "block upload with 128 segments a block: 05040002h", "CiA 301, 7.2.4.3.13", |b| {
        has_block_upload(b)?;
        b.refuses(request(0xA4, 0x1008, 0, [128, 0, 0, 0]), BLOCK_SIZE)
    }),
];

/// Begins an upload of 1008h and returns its size. The object is optional.
fn begin_segmented(b: &mut Bench<'_>) -> Result<u32, Stop> {
    let answer = b.ask(request(UP, 0x1008, 0, [0; 4]))?;
    match answer[0] {
        0x41 => match u32::from_le_bytes([answer[4], answer[5], answer[6], answer[7]]) {
            // A name; more would be no name, and the check would not end.
            size @ 1..=1024 => Ok(size),
            size => failed(format!("1008h has {size} bytes")),
        },
        0x40 => skipped("1008h comes without a size"),
        0x80 => skipped("the device has no 1008h"),
        byte if byte & 0xE2 == 0x42 => skipped("1008h has at most 4 bytes"),
        byte => failed(format!("1008h: command byte {byte:02X}h")),
    }
}

/// Block transfer is optional: a server without it answers with an abort or with an upload.
fn has_block_upload(b: &mut Bench<'_>) -> Result<(), Stop> {
    let answer = b.ask(request(0xA4, 0x1008, 0, [127, 0, 0, 0]))?;
    if abort_of(&answer).is_none() {
        let abort = request(0x80, 0x1008, 0, 0x0800_0000_u32.to_le_bytes());
        let id = CobId::sdo_request(b.node);
        b.send(&Frame::full(id, abort))?;
    }
    if answer[0] & 0xE1 == 0xC0 {
        Ok(())
    } else {
        skipped("the device has no block upload of 1008h")
    }
}
