//! Checks of boot-up, heartbeat and network management.

use std::time::Duration;

use canopen::nmt::{NmtCommand, NmtState};
use canopen::{CobId, Frame};

use super::bench::{abort_of, failed, need, request, skipped, Bench, Stop};
use super::check::Check;
use super::frames::{no_boot_up, REACTION};

/// How long a device may take to start. The standard sets no limit.
const START: Duration = Duration::from_secs(10);
/// The longest heartbeat time that a check waits for.
const LONGEST: u32 = 5000;

const BOOT_UP: &str = "CiA 301 4.2, boot-up protocol";
const HEARTBEAT: &str = "CiA 301 4.2, heartbeat protocol";
const NMT: &str = "CiA 301 4.2, NMT protocols";

#[rustfmt::skip]
pub(super) const CHECKS: &[Check] = &[
    Check::new("BOOT-001", "boot-up message after reset communication", BOOT_UP, |b| {
        boots(b, NmtCommand::ResetCommunication)
    })
    .that_resets(),
    Check::new("BOOT-002", "boot-up message after reset node", BOOT_UP, |b| {
        boots(b, NmtCommand::ResetNode)
    })
    .that_resets(),
    Check::new("BOOT-003", "after the boot-up message, SDO requests are answered", BOOT_UP, |b| {
        boots(b, NmtCommand::ResetCommunication)?;
        b.works()
    })
    .that_resets(),
    Check::new("BOOT-004", "a transfer does not survive reset communication", "CiA 301 4.2, NMT state machine", |b| {
        opens_transfer(b)?;
        boots(b, NmtCommand::ResetCommunication)?;
        b.refuses([0x60, 0, 0, 0, 0, 0, 0, 0], super::sdo::COMMAND)
    })
    .that_resets(),
    Check::new("HB-001", "the heartbeat is one byte and tells pre-operational", HEARTBEAT, |b| {
        reports(b, NmtState::PreOperational)
    }),
    Check::new("HB-002", "five heartbeats in 4 times 1017h, within 25 %", HEARTBEAT, |b| {
        let (id, period) = heartbeat(b)?;
        let due = period * 4;
        // The adapter's clock includes the delays of the host: those do not come each time.
        let mut took = Vec::new();
        for _ in 0..3 {
            next(b, id, period)?;
            let first = b.now();
            for _ in 0..4 {
                next(b, id, period)?;
            }
            let time = b.now().saturating_sub(first);
            if (due * 3 / 4..=due * 5 / 4).contains(&time) {
                return Ok(());
            }
            took.push(time.as_millis());
        }
        failed(format!("{took:?} ms in place of {} ms", due.as_millis()))
    })
    .needs(has_heartbeat_time),
    Check::new("HB-003", "the heartbeat goes on while a transfer is open", HEARTBEAT, |b| {
        let (id, period) = heartbeat(b)?;
        opens_transfer(b)?;
        next(b, id, period)?;
        next(b, id, period).map(drop)
    })
    .needs(has_heartbeat_time),
    Check::new("HB-004", "1017h can be changed, and changed back", "CiA 301 4.2, object 1017h", |b| {
        let time = b.value(0x1017, 0, 2)?;
        let [low, high, ..] = time.to_le_bytes();
        let [other, more, ..] = (time ^ 0x40).to_le_bytes();
        let answer = b.ask(request(0x2B, 0x1017, 0, [other, more, 0, 0]))?;
        match abort_of(&answer) {
            Some(super::sdo::READ_ONLY) => return skipped("1017h is const in this device"),
            Some(code) => return failed(format!("abort {code:08X}h")),
            None => {}
        }
        let changed = b.value(0x1017, 0, 2);
        b.takes(request(0x2B, 0x1017, 0, [low, high, 0, 0]), 0x60)?;
        match changed? {
            value if value == time ^ 0x40 => Ok(()),
            value => failed(format!("1017h reads {value}")),
        }
    })
    .needs(has_heartbeat_time),
    Check::new("HB-005", "a download of 2 bytes more than 1017h has is refused", "CiA 301 4.2, SDO abort transfer", |b| {
        let answer = b.ask(request(0x23, 0x1017, 0, [0; 4]))?;
        match abort_of(&answer) {
            Some(super::sdo::READ_ONLY | 0x0607_0010 | 0x0607_0012) => Ok(()),
            _ => failed(format!("answered with {answer:02X?}")),
        }
    })
    .needs(has_heartbeat_time),
    Check::new("NMT-001", "start: the heartbeat tells operational", NMT, |b| {
        b.send(&NmtCommand::Start.emit(Some(b.node)))?;
        reports(b, NmtState::Operational)
    })
    .needs(has_states),
    Check::new("NMT-002", "stop: the heartbeat tells stopped", NMT, |b| {
        b.send(&NmtCommand::Stop.emit(Some(b.node)))?;
        reports(b, NmtState::Stopped)
    })
    .needs(has_states),
    Check::new("NMT-003", "stopped: no SDO is answered", "CiA 301 4.2, NMT state machine", |b| {
        b.send(&NmtCommand::Stop.emit(Some(b.node)))?;
        let (ask, answer) = (CobId::sdo_request(b.node), CobId::sdo_response(b.node));
        b.send(&Frame::full(ask, request(0x40, 0x1000, 0, [0; 4])))?;
        match b.hear(answer, REACTION)? {
            Some(frame) => failed(format!("answered in stopped state: {frame}")),
            None => Ok(()),
        }
    })
    .needs(has_states),
    Check::new("NMT-004", "reset communication for 80h + node-ID, which nobody has, is not obeyed", NMT, |b| {
        let nobody = 0x80 | b.node.get();
        no_boot_up(b, &Frame::of(CobId::NMT, &[0x82, nobody]))
    }),
    Check::new("NMT-005", "the unknown commands 0, 3, 7Fh, 83h and FFh are not obeyed", NMT, |b| {
        for command in [0, 3, 0x7F, 0x83, 0xFF] {
            let node = b.node.get();
            no_boot_up(b, &Frame::of(CobId::NMT, &[command, node]))?;
        }
        reports(b, NmtState::PreOperational)
    }),
    Check::new("NMT-006", "enter pre-operational is obeyed in operational state", NMT, |b| {
        b.send(&NmtCommand::Start.emit(Some(b.node)))?;
        reports(b, NmtState::Operational)?;
        b.send(&NmtCommand::EnterPreOperational.emit(Some(b.node)))?;
        reports(b, NmtState::PreOperational)
    })
    .needs(has_states),
];

