//! The single steps of an update, for the procedure and for whoever wants just one of them.

use std::time::Duration;

use canopen::program::{self, ProgramControl};
use canopen::{AbortCode, Address};

use super::event::{Event, Phase};
use super::options::Target;
use super::phase::PUT_OFF;
use crate::device::error::{absent, Error, Mismatch};
use crate::device::{DeviceType, Doing, Session, Timing};

/// How often an application is asked to go back to the bootloader. A program that was started right
/// behind its download may take the first time for a confirmation.
const CALLS: u32 = 3;
/// How long an application that was called may go on before it leaves, and is not asked again.
const LEAVES_WITHIN: Duration = Duration::from_secs(2);
/// The sub-index of 1F51h that takes the call, whichever program runs (manual, step 3). An application
/// of another maker has no other.
pub(super) const CALL_BACK: u8 = 1;

/// Compares the device's identity with that of the file's target. Bootloader and application have
/// the same one.
///
/// # Errors
/// [`Error::WrongTarget`], and what a [read](Session::read) has.
pub fn check_target(session: &mut Session<'_>, target: Target) -> Result<(), Error> {
    let wanted = [(1, target.vendor_id), (2, target.product_code)];
    for (sub, file) in wanted {
        let device = session.read_number(Address::new(program::IDENTITY, sub))?;
        if device != file {
            let what = if sub == 1 { Mismatch::VendorId } else { Mismatch::ProductCode };
            return Err(Error::WrongTarget { node: session.node(), what, device, file });
        }
    }
    Ok(())
}

/// Steps 2 and 3: afterwards the bootloader is running.
///
/// # Errors
/// [`Error::NoAnswer`] where nothing answers, [`Error::NoBootloader`] where the application does
/// not go back.
pub fn enter_bootloader(session: &mut Session<'_>, tell: &mut dyn FnMut(Event)) -> Result<(), Error> {
    let running = session.find()?;
    tell(Event::Found(running));
    if running.is_bootloader() {
        return Ok(());
    }
    tell(Phase::CallingBack.into());
    call_back(session)?;
    tell(Phase::InBootloader.into());
    Ok(())
}

/// Steps 3 and 12, 13: asks the application to go back to the bootloader and waits until it has.
///
/// Gives what the bootloader says it is.
///
/// # Errors
/// [`Error::NoBootloader`].
pub fn call_back(session: &mut Session<'_>) -> Result<DeviceType, Error> {
    let node = session.node();
    let mut seen = None;
    for call in 1..=CALLS {
        match session.command(CALL_BACK, ProgramControl::StartBootloader) {
            // A device that resets at once may not get its answer out.
            Ok(()) | Err(Error::NoAnswer { .. } | Error::Protocol { .. }) => {}
            Err(Error::Refused { code, .. }) => {
                let running = session.device_type()?;
                return Err(Error::NoBootloader { node, running, code: Some(code) });
            }
            Err(error) => return Err(error),
        }
        let timing = *session.timing();
        // An application that goes on as before has taken the first call for a confirmation.
        let first = Timing { boot: timing.boot.min(LEAVES_WITHIN), ..timing };
        seen = settle(
            &mut session.with(node, if call == 1 { first } else { timing }),
            DeviceType::is_bootloader,
        )?;
        if call == 1 && seen.is_none() {
            // It restarts.
            seen = settle(session, DeviceType::is_bootloader)?;
        }
        if let Some(running) = seen.filter(|running| running.is_bootloader()) {
            return Ok(running);
        }
    }
    Err(Error::NoBootloader { node, running: seen, code: None })
}

/// Waits for a restarting device, [`Timing::boot`] at most, until what it runs is what is `wanted`;
/// gives what answered last.
fn settle(
    session: &mut Session<'_>,
    wanted: impl Fn(DeviceType) -> bool,
) -> Result<Option<DeviceType>, Error> {
    let (began, boot) = (session.now(), session.timing().boot);
    let deadline = began + boot;
    loop {
        // The boot-up message says when to look; without it (it may get lost) a look now and then
        // does.
        let pause = session.timing().sdo;
        session.await_boot_up(pause)?;
        let seen = session.device_type()?;
        if seen.is_some_and(&wanted) || session.now() >= deadline {
            return Ok(seen);
        }
        session.note_silence(began, boot, Doing::Restart);
    }
}

/// Steps 4 and 5: erases the program.
///
/// # Errors
/// [`Error::Failed`] with what 1F57h says, [`Error::Busy`], [`Error::NoAnswer`].
pub fn erase(session: &mut Session<'_>, number: u8, tell: &mut dyn FnMut(Event)) -> Result<(), Error> {
    tell(Phase::Erasing.into());
    let began = session.now();
    execute(session, number, ProgramControl::Clear)?;
    tell(Phase::Erased { took: session.now().saturating_sub(began) }.into());
    Ok(())
}

/// Steps 4 and 5 on a device that may have no 1F57h to tell how it goes, and may answer when it has
/// erased.
pub(super) fn clear_and_wait(
    session: &mut Session<'_>,
    number: u8,
    tell: &mut dyn FnMut(Event),
) -> Result<(), Error> {
    match session.status(number) {
        Err(Error::Refused { code, .. }) if absent(code) => {}
        Err(error @ Error::Refused { .. }) => return Err(error),
        _ => return erase(session, number, tell),
    }
    tell(Phase::Erasing.into());
    let began = session.now();
    let node = session.node();
    let patient = session.timing().erasing();
    session.with(node, patient).command(number, ProgramControl::Clear)?;
    tell(Phase::Erased { took: session.now().saturating_sub(began) }.into());
    Ok(())
}

