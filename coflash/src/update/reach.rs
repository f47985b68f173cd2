//! The search for a device and its bootloader.

use canopen::NodeId;

use super::admission::{admit, admit_to_bootloader};
use super::catch::knock;
use super::content::Content;
use super::dialect;
use super::event::{Event, Note, Phase};
use super::options::FlashOptions;
use super::running::RunningUpdate;
use super::steps::{check_target, CALL_BACK};
use crate::device::{recognise, Dialect, Error, Session};

/// Steps 2 and 3: finds the device and brings it into its bootloader; with `wait`, tries again
/// until this works or the user cancels. Returns the dialect of the bootloader.
pub(super) fn reach(
    session: &mut Session<'_>,
    file: Content<'_>,
    options: &FlashOptions,
    update: &mut RunningUpdate<'_>,
) -> Result<Dialect, Error> {
    if options.alone && !options.wait {
        // Check before the first request, which would disturb another tool's running transfer.
        // While the tool catches a device, there is no time for this: a rescue window is as short
        // as the check.
        session.ensure_alone()?;
    }
    if !options.wait {
        return attempt(session, file, options, update);
    }
    update.tell_once(true);
    loop {
        knock(session, None, &mut |event| update.tell(event))?;
        match attempt(session, file, options, update) {
            Err(error @ (Error::NoAnswer { .. } | Error::NoBootloader { .. })) => {
                update.tell(Phase::Searching { reason: error.to_string() }.into());
                let pause = session.timing().poll_most;
                session.wait(pause)?;
            }
            result => {
                update.tell_once(false);
                return result;
            }
        }
    }
}

/// One attempt of steps 2 and 3.
fn attempt(
    session: &mut Session<'_>,
    file: Content<'_>,
    options: &FlashOptions,
    update: &mut RunningUpdate<'_>,
) -> Result<Dialect, Error> {
    let running = session.find()?;
    update.tell(Event::Found(running));
    if let Some(target) = options.check_target {
        check_target(session, target)?;
        update.tell(Note::TargetRight(target).into());
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
    let (original, before) = (session.node(), session.now());
    let dialect = dialect::of(found).enter(session, running, options, update)?;
    let is_ready = (|| {
        // The bootloader may have reported more than the application.
        check_way(file, dialect, options)?;
        if !admitted && !running.is_bootloader() {
            admit_to_bootloader(session, file, dialect, options)?;
        }
        match update.called {
            _ if !options.alone => Ok(()),
            Some(_) => session.await_peace(before),
            None => session.still_alone(),
        }
    })();
    if let (Err(error), Some(program)) = (&is_ready, update.called) {
        let is_lost = matches!(error, Error::Adapter(_) | Error::Cancelled | Error::NoAnswer { .. });
        // The device belongs to the tool that commands it.
        if !is_lost && !session.is_commanded_since(before) {
            start_again(session, dialect, original, program, update);
        }
    }
    is_ready.map(|()| dialect)
}

/// Starts the program again that was called back for an update which does not take place. The reason
/// for that stays the result, whether the program starts or not.
fn start_again(
    session: &mut Session<'_>,
    dialect: Dialect,
    original: NodeId,
    program: u8,
    update: &mut RunningUpdate<'_>,
) {
    update.tell(Phase::StartingAgain.into());
    if let Ok(running) = dialect::of(dialect).start(session, original, program) {
        update.tell(Phase::Started(running).into());
    }
}

/// Checks that the dialect supports the way in which the file is to be sent.
fn check_way(file: Content<'_>, dialect: Dialect, options: &FlashOptions) -> Result<(), Error> {
    match (file, dialect) {
        (Content::Sealed(_), Dialect::Block) | (Content::Program(_), _) => Ok(()),
        (Content::Sealed(_), _) if options.blocks.is_none() => Ok(()),
        (Content::Sealed(_), dialect) => Err(Error::NotInDialect {
            dialect,
            what: "a sealed image is sent in one download, not in blocks",
        }),
    }
}
