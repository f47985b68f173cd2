//! The parts of the update procedure that differ between dialects.

use std::time::Duration;

use canopen::NodeId;

use super::whole;
use crate::device::{DeviceType, Dialect, Doing, Error, Session};
use crate::update::device_after::DeviceState;
use crate::update::event::{Note, Phase};
use crate::update::judge::DownloadStatus;
use crate::update::password::Password;
use crate::update::payload::Payload;
use crate::update::reach::Found;
use crate::update::report::Renewal;
use crate::update::running::RunningUpdate;
use crate::update::steps;

/// The parts of an update that each dialect and the renewal of a bootloader implement, in their order.
pub(in crate::update) trait Procedure {
    /// Step 3: makes the bootloader run, by the call of coboot and SYS TEC. Returns the dialect of the
    /// bootloader, which may report more than the application did.
    ///
    /// # Errors
    /// [`Error::NoBootloader`], [`Error::NotInDialect`], and the errors of unlocking.
    fn enter(
        &self,
        session: &mut Session<'_>,
        found: Found,
        update: &mut RunningUpdate<'_>,
    ) -> Result<Dialect, Error> {
        let dialect = call_back(session, found, update)?;
        update.report(Note::Dialect { dialect }.into());
        Ok(dialect)
    }

    /// Steps 4 to 14, in one download of the program: afterwards it is in the device and starts at the next
    /// reset, or its bootloader is renewed.
    ///
    /// # Errors
    /// The device's refusal.
    fn download(
        &self,
        session: &mut Session<'_>,
        file: &Payload,
        update: &mut RunningUpdate<'_>,
    ) -> Result<Downloaded, Error> {
        whole::download(self, session, file, update)
    }

    /// Steps 4 and 5, before each attempt of one download: erases the program.
    ///
    /// # Errors
    /// The device's refusal.
    fn prepare(
        &self,
        session: &mut Session<'_>,
        number: u8,
        update: &mut RunningUpdate<'_>,
    ) -> Result<(), Error> {
        steps::clear_and_wait(session, number, &mut |event| update.report(event))
    }

    /// Reads the device's result of one download.
    ///
    /// # Errors
    /// The errors of a [read](Session::read).
    fn status(&self, session: &mut Session<'_>, number: u8, doing: Doing) -> Result<DownloadStatus, Error> {
        whole::status(session, number, doing)
    }

    /// Writes the password for the bootloader's own program number, in a dialect with passwords; whether
    /// there was one to write. A locked device needs it again after each reset.
    ///
    /// # Errors
    /// [`Error::NoPassword`], and [`Error::Refused`] for a wrong password.
    fn unlock(
        &self,
        session: &mut Session<'_>,
        password: Option<Password>,
        number: u8,
    ) -> Result<bool, Error> {
        let _ = (session, password, number);
        Ok(false)
    }

    /// Step 15: starts the program; afterwards the session talks to the program's node. `original`
    /// is the node at the start of the update.
    ///
    /// # Errors
    /// [`Error::StartFailed`].
    fn start(&self, session: &mut Session<'_>, original: NodeId, number: u8) -> Result<DeviceType, Error> {
        let _ = original;
        steps::start(session, number)
    }
}

/// The result of a download.
pub(in crate::update) struct Downloaded {
    /// The number of repetitions of a block, or of the whole program.
    pub(in crate::update) repeats: u32,
    /// How long the blocks took.
    pub(in crate::update) took: Duration,
    /// Whether it is released for autostart; `None` in a dialect without a release.
    pub(in crate::update) released: Option<bool>,
    /// The results of a renewal, after which the program runs again if it did before.
    pub(in crate::update) renewal: Option<Renewal>,
}

/// Calls an application back with the call of coboot and SYS TEC. Returns the bootloader's dialect:
/// the user's choice, otherwise the dialect of its device type, otherwise what was `found`.
pub(super) fn call_back(
    session: &mut Session<'_>,
    found: Found,
    update: &mut RunningUpdate<'_>,
) -> Result<Dialect, Error> {
    if found.running.is_bootloader() {
        return Ok(found.dialect);
    }
    let program = steps::running_program(session, update.options.program)?;
    update.state = DeviceState::Called;
    update.called = Some(program.unwrap_or(steps::CALL_BACK));
    update.report(Phase::CallingBack.into());
    let running = steps::call_back(session)?;
    update.report(Phase::InBootloader.into());
    let reported = Dialect::of_bootloader(running, session.node());
    Ok(update.options.dialect.or(reported).unwrap_or(found.dialect))
}
