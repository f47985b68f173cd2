//! The parts of the update procedure that differ between dialects.

use std::time::Duration;

use canopen::{program, Address, NodeId};

use crate::device::error::absent;
use crate::device::{DeviceType, Dialect, Doing, Error, Session, Timing};
use crate::update::device_after::DeviceState;
use crate::update::event::{Event, Note, Phase};
use crate::update::judge::{judge, DownloadStatus, Repeats};
use crate::update::password::Password;
use crate::update::payload::Payload;
use crate::update::reach::Found;
use crate::update::report::Renewal;
use crate::update::running::RunningUpdate;
use crate::update::steps;

/// The parts of an update that each dialect and the renewal of a bootloader implement, in their order.
pub(in crate::update) trait Procedure {
    /// Checks the password before the first frame to a device, as far as the dialect alone decides.
    ///
    /// # Errors
    /// [`Error::NoPassword`], and [`Error::NotInDialect`] for a password of another form.
    fn judge_password(&self, node: NodeId, password: Option<Password>) -> Result<(), Error> {
        let _ = (node, password);
        Ok(())
    }

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
        download(self, session, file, update)
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
        status(session, number, doing)
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
    update.calls(program);
    update.called = Some(program.unwrap_or(steps::CALL_BACK));
    update.report(Phase::CallingBack.into());
    let running = steps::call_back(session)?;
    update.report(Phase::InBootloader.into());
    let reported = Dialect::of_bootloader(running, session.node());
    Ok(update.options.dialect.or(reported).unwrap_or(found.dialect))
}

// --- the download of a program in one SDO transfer

/// A device that takes the whole program in one transfer may erase after any segment: at most 2 s,
/// plus a margin.
const SLOW_SEGMENT: Duration = Duration::from_secs(5);

/// Steps 4 to 9 in one download.
///
/// # Errors
/// The device's refusal.
pub(super) fn download(
    procedure: &(impl Procedure + ?Sized),
    session: &mut Session<'_>,
    file: &Payload,
    update: &mut RunningUpdate<'_>,
) -> Result<Downloaded, Error> {
    let number = update.options.program;
    let began = session.now();
    let before = steps::crc(session, number)?;
    update.erases(before);
    let content = file.encoded(update.dialect.form());
    let repeats = send(procedure, session, number, &content, Doing::Program, update)?;
    let took = session.now().saturating_sub(began);
    update.known.state = DeviceState::Written;
    // 1F56h is a CRC in bootloaders of this kind; elsewhere it is whatever the manufacturer has
    // chosen.
    if knows_crc(session)? {
        steps::verify(session, number, file.crcs(), &mut |event| update.report(event))?;
    }
    Ok(Downloaded { repeats, took, released: None, renewal: None })
}

/// Sends this content to a program, with the preparation before each attempt; returns the number of
/// repetitions.
///
/// # Errors
/// The device's refusal.
pub(super) fn send(
    procedure: &(impl Procedure + ?Sized),
    session: &mut Session<'_>,
    number: u8,
    content: &[u8],
    doing: Doing,
    update: &mut RunningUpdate<'_>,
) -> Result<u32, Error> {
    let at = Address::new(program::PROGRAM_DATA, number);
    let total = content.len();
    let mut repeats = Repeats { block: None, count: 0, of: update.options.repeats };
    loop {
        if let Err(error) = procedure.prepare(session, number, update) {
            update.erase_failed(&error);
            return Err(error);
        }
        update.report(Event::Progress { done: 0, total });
        let slow = Timing { sdo: SLOW_SEGMENT.max(session.timing().sdo), ..*session.timing() };
        let node = session.node();
        let mut long = session.with(node, slow);
        let mut progress = |part: u32| {
            update.known.wrote |= part > 0;
            update.known.postponed &= part == 0;
            update.report(Event::Progress { done: part as usize, total });
        };
        let sent = long.write(at, content, doing, &mut progress);
        let transfers = long.transfers();
        session.transfer_by(transfers);
        // Data without an answer may have arrived.
        update.known.wrote |= !matches!(sent, Err(Error::Refused { .. }));
        if let Err(error @ (Error::Adapter(_) | Error::Cancelled)) = sent {
            return Err(error);
        }
        let status = procedure.status(session, number, doing)?;
        let Err(failure) = judge(sent, status, doing) else { return Ok(repeats.count) };
        update.report(Event::Retry(repeats.again(session, failure)?));
    }
}

/// The result of the download in 1F57h; `None` if the device does not have this object.
pub(super) fn status(session: &mut Session<'_>, number: u8, doing: Doing) -> Result<DownloadStatus, Error> {
    match session.read(Address::new(program::FLASH_STATUS, number)) {
        Err(Error::Refused { code, .. }) if absent(code) => Ok(None),
        Ok(_) | Err(Error::NoAnswer { .. } | Error::ShortAnswer { .. } | Error::Protocol { .. }) => {
            idle(session, number, doing)
        }
        Err(error) => Err(error),
    }
}

/// The value of 1F57h when it is no longer busy.
pub(super) fn idle(session: &mut Session<'_>, number: u8, doing: Doing) -> Result<DownloadStatus, Error> {
    let status = session.await_idle(number, doing)?;
    Ok(status.error.map(|error| (error, status.detail)))
}

/// Whether 1F56h of this bootloader is the CRC of the program, judged by the device type: it is for
/// coboot and SYS TEC.
///
/// # Errors
/// The errors of a [read](Session::read).
fn knows_crc(session: &mut Session<'_>) -> Result<bool, Error> {
    let running = session.device_type()?;
    Ok(running.is_some_and(|running| running.0 == program::BOOTLOADER_DEVICE_TYPE))
}
