//! Step 2: the search for a device.

use super::catch::search;
use super::event::{Event, Phase};
use super::running::RunningUpdate;
use super::steps::{check_target, CALL_BACK};
use crate::device::{recognise, DeviceType, Dialect, Error, Session};

/// A device that answers.
#[derive(Clone, Copy)]
pub(super) struct Found {
    /// What runs.
    pub(super) running: DeviceType,
    /// The dialect that it speaks, or that the user has named.
    pub(super) dialect: Dialect,
}

/// Makes an attempt to bring the device into its bootloader; with `wait`, one after the other until it
/// works or the user cancels. Returns the result of the last one.
///
/// # Errors
/// [`Error::NotAlone`], [`Error::Cancelled`], and those of the attempt.
pub(super) fn reach<R>(
    session: &mut Session<'_>,
    update: &mut RunningUpdate<'_>,
    mut attempt: impl FnMut(&mut Session<'_>, &mut RunningUpdate<'_>) -> Result<R, Error>,
) -> Result<R, Error> {
    if !update.options.wait {
        if update.options.alone {
            // Check before the first request, which would disturb another tool's running transfer.
            // While the tool catches a device, there is no time for this: a rescue window is as short
            // as the check.
            session.ensure_alone()?;
        }
        return attempt(session, update);
    }
    update.report_once(true);
    loop {
        search(session, None, &mut |event| update.report(event))?;
        match attempt(session, update) {
            Err(error @ (Error::NoAnswer { .. } | Error::NoBootloader { .. })) => {
                update.report(Phase::Searching { reason: error.to_string() }.into());
                let pause = session.timing().poll_most;
                session.wait(pause)?;
            }
            result => {
                update.report_once(false);
                return result;
            }
        }
    }
}

/// Finds the device: what runs in it, and which dialect it speaks. One that is not the target is refused.
///
/// # Errors
/// [`Error::NoAnswer`], [`Error::WrongTarget`], and the errors of a [read](Session::read).
pub(super) fn find(session: &mut Session<'_>, update: &mut RunningUpdate<'_>) -> Result<Found, Error> {
    let running = session.find()?;
    update.report(Event::Found(running));
    if let Some(target) = update.options.check_target {
        check_target(session, target)?;
    }
    let dialect = match update.options.dialect {
        Some(dialect) => dialect,
        None => recognise(session, running, CALL_BACK)?,
    };
    Ok(Found { running, dialect })
}
