//! The watch over a program that has just started: a program may answer once and die a moment later, by a
//! panic or by a watchdog that it does not feed.

use std::time::Duration;

use canopen::program::DEVICE_TYPE;
use canopen::Address;
use shared_abi::handoff::ResetCause;

use super::options::FlashOptions;
use crate::device::error::{Ended, Error};
use crate::device::read_state::{program_watchdog, state_after_failure};
use crate::device::state::BootloaderState;
use crate::device::{DeviceType, Dialect, Session};

/// How long a program is watched at least.
const WATCH: Duration = Duration::from_secs(1);

/// How long the program will be watched: as asked for; otherwise a second, or twice the time of the
/// watchdog that the bootloader starts for it. The device must be in its bootloader.
///
/// # Errors
/// Those of a [read](Session::read).
pub(super) fn time(
    session: &mut Session<'_>,
    dialect: Dialect,
    options: &FlashOptions,
) -> Result<Duration, Error> {
    match options.watch {
        Some(time) => Ok(time),
        None if dialect == Dialect::Block => {
            Ok(program_watchdog(session)?.map_or(WATCH, |watchdog| WATCH.max(2 * watchdog)))
        }
        None => Ok(WATCH),
    }
}

/// Watches the program that was started at `began`, for `time` from its first frame on: a second boot-up
/// message, an emergency 6000h or the bootloader's device type shows that it has ended.
///
/// # Errors
/// [`Error::ProgramEnded`], [`Error::FellSilent`] for a device that is silent at the end, and the errors of a
/// [read](Session::read).
pub(super) fn watch(session: &mut Session<'_>, began: Duration, time: Duration) -> Result<(), Error> {
    if time.is_zero() {
        return Ok(());
    }
    let node = session.node();
    let first = session.booted_since(began).unwrap_or_else(|| session.now());
    let left = (first + time).saturating_sub(session.now());
    let has_ended = session.await_end(first, left)?;
    let ran = session.now().saturating_sub(first);
    match answering(session)? {
        Some(running) if !has_ended && !running.is_bootloader() => Ok(()),
        None if !has_ended => {
            Err(Error::FellSilent { node, elsewhere: session.booted_elsewhere_since(began) })
        }
        running => Err(Error::ProgramEnded { node, ended: Ended { ran, by: ended_by(session, running) } }),
    }
}

/// A program that was started at `began` and does not answer a later request has fallen silent.
pub(super) fn fell_silent(session: &mut Session<'_>, began: Duration, error: Error) -> Error {
    match error {
        Error::NoAnswer { node, .. } => {
            Error::FellSilent { node, elsewhere: session.booted_elsewhere_since(began) }
        }
        error => error,
    }
}

/// What runs at the end of the watch; `None` if no request is answered: one lost frame is no silence.
fn answering(session: &mut Session<'_>) -> Result<Option<DeviceType>, Error> {
    match session.read_number(Address::new(DEVICE_TYPE, 0)) {
        Ok(number) => Ok(Some(DeviceType(number))),
        Err(Error::NoAnswer { .. } | Error::ShortAnswer { .. } | Error::Protocol { .. }) => Ok(None),
        Err(error) => Err(error),
    }
}

/// How the program ended, as the bootloader reports it.
fn ended_by(session: &mut Session<'_>, running: Option<DeviceType>) -> Option<ResetCause> {
    running.filter(|running| running.is_bootloader())?;
    state_after_failure(session).and_then(BootloaderState::ended_by)
}
