//! The update of a device: steps 2 to 15 of the procedure in the manual (L-1112d_10, "Prinzipieller
//! Ablauf").
//!
//! Step 1, making the program, is [`convert`](mod@crate::file::convert); the dialect cuts it in blocks. All checks that are
//! possible before the device is changed are made there and in `admission`.

use super::admission::admit;
use super::aftermath::look;
use super::content::{Content, Payload};
use super::device_after::{DeviceAfterUpdate, DeviceAnswer};
use super::dialect::{self, Downloaded};
use super::entry::enter;
use super::event::{Done, Event, Phase, Report};
use super::options::FlashOptions;
use super::reach::{find, reach};
use super::renew;
use super::running::{give_back, telling_silence, RunningUpdate};
use super::steps::compare_crc;
use super::watch;
use crate::device::{Dialect, Error, Session};
use crate::file::sealed::SealedFile;
use crate::file::Program;

/// Downloads a program into a device: detects what runs there, calls the bootloader, erases, sends
/// the blocks, compares the CRC, tries the program, releases it for autostart and starts it.
///
/// `tell` gets the events; the last event is always [`Event::Done`].
///
/// An update that was interrupted at any point can be started again at once.
///
/// # Errors
/// The first step that fails ends the procedure. Until the program is released for autostart, the
/// device comes up in the bootloader.
pub fn flash(
    session: &mut Session<'_>,
    program: &Program,
    options: &FlashOptions,
    tell: &mut dyn FnMut(Event),
) -> Result<Report, Error> {
    flash_content(session, Content::Program(program), options, tell)
}

/// [`flash`] with a sealed image, which is sent unchanged in one download. Only the device can
/// check the signature; all checks that need no keys are made before the download.
///
/// # Errors
/// Those of [`flash`].
pub fn flash_sealed(
    session: &mut Session<'_>,
    file: &SealedFile,
    options: &FlashOptions,
    tell: &mut dyn FnMut(Event),
) -> Result<Report, Error> {
    flash_content(session, Content::Sealed(file), options, tell)
}

/// [`flash`], [`flash_sealed`], or [`renew`](super::renew()) for a bootloader.
///
/// # Errors
/// Those of [`flash`].
pub fn flash_program(
    session: &mut Session<'_>,
    payload: &Payload,
    options: &FlashOptions,
    tell: &mut dyn FnMut(Event),
) -> Result<Report, Error> {
    match payload {
        Payload::Program(program) => flash_content(session, Content::Program(program), options, tell),
        Payload::Sealed(file) => flash_content(session, Content::Sealed(file), options, tell),
        Payload::Bootloader(new) => renew::update(session, new, options, tell),
    }
}

fn flash_content(
    session: &mut Session<'_>,
    file: Content<'_>,
    options: &FlashOptions,
    tell: &mut dyn FnMut(Event),
) -> Result<Report, Error> {
    let original = session.node();
    let (result, node, transfers) = telling_silence(session, tell, |session, tell| {
        let mut update = RunningUpdate::new(tell);
        let result = procedure(session, file, options, &mut update);
        let left = match &result {
            Ok(_) => DeviceAfterUpdate { state: update.state, answer: DeviceAnswer::NotAsked },
            Err(error) => look(session, error, &update, original, options.program, file.crcs()),
        };
        if let Some(taken) = update.mastership.take() {
            give_back(session, taken, &mut |event| update.tell(event));
        }
        update.tell(Event::Done(Box::new(Done::new(left, &result))));
        (result, session.node(), session.transfers())
    });
    // The session may have followed the device to another node-ID.
    session.talk_to(node);
    session.transfer_by(transfers);
    result
}

/// [`flash`] without the actions that are necessary after success and failure alike.
fn procedure(
    session: &mut Session<'_>,
    file: Content<'_>,
    options: &FlashOptions,
    update: &mut RunningUpdate<'_>,
) -> Result<Report, Error> {
    let began = session.now();
    let original = session.node();
    let dialect = reach(session, options, update, |session, update| {
        let found = find(session, options, update)?;
        let admission = admit(session, file, found.dialect, options)?;
        enter(session, found, admission, options, update)
    })?;
    let its = dialect::of(dialect);
    if dialect != Dialect::Block {
        session.leave_group();
    }
    let Downloaded { repeats, took: transfer, released } = its.download(session, file, options, update)?;
    let running = if options.start {
        let time = watch::time(session, dialect, options)?;
        update.tell(Phase::Starting.into());
        let starts = session.now();
        let running = its.start(session, original, options.program)?;
        watch::watch(session, starts, time)?;
        update.tell(Phase::Started(running).into());
        Some(running)
    } else {
        None
    };
    if options.verify {
        let crc = compare_crc(session, options.program, file.crcs())?;
        update.tell(Phase::VerifiedAgain { crc }.into());
    }
    let took = session.now().saturating_sub(began);
    let (program_size, program_crc) = (file.size(), file.crc());
    let transfers = session.transfers();
    Ok(Report {
        program_size,
        program_crc,
        repeats,
        took,
        transfer,
        transfers,
        running,
        released,
        dialect,
        renewal: None,
    })
}
