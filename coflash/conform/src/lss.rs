//! Checks of layer setting services. None stores anything, and none changes node-ID or bit rate.
//!
//! All devices of a bus answer with the same COB-ID, 7E4h, and the next serial number is often that
//! of the next device. So an answer is judged by the node-ID that the selected device tells (5Eh):
//!
//! | who answers | the check |
//! |---|---|
//! | this device, or a node-ID that nobody has | is failed, if the answer is wrong |
//! | another device, to an altered LSS address | is repeated with another alteration |
//! | another device with the same LSS address, or one that answers in waiting state | is skipped |

use std::time::Duration;

use canopen::nmt::NmtCommand;
use canopen::{CobId, Frame, NodeId};

use super::bench::{failed, need, skipped, Bench, Stop};
use super::check::{Check, Step};
use super::frames::extended;

/// How long an LSS answer may take; CiA 305 leaves the limit to the master.
const LIMIT: Duration = Duration::from_millis(200);

/// The node-ID that a device without node-ID tells.
const NO_NODE: u8 = 0xFF;
/// How fields of the LSS address are altered. The first one is the smallest mistake; another device
/// may have this address, so there are more.
const ALTERATIONS: [u32; 3] = [1, 0x8000_0000, 0x5A5A_5A5A];

const INQUIRY: &str = "CiA 305, LSS inquiry";
const SWITCH: &str = "CiA 305, LSS switch state";
const CONFIGURE: &str = "CiA 305, LSS configuration";
const IDENTIFY: &str = "CiA 305, LSS identification";

/// A check of a device that has layer setting services.
const fn check(id: &'static str, title: &'static str, clause: &'static str, run: Step) -> Check {
    Check::new(id, title, clause, run).needs(has_lss)
}

