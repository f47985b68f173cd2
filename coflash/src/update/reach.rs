//! The search for a device and its bootloader.

use std::time::Duration;

use canopen::{program, Address};

use super::admission::{admit, admit_to_bootloader};
use super::course::Course;
use super::dialect;
use super::event::{Event, Note, Phase};
use super::options::FlashOptions;
use super::steps::{check_target, CALL_BACK};
use crate::device::{recognise, Dialect, Doing, Error, Session, Timing};
use crate::file::BlockFile;

/// Steps 2 and 3: finds the device, and brings it into its bootloader; again and again until it
/// works or the user gives up, if that is asked for. Gives what the bootloader speaks.
pub(super) fn reach(
    session: &mut Session<'_>,
    file: &BlockFile,
    options: &FlashOptions,
    course: &mut Course<'_>,
) -> Result<Dialect, Error> {
    if !options.wait {
        return attempt(session, file, options, course);
    }
    course.tell_once(true);
    loop {
        knock(session, course)?;
        match attempt(session, file, options, course) {
            Err(error @ (Error::NoAnswer { .. } | Error::NoBootloader { .. })) => {
                course.tell(Phase::Searching { reason: error.to_string() }.into());
                let pause = session.timing().poll_most;
                session.wait(pause)?;
            }
            result => {
                course.tell_once(false);
                return result;
            }
        }
    }
}

/// Steps 2 and 3, once.
fn attempt(
    session: &mut Session<'_>,
    file: &BlockFile,
    options: &FlashOptions,
    course: &mut Course<'_>,
) -> Result<Dialect, Error> {
    let running = session.find()?;
    course.tell(Event::Found(running));
    if let Some(target) = options.check_target {
        check_target(session, target)?;
        course.tell(Note::TargetRight(target).into());
    }
    let found = match options.dialect {
        Some(dialect) => dialect,
        None => recognise(session, running, CALL_BACK)?,
    };
    let admitted = admit(session, file, found, options)?;
    let dialect = dialect::of(found).enter(session, running, options, course)?;
    if !admitted && !running.is_bootloader() {
        admit_to_bootloader(session, file, dialect, options)?;
    }
    Ok(dialect)
}

/// A device that is only just switched on is caught if it is asked often enough: a program that was
/// never confirmed is held back for 300 ms.
const KNOCK: Duration = Duration::from_millis(100);

/// Asks until something answers.
fn knock(session: &mut Session<'_>, course: &mut Course<'_>) -> Result<(), Error> {
    let node = session.node();
    let timing = Timing { sdo: KNOCK.min(session.timing().sdo), attempts: 1, ..*session.timing() };
    while session.with(node, timing).device_type()?.is_none() {
        let doing = Doing::Read(Address::new(program::DEVICE_TYPE, 0));
        course.tell(Phase::Searching { reason: Error::NoAnswer { node, doing }.to_string() }.into());
        let pause = session.timing().poll_first;
        session.await_boot_up(pause)?;
    }
    Ok(())
}
