//! Checks of layer setting services. None stores anything, and none changes node-ID or bit rate.

use std::time::Duration;

use canopen::nmt::NmtCommand;
use canopen::{CobId, Frame};

use super::bench::{failed, skipped, Bench, Stop};
use super::check::Check;
use super::frames::extended;

/// How long an LSS answer may take; CiA 305 leaves the limit to the master.
const LIMIT: Duration = Duration::from_millis(200);

const INQUIRY: &str = "CiA 305, LSS inquiry";
const SWITCH: &str = "CiA 305, LSS switch state";
const CONFIGURE: &str = "CiA 305, LSS configuration";
const IDENTIFY: &str = "CiA 305, LSS identification";

/// A check of a device that has layer setting services.
const fn check(
    id: &'static str,
    title: &'static str,
    clause: &'static str,
    run: fn(&mut Bench<'_>) -> Result<(), Stop>,
) -> Check {
    Check::new(id, title, clause, run).needs(has_lss)
}

#[rustfmt::skip]
pub(super) const CHECKS: &[Check] = &[
    check("LSS-001", "inquiry of the node-ID in waiting state is not answered", INQUIRY, |b| silent(b, &[0x5E])),
    check("LSS-002", "a device with this identity is selected, and tells its node-ID", SWITCH, |b| {
        select(b, None)?;
        inquires_node(b)
    }),
    check("LSS-003", "a wrong serial number selects nothing", SWITCH, |b| selects_nothing(b, 3)),
    check("LSS-004", "a wrong vendor-ID selects nothing", SWITCH, |b| selects_nothing(b, 0)),
    check("LSS-005", "a wrong product code selects nothing", SWITCH, |b| selects_nothing(b, 1)),
    check("LSS-006", "a wrong revision selects nothing", SWITCH, |b| selects_nothing(b, 2)),
    check("LSS-007", "the inquiry of the vendor-ID tells 1018h/1", INQUIRY, |b| inquires(b, 0)),
    check("LSS-008", "the inquiry of the product code tells 1018h/2", INQUIRY, |b| inquires(b, 1)),
    check("LSS-009", "the inquiry of the revision tells 1018h/3", INQUIRY, |b| inquires(b, 2)),
    check("LSS-010", "the inquiry of the serial number tells 1018h/4", INQUIRY, |b| inquires(b, 3)),
    check("LSS-011", "inquiry of the identity in waiting state is not answered", INQUIRY, |b| silent(b, &[0x5A])),
    check("LSS-012", "unknown commands in configuration state are not answered", "CiA 305, LSS protocols", |b| {
        select(b, None)?;
        [0x00, 0x01, 0x7F, 0xFF].into_iter().try_for_each(|command| silent(b, &[command]))?;
        inquires_node(b)
    }),
    check("LSS-013", "switch state global to waiting ends the configuration state", SWITCH, |b| {
        select(b, None)?;
        tell(b, &[0x04, 0])?;
        silent(b, &[0x5E])
    }),
    check("LSS-014", "switch state global to a state that does not exist is ignored", SWITCH, |b| {
        select(b, None)?;
        tell(b, &[0x04, 2])?;
        inquires_node(b)
    }),
    check("LSS-015", "node-ID 0 is refused with error 1", CONFIGURE, |b| refuses(b, &[0x11, 0])),
    check("LSS-016", "node-ID 128 is refused with error 1", CONFIGURE, |b| refuses(b, &[0x11, 128])),
    check("LSS-017", "node-ID 254 is refused with error 1", CONFIGURE, |b| refuses(b, &[0x11, 254])),
    check("LSS-018", "a reserved table of bit timings is refused with error 1", CONFIGURE, |b| refuses(b, &[0x13, 5, 0])),
    check("LSS-019", "a bit timing outside the table is refused with error 1", CONFIGURE, |b| refuses(b, &[0x13, 0, 200])),
    check("LSS-020", "configure node-ID in waiting state is not answered", CONFIGURE, |b| {
        let node = b.node.get();
        silent(b, &[0x11, node])
    }),
    check("LSS-021", "identify remote slave with a range around this device is answered", IDENTIFY, |b| {
        match identify(b, 0)? {
            Some([0x4F, ..]) => Ok(()),
            other => failed(format!("answered with {other:02X?}")),
        }
    }),
    check("LSS-022", "identify remote slave with another serial number is not answered", IDENTIFY, |b| {
        match identify(b, 1)? {
            None => Ok(()),
            Some(answer) => failed(format!("answered with {answer:02X?}")),
        }
    }),
    check("LSS-023", "fastscan with the identity of a device that has a node-ID is not answered", "CiA 305, LSS fastscan", |b| {
        let identity = identity(b)?;
        // The answers to these may come from a device without node-ID.
        ask(b, &[0x51, 0, 0, 0, 0, 0x80, 0, 0])?;
        for (field, value) in (0..3).zip(identity) {
            ask(b, &fastscan(value, field, field + 1))?;
        }
        // The serial number makes the identity that of this device alone.
        match ask(b, &fastscan(identity[3], 3, 0))? {
            None => Ok(()),
            Some(answer) => failed(format!("answered with {answer:02X?}")),
        }
    }),
    check("LSS-024", "a 29-bit inquiry in configuration state is not answered", "CiA 305, LSS protocols", |b| {
        select(b, None)?;
        let frame = extended(CobId::LSS_REQUEST, &padded(&[0x5E]))?;
        b.ignores(&frame, CobId::LSS_RESPONSE)
    }),
    check("LSS-025", "inquiries of 1 to 7 bytes in configuration state are not answered", "CiA 305, LSS protocols", |b| {
        select(b, None)?;
        (1..=7).try_for_each(|len| {
            b.ignores(&Frame::of(CobId::LSS_REQUEST, &padded(&[0x5E])[..len]), CobId::LSS_RESPONSE)
        })
    }),
    check("LSS-026", "after reset communication the device is in waiting state", "CiA 305, LSS state machine", |b| {
        select(b, None)?;
        super::network::boots(b, NmtCommand::ResetCommunication)?;
        silent(b, &[0x5E])
    })
    .that_resets(),
];

fn padded(data: &[u8]) -> [u8; 8] {
    let mut all = [0; 8];
    all[..data.len()].copy_from_slice(data);
    all
}

fn fastscan(value: u32, field: u8, next: u8) -> [u8; 8] {
    let [a, b, c, d] = value.to_le_bytes();
    [0x51, a, b, c, d, 0, field, next]
}

fn tell(b: &mut Bench<'_>, data: &[u8]) -> Result<(), Stop> {
    b.send(&Frame::full(CobId::LSS_REQUEST, padded(data)))
}

fn ask(b: &mut Bench<'_>, data: &[u8]) -> Result<Option<[u8; 8]>, Stop> {
    tell(b, data)?;
    Ok(b.hear(CobId::LSS_RESPONSE, LIMIT)?.and_then(|frame| frame.exactly().copied()))
}

fn silent(b: &mut Bench<'_>, data: &[u8]) -> Result<(), Stop> {
    b.ignores(&Frame::full(CobId::LSS_REQUEST, padded(data)), CobId::LSS_RESPONSE)
}

/// The LSS address: 1018h/1 to 4.
fn identity(b: &mut Bench<'_>) -> Result<[u32; 4], Stop> {
    if b.value(0x1018, 0, 1)? < 4 {
        return skipped("1018h has no serial number");
    }
    Ok([b.value(0x1018, 1, 4)?, b.value(0x1018, 2, 4)?, b.value(0x1018, 3, 4)?, b.value(0x1018, 4, 4)?])
}

/// Sends the four frames of switch state selective. The numbered field is altered in one bit.
fn switch(b: &mut Bench<'_>, altered: Option<usize>) -> Result<Option<[u8; 8]>, Stop> {
    let mut answer = None;
    for (field, (command, value)) in (0x40_u8..).zip(identity(b)?).enumerate() {
        let [a, c, d, e] = if altered == Some(field) { value ^ 1 } else { value }.to_le_bytes();
        let frame = [command, a, c, d, e];
        if field < 3 {
            tell(b, &frame)?;
        } else {
            answer = ask(b, &frame)?;
        }
    }
    Ok(answer)
}

fn has_lss(b: &mut Bench<'_>) -> Result<(), Stop> {
    if switch(b, None)?.is_none() {
        return skipped("the device does not answer to LSS");
    }
    tell(b, &[0x04, 0])
}

fn select(b: &mut Bench<'_>, altered: Option<usize>) -> Result<(), Stop> {
    match switch(b, altered)? {
        Some([0x44, ..]) => Ok(()),
        other => failed(format!("the switch was answered with {other:02X?}")),
    }
}

fn selects_nothing(b: &mut Bench<'_>, altered: usize) -> Result<(), Stop> {
    match switch(b, Some(altered))? {
        None => silent(b, &[0x5E]),
        Some(_) => failed("the device answers to another identity"),
    }
}

fn inquires_node(b: &mut Bench<'_>) -> Result<(), Stop> {
    match ask(b, &[0x5E])? {
        Some([0x5E, id, ..]) if id == b.node.get() => Ok(()),
        other => failed(format!("the inquiry was answered with {other:02X?}")),
    }
}

fn inquires(b: &mut Bench<'_>, field: u8) -> Result<(), Stop> {
    let [x, y, z, w] = identity(b)?[usize::from(field)].to_le_bytes();
    select(b, None)?;
    match ask(b, &[0x5A + field])? {
        Some([command, rest @ ..]) if command == 0x5A + field && rest[..4] == [x, y, z, w] => Ok(()),
        other => failed(format!("the inquiry was answered with {other:02X?}")),
    }
}

fn refuses(b: &mut Bench<'_>, data: &[u8]) -> Result<(), Stop> {
    select(b, None)?;
    match ask(b, data)? {
        Some([command, 1, ..]) if command == data[0] => inquires_node(b),
        other => failed(format!("answered with {other:02X?}")),
    }
}

/// Identify remote slave, with `off` added to the serial number.
fn identify(b: &mut Bench<'_>, off: u32) -> Result<Option<[u8; 8]>, Stop> {
    let [vendor, product, revision, serial] = identity(b)?;
    let serial = serial.wrapping_add(off);
    for (command, value) in (0x46_u8..).zip([vendor, product, revision, revision, serial]) {
        let [a, c, d, e] = value.to_le_bytes();
        tell(b, &[command, a, c, d, e])?;
    }
    let [a, c, d, e] = serial.to_le_bytes();
    ask(b, &[0x4B, a, c, d, e])
}
