//! The dialect `esacademy`: Intel HEX text after a password that erases the program.

use std::time::Duration;

use canopen::program::{self, FlashError};
use canopen::{AbortCode, Address, NodeId};

use super::procedure::{idle, Procedure};
use crate::device::error::absent;
use crate::device::{DeviceType, Dialect, Doing, Error, Session};
use crate::update::event::Note;
use crate::update::judge::DownloadStatus;
use crate::update::password::Password;
use crate::update::running::RunningUpdate;
use crate::update::steps::{await_application, await_program, reset_program};

/// ESAcademy's password for 7F50h: "INIT".
pub const PASSWORD: u32 = 0x494E_4954;
/// How long a program that starts by itself may take before the bootloader gets a command.
const BY_ITSELF: Duration = Duration::from_secs(1);
/// Generic error and manufacturer-specific error of 1001h: a flash operation has failed.
const ERROR_BITS: u32 = 0x81;

/// See the [module](self).
pub(super) struct EsAcademy;

impl Procedure for EsAcademy {
    fn judge_password(&self, _: NodeId, password: Option<Password>) -> Result<(), Error> {
        number(password).map(|_| ())
    }

    /// The password of a program erases it.
    fn prepare(
        &self,
        session: &mut Session<'_>,
        number: u8,
        update: &mut RunningUpdate<'_>,
    ) -> Result<(), Error> {
        if self.unlock(session, update.options.unlock, number)? {
            update.report(Note::Unlocked.into());
        }
        Ok(())
    }

    /// From 1F57h if the device has it, otherwise from 1001h.
    fn status(&self, session: &mut Session<'_>, number: u8, doing: Doing) -> Result<DownloadStatus, Error> {
        match session.read(Address::new(program::FLASH_STATUS, number)) {
            Err(Error::Refused { code, .. }) if absent(code) => {}
            // A device that has the whole program may restart at once.
            Err(Error::NoAnswer { .. }) => return Ok(None),
            Ok(_) | Err(Error::Protocol { .. }) => return idle(session, number, doing),
            Err(error) => return Err(error),
        }
        let register = match session.read_number(Address::new(program::ERROR_REGISTER, 0)) {
            Err(Error::NoAnswer { .. }) => None,
            Err(Error::Refused { code, .. }) if absent(code) => None,
            register => Some(register?),
        };
        let failed = register.is_some_and(|bits| bits & ERROR_BITS == ERROR_BITS);
        Ok(failed.then_some((FlashError::Unspecified, 0)))
    }

    /// The password is optional; without it, the download alone must be sufficient.
    fn unlock(
        &self,
        session: &mut Session<'_>,
        password: Option<Password>,
        number: u8,
    ) -> Result<bool, Error> {
        let node = session.node();
        let password = self::number(password)?;
        let at = Address::new(program::ENABLE_FLASH, number);
        // The device erases before it answers.
        let mut patient = session.with(node, session.timing().erasing());
        match patient.write(at, &password.to_le_bytes(), Doing::Unlock, &mut |_| {}) {
            Ok(()) => Ok(true),
            Err(Error::Refused { code: AbortCode::NO_OBJECT, .. }) => Ok(false),
            Err(error) => Err(error),
        }
    }

    fn start(&self, session: &mut Session<'_>, _: NodeId, number: u8) -> Result<DeviceType, Error> {
        let boot = session.timing().boot;
        if let Some(running) = await_application(session, BY_ITSELF.min(boot))? {
            return Ok(running);
        }
        let began = session.now();
        reset_program(session, number)?;
        await_program(session, number, began)
    }
}

/// The password as it is written into 7F50h.
///
/// # Errors
/// [`Error::NotInDialect`] for a text of another form.
fn number(password: Option<Password>) -> Result<u32, Error> {
    password.map_or(Some(PASSWORD), |password| password.number()).ok_or(Error::NotInDialect {
        dialect: Dialect::EsAcademy,
        what: "the password is a number of 32 bits: 0x and up to 8 digits, or 4 characters",
    })
}
