//! The search for a device and its bootloader.

use super::admission::{admit, admit_to_bootloader};
use super::catch::knock;
use super::content::Content;
use super::course::Course;
use super::dialect;
use super::event::{Event, Note, Phase};
use super::options::FlashOptions;
use super::steps::{check_target, CALL_BACK};
use crate::device::{recognise, Dialect, Error, Session};

/// Steps 2 and 3: finds the device, and brings it into its bootloader; again and again until it
/// works or the user gives up, if that is asked for. Gives what the bootloader speaks.
pub(super) fn reach(
    session: &mut Session<'_>,
    file: Content<'_>,
    options: &FlashOptions,
    course: &mut Course<'_>,
) -> Result<Dialect, Error> {
    if options.alone && !options.wait {
        // Before the first question, which would disturb a transfer that somebody else has under way.
        // Who knocks cannot wait: a rescue window is as short.
        session.ensure_alone()?;
    }
    if !options.wait {
        return attempt(session, file, options, course);
    }
    course.tell_once(true);
    loop {
        knock(session, None, &mut |event| course.tell(event))?;
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
    file: Content<'_>,
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
    check_way(file, found, options)?;
    let admitted = admit(session, file, found, options)?;
    match (options.alone, options.wait) {
        (false, _) => {}
        (true, false) => session.still_alone()?,
        (true, true) => session.ensure_alone()?,
    }
    let dialect = dialect::of(found).enter(session, running, options, course)?;
    // The bootloader may have told more than the application did.
    check_way(file, dialect, options)?;
    if !admitted && !running.is_bootloader() {
        admit_to_bootloader(session, file, dialect, options)?;
    }
    Ok(dialect)
}

/// Whether the dialect has the way in which the file is to be sent.
fn check_way(file: Content<'_>, dialect: Dialect, options: &FlashOptions) -> Result<(), Error> {
    match (file, dialect) {
        (Content::Sealed(_), Dialect::Block) | (Content::Blocks(_), _) => Ok(()),
        (Content::Sealed(_), _) if options.blocks.is_none() => Ok(()),
        (Content::Sealed(_), dialect) => Err(Error::NotInDialect {
            dialect,
            what: "a sealed image goes with one download, and not in blocks",
        }),
    }
}
