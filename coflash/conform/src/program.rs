//! Checks of 1F50h to 1F57h in a bootloader. All requests here are refused, or change no program:
//! the unknown command 55h is sent where a download to 1F51h needs a value.

use std::time::Duration;

use canopen::CobId;
use crc::{Crc, CRC_16_XMODEM, CRC_32_ISO_HDLC};

use super::bench::{abort_of, ensure, failed, need, request, skipped, Bench, Stop};
use super::check::{Check, Run, Step};
use super::sdo::{COMMAND, INVALID, NO_OBJECT, NO_SUB_INDEX, READ_ONLY, TOGGLE, WRITE_ONLY};

/// What 1000h reads in a bootloader (L-1112, "Procedure in principle").
pub(super) const BOOTLOADER: u32 = 0x1000_0000;

const CRC: u32 = 0x0504_0004;
const SEQUENCE: u32 = 0x0504_0003;
const LENGTH: u32 = 0x0607_0010;
const TOO_LONG: u32 = 0x0607_0012;
const TOO_SHORT: u32 = 0x0607_0013;
const WRONG_STATE: u32 = 0x0800_0022;

const OBJECTS: &str = "L-1112, table 1";
const COMMANDS: &str = "L-1112, table 2";
const STATES: &str = "coboot, ADR 3";
const ABORTS: &str = "CiA 301 4.2, SDO abort transfer";
const DOWNLOAD: &str = "CiA 301 4.2, SDO download segment";
const BLOCK: &str = "CiA 301 4.2, SDO block download";
/// No command of table 2.
const UNKNOWN: u8 = 0x55;

const fn number(id: &'static str, title: &'static str, index: u16, sub: u8, len: u8) -> Check {
    Check::of(id, title, OBJECTS, Run::Number(index, sub, len)).needs(is_bootloader)
}

const fn refused(
    id: &'static str,
    title: &'static str,
    clause: &'static str,
    asked: [u8; 8],
    code: u32,
) -> Check {
    Check::of(id, title, clause, Run::Refused(asked, code)).needs(is_bootloader)
}

const fn check(id: &'static str, title: &'static str, clause: &'static str, run: Step) -> Check {
    Check::new(id, title, clause, run).needs(is_bootloader)
}

