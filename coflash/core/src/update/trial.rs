//! The trial run: a program is started once before it is released for autostart.

use super::event::Phase;
use super::running::RunningUpdate;
use super::steps::{call_back, check_target, start};
use super::watch;
use crate::device::error::{Error, IdentityPart, TrialFailure};
use crate::device::info::{identity, Identity};
use crate::device::{Dialect, Session};

/// Steps 10 to 13: starts the program for a trial, compares identities, and calls it back.
pub(super) fn run(session: &mut Session<'_>, update: &mut RunningUpdate<'_>) -> Result<(), Error> {
    let options = update.options;
    let bootloader = identity(session)?;
    let time = watch::time(session, Dialect::Block, &options)?;
    update.report(Phase::TrialStarting.into());
    update.losses = Some(session.losses());
    let began = session.now();
    let running = start(session, options.program).map_err(failed)?;
    watch::watch(session, began, time).map_err(failed)?;
    let right = same_identity(session, bootloader).and_then(|()| match options.check_target {
        Some(target) => check_target(session, target),
        None => Ok(()),
    });
    let right = right.map_err(|error| failed(watch::fell_silent(session, began, error)));
    // Even a wrong program must not keep running.
    let back = call_back(session).map_err(failed);
    right?;
    back?;
    update.verdict(session, Ok(()))?;
    // What fails from here on is no part of the trial.
    update.losses = None;
    update.report(Phase::TrialPassed(running).into());
    Ok(())
}

/// The same error, in the form for a program on trial.
fn failed(error: Error) -> Error {
    let (node, how) = match error {
        Error::StartFailed { node, running: Some(_), status, state, .. } => {
            (node, TrialFailure::NotStarted(status, state))
        }
        Error::StartFailed { node, running: None, elsewhere, .. } => (node, TrialFailure::Silent(elsewhere)),
        Error::FellSilent { node, elsewhere } => (node, TrialFailure::FellSilent(elsewhere)),
        Error::ProgramEnded { node, ended } => (node, TrialFailure::Ended(ended)),
        Error::NoBootloader { node, running: Some(_), code, .. } => (node, TrialFailure::Stays(code)),
        Error::NoBootloader { node, running: None, elsewhere, .. } => (node, TrialFailure::Lost(elsewhere)),
        error => return error,
    };
    Error::TrialFailed { node, how }
}

/// Compares the identity that the application on trial reports with the bootloader's (manual,
/// chapter 5.2, step 6). The revision belongs to the program and may differ; 0 in an optional value
/// means that it is not supported (CiA 301, 1018h).
fn same_identity(session: &mut Session<'_>, bootloader: Identity) -> Result<(), Error> {
    let application = identity(session)?;
    for (sub, optional) in [(1, false), (2, true), (4, true)] {
        let reported =
            |identity: Identity| identity[usize::from(sub) - 1].filter(|number| !optional || *number != 0);
        let (expected, found) = (reported(bootloader), reported(application));
        let silent = found.is_none() && optional;
        if expected.is_some() && found != expected && !silent {
            let node = session.node();
            let what = IdentityPart::of(sub);
            return Err(Error::OtherIdentity { node, what, bootloader: expected, application: found });
        }
    }
    Ok(())
}
