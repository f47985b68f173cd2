//! The download of a program in one SDO transfer.

use std::time::Duration;

use canopen::program;
use canopen::Address;

use super::procedure::{Downloaded, Procedure};
use crate::device::error::absent;
use crate::device::{Doing, Error, Session, Timing};
use crate::update::device_after::DeviceState;
use crate::update::event::Event;
use crate::update::judge::{judge, DownloadStatus, Repeats};
use crate::update::payload::Payload;
use crate::update::running::RunningUpdate;
use crate::update::steps;

/// A device that takes the whole program in one transfer may erase after any segment: at most 2 s,
/// plus a margin.
const SLOW_SEGMENT: Duration = Duration::from_secs(5);

/// Steps 4 to 9 in one download.
///
/// # Errors
/// The device's refusal.
pub(super) fn download(
    procedure: &(impl Procedure + ?Sized),
    session: &mut Session<'_>,
    file: &Payload,
    update: &mut RunningUpdate<'_>,
) -> Result<Downloaded, Error> {
    let number = update.options.program;
    let began = session.now();
    let before = steps::crc_before(session, number)?;
    update.erases(before);
    let content = file.encoded(update.dialect.form());
    let repeats = send(procedure, session, number, &content, Doing::Program, update)?;
    let took = session.now().saturating_sub(began);
    update.state = DeviceState::Written;
    // 1F56h is a CRC in bootloaders of this kind; elsewhere it is whatever the manufacturer has
    // chosen.
    if knows_crc(session)? {
        steps::verify(session, number, file.crcs(), &mut |event| update.report(event))?;
    }
    Ok(Downloaded { repeats, took, released: None, renewal: None })
}

/// Sends this content to a program, with the preparation before each attempt; returns the number of
/// repetitions.
///
/// # Errors
/// The device's refusal.
pub(super) fn send(
    procedure: &(impl Procedure + ?Sized),
    session: &mut Session<'_>,
    number: u8,
    content: &[u8],
    doing: Doing,
    update: &mut RunningUpdate<'_>,
) -> Result<u32, Error> {
    let at = Address::new(program::PROGRAM_DATA, number);
    let total = content.len();
    let mut repeats = Repeats { block: None, count: 0, of: update.options.repeats };
    loop {
        if let Err(error) = procedure.prepare(session, number, update) {
            // A refused password erases nothing, and neither does a refused command.
            if error.is_refusal() || matches!(error, Error::NotInDialect { .. }) {
                update.erases_not();
            }
            return Err(error);
        }
        update.report(Event::Progress { done: 0, total });
        let slow = Timing { sdo: SLOW_SEGMENT.max(session.timing().sdo), ..*session.timing() };
        let node = session.node();
        let mut long = session.with(node, slow);
        let mut progress = |part: u32| {
            update.wrote |= part > 0;
            update.postponed &= part == 0;
            update.report(Event::Progress { done: part as usize, total });
        };
        let sent = long.write(at, content, doing, &mut progress);
        let transfers = long.transfers();
        session.transfer_by(transfers);
        // Data without an answer may have arrived.
        update.wrote |= !matches!(sent, Err(Error::Refused { .. }));
        if let Err(error @ (Error::Adapter(_) | Error::Cancelled)) = sent {
            return Err(error);
        }
        let status = procedure.status(session, number, doing)?;
        let Err(failure) = judge(sent, status, doing) else { return Ok(repeats.count) };
        update.report(Event::Retry(repeats.again(session, failure)?));
    }
}

/// The result of the download in 1F57h; `None` if the device does not have this object.
pub(super) fn status(session: &mut Session<'_>, number: u8, doing: Doing) -> Result<DownloadStatus, Error> {
    match session.read(Address::new(program::FLASH_STATUS, number)) {
        Err(Error::Refused { code, .. }) if absent(code) => Ok(None),
        Ok(_) | Err(Error::NoAnswer { .. } | Error::ShortAnswer { .. } | Error::Protocol { .. }) => {
            idle(session, number, doing)
        }
        Err(error) => Err(error),
    }
}

/// The value of 1F57h when it is no longer busy.
pub(super) fn idle(session: &mut Session<'_>, number: u8, doing: Doing) -> Result<DownloadStatus, Error> {
    let status = session.await_idle(number, doing)?;
    Ok(status.error.map(|error| (error, status.detail)))
}

/// Whether 1F56h of this bootloader is the CRC of the program, judged by the device type: it is for
/// coboot and SYS TEC.
///
/// # Errors
/// The errors of a [read](Session::read).
fn knows_crc(session: &mut Session<'_>) -> Result<bool, Error> {
    let running = session.device_type()?;
    Ok(running.is_some_and(|running| running.0 == program::BOOTLOADER_DEVICE_TYPE))
}
