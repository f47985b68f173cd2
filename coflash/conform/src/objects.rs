//! Checks of the objects that describe the device, and of emergencies.

use canopen::CobId;

use super::bench::{abort_of, ensure, failed, request, skipped, Bench, Stop};
use super::check::{Check, Run};
use super::sdo::{text, INVALID, NO_DATA, NO_OBJECT, NO_SUB_INDEX, READ_ONLY};

const IDENTITY: &str = "CiA 301 4.2, object 1018h";
const ERRORS: &str = "CiA 301 4.2, object 1003h";

/// An object that is read by expedited upload, with its number of bytes.
const fn number(id: &'static str, title: &'static str, clause: &'static str, index: u16, len: u8) -> Check {
    Check::of(id, title, clause, Run::Number(index, 0, len))
}

pub(super) const CHECKS: &[Check] = &[
    number("OD-001", "device type, 1000h, is 4 bytes, expedited", "CiA 301 4.2, object 1000h", 0x1000, 4),
    number("OD-002", "error register, 1001h, is 1 byte, expedited", "CiA 301 4.2, object 1001h", 0x1001, 1),
    Check::new("OD-003", "1018h/0 is 1 to 4", IDENTITY, |b| match b.value(0x1018, 0, 1)? {
        1..=4 => Ok(()),
        other => failed(format!("1018h/0 is {other}")),
    }),
    Check::of("OD-004", "vendor-ID, 1018h/1, is 4 bytes", IDENTITY, Run::Number(0x1018, 1, 4)),
    Check::new("OD-005", "every sub-index up to 1018h/0 can be read", IDENTITY, |b| {
        let highest = b.value(0x1018, 0, 1)?.min(4) as u8;
        (1..=highest).try_for_each(|sub| b.value(0x1018, sub, 4).map(drop))
    }),
    Check::new("OD-006", "the same value is read twice from 1018h/1", IDENTITY, |b| {
        let (first, second) = (b.value(0x1018, 1, 4)?, b.value(0x1018, 1, 4)?);
        ensure!(first == second, "{first:08X}h, then {second:08X}h");
        Ok(())
    }),
    number("OD-007", "producer heartbeat time, 1017h, is 2 bytes", "CiA 301 4.2, object 1017h", 0x1017, 2)
        .needs(|b| has(b, 0x1017, 0)),
    Check::new("OD-008", "device name, 1008h, is printable text", "CiA 301 4.2, object 1008h", |b| {
        printable(b, 0x1008)
    }),
    Check::new("OD-009", "hardware version, 1009h, is printable text", "CiA 301 4.2, object 1009h", |b| {
        printable(b, 0x1009)
    }),
    Check::new("OD-010", "software version, 100Ah, is printable text", "CiA 301 4.2, object 100Ah", |b| {
        printable(b, 0x100A)
    }),
    Check::new(
        "EMCY-001",
        "1014h is valid and tells 80h + node-ID",
        "CiA 301 4.2, object 1014h",
        |b| match b.value(0x1014, 0, 4)? {
            id if id & 0x8000_0000 != 0 => skipped("1014h says that there are no emergencies"),
            id if id == u32::from(CobId::emcy(b.node).get()) => Ok(()),
            id => failed(format!("1014h is {id:08X}h")),
        },
    )
    .needs(|b| has(b, 0x1014, 0)),
    number("EMCY-002", "number of errors, 1003h/0, is 1 byte", ERRORS, 0x1003, 1)
        .needs(|b| has(b, 0x1003, 0)),
    Check::of(
        "EMCY-003",
        "download of 1 to 1003h/0: 06090030h",
        ERRORS,
        Run::Refused(request(0x2F, 0x1003, 0, [1, 0, 0, 0]), INVALID),
    )
    .needs(|b| has(b, 0x1003, 0)),
    Check::new("EMCY-004", "as many errors can be read as 1003h/0 tells, and no more", ERRORS, |b| {
        let count = b.value(0x1003, 0, 1)?.min(254) as u8;
        (1..=count).try_for_each(|sub| b.value(0x1003, sub, 4).map(drop))?;
        let answer = b.ask(request(0x40, 0x1003, count.saturating_add(1), [0; 4]))?;
        match abort_of(&answer) {
            Some(NO_DATA | NO_SUB_INDEX) => Ok(()),
            Some(code) => failed(format!("abort {code:08X}h for the entry after the last")),
            None if answer[4..] == [0; 4] => Ok(()),
            None => failed("there is an entry more than 1003h/0 tells"),
        }
    })
    .needs(|b| has(b, 0x1003, 0)),
    Check::of(
        "EMCY-005",
        "download to 1003h/1: 06010002h",
        ERRORS,
        Run::Refused(request(0x23, 0x1003, 1, [0; 4]), READ_ONLY),
    )
    .needs(|b| has(b, 0x1003, 0)),
];

/// Skips a check of an optional object that the device has not.
pub(super) fn has(b: &mut Bench<'_>, index: u16, sub: u8) -> Result<(), Stop> {
    let answer = b.ask(request(0x40, index, sub, [0; 4]))?;
    match abort_of(&answer) {
        Some(NO_OBJECT) => skipped(format!("the device has no {index:04X}h")),
        _ => Ok(()),
    }
}

fn printable(b: &mut Bench<'_>, index: u16) -> Result<(), Stop> {
    has(b, index, 0)?;
    let text = text(b, index)?;
    ensure!(text.iter().all(|byte| (0x20..0x7F).contains(byte)), "{index:04X}h is {text:02X?}");
    Ok(())
}
