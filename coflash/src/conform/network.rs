//! Checks of boot-up, heartbeat, network management and layer setting services.

use std::time::Duration;

use canopen::nmt::{NmtCommand, NmtState};
use canopen::{CobId, Frame};

use super::bench::{failed, request, skipped, Bench, Stop};
use super::Check;

/// How long a device may take to start. The standard sets no limit.
const START: Duration = Duration::from_secs(10);
/// The longest heartbeat time that a check waits for.
const LONGEST: u32 = 5000;
/// How long an LSS answer may take; CiA 305 leaves the limit to the master.
const LSS: Duration = Duration::from_millis(200);

pub(super) const CHECKS: &[Check] = &[
    Check::new("BOOT-001", "boot-up message after reset communication", "CiA 301, 7.3.2.2.3", |b| {
        boots(b, NmtCommand::ResetCommunication)
    })
    .that_resets(),
    Check::new("BOOT-002", "boot-up message after reset node", "CiA 301, 7.3.2.2.3", |b| {
        boots(b, NmtCommand::ResetNode)
    })
    .that_resets(),
    Check::new(
        "HB-001",
        "the heartbeat is one byte and tells pre-operational",
        "CiA 301, 7.2.8.3.2.2",
        |b| tells(b, NmtState::PreOperational),
    ),
    Check::new("HB-002", "five heartbeats in 4 times 1017h, within 25 %", "CiA 301, 7.2.8.3.2.2", |b| {
        let (id, period) = heartbeat(b)?;
        next(b, id, period)?;
        let first = b.now();
        for _ in 0..4 {
            next(b, id, period)?;
        }
        let (took, due) = (b.now().saturating_sub(first), period * 4);
        if took > due * 5 / 4 {
            // A slow host cannot be told from a slow device without time stamps of the adapter.
            return skipped(format!(
                "{} ms in place of {} ms by this host's clock",
                took.as_millis(),
                due.as_millis()
            ));
        }
        if took < due * 3 / 4 {
            failed(format!("{} ms in place of {}", took.as_millis(), due.as_millis()))
        } else {
            Ok(())
        }
    }),
    Check::new("NMT-001", "start: the heartbeat tells operational", "CiA 301, 7.3.2.2.1", |b| {
        b.send(&NmtCommand::Start.emit(Some(b.node)))?;
        tells(b, NmtState::Operational)
    }),
    Check::new("NMT-002", "stop: the heartbeat tells stopped", "CiA 301, 7.3.2.2.1", |b| {
        b.send(&NmtCommand::Stop.emit(Some(b.node)))?;
        tells(b, NmtState::Stopped)
    }),
    Check::new("NMT-003", "stopped: no SDO is answered", "CiA 301, 7.3.2.2.4", |b| {
        b.send(&NmtCommand::Stop.emit(Some(b.node)))?;
        let (ask, answer) = (CobId::sdo_request(b.node), CobId::sdo_response(b.node));
        b.send(&Frame::full(ask, request(0x40, 0x1000, 0, [0; 4])))?;
        match b.hear(answer, LSS)? {
            Some(frame) => failed(format!("answered in stopped state: {frame}")),
            None => Ok(()),
        }
    }),
    Check::new("NMT-004", "a command for another node-ID is not obeyed", "CiA 301, 7.2.8.3.1.1", |b| {
        b.send(&Frame::of(CobId::NMT, &[1, b.node.get() ^ 0x40]))?;
        tells(b, NmtState::PreOperational)
    }),
    Check::new("NMT-005", "an unknown command is not obeyed", "CiA 301, 7.2.8.3.1.1", |b| {
        b.send(&Frame::of(CobId::NMT, &[3, b.node.get()]))?;
        tells(b, NmtState::PreOperational)
    }),
    Check::new(
        "LSS-001",
        "inquiry of the node-ID in waiting state is not answered",
        "CiA 305, LSS inquiry",
        |b| b.ignores(&Frame::full(CobId::LSS_REQUEST, [0x5E, 0, 0, 0, 0, 0, 0, 0]), CobId::LSS_RESPONSE),
    ),
    Check::new(
        "LSS-002",
        "a device with this identity is selected, and tells its node-ID",
        "CiA 305, LSS switch",
        |b| {
            select(b, 0)?;
            match lss(b, [0x5E, 0, 0, 0, 0, 0, 0, 0])? {
                Some([0x5E, id, ..]) if id == b.node.get() => Ok(()),
                other => failed(format!("the inquiry was answered with {other:02X?}")),
            }
        },
    ),
    Check::new("LSS-003", "a wrong serial number selects nothing", "CiA 305, LSS switch", |b| {
        select(b, 0)?;
        lss(b, [4, 0, 0, 0, 0, 0, 0, 0])?;
        match select(b, 1) {
            Err(Stop::Skipped(_)) => Ok(()),
            Ok(()) => failed("the device answers to another serial number"),
            Err(stop) => Err(stop),
        }
    }),
];

fn boots(b: &mut Bench<'_>, command: NmtCommand) -> Result<(), Stop> {
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
fn tells(b: &mut Bench<'_>, state: NmtState) -> Result<(), Stop> {
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

fn lss(b: &mut Bench<'_>, data: [u8; 8]) -> Result<Option<[u8; 8]>, Stop> {
    b.send(&Frame::full(CobId::LSS_REQUEST, data))?;
    Ok(b.hear(CobId::LSS_RESPONSE, LSS)?.and_then(|frame| frame.exactly().copied()))
}

/// Selects the device by its identity, with `off` added to the serial number.
fn select(b: &mut Bench<'_>, off: u32) -> Result<(), Stop> {
    if b.value(0x1018, 0, 1)? < 4 {
        return skipped("1018h has no serial number");
    }
    for (sub, command) in [(1, 0x40), (2, 0x41), (3, 0x42), (4, 0x43)] {
        let value = b.value(0x1018, sub, 4)?.wrapping_add(if sub == 4 { off } else { 0 });
        let [a, c, d, e] = value.to_le_bytes();
        let frame = [command, a, c, d, e, 0, 0, 0];
        if sub < 4 {
            b.send(&Frame::full(CobId::LSS_REQUEST, frame))?;
        } else if lss(b, frame)?.is_none_or(|answer| answer[0] != 0x44) {
            return skipped("the device does not answer to LSS");
        }
    }
    Ok(())
}
