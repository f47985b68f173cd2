//! The download of a program in one SDO transfer.

use std::time::Duration;

use canopen::program::{self, FlashError};
use canopen::Address;

use super::procedure::Downloaded;
use crate::device::error::absent;
use crate::device::{Doing, Error, Session, Timing, Transfers};
use crate::update::device_after::DeviceState;
use crate::update::event::{Event, RepeatReason, Retry};
use crate::update::judge::{judge, Judgement};
use crate::update::running::RunningUpdate;
use crate::update::steps;

/// A device that takes the whole program in one transfer may erase after any segment: at most 2 s,
/// plus a margin.
const SLOW_SEGMENT: Duration = Duration::from_secs(5);

/// The result in 1F57h: an error and its detail.
pub(super) type Said = Option<(FlashError, u16)>;

/// The data to send, and the dialect's actions around the transfer.
pub(super) struct Whole<'w> {
    /// The program number: the sub-index of 1F50h and 1F57h.
    pub(super) number: u8,
    /// All that is sent.
    pub(super) content: &'w [u8],
    /// The word for it.
    pub(super) doing: Doing,
    /// The action at the start of each attempt.
    pub(super) prepare: &'w dyn Fn(&mut Session<'_>, &mut RunningUpdate<'_>) -> Result<(), Error>,
    /// Reads the device's result of the download.
    pub(super) status: fn(&mut Session<'_>, u8, Doing) -> Result<Said, Error>,
}

/// Steps 4 to 9 in one download of a program; `crcs` are its CRCs, as the device may compute them.
///
/// # Errors
/// The device's refusal.
pub(super) fn download(
    session: &mut Session<'_>,
    whole: &Whole<'_>,
    crcs: [u32; 2],
    update: &mut RunningUpdate<'_>,
) -> Result<Downloaded, Error> {
    let began = session.now();
    let before = steps::told_before(session, whole.number)?;
    update.erases(before);
    let repeats = send(session, whole, update)?;
    let took = session.now().saturating_sub(began);
    update.state = DeviceState::Written;
    // 1F56h is a CRC in bootloaders of this kind; elsewhere it is whatever the manufacturer has
    // chosen.
    if knows_crc(session)? {
        steps::verify(session, whole.number, crcs, &mut |event| update.tell(event))?;
    }
    Ok(Downloaded { repeats, took, released: None, renewal: None })
}

/// Sends it, with the preparation before each attempt; returns the number of repetitions.
///
/// # Errors
/// The device's refusal.
pub(super) fn send(
    session: &mut Session<'_>,
    whole: &Whole<'_>,
    update: &mut RunningUpdate<'_>,
) -> Result<u32, Error> {
    let Whole { number, content, doing, .. } = *whole;
    let at = Address::new(program::PROGRAM_DATA, number);
    let total = content.len();
    let mut repeat = 0;
    loop {
        if let Err(error) = (whole.prepare)(session, update) {
            // A refused password erases nothing, and neither does a refused command.
            if error.is_refusal() || matches!(error, Error::NotInDialect { .. }) {
                update.erases_not();
            }
            return Err(error);
        }
        update.tell(Event::Progress { done: 0, total });
        let slow = Timing { sdo: SLOW_SEGMENT.max(session.timing().sdo), ..*session.timing() };
        let node = session.node();
        let mut long = session.with(node, slow);
        let mut progress = |part: u32| {
            update.wrote |= part > 0;
            update.postponed &= part == 0;
            update.tell(Event::Progress { done: part as usize, total });
        };
        let sent = long.write(at, content, doing, &mut progress);
        let transfers = long.transfers();
        session.transfer_by(transfers);
        // Data without an answer may have arrived.
        update.wrote |= !matches!(sent, Err(Error::Refused { .. }));
        if let Err(error @ (Error::Adapter(_) | Error::Cancelled)) = sent {
            return Err(error);
        }
        let status = (whole.status)(session, number, doing)?;
        let (why, error) = match judge(sent, status, doing) {
            Judgement::Good => return Ok(repeat),
            Judgement::Bad { why, error } => (why, error),
        };
        match why {
            Some(why) if repeat < update.options.repeats => {
                repeat += 1;
                if repeat > 1 && matches!(why, RepeatReason::Broken(_) | RepeatReason::NoAnswer) {
                    session.transfer_by(Transfers::Segments);
                }
                update.tell(Event::Retry(Retry::program(repeat, update.options.repeats, why)));
            }
            _ => return Err(error),
        }
    }
}

/// The result of the download in 1F57h; `None` if the device does not have this object.
pub(super) fn status(session: &mut Session<'_>, number: u8, doing: Doing) -> Result<Said, Error> {
    match session.read(Address::new(program::FLASH_STATUS, number)) {
        Err(Error::Refused { code, .. }) if absent(code) => Ok(None),
        Ok(_) | Err(Error::NoAnswer { .. } | Error::ShortAnswer { .. } | Error::Protocol { .. }) => {
            idle(session, number, doing)
        }
        Err(error) => Err(error),
    }
}

/// The value of 1F57h when it is no longer busy.
pub(super) fn idle(session: &mut Session<'_>, number: u8, doing: Doing) -> Result<Said, Error> {
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
