//! The restart into a program in the dialects without START.

use canopen::program::{self, ProgramControl};
use canopen::Address;

use crate::device::error::absent;
use crate::device::read_state::state_after_failure;
use crate::device::{DeviceType, Doing, Error, Session};
use crate::update::steps::await_application;

/// "Reset program" (2 of 1F51h); NMT reset node if the device does not have this object.
pub(super) fn reset_program(session: &mut Session<'_>, number: u8) -> Result<(), Error> {
    let at = Address::new(program::PROGRAM_CONTROL, number);
    match session.write(at, &[ProgramControl::ResetStat as u8], Doing::Restart, &mut |_| {}) {
        Err(Error::Refused { code, .. }) if absent(code) => session.reset_node(),
        // A device that resets at once may not send its answer.
        Ok(()) | Err(Error::NoAnswer { .. } | Error::Protocol { .. }) => Ok(()),
        Err(error) => Err(error),
    }
}

/// Waits for the application.
pub(super) fn arrived(session: &mut Session<'_>, number: u8) -> Result<DeviceType, Error> {
    let (began, boot) = (session.now(), session.timing().boot);
    if let Some(running) = await_application(session, boot)? {
        return Ok(running);
    }
    let (node, running) = (session.node(), session.device_type()?);
    let (status, state) = (session.status(number).ok(), state_after_failure(session));
    let elsewhere = session.booted_elsewhere_since(began).filter(|_| running.is_none());
    Err(Error::StartFailed { node, running, status, state, elsewhere })
}