#[rustfmt::skip]
pub(super) const CHECKS: &[Check] = &[
    number("PRG-001", "1F50h/0 is 1 byte", 0x1F50, 0, 1),
    number("PRG-002", "1F51h/0 is 1 byte", 0x1F51, 0, 1),
    number("PRG-003", "1F56h/0 is 1 byte", 0x1F56, 0, 1),
    number("PRG-004", "1F57h/0 is 1 byte", 0x1F57, 0, 1),
    check("PRG-005", "1F50h, 1F51h, 1F56h and 1F57h have the same number of programs", OBJECTS, |b| {
        let count = b.value(0x1F50, 0, 1)?;
        for index in [0x1F51, 0x1F56, 0x1F57] {
            let other = b.value(index, 0, 1)?;
            ensure!(other == count, "1F50h/0 is {count}, {index:04X}h/0 is {other}");
        }
        Ok(())
    }),
    number("PRG-006", "program control, 1F51h/1, is 1 byte", 0x1F51, 1, 1),
    number("PRG-007", "program identification, 1F56h/1, is 4 bytes", 0x1F56, 1, 4),
    number("PRG-008", "flash status, 1F57h/1, is 4 bytes", 0x1F57, 1, 4),
    refused("PRG-009", "upload of 1F50h/1: 06010001h", OBJECTS, request(0x40, 0x1F50, 1, [0; 4]), WRITE_ONLY),
    refused("PRG-010", "download to 1F56h/1: 06010002h", OBJECTS, request(0x23, 0x1F56, 1, [0; 4]), READ_ONLY),
    refused("PRG-011", "download to 1F57h/1: 06010002h", OBJECTS, request(0x23, 0x1F57, 1, [0; 4]), READ_ONLY),
    refused("PRG-012", "download to 1F50h/0: 06010002h", OBJECTS, request(0x2F, 0x1F50, 0, [1, 0, 0, 0]), READ_ONLY),
    refused("PRG-013", "download to 1F51h/0: 06010002h", OBJECTS, request(0x2F, 0x1F51, 0, [1, 0, 0, 0]), READ_ONLY),
    refused("PRG-014", "download to 1F50h/254: 06090011h", ABORTS, request(0x23, 0x1F50, 254, [0; 4]), NO_SUB_INDEX),
    refused("PRG-015", "download to 1F51h/254: 06090011h", ABORTS, request(0x2F, 0x1F51, 254, [UNKNOWN, 0, 0, 0]), NO_SUB_INDEX),
    refused("PRG-016", "upload of 1F56h/254: 06090011h", ABORTS, request(0x40, 0x1F56, 254, [0; 4]), NO_SUB_INDEX),
    refused("PRG-017", "upload of 1F57h/254: 06090011h", ABORTS, request(0x40, 0x1F57, 254, [0; 4]), NO_SUB_INDEX),
    refused("PRG-018", "the unknown command 55h: 06090030h", COMMANDS, request(0x2F, 0x1F51, 1, [UNKNOWN, 0, 0, 0]), INVALID),
    refused("PRG-019", "a command of 2 bytes: 06070012h", ABORTS, request(0x2B, 0x1F51, 1, [UNKNOWN, 0, 0, 0]), TOO_LONG),
    refused("PRG-020", "a command of 4 bytes: 06070012h", ABORTS, request(0x23, 0x1F51, 1, [UNKNOWN, 0, 0, 0]), TOO_LONG),
    check("PRG-021", "the unknown command in a segment: 06090030h", DOWNLOAD, |b| {
        b.takes(request(0x21, 0x1F51, 1, [1, 0, 0, 0]), 0x60)?;
        b.refuses([0x0D, UNKNOWN, 0, 0, 0, 0, 0, 0], INVALID)
    }),
    check("PRG-022", "the unknown command in a segment without size: 06090030h", DOWNLOAD, |b| {
        b.takes(request(0x20, 0x1F51, 1, [0; 4]), 0x60)?;
        b.refuses([0x0D, UNKNOWN, 0, 0, 0, 0, 0, 0], INVALID)
    }),
    check("PRG-023", "download segment with the toggle bit wrong: 05030000h", DOWNLOAD, |b| {
        b.takes(request(0x21, 0x1F51, 1, [1, 0, 0, 0]), 0x60)?;
        b.refuses([0x1D, UNKNOWN, 0, 0, 0, 0, 0, 0], TOGGLE)
    }),
    check("PRG-024", "more bytes than were announced are refused", DOWNLOAD, |b| {
        b.takes(request(0x21, 0x1F51, 1, [1, 0, 0, 0]), 0x60)?;
        refuses_length(b, [0x0B, UNKNOWN, UNKNOWN, 0, 0, 0, 0, 0])
    }),
    check("PRG-025", "a command of 7 bytes without size is refused", DOWNLOAD, |b| {
        b.takes(request(0x20, 0x1F51, 1, [0; 4]), 0x60)?;
        refuses_length(b, [0x01, UNKNOWN, 0, 0, 0, 0, 0, 0])
    }),
    check("PRG-026", "no segment after the client's abort: 05040001h", ABORTS, |b| {
        b.takes(request(0x21, 0x1F51, 1, [1, 0, 0, 0]), 0x60)?;
        b.abort(0x1F51, 1)?;
        b.refuses([0x0D, UNKNOWN, 0, 0, 0, 0, 0, 0], COMMAND)
    }),
    check("PRG-027", "an upload segment within a download: 05040001h", ABORTS, |b| {
        b.takes(request(0x21, 0x1F51, 1, [1, 0, 0, 0]), 0x60)?;
        b.refuses([0x60, 0, 0, 0, 0, 0, 0, 0], COMMAND)
    }),
    check("PRG-028", "the unknown command by block download: 06090030h", BLOCK, |b| {
        one_block(b)?;
        b.refuses(end(0), INVALID)
    }),
    check("PRG-029", "block download with a wrong CRC: 05040004h", BLOCK, |b| {
        one_block(b)?;
        b.refuses(end(1), CRC)
    }),
    check("PRG-030", "block download, a segment with number 0: 05040003h", BLOCK, |b| {
        begin_block(b, 1)?;
        b.refuses([0x00, UNKNOWN, 0, 0, 0, 0, 0, 0], SEQUENCE)
    }),
    check("PRG-031", "block download, the second segment missing: the first alone is acknowledged", BLOCK, |b| {
        begin_download(b, 0xC6, 0x1F50, 28)?;
        b.send_sdo([1, 99, 0, 0, 0, 0, 0, 0])?;
        let answer = b.takes([0x80 | 3, 0, 0, 0, 0, 0, 0, 0], 0xA2)?;
        b.abort(0x1F50, 1)?;
        ensure!(answer[1] == 1, "{} is acknowledged", answer[1]);
        Ok(())
    }),
    check("PRG-032", "no end of a block download after the client's abort: 05040001h", ABORTS, |b| {
        one_block(b)?;
        b.abort(0x1F51, 1)?;
        b.refuses(end(0), COMMAND)
    }),
    refused("PRG-033", "end of block download without a transfer: 05040001h", ABORTS, [0xC1, 0, 0, 0, 0, 0, 0, 0], COMMAND),
    refused("PRG-034", "block download to an absent object: 06020000h", BLOCK, request(0xC6, 0x0FFF, 0, [8, 0, 0, 0]), NO_OBJECT),
    refused("PRG-035", "block download to 1000h: 06010002h", BLOCK, request(0xC6, 0x1000, 0, [4, 0, 0, 0]), READ_ONLY),
    check("PRG-036", "a block shorter than its framing: 06070013h", STATES, |b| {
        unchanged(b, |b| b.refuses(request(0x23, 0x1F50, 1, [0; 4]), TOO_SHORT))
    }),
    check("PRG-037", "block 5 without a control block: 08000022h", STATES, |b| {
        unchanged(b, |b| send_block(b, &block(5, 0), WRONG_STATE))
    }),
    check("PRG-038", "the last block without a control block is refused", STATES, |b| {
        unchanged(b, |b| send_block(b, &block(u32::MAX, 0), WRONG_STATE))
    }),
    check("PRG-039", "a control block with a wrong CRC: 08000020h", STATES, |b| {
        let mut block = block(0, 0);
        if let Some(last) = block.last_mut() {
            *last ^= 1;
        }
        unchanged(b, |b| send_block(b, &block, 0x0800_0020))
    }),
    check("PRG-040", "a block that was cut off leaves the program alone", STATES, |b| {
        unchanged(b, |b| {
            b.takes(request(0x21, 0x1F50, 1, [24, 0, 0, 0]), 0x60)?;
            b.takes([0x00, 0, 0, 0, 0, 0, 0, 0], 0x20)?;
            b.abort(0x1F50, 1)
        })
    }),
    check("PRG-041", "RESET_STAT sets 1F57h/1 to 0", COMMANDS, |b| {
        b.takes(request(0x2F, 0x1F51, 1, [2, 0, 0, 0]), 0x60)?;
        match idle(b, 1)? {
            0 => Ok(()),
            status => failed(format!("1F57h/1 is {status:08X}h")),
        }
    }),
    check("PRG-042", "1F56h/1 is the same when it is read again", OBJECTS, |b| unchanged(b, |_| Ok(()))),
];