#[rustfmt::skip]
pub(super) const CHECKS: &[Check] = &[
    check("LSS-001", "inquiry of the node-ID in waiting state is not answered", INQUIRY, waits),
    check("LSS-002", "a device with this identity is selected, and tells its node-ID", SWITCH, |b| {
        select(b)?;
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
    check("LSS-011", "inquiry of the identity in waiting state is not answered", INQUIRY, |b| {
        waits(b)?;
        silent(b, &[0x5A])
    }),
    check("LSS-012", "unknown commands in configuration state are not answered", "CiA 305, LSS protocols", |b| {
        select(b)?;
        [0x00, 0x01, 0x7F, 0xFF].into_iter().try_for_each(|command| silent(b, &[command]))?;
        inquires_node(b)
    }),
    check("LSS-013", "switch state global to waiting ends the configuration state", SWITCH, |b| {
        select(b)?;
        send(b, &[0x04, 0])?;
        waits(b)
    }),
    check("LSS-014", "switch state global to a state that does not exist is ignored", SWITCH, |b| {
        select(b)?;
        send(b, &[0x04, 2])?;
        inquires_node(b)
    }),
    check("LSS-015", "node-ID 0 is refused with error 1", CONFIGURE, |b| refuses(b, &[0x11, 0])),
    check("LSS-016", "node-ID 128 is refused with error 1", CONFIGURE, |b| refuses(b, &[0x11, 128])),
    check("LSS-017", "node-ID 254 is refused with error 1", CONFIGURE, |b| refuses(b, &[0x11, 254])),
    check("LSS-018", "a reserved table of bit timings is refused with error 1", CONFIGURE, |b| refuses(b, &[0x13, 5, 0])),
    check("LSS-019", "a bit timing outside the table is refused with error 1", CONFIGURE, |b| refuses(b, &[0x13, 0, 200])),
    check("LSS-020", "configure node-ID in waiting state is not answered", CONFIGURE, |b| {
        // A device in configuration state would take this node-ID.
        waits(b)?;
        let node = b.node.get();
        silent(b, &[0x11, node])
    }),
    check("LSS-021", "identify remote slave with a range around this device is answered", IDENTIFY, |b| {
        let address = identity(b)?;
        match identify(b, address)?.first() {
            Some([0x4F, ..]) => Ok(()),
            None => skipped("the device has no identification by ranges; fastscan finds it"),
            Some(answer) => failed(format!("answered with {answer:02X?}")),
        }
    }),
    check("LSS-022", "identify remote slave with another serial number is not answered", IDENTIFY, |b| {
        for alteration in ALTERATIONS {
            let address = altered(b, 3, alteration)?;
            match identify(b, address)?.first() {
                None => return Ok(()),
                Some(_) if holders(b, address)?.others.is_empty() => {
                    return failed("the device answers to another serial number")
                }
                // Another device has this address.
                Some(_) => {}
            }
        }
        skipped("other devices have the altered LSS addresses")
    }),
    check("LSS-023", "fastscan with the identity of a device that has a node-ID is not answered", "CiA 305, LSS fastscan", |b| {
        let identity = identity(b)?;
        // The answers to these may come from devices without node-ID.
        ask_all(b, &[0x51, 0, 0, 0, 0, 0x80, 0, 0])?;
        for (field, value) in (0..3).zip(identity) {
            ask_all(b, &fastscan(value, field, field + 1))?;
        }
        // The serial number makes the identity that of this device alone.
        match ask(b, &fastscan(identity[3], 3, 0))? {
            None => Ok(()),
            Some(answer) => failed(format!("answered with {answer:02X?}")),
        }
    }),
    check("LSS-024", "a 29-bit inquiry in configuration state is not answered", "CiA 305, LSS protocols", |b| {
        select(b)?;
        let frame = extended(CobId::LSS_REQUEST, &padded(&[0x5E]))?;
        b.ignores(&frame, CobId::LSS_RESPONSE)
    }),
    check("LSS-025", "inquiries of 1 to 7 bytes in configuration state are not answered", "CiA 305, LSS protocols", |b| {
        select(b)?;
        (1..=7).try_for_each(|len| {
            b.ignores(&Frame::of(CobId::LSS_REQUEST, &padded(&[0x5E])[..len]), CobId::LSS_RESPONSE)
        })
    }),
    check("LSS-026", "after reset communication the device is in waiting state", "CiA 305, LSS state machine", |b| {
        select(b)?;
        super::network::boots(b, NmtCommand::ResetCommunication)?;
        waits(b)
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

fn send(b: &mut Bench<'_>, data: &[u8]) -> Result<(), Stop> {
    b.send(&Frame::full(CobId::LSS_REQUEST, padded(data)))
}

fn ask(b: &mut Bench<'_>, data: &[u8]) -> Result<Option<[u8; 8]>, Stop> {
    send(b, data)?;
    Ok(b.hear(CobId::LSS_RESPONSE, LIMIT)?.and_then(|frame| frame.exactly().copied()))
}

/// The answers of all devices.
fn ask_all(b: &mut Bench<'_>, data: &[u8]) -> Result<Vec<[u8; 8]>, Stop> {
    send(b, data)?;
    let frames = b.hear_all(CobId::LSS_RESPONSE, LIMIT)?;
    Ok(frames.iter().filter_map(|frame| frame.exactly().copied()).collect())
}

fn silent(b: &mut Bench<'_>, data: &[u8]) -> Result<(), Stop> {
    b.ignores(&Frame::full(CobId::LSS_REQUEST, padded(data)), CobId::LSS_RESPONSE)
}

/// The LSS address: 1018h/1 to 4.
fn identity(b: &mut Bench<'_>) -> Result<[u32; 4], Stop> {
    need!(b.value(0x1018, 0, 1)? >= 4, "1018h has no serial number");
    Ok([b.value(0x1018, 1, 4)?, b.value(0x1018, 2, 4)?, b.value(0x1018, 3, 4)?, b.value(0x1018, 4, 4)?])
}

/// The LSS address of the device with a field altered.
fn altered(b: &mut Bench<'_>, field: usize, alteration: u32) -> Result<[u32; 4], Stop> {
    let mut address = identity(b)?;
    address[field] ^= alteration;
    Ok(address)
}

/// The four frames of switch state selective.
fn switch(address: [u32; 4]) -> [[u8; 5]; 4] {
    std::array::from_fn(|field| {
        let [a, c, d, e] = address[field].to_le_bytes();
        [0x40 + field as u8, a, c, d, e]
    })
}

/// Switches the devices with this LSS address to configuration state; returns their answers.
fn switch_all(b: &mut Bench<'_>, address: [u32; 4]) -> Result<Vec<[u8; 8]>, Stop> {
    let [vendor, product, revision, serial] = switch(address);
    [vendor, product, revision].iter().try_for_each(|frame| send(b, frame))?;
    ask_all(b, &serial)
}

/// Who is in configuration state.
#[derive(Default)]
struct Holders {
    /// The device that is checked.
    this: bool,
    /// The node-IDs of other devices.
    others: Vec<u8>,
}

/// Asks all devices in configuration state for their node-ID. They may be in waiting state
/// afterwards.
fn configured(b: &mut Bench<'_>) -> Result<Holders, Stop> {
    let mut holders = Holders::default();
    for answer in ask_all(b, &[0x5E])? {
        match answer {
            [0x5E, id, ..] if is_other(b, id)? => holders.others.push(id),
            // A wrong answer is this device's.
            _ => holders.this = true,
        }
    }
    Ok(holders)
}

/// The devices that are selected by this LSS address. Leaves them in waiting state.
fn holders(b: &mut Bench<'_>, address: [u32; 4]) -> Result<Holders, Stop> {
    switch_all(b, address)?;
    let holders = configured(b)?;
    send(b, &[0x04, 0])?;
    Ok(holders)
}

/// Whether another device of the bus has this node-ID.
fn is_other(b: &mut Bench<'_>, id: u8) -> Result<bool, Stop> {
    match NodeId::new(id) {
        Some(node) => Ok(node != b.node && b.reaches(node)?),
        // LSS identify non-configured remote slave, in waiting state.
        None if id == NO_NODE => {
            send(b, &[0x04, 0])?;
            Ok(ask_all(b, &[0x4C])?.iter().any(|answer| answer[0] == 0x50))
        }
        None => Ok(false),
    }
}

fn named(others: &[u8]) -> String {
    let name = |id: &u8| match *id {
        NO_NODE => "a device without node-ID".to_string(),
        id => format!("node {id}"),
    };
    others.iter().map(name).collect::<Vec<_>>().join(" and ")
}

fn has_lss(b: &mut Bench<'_>) -> Result<(), Stop> {
    let judged = match b.lss.clone() {
        Some(judged) => judged,
        None => {
            let judged = can_be_judged(b)?;
            b.lss.insert(judged).clone()
        }
    };
    match judged {
        Ok(()) => send(b, &[0x04, 0]),
        Err(why) => skipped(why),
    }
}

/// Whether the answers of this device can be told from those of others, or why not.
fn can_be_judged(b: &mut Bench<'_>) -> Result<Result<(), String>, Stop> {
    let address = identity(b)?;
    let others = configured(b)?.others;
    if !others.is_empty() {
        let others = named(&others);
        return Ok(Err(format!("{others} answers in LSS waiting state: take it off the bus")));
    }
    if switch_all(b, address)?.is_empty() {
        return Ok(Err("the device does not answer to LSS".to_string()));
    }
    let Holders { this, others } = configured(b)?;
    Ok(match (this, others.as_slice()) {
        (_, []) => Ok(()),
        (true, others) => {
            Err(format!("{} has the same LSS address, 1018h/1 to 4: take it off the bus", named(others)))
        }
        (false, others) => Err(format!(
            "the device does not answer to LSS; {}, with the same LSS address, does",
            named(others)
        )),
    })
}

/// Expects that the device is in waiting state.
fn waits(b: &mut Bench<'_>) -> Result<(), Stop> {
    match configured(b)? {
        Holders { this: true, .. } => failed("the inquiry of the node-ID was answered"),
        Holders { others, .. } if others.is_empty() => b.works(),
        Holders { others, .. } => skipped(format!("{} answers in LSS waiting state", named(&others))),
    }
}

fn select(b: &mut Bench<'_>) -> Result<(), Stop> {
    let [vendor, product, revision, serial] = switch(identity(b)?);
    [vendor, product, revision].iter().try_for_each(|frame| send(b, frame))?;
    match ask(b, &serial)? {
        Some([0x44, ..]) => Ok(()),
        other => failed(format!("the switch was answered with {other:02X?}")),
    }
}

fn selects_nothing(b: &mut Bench<'_>, field: usize) -> Result<(), Stop> {
    for alteration in ALTERATIONS {
        let address = altered(b, field, alteration)?;
        let answers = switch_all(b, address)?;
        let holders = configured(b)?;
        if holders.this || (holders.others.is_empty() && !answers.is_empty()) {
            return failed("the device answers to another identity");
        }
        if holders.others.is_empty() {
            return b.works();
        }
        // Another device has this address.
        send(b, &[0x04, 0])?;
    }
    skipped("other devices have the altered LSS addresses")
}

fn inquires_node(b: &mut Bench<'_>) -> Result<(), Stop> {
    match ask(b, &[0x5E])? {
        Some([0x5E, id, ..]) if id == b.node.get() => Ok(()),
        other => failed(format!("the inquiry was answered with {other:02X?}")),
    }
}

fn inquires(b: &mut Bench<'_>, field: u8) -> Result<(), Stop> {
    let [x, y, z, w] = identity(b)?[usize::from(field)].to_le_bytes();
    select(b)?;
    match ask(b, &[0x5A + field])? {
        Some([command, rest @ ..]) if command == 0x5A + field && rest[..4] == [x, y, z, w] => Ok(()),
        other => failed(format!("the inquiry was answered with {other:02X?}")),
    }
}

fn refuses(b: &mut Bench<'_>, data: &[u8]) -> Result<(), Stop> {
    select(b)?;
    match ask(b, data)? {
        Some([command, 1, ..]) if command == data[0] => inquires_node(b),
        other => failed(format!("answered with {other:02X?}")),
    }
}

/// Identify remote slave, with ranges that contain this LSS address alone.
fn identify(b: &mut Bench<'_>, address: [u32; 4]) -> Result<Vec<[u8; 8]>, Stop> {
    let [vendor, product, revision, serial] = address;
    for (command, value) in (0x46_u8..).zip([vendor, product, revision, revision, serial]) {
        let [a, c, d, e] = value.to_le_bytes();
        send(b, &[command, a, c, d, e])?;
    }
    let [a, c, d, e] = serial.to_le_bytes();
    ask_all(b, &[0x4B, a, c, d, e])
}