/// 1017h is optional: a device may be guarded by its master.
fn has_heartbeat_time(b: &mut Bench<'_>) -> Result<(), Stop> {
    super::objects::has(b, 0x1017, 0)
}

/// Opens a segmented upload of 1008h.
fn opens_transfer(b: &mut Bench<'_>) -> Result<(), Stop> {
    let answer = b.ask(request(0x40, 0x1008, 0, [0; 4]))?;
    need!(answer[0] & 0xE2 == 0x40, "1008h does not come in segments");
    Ok(())
}

/// A bootloader, by 1000h, has nothing to operate: it may stay in pre-operational state.
fn has_states(b: &mut Bench<'_>) -> Result<(), Stop> {
    need!(b.value(0x1000, 0, 4)? != super::program::BOOTLOADER, "a bootloader stays pre-operational");
    Ok(())
}

pub(super) fn boots(b: &mut Bench<'_>, command: NmtCommand) -> Result<(), Stop> {
    let id = CobId::heartbeat(b.node);
    b.send(&command.emit(Some(b.node)))?;
    let end = b.now() + START;
    // A heartbeat may have been on its way.
    while let Some(frame) = b.hear(id, end.saturating_sub(b.now()))? {
        if frame.exactly() == Some(&[0_u8]) {
            return Ok(());
        }
    }
    failed(format!("no boot-up message within {} s", START.as_secs()))
}

/// The COB-ID and the time of the heartbeat.
fn heartbeat(b: &mut Bench<'_>) -> Result<(CobId, Duration), Stop> {
    match b.value(0x1017, 0, 2)? {
        0 => skipped("1017h is 0: the heartbeat is off"),
        time if time > LONGEST => skipped(format!("1017h is {time} ms")),
        time => Ok((CobId::heartbeat(b.node), Duration::from_millis(time.into()))),
    }
}

fn next(b: &mut Bench<'_>, id: CobId, period: Duration) -> Result<Frame, Stop> {
    match b.hear(id, period * 3)? {
        Some(frame) => Ok(frame),
        None => failed(format!("no heartbeat within 3 times {} ms", period.as_millis())),
    }
}

/// Expects the state in the second heartbeat from now: the first may have been on its way.
fn reports(b: &mut Bench<'_>, state: NmtState) -> Result<(), Stop> {
    let id = CobId::heartbeat(b.node);
    let mut frame = None;
    for _ in 0..2 {
        // 1017h cannot be read in stopped state, so the wait is the longest.
        frame = b.hear(id, Duration::from_millis(LONGEST.into()))?;
    }
    let Some(frame) = frame else { return skipped("the device sends no heartbeat") };
    match frame.exactly::<1>() {
        Some([byte]) if NmtState::from_byte(*byte) == Some(state) => Ok(()),
        _ => failed(format!("the heartbeat is {frame}")),
    }
}
