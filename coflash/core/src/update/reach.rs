//! Steps 2 and 3: the search for a device, and its way into the bootloader.

use super::admission::Admission;
use super::catch::search;
use super::dialect;
use super::event::{Event, Note, Phase};
use super::payload::Payload;
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
        update.report(Note::TargetRight(target).into());
    }
    let dialect = match update.options.dialect {
        Some(dialect) => dialect,
        None => recognise(session, running, CALL_BACK)?,
    };
    Ok(Found { running, dialect })
}

/// Brings the device into its bootloader, which answers what the application did not know.
///
/// # Errors
/// [`Error::NotAlone`], [`Error::NoBootloader`], and those of the [admission](Admission::ask). The program
/// that was called back is started again, if the device still answers.
pub(super) fn enter(
    session: &mut Session<'_>,
    file: &Payload,
    found: Found,
    mut admission: Admission<'_>,
    update: &mut RunningUpdate<'_>,
) -> Result<(), Error> {
    let alone = update.options.alone;
    match (alone, update.options.wait) {
        (false, _) => {}
        (true, false) => session.still_alone()?,
        (true, true) => session.ensure_alone()?,
    }
    let before = session.now();
    update.dialect = dialect::procedure(file, found.dialect).enter(session, found, update)?;
    let is_ready = (|| {
        if !found.running.is_bootloader() {
            admission.ask(session, update.dialect)?;
        }
        match update.called {
            _ if !alone => Ok(()),
            Some(_) => session.await_peace(before),
            None => session.still_alone(),
        }
    })();
    if let (Err(error), Some(program)) = (&is_ready, update.called) {
        let is_lost = matches!(error, Error::Adapter(_) | Error::Cancelled | Error::NoAnswer { .. });
        // The device belongs to the tool that commands it.
        if !is_lost && !session.is_commanded_since(before) {
            start_again(session, program, update);
        }
    }
    is_ready
}

/// Starts the program again that was called back for an update which does not take place. The reason
/// for that stays the result, whether the program starts or not.
fn start_again(session: &mut Session<'_>, program: u8, update: &mut RunningUpdate<'_>) {
    update.report(Phase::StartingAgain.into());
    if let Ok(running) = dialect::of(update.dialect).start(session, update.original, program) {
        update.report(Phase::Started(running).into());
    }
}
