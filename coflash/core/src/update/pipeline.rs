//! The update of a device: steps 2 to 15 of the procedure in the manual (L-1112d_10, "Prinzipieller
//! Ablauf").
//!
//! Step 1, making the program, is [`convert`](mod@crate::file::convert); the dialect cuts it in blocks. All
//! checks that are possible before the device is changed are made there and in `admission`.

use canopen::program::PROGRAM_VERSION;
use canopen::Address;
use shared_abi::block_file::ProgramVersion;

use super::admission::questions;
use super::aftermath::state_after;
use super::device_after::{DeviceAfterUpdate, DeviceAnswer};
use super::dialect::{self, Downloaded};
use super::entry::{self, enter};
use super::event::{Done, Event, Note, Phase, Report, Warning};
use super::options::FlashOptions;
use super::payload::Payload;
use super::reach::{find, reach};
use super::report::Renewal;
use super::running::{give_back, reporting_silence, Known, RunningUpdate};
use super::steps::compare_crc;
use super::watch;
use crate::device::error::reported;
use crate::device::{Dialect, Error, Session};
use coboot_can::Losses;

/// Updates a device: detects what runs there, calls the bootloader, and gives it the program, the sealed
/// image, which is sent unchanged, or the bootloader.
///
/// A program is erased, sent, compared by its CRC, tried, released for autostart and started, as far as
/// the dialect of the device has these steps. A bootloader runs on trial, is confirmed and installed; the
/// program stays, and is started again if it ran before.
///
/// `on_event` gets the events; the last event is always [`Event::Done`].
///
/// An update that was interrupted at any point can be started again at once.
///
/// # Errors
/// The first step that fails ends the procedure. Until a program is released for autostart, the device
/// comes up in the bootloader; until a bootloader is confirmed, the old one comes back by itself.
pub fn flash(
    session: &mut Session<'_>,
    file: impl Into<Payload>,
    options: &FlashOptions,
    on_event: &mut dyn FnMut(Event),
) -> Result<Report, Error> {
    flash_knowing(session, &file.into(), options, &mut Known::default(), on_event)
}

/// [`flash`] of a device of which something is known from an earlier attempt; what is known after this one.
pub(super) fn flash_knowing(
    session: &mut Session<'_>,
    file: &Payload,
    options: &FlashOptions,
    known: &mut Known,
    on_event: &mut dyn FnMut(Event),
) -> Result<Report, Error> {
    let (result, node, transfers) = reporting_silence(session, on_event, |session, on_event| {
        let before = session.losses();
        let mut update = RunningUpdate::new(session.node(), *options, known, on_event);
        let result = procedure(session, file, &mut update);
        let result = update.verdict(session, result);
        let left = match &result {
            Ok(_) => DeviceAfterUpdate { state: update.known.state, answer: DeviceAnswer::NotAsked },
            Err(error) => state_after(session, error, &update, options.program, file.crcs()),
        };
        if let Some(taken) = update.mastership.take() {
            give_back(session, taken, &mut |event| update.report(event));
        }
        if let DeviceAnswer::Given(_) = left.answer {
            update.known.state = left.state;
        }
        let losses = session.losses().since(before);
        if losses != Losses::default() {
            update.report(Warning::Adapter(losses).into());
        }
        update.report(Event::Done(Box::new(Done::new(left, &result))));
        (result, session.node(), session.transfers())
    });
    // The session may have followed the device to another node-ID.
    session.talk_to(node);
    session.transfer_by(transfers);
    result
}

/// Warns of a program that is older than that of the device, which reports its version in 2005h.
fn warn_of_older(
    session: &mut Session<'_>,
    file: &Payload,
    dialect: Dialect,
    update: &mut RunningUpdate<'_>,
) -> Result<(), Error> {
    let Some(gets) = file.version().filter(|_| dialect == Dialect::Block) else { return Ok(()) };
    let at = Address::new(PROGRAM_VERSION, update.options.program);
    let has = ProgramVersion(reported(session.read_number(at))?.unwrap_or(0));
    if gets.is_before(has) {
        update.report(Warning::Older { has: has.to_string(), gets: gets.to_string() }.into());
    }
    Ok(())
}

/// [`flash`] without the actions that are necessary after success and failure alike.
fn procedure(
    session: &mut Session<'_>,
    file: &Payload,
    update: &mut RunningUpdate<'_>,
) -> Result<Report, Error> {
    let began = session.now();
    // What options alone decide is decided before the first frame, or where the dialect is found.
    if let Some(dialect) = update.options.dialect {
        questions(file, dialect, &update.options).judge(dialect)?;
        dialect::of(dialect).judge_password(session.node(), update.options.unlock)?;
    }
    reach(session, update, |session, update| {
        let found = find(session, update)?;
        let mut admission = questions(file, found.dialect, &update.options);
        admission.ask(session, found.dialect)?;
        if found.dialect == Dialect::EsAcademy {
            dialect::of(found.dialect).judge_password(session.node(), update.options.unlock)?;
        }
        // The target may be that of the device itself, as a plan has found it: only a file says more.
        if let Some(target) = update.options.check_target.filter(|target| file.target() == Some(*target)) {
            update.report(Note::TargetRight(target).into());
        }
        warn_of_older(session, file, found.dialect, update)?;
        enter(session, file, found, admission, update)
    })?;
    let (dialect, options) = (update.dialect, update.options);
    let procedure = entry::procedure(file, dialect);
    if dialect != Dialect::Block {
        session.leave_group();
    }
    let downloaded = procedure.download(session, file, update)?;
    let Downloaded { repeats, took: transfer, released, renewal } = downloaded;
    let mut watched = None;
    let running = match renewal {
        Some(renewal) => renewal.running,
        None if options.start => {
            let time = watch::time(session, dialect, &options)?;
            update.report(Phase::Starting.into());
            update.losses = Some(session.losses());
            let starts = session.now();
            let running = procedure.start(session, update.original, options.program)?;
            watch::watch(session, starts, time)?;
            update.report(Phase::Started(running).into());
            watched = Some((starts, time));
            Some(running)
        }
        None => None,
    };
    // 1F56h of a program is not that of a new bootloader.
    if options.verify && renewal.is_none() {
        let crc = compare_crc(session, options.program, file.crcs());
        let crc = match watched {
            Some((starts, _)) => crc.map_err(|error| watch::fell_silent(session, starts, error))?,
            None => crc?,
        };
        update.report(Phase::VerifiedAgain { crc }.into());
    }
    let took = session.now().saturating_sub(began);
    let (program_size, program_crc) = (file.size(), file.crc());
    let transfers = session.transfers();
    Ok(Report {
        program_size,
        program_crc,
        device_crc: update.verified,
        tried: update.tried,
        repeats,
        took,
        transfer,
        transfers,
        running,
        watched: watched.map(|(_, time)| time),
        released,
        dialect,
        renewal: renewal.map(|renewal| Renewal { took, ..renewal }),
    })
}
