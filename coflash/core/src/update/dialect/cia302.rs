//! The dialects `raw` and `hex`: CiA 302-3, with STOP, CLEAR, one download and START. They differ in the
//! form of the program alone.

use canopen::program::{self, ProgramControl, ProgramState};
use canopen::Address;

use super::procedure::Procedure;
use crate::device::error::absent;
use crate::device::{Dialect, Error, Session};
use crate::update::event::{Note, Phase};
use crate::update::reach::Found;
use crate::update::running::RunningUpdate;
use crate::update::steps::{call_back, running_program};

/// See the [module](self).
pub(super) struct Cia302(pub(super) Dialect);

impl Procedure for Cia302 {
    fn enter(
        &self,
        session: &mut Session<'_>,
        found: Found,
        update: &mut RunningUpdate<'_>,
    ) -> Result<Dialect, Error> {
        if !found.running.is_bootloader() {
            update.calls(None);
            stop_program(session, update.options.program, update)?;
        }
        update.report(Note::Dialect { dialect: self.0 }.into());
        Ok(self.0)
    }
}

/// Calls the bootloader of a device that only supports CiA 302-3 with STOP: the bootloader then
/// answers. An application that refuses STOP may support the call of coboot and SYS TEC.
///
/// # Errors
/// [`Error::NoBootloader`].
fn stop_program(session: &mut Session<'_>, number: u8, update: &mut RunningUpdate<'_>) -> Result<(), Error> {
    const RUNNING: u32 = ProgramState::Running as u32;
    // The running program may have another number than the program to be written.
    let Some(running) = running_program(session, number)? else {
        // The bootloader is already running, or the device does not report it.
        return Ok(());
    };
    update.calls(Some(running));
    update.called = Some(running);
    let at = Address::new(program::PROGRAM_CONTROL, running);
    update.report(Phase::CallingBack.into());
    let began = session.now();
    match session.command(running, ProgramControl::Stop) {
        Ok(()) | Err(Error::NoAnswer { .. } | Error::Protocol { .. }) => {}
        Err(Error::Refused { .. }) => {
            call_back(session)?;
            update.report(Phase::InBootloader.into());
            return Ok(());
        }
        Err(error) => return Err(error),
    }
    let deadline = session.now() + session.timing().boot;
    loop {
        match session.read_number(at) {
            Ok(RUNNING)
            | Err(Error::NoAnswer { .. } | Error::ShortAnswer { .. } | Error::Protocol { .. }) => {}
            Ok(_) => break,
            Err(Error::Refused { code, .. }) if absent(code) => break,
            Err(error) => return Err(error),
        }
        if session.now() >= deadline {
            let (node, running) = (session.node(), session.device_type()?);
            let elsewhere = session.booted_elsewhere_since(began).filter(|_| running.is_none());
            return Err(Error::NoBootloader { node, running, code: None, elsewhere });
        }
        let pause = session.timing().sdo;
        session.await_boot_up(pause)?;
    }
    update.report(Phase::InBootloader.into());
    Ok(())
}