/// 1F57h of a program, when it is no longer busy, or after 400 ms.
pub(super) fn idle(b: &mut Bench<'_>, program: u8) -> Result<u32, Stop> {
    let mut status = 1;
    for _ in 0..20 {
        status = b.value(0x1F57, program, 4)?;
        if status & 1 == 0 {
            break;
        }
        b.hear(CobId::NMT, Duration::from_millis(20))?;
    }
    Ok(status)
}

/// Skips the checks of this group in a device that is no bootloader by these documents.
pub(super) fn is_bootloader(b: &mut Bench<'_>) -> Result<(), Stop> {
    need!(b.value(0x1000, 0, 4)? == BOOTLOADER, "1000h is not 10000000h: no bootloader, or its program runs");
    super::objects::has(b, 0x1F57, 0)
}

/// Expects that 1F56h/1 is afterwards what it was.
fn unchanged(b: &mut Bench<'_>, step: impl FnOnce(&mut Bench<'_>) -> Result<(), Stop>) -> Result<(), Stop> {
    let before = b.value(0x1F56, 1, 4)?;
    step(b)?;
    match b.value(0x1F56, 1, 4)? {
        after if after == before => Ok(()),
        after => failed(format!("1F56h/1 was {before:08X}h and is {after:08X}h")),
    }
}

