//! The single steps of an update, for the procedure and for users of single steps.

use std::time::Duration;

use canopen::program::{self, FlashError, ProgramControl, ProgramState};
use canopen::{AbortCode, Address};
use shared_abi::block_file::{fits, Difference};

use super::event::{Event, Phase};
use super::phase::Note;
use crate::device::error::{absent, reported, Error, IdentityPart};
use crate::device::read_state::{autostart_words, program_start, state_after_failure};
use crate::device::{DeviceType, Doing, Session, Timing};
use crate::file::Target;

/// How many times an application is called back. A program that was started directly after its
/// download may take the first call for a confirmation.
const CALLS: u32 = 3;
/// How long an application may continue after the call before it leaves; the call is not repeated
/// meanwhile.
const LEAVES_WITHIN: Duration = Duration::from_secs(2);
/// The sub-index of 1F51h for the call, whichever program runs (manual, step 3). An application of
/// another manufacturer has no other sub-index.
pub(super) const CALL_BACK: u8 = 1;

/// Compares the device's identity with the file's target ([`fits`]). Bootloader and application have
/// the same identity.
///
/// # Errors
/// [`Error::WrongTarget`], and the errors of a [read](Session::read).
pub fn check_target(session: &mut Session<'_>, target: Target) -> Result<(), Error> {
    compare_target(session, target, |session, at| session.read_number(at).map(Some))
}

