//! The trial run: a program is started once before it is released for autostart.

use super::course::Course;
use super::event::Phase;
use super::options::FlashOptions;
use super::steps::{call_back, check_target, start};
use crate::device::error::{Error, IdentityPart, TrialFailure};
use crate::device::info::{identity, Identity};
use crate::device::Session;

/// Steps 10 to 13: starts the program for a trial, compares identities, and calls it back.
pub(super) fn run(
    session: &mut Session<'_>,
    options: &FlashOptions,
    course: &mut Course<'_>,
) -> Result<(), Error> {
    let bootloader = identity(session)?;
    course.tell(Phase::TrialStarting.into());
    let running = start(session, options.program).map_err(failed)?;
    let right = same_identity(session, bootloader).and_then(|()| match options.check_target {
        Some(target) => check_target(session, target),
        None => Ok(()),
    });
    // A program that is not the right one does not stay, either.
    let back = call_back(session).map_err(failed);
    right?;
    back?;
    course.tell(Phase::TrialPassed(running).into());
    Ok(())
}

/// The same error, where it is one of a program that was just tried.
fn failed(error: Error) -> Error {
    let (node, how) = match error {
        Error::StartFailed { node, running: Some(_), status } => (node, TrialFailure::NotStarted(status)),
        Error::StartFailed { node, running: None, .. } => (node, TrialFailure::Silent),
        Error::NoBootloader { node, running: Some(_), code } => (node, TrialFailure::Stays(code)),
        Error::NoBootloader { node, running: None, .. } => (node, TrialFailure::Lost),
        error => return error,
    };
    Error::TrialFailed { node, how }
}

/// Compares what the application on trial tells as its identity with what its bootloader told
/// (manual, chapter 5.2, step 6). The revision is the program's own; 0 of what is optional says
/// nothing (CiA 301, 1018h).
fn same_identity(session: &mut Session<'_>, bootloader: Identity) -> Result<(), Error> {
    let application = identity(session)?;
    for (sub, optional) in [(1, false), (2, true), (4, true)] {
        let told = |identity: Identity| identity[sub - 1].filter(|number| !optional || *number != 0);
        let (expected, found) = (told(bootloader), told(application));
        let silent = found.is_none() && optional;
        if expected.is_some() && found != expected && !silent {
            let node = session.node();
            let what = IdentityPart::of(sub);
            return Err(Error::OtherIdentity { node, what, bootloader: expected, application: found });
        }
    }
    Ok(())
}