fn refuses_length(b: &mut Bench<'_>, data: [u8; 8]) -> Result<(), Stop> {
    let answer = b.ask(data)?;
    match abort_of(&answer) {
        Some(LENGTH | TOO_LONG) => Ok(()),
        Some(code) => failed(format!("abort {code:08X}h in place of 06070010h or 06070012h")),
        None => failed(format!("{:02X}h in place of an abort", answer[0])),
    }
}

/// A block with eight bytes of data, all zero.
fn block(number: u32, address: u32) -> Vec<u8> {
    let mut bytes: Vec<u8> = [number, address, 8, 0, 0].iter().flat_map(|word| word.to_le_bytes()).collect();
    bytes.extend(Crc::<u32>::new(&CRC_32_ISO_HDLC).checksum(&bytes).to_le_bytes());
    bytes
}

/// Downloads a block, which the device has to refuse with this code, perhaps before the last segment.
fn send_block(b: &mut Bench<'_>, block: &[u8], code: u32) -> Result<(), Stop> {
    match download(b, 1, block)? {
        Some(given) if given == code => Ok(()),
        Some(given) => failed(format!("abort {given:08X}h in place of {code:08X}h")),
        None => failed("the block was accepted"),
    }
}

/// Downloads bytes to 1F50h of a program in segments; the abort code if the device refuses them.
pub(super) fn download(b: &mut Bench<'_>, program: u8, bytes: &[u8]) -> Result<Option<u32>, Stop> {
    let initiate = request(0x21, 0x1F50, program, (bytes.len() as u32).to_le_bytes());
    let count = bytes.len().div_ceil(7);
    let segments = bytes.chunks(7).enumerate().map(|(number, part)| {
        let toggle = (number as u8 & 1) << 4;
        let mut data = [0; 8];
        data[0] = toggle | (7 - part.len() as u8) << 1 | u8::from(number + 1 == count);
        data[1..=part.len()].copy_from_slice(part);
        (data, 0x20 | toggle)
    });
    for (data, command) in std::iter::once((initiate, 0x60)).chain(segments) {
        let answer = b.ask(data)?;
        match abort_of(&answer) {
            Some(code) => return Ok(Some(code)),
            None if answer[0] == command => {}
            None => return failed(format!("{:02X}h in place of {command:02X}h", answer[0])),
        }
    }
    Ok(None)
}

/// Block transfer is optional.
fn begin_download(b: &mut Bench<'_>, command: u8, index: u16, size: u32) -> Result<(), Stop> {
    let answer = b.ask(request(command, index, 1, size.to_le_bytes()))?;
    match abort_of(&answer) {
        None if answer[0] & 0xFB == 0xA0 && (1..=127).contains(&answer[4]) => Ok(()),
        Some(COMMAND) => skipped("the device has no block download"),
        _ => failed(format!("the initiate was answered with {answer:02X?}")),
    }
}

/// Begins a block download of so many bytes to 1F51h/1, with CRC.
fn begin_block(b: &mut Bench<'_>, size: u32) -> Result<(), Stop> {
    begin_download(b, 0xC6, 0x1F51, size)
}

/// Downloads the unknown command as one segment, all but the end.
fn one_block(b: &mut Bench<'_>) -> Result<(), Stop> {
    begin_block(b, 1)?;
    let answer = b.takes([0x81, UNKNOWN, 0, 0, 0, 0, 0, 0], 0xA2)?;
    ensure!(answer[1] == 1, "{} is acknowledged", answer[1]);
    Ok(())
}

/// The end of this download; `wrong` alters the CRC.
fn end(wrong: u16) -> [u8; 8] {
    let [low, high] = (Crc::<u16>::new(&CRC_16_XMODEM).checksum(&[UNKNOWN]) ^ wrong).to_le_bytes();
    [0xC1 | 6 << 2, low, high, 0, 0, 0, 0, 0]
}