/// Compares 1018h/1 and 1018h/2 with the target, by the rule of the bootloader. A value that the device
/// does not report (`None`) cannot differ.
pub(super) fn compare_target(
    session: &mut Session<'_>,
    target: Target,
    read: impl Fn(&mut Session<'_>, Address) -> Result<Option<u32>, Error>,
) -> Result<(), Error> {
    let Target { vendor_id, product_code } = target;
    let mut reported = |sub| read(session, Address::new(program::IDENTITY, sub));
    let mut device = (vendor_id, product_code);
    // What the file leaves open is read only if the rest differs: 0 and 0 are no identity.
    for is_open in [false, true] {
        for (sub, file, value) in [(1, vendor_id, &mut device.0), (2, product_code, &mut device.1)] {
            if (file == 0) == is_open {
                *value = reported(sub)?.unwrap_or(file);
            }
        }
        if device == (vendor_id, product_code) {
            return Ok(());
        }
    }
    let node = session.node();
    fits((vendor_id, product_code), device).map_err(|difference| {
        let (what, device, file) = match difference {
            Difference::VendorId => (IdentityPart::VendorId, device.0, vendor_id),
            Difference::ProductCode => (IdentityPart::ProductCode, device.1, product_code),
        };
        Error::WrongTarget { node, what, device, file }
    })
}

/// Steps 2 and 3: makes the bootloader run.
///
/// # Errors
/// [`Error::NoAnswer`] if nothing answers, [`Error::NoBootloader`] if the application does not
/// return.
pub fn enter_bootloader(session: &mut Session<'_>, on_event: &mut dyn FnMut(Event)) -> Result<(), Error> {
    let running = session.find()?;
    on_event(Event::Found(running));
    if running.is_bootloader() {
        return Ok(());
    }
    on_event(Phase::CallingBack.into());
    call_back(session)?;
    on_event(Phase::InBootloader.into());
    Ok(())
}

/// Steps 3 and 12, 13: calls the application back to the bootloader and waits for the bootloader.
///
/// Returns the bootloader's device type.
///
/// # Errors
/// [`Error::NoBootloader`].
pub fn call_back(session: &mut Session<'_>) -> Result<DeviceType, Error> {
    let (node, began) = (session.node(), session.now());
    let mut seen = None;
    for call in 1..=CALLS {
        match session.command(CALL_BACK, ProgramControl::StartBootloader) {
            // A device that resets at once may not send its answer.
            Ok(()) | Err(Error::NoAnswer { .. } | Error::Protocol { .. }) => {}
            Err(Error::Refused { code, .. }) => {
                let running = session.device_type()?;
                return Err(Error::NoBootloader { node, running, code: Some(code), elsewhere: None });
            }
            Err(error) => return Err(error),
        }
        let timing = *session.timing();
        // An application that continues has taken the first call for a confirmation.
        let first = Timing { boot: timing.boot.min(LEAVES_WITHIN), ..timing };
        seen = settle(
            &mut session.with(node, if call == 1 { first } else { timing }),
            DeviceType::is_bootloader,
        )?;
        if call == 1 && seen.is_none() {
            // The device restarts.
            seen = settle(session, DeviceType::is_bootloader)?;
        }
        if let Some(running) = seen.filter(|running| running.is_bootloader()) {
            return Ok(running);
        }
    }
    let elsewhere = session.booted_elsewhere_since(began).filter(|_| seen.is_none());
    Err(Error::NoBootloader { node, running: seen, code: None, elsewhere })
}

/// The program that runs, as 1F51h reports it: `number`, or the one of [`CALL_BACK`]; `None` if
/// neither runs, or the device does not say.
pub(super) fn running_program(session: &mut Session<'_>, number: u8) -> Result<Option<u8>, Error> {
    for number in [number, CALL_BACK] {
        if reported(session.read_number(Address::new(program::PROGRAM_CONTROL, number)))?
            == Some(ProgramState::Running as u32)
        {
            return Ok(Some(number));
        }
    }
    Ok(None)
}

/// Waits for a restarting device, at most [`Timing::boot`], until `wanted` accepts its device type;
/// returns the last device type.
pub(super) fn settle(
    session: &mut Session<'_>,
    wanted: impl Fn(DeviceType) -> bool,
) -> Result<Option<DeviceType>, Error> {
    let (began, boot) = (session.now(), session.timing().boot);
    let deadline = began + boot;
    loop {
        // The boot-up message ends the pause early; if it gets lost, the device is still asked at
        // intervals.
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
/// [`Error::Failed`] with the error in 1F57h, [`Error::Busy`], [`Error::NoAnswer`].
pub fn erase(session: &mut Session<'_>, number: u8, on_event: &mut dyn FnMut(Event)) -> Result<(), Error> {
    on_event(Phase::Erasing.into());
    let began = session.now();
    execute(session, number, ProgramControl::Clear)?;
    erased(session, number, began, on_event)
}

/// Reports the end of the command to erase, with what 1F56h says of it.
fn erased(
    session: &mut Session<'_>,
    number: u8,
    began: Duration,
    on_event: &mut dyn FnMut(Event),
) -> Result<(), Error> {
    let took = session.now().saturating_sub(began);
    let postponed = crc(session, number)?.map(|crc| crc != 0);
    on_event(Phase::Erased { took, postponed }.into());
    Ok(())
}

/// Steps 4 and 5 on a device that may not have 1F57h, and may answer only after the erase.
pub(super) fn clear_and_wait(
    session: &mut Session<'_>,
    number: u8,
    on_event: &mut dyn FnMut(Event),
) -> Result<(), Error> {
    match session.status(number) {
        Err(Error::Refused { code, .. }) if absent(code) => {}
        Err(error @ Error::Refused { .. }) => return Err(error),
        _ => return erase(session, number, on_event),
    }
    on_event(Phase::Erasing.into());
    let began = session.now();
    let node = session.node();
    let patient = session.timing().erasing();
    session.with(node, patient).command(number, ProgramControl::Clear)?;
    erased(session, number, began, on_event)
}

/// Erases the program without writing another one. A bootloader that postpones the erase until the
/// first block (figure 12 of the manual) gets the command a second time, which makes it erase at
/// once; so does one of which 1F56h does not say that the first command has erased its program.
///
/// # Errors
/// As [`erase`].
pub fn erase_at_once(session: &mut Session<'_>, number: u8) -> Result<(), Error> {
    let before = crc(session, number)?;
    execute(session, number, ProgramControl::Clear)?;
    // Without a program before, nothing says whether the rest of a cut-off download is gone.
    let is_erased = before.is_some_and(|crc| crc != 0) && crc(session, number)? == Some(0);
    if !is_erased {
        execute(session, number, ProgramControl::Clear)?;
    }
    Ok(())
}

/// Step 14: releases the program for autostart (83h).
///
/// # Errors
/// As [`erase`].
pub fn release(session: &mut Session<'_>, number: u8, on_event: &mut dyn FnMut(Event)) -> Result<(), Error> {
    execute(session, number, ProgramControl::SetSignature)?;
    on_event(Phase::Released.into());
    if let Some(says) = program_start(session)?.and_then(|start| autostart_words(start, number)) {
        on_event(Note::Autostart { number, says }.into());
    }
    Ok(())
}

/// Withdraws the release for autostart (84h): the program no longer starts by itself.
///
/// # Errors
/// As [`erase`].
pub fn withdraw(session: &mut Session<'_>, number: u8) -> Result<(), Error> {
    execute(session, number, ProgramControl::ClrSignature)
}

/// Sets 1F57h to "no error".
///
/// # Errors
/// As [`erase`].
pub fn reset_status(session: &mut Session<'_>, number: u8) -> Result<(), Error> {
    execute(session, number, ProgramControl::ResetStat)
}

/// Sends a command that may be repeated, and waits until it is carried out. A device that has just
/// started may still be storing something (86h): the command is repeated for as long as a start may
/// take. CLEAR is not: the work may be another master's download, which it would end.
pub(super) fn execute(session: &mut Session<'_>, number: u8, command: ProgramControl) -> Result<(), Error> {
    let doing = Doing::Command(command);
    let mut attempt = 1;
    let deadline = session.now() + session.timing().boot;
    loop {
        match session.command(number, command) {
            Ok(()) => break,
            Err(Error::NoAnswer { .. } | Error::Protocol { .. }) if attempt < session.timing().attempts => {
                attempt += 1;
                // The command may have arrived, and the device may be silent while it carries the
                // command out.
                session.await_idle(number, doing)?;
            }
            Err(Error::Refused { code, .. }) => match explain(session, number, doing, code) {
                Error::Failed { error: FlashError::Busy, .. }
                    if command != ProgramControl::Clear && session.now() < deadline =>
                {
                    session.wait(session.timing().poll_most)?;
                }
                error => return Err(error),
            },
            Err(error) => return Err(error),
        }
    }
    let status = session.await_idle(number, doing)?;
    match status.error {
        None => Ok(()),
        Some(error) => Err(Error::Failed { doing, error, detail: status.detail, code: None }),
    }
}

/// The meaning of an SDO abort: 1F57h gives the best explanation, if it reports an error.
fn explain(session: &mut Session<'_>, number: u8, doing: Doing, code: AbortCode) -> Error {
    match session.status(number) {
        Ok(status) => match status.error {
            Some(error) => Error::Failed { doing, error, detail: status.detail, code: Some(code) },
            None => Error::Refused { node: session.node(), doing, code },
        },
        Err(_) => Error::Refused { node: session.node(), doing, code },
    }
}

/// Compares the CRC that the bootloader computed with the file's (manual, chapter 5.2, step 4): one of
/// `crcs`, the first of which is that of the file itself.
///
/// # Errors
/// [`Error::WrongCrc`].
pub fn verify(
    session: &mut Session<'_>,
    number: u8,
    crcs: [u32; 2],
    on_event: &mut dyn FnMut(Event),
) -> Result<(), Error> {
    let crc = compare_crc(session, number, crcs)?;
    on_event(Phase::Verified { crc }.into());
    Ok(())
}

/// 1F56h: the CRC of the program in the device, 0 for none.
pub(super) fn identification(session: &mut Session<'_>, number: u8) -> Result<u32, Error> {
    session.read_number(Address::new(program::PROGRAM_ID, number))
}

/// The value of 1F56h, if the device reports it.
pub(super) fn crc(session: &mut Session<'_>, number: u8) -> Result<Option<u32>, Error> {
    match identification(session, number) {
        Ok(crc) => Ok(Some(crc)),
        Err(error @ (Error::Adapter(_) | Error::Cancelled)) => Err(error),
        // Not a reason to fail: the next step shows the problem.
        Err(_) => Ok(None),
    }
}

/// Compares 1F56h with the values that it may have; returns the value.
pub(super) fn compare_crc(session: &mut Session<'_>, number: u8, crcs: [u32; 2]) -> Result<u32, Error> {
    let device = identification(session, number)?;
    if crcs.contains(&device) {
        return Ok(device);
    }
    Err(Error::WrongCrc { device, file: crcs[0] })
}

/// Steps 10, 11 and 15: starts the program and waits until it answers; returns its device type.
///
/// # Errors
/// [`Error::StartFailed`].
pub fn start(session: &mut Session<'_>, number: u8) -> Result<DeviceType, Error> {
    let began = session.now();
    match session.command(number, ProgramControl::Start) {
        // A device that resets at once may not send its answer.
        Ok(()) | Err(Error::NoAnswer { .. } | Error::Protocol { .. }) => {
            await_program(session, number, began)
        }
        Err(Error::Refused { .. }) => {
            let running = session.device_type()?;
            Err(start_failed(session, number, running, began))
        }
        Err(error) => Err(error),
    }
}

/// Step 15 in the dialects without START: "reset program" (2 of 1F51h), or NMT reset node if the device does
/// not have this object.
pub(super) fn reset_program(session: &mut Session<'_>, number: u8) -> Result<(), Error> {
    let at = Address::new(program::PROGRAM_CONTROL, number);
    match session.write(at, &[ProgramControl::ResetStat as u8], Doing::Restart, &mut |_| {}) {
        Err(Error::Refused { code, .. }) if absent(code) => session.reset_node(),
        // A device that resets at once may not send its answer.
        Ok(()) | Err(Error::NoAnswer { .. } | Error::Protocol { .. }) => Ok(()),
        Err(error) => Err(error),
    }
}

/// Waits for the program that was started at `began`; returns its device type.
///
/// # Errors
/// [`Error::StartFailed`].
pub(super) fn await_program(
    session: &mut Session<'_>,
    number: u8,
    began: Duration,
) -> Result<DeviceType, Error> {
    match settle(session, |running| !running.is_bootloader())? {
        Some(running) if !running.is_bootloader() => Ok(running),
        running => Err(start_failed(session, number, running, began)),
    }
}

/// The error of a program that does not start; a device that answers is asked for the reason.
fn start_failed(
    session: &mut Session<'_>,
    number: u8,
    running: Option<DeviceType>,
    began: Duration,
) -> Error {
    let node = session.node();
    match running {
        Some(_) => {
            let (status, state) = (session.status(number).ok(), state_after_failure(session));
            Error::StartFailed { node, running, status, state, elsewhere: None }
        }
        None => {
            let elsewhere = session.booted_elsewhere_since(began);
            Error::StartFailed { node, running, status: None, state: None, elsewhere }
        }
    }
}

/// Waits for an application for at most `time`; returns its device type.
pub(super) fn await_application(
    session: &mut Session<'_>,
    time: Duration,
) -> Result<Option<DeviceType>, Error> {
    let (node, timing) = (session.node(), Timing { boot: time, ..*session.timing() });
    let seen = settle(&mut session.with(node, timing), |running| !running.is_bootloader())?;
    Ok(seen.filter(|running| !running.is_bootloader()))
}