/// Gets rid of the program, without another one in its place. A bootloader that puts the erasure
/// off until the first block comes (figure 12 of the manual) is told a second time, which there
/// means at once; elsewhere that erases what is erased already.
///
/// # Errors
/// As [`erase`].
pub fn erase_at_once(session: &mut Session<'_>, number: u8) -> Result<(), Error> {
    let began = session.now();
    execute(session, number, ProgramControl::Clear)?;
    if session.now().saturating_sub(began) < PUT_OFF {
        execute(session, number, ProgramControl::Clear)?;
    }
    Ok(())
}

/// Step 14: releases the program for autostart (83h): from then on it starts by itself.
///
/// # Errors
/// As [`erase`].
pub fn release(session: &mut Session<'_>, number: u8, tell: &mut dyn FnMut(Event)) -> Result<(), Error> {
    execute(session, number, ProgramControl::SetSignature)?;
    tell(Phase::Released.into());
    Ok(())
}

/// Withdraws the release for autostart (84h): the program does not start by itself any more.
///
/// # Errors
/// As [`erase`].
pub fn withdraw(session: &mut Session<'_>, number: u8) -> Result<(), Error> {
    execute(session, number, ProgramControl::ClrSignature)
}

/// Sets 1F57h back to "no error".
///
/// # Errors
/// As [`erase`].
pub fn reset_status(session: &mut Session<'_>, number: u8) -> Result<(), Error> {
    execute(session, number, ProgramControl::ResetStat)
}

/// Gives a command that may be repeated, and waits until it is carried out.
fn execute(session: &mut Session<'_>, number: u8, command: ProgramControl) -> Result<(), Error> {
    let doing = Doing::Command(command);
    let mut attempt = 1;
    loop {
        match session.command(number, command) {
            Ok(()) => break,
            Err(Error::NoAnswer { .. } | Error::Protocol { .. }) if attempt < session.timing().attempts => {
                attempt += 1;
                // The command may have arrived, and the device may be silent because it carries it
                // out.
                session.await_idle(number, doing)?;
            }
            Err(Error::Refused { code, .. }) => return Err(explain(session, number, doing, code)),
            Err(error) => return Err(error),
        }
    }
    let status = session.await_idle(number, doing)?;
    match status.error {
        None => Ok(()),
        Some(error) => Err(Error::Failed { doing, error, detail: status.detail, code: None }),
    }
}

/// What an SDO abort means: 1F57h tells it best, if it tells something.
fn explain(session: &mut Session<'_>, number: u8, doing: Doing, code: AbortCode) -> Error {
    match session.status(number) {
        Ok(status) => match status.error {
            Some(error) => Error::Failed { doing, error, detail: status.detail, code: Some(code) },
            None => Error::Refused { node: session.node(), doing, code },
        },
        Err(_) => Error::Refused { node: session.node(), doing, code },
    }
}

/// Compares the CRC that the bootloader computed with the file's (manual, chapter 5.2, step 4).
///
/// # Errors
/// [`Error::WrongCrc`].
pub fn verify(
    session: &mut Session<'_>,
    number: u8,
    crc: u32,
    tell: &mut dyn FnMut(Event),
) -> Result<(), Error> {
    compare_crc(session, number, crc)?;
    tell(Phase::Verified { crc }.into());
    Ok(())
}

/// 1F56h: the CRC over the program that is in the device, 0 for none.
pub(super) fn identification(session: &mut Session<'_>, number: u8) -> Result<u32, Error> {
    session.read_number(Address::new(program::PROGRAM_ID, number))
}

/// What 1F56h reads before the erasure, if it tells something: what it reads behind a failure can be
/// compared with it.
pub(super) fn told_before(session: &mut Session<'_>, number: u8) -> Result<Option<u32>, Error> {
    match identification(session, number) {
        Ok(crc) => Ok(Some(crc)),
        Err(error @ (Error::Adapter(_) | Error::Cancelled)) => Err(error),
        // It is no reason to fail: what comes next will tell.
        Err(_) => Ok(None),
    }
}

pub(super) fn compare_crc(session: &mut Session<'_>, number: u8, crc: u32) -> Result<(), Error> {
    let device = identification(session, number)?;
    if device != crc {
        return Err(Error::WrongCrc { device, file: crc });
    }
    Ok(())
}

/// Steps 10, 11 and 15: starts the program and waits until it answers; gives what it says it is.
///
/// # Errors
/// [`Error::StartFailed`].
pub fn start(session: &mut Session<'_>, number: u8) -> Result<DeviceType, Error> {
    let node = session.node();
    let failed = |running, status| Error::StartFailed { node, running, status };
    match session.command(number, ProgramControl::Start) {
        // A device that resets at once may not get its answer out.
        Ok(()) | Err(Error::NoAnswer { .. } | Error::Protocol { .. }) => {}
        Err(Error::Refused { .. }) => {
            let running = session.device_type()?;
            return Err(failed(running, session.status(number).ok()));
        }
        Err(error) => return Err(error),
    }
    match settle(session, |running| !running.is_bootloader())? {
        Some(running) if !running.is_bootloader() => Ok(running),
        Some(running) => Err(failed(Some(running), session.status(number).ok())),
        None => Err(failed(None, None)),
    }
}

/// Waits for an application, `time` at most; gives what it says it is.
pub(super) fn await_application(
    session: &mut Session<'_>,
    time: Duration,
) -> Result<Option<DeviceType>, Error> {
    let (node, timing) = (session.node(), Timing { boot: time, ..*session.timing() });
    let seen = settle(&mut session.with(node, timing), |running| !running.is_bootloader())?;
    Ok(seen.filter(|running| !running.is_bootloader()))
}
