//! Step 3: the way of a device into its bootloader.

use super::admission::{covers_staging, Admission};
use super::dialect::renew::Renew;
use super::dialect::{self, Procedure};
use super::event::Phase;
use super::payload::Payload;
use super::reach::Found;
use super::running::RunningUpdate;
use crate::device::{Dialect, Error, Session};

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
    update.dialect = procedure(file, found.dialect).enter(session, found, update)?;
    let is_ready = (|| {
        if !found.running.is_bootloader() {
            dialect::of(update.dialect).judge_password(session.node(), update.options.unlock)?;
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
    is_ready?;
    if let Some(warning) = covers_staging(session, file, update.options.program)? {
        update.report(warning.into());
    }
    Ok(())
}

/// Starts the program again that was called back for an update which does not take place. The reason
/// for that stays the result, whether the program starts or not.
fn start_again(session: &mut Session<'_>, program: u8, update: &mut RunningUpdate<'_>) {
    update.report(Phase::StartingAgain.into());
    if let Ok(running) = dialect::of(update.dialect).start(session, update.original, program) {
        update.report(Phase::Started(running).into());
    }
}

/// The procedure for this payload in this dialect.
pub(super) fn procedure(file: &Payload, dialect: Dialect) -> &'static dyn Procedure {
    if file.is_bootloader() {
        &Renew
    } else {
        dialect::of(dialect)
    }
}
