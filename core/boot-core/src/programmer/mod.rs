//! The flash half of a download: carries out the accepted work, one operation or one bounded
//! computation at a time.
//!
//! Pieces wait in the source. The programmer erases sectors before the pieces need them, writes each
//! piece and reads it back, and computes the CRC of the program at the end. It also writes what the
//! store needs. It knows pieces, addresses and program numbers, but no formats, objects or commands:
//! all its data come from one [`Source`].
//!
//! **Data are not changed while a record for them is valid**: [`Programmer::open`] and
//! [`Programmer::void`] only note that a record must be removed, and until it is removed, nothing
//! is erased or written. The record of an opened program is removed with the first piece and not
//! before: a refusal or an abort until then has no effect on the old program.
//!
//! Staging is the end of the last program's flash and the place of a new RAM image, so there two
//! records can be in the way. [`Programmer::may_take`] is the rule for it.

mod install;
mod write;

use core::marker::PhantomData;
use core::task::Poll;

use canopen::program::{FlashError, Supply, SUPPLY_DETAIL};
use shared_abi::geometry::{Region, Sector};
use shared_abi::ram_image::Header;
use shared_abi::renewal::{State, BOOTLOADER};

use crate::choices::{Choices, Has};
use crate::crc::CrcKind;
use crate::flash::{Flash, FlashFault, Next, Operation};
use crate::program::{Expected, FlashCrc};
use crate::queue::Piece;
use crate::renewal::{check, Places};
use crate::resume::Partial;
use crate::source::{Demand, Source};
use crate::store::{Key, NodeParameters, Parameters, ProgramRecord, RenewalRecord, Value};
use install::{value, Phase};
use write::WritePiece;

pub(crate) use install::Renewing;

/// The result of a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Step {
    /// There is no work.
    Idle,
    /// The flash is programming a word, which takes tens of microseconds.
    Programming,
    /// The flash is erasing a sector, which takes hundreds of milliseconds.
    Erasing,
    /// There is more to compute; call again soon.
    Again,
}

/// The number of bytes that one step checks for the erased state; the size of each sector is a
/// multiple of it. A CRC over as many bytes takes about as long.
const BLANK_STEP: u32 = 1024;

/// The end of a piece of work.
pub(crate) enum Event {
    /// The record of a program is stored or removed; `ends`: this ends a piece of work.
    Stored { program: u8, ends: bool },
    /// A program was written completely; with its CRC in flash.
    Written { program: u8, expected: Expected, crc: u32 },
    /// The storing of node-ID and bit rate has ended.
    NodeStored(Result<(), FlashError>),
    /// The work on a program failed. `erasing`: an erase failed.
    Failed { program: u8, error: FlashError, erasing: bool },
}

/// The program that is being downloaded, and the state of its flash.
#[derive(Clone, Copy, Debug)]
struct Target {
    program: u8,
    region: Region,
    /// The flash is erased up to this address.
    erased: u32,
    /// The flash may be erased up to this address before data arrive.
    ahead: u32,
    /// `Some` while nothing is lost yet, because neither a piece nor a command to erase has come:
    /// the later value of `ahead`.
    untouched: Option<u32>,
    /// All of it is being erased for a command.
    clearing: bool,
    /// A download has begun, perhaps while `clearing`.
    opened: bool,
    /// See [`ProgramRecord::half_erased`]; not including the present work, which begins with the
    /// removal of the record.
    half_erased: bool,
    /// What is stored of its progress.
    partial: Partial,
}

/// The present work.
enum Job {
    /// A value is being stored; with the program that it concerns.
    Store(Change, u8),
    /// A sector until its erase was started, and its end; or no sector, and the address up to which
    /// the flash was found to be erased.
    Erase { sector: Option<Sector>, until: u32 },
    /// The next piece of the source is being written.
    Write(WritePiece),
    /// The source processes received bytes.
    Process,
    /// The flash is compared with the sent program.
    Verify { expected: Expected, crc: FlashCrc },
    /// A confirmed RAM image is being installed.
    Install,
}

/// The kind of change in the store.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Change {
    /// The record of a program is removed.
    Void,
    /// The record of a program is replaced.
    Record,
    /// The same at the end of CLEAR: a download may begin before it.
    Clear,
    /// The same as `Record`, but no host waits for it.
    Confirm,
    /// Node-ID and bit rate.
    Node,
    /// A value that the program must have before its record: the security counter of a sealed image, or its date.
    Value,
    /// A value for which no host waits.
    Note,
    /// The record that permits an installation.
    Permit,
    /// No value: the store is compacted.
    Compact,
}

/// The flash half. It starts operations and polls them, but never waits for them. `C` is what
/// the device has.
pub(crate) struct Programmer<'b, C> {
    choices: PhantomData<fn() -> C>,
    source: Source<'b>,
    crc_kind: CrcKind,
    crc_step: u32,
    target: Option<Target>,
    /// Bit n: the record of program n must be removed before anything is erased or written.
    voids: u32,
    /// The region of a program whose record is only removed if all of it may be written.
    unwritten: Option<Region>,
    /// See [`take_detail`](Self::take_detail).
    detail: u8,
    /// Whether the counter proved by the next of these programs is already stored.
    kept: bool,
    job: Option<Job>,
    /// Whether a value was stored since the last compaction: one that fails is not repeated for ever.
    may_compact: bool,
    /// The installation of a RAM image.
    install: Option<Phase>,
    /// `None` if the RAM image cannot be renewed.
    pub renewing: Option<Renewing>,
    /// The present operation of the flash. Without a job its result is ignored.
    running: Option<Step>,
}

impl<'b, C: Choices> Programmer<'b, C> {
    /// One step of a CRC covers `crc_step` bytes.
    pub(crate) fn new(source: Source<'b>, crc_kind: CrcKind, crc_step: u32) -> Self {
        Self {
            choices: PhantomData,
            source,
            crc_kind,
            crc_step,
            target: None,
            voids: 0,
            unwritten: None,
            detail: 0,
            kept: false,
            job: None,
            may_compact: true,
            install: None,
            renewing: None,
            running: None,
        }
    }

    pub(crate) fn into_buffer(self) -> &'b mut [u8] {
        self.source.queue.into_buffer()
    }

    /// The source of its data.
    pub(crate) fn source(&self) -> &Source<'b> {
        &self.source
    }

    /// See [`source`](Self::source).
    pub(crate) fn source_mut(&mut self) -> &mut Source<'b> {
        &mut self.source
    }

    /// Prepares for pieces of this program, and of no other. The first piece removes its record.
    /// With `erase`, its sectors are erased, those of the first `size` bytes before data arrive;
    /// otherwise each piece must find its place erased. CLEAR that is still at work goes on beside the
    /// pieces.
    /// `partial` is the progress to begin with: a download that goes on begins after its region's
    /// start.
    pub(crate) fn open(&mut self, program: u8, region: Region, erase: bool, size: u32, partial: Partial) {
        let (erased, ahead) = if erase {
            (partial.start(), region.base + size.min(region.size))
        } else {
            (region.end(), region.end())
        };
        let (untouched, clearing, opened, half_erased) = (Some(ahead), false, true, true);
        let ahead = erased;
        self.source.end();
        if let Some(target) =
            self.target.as_mut().filter(|target| target.program == program && target.clearing)
        {
            (target.opened, target.partial) = (true, partial);
            return;
        }
        self.target = Some(Target {
            program,
            region,
            erased,
            ahead,
            untouched,
            clearing,
            opened,
            half_erased,
            partial,
        });
    }

    /// The download of this program does not go on after a cut: a part of it was refused, or its pieces
    /// are of another file from here on.
    pub(crate) fn forbid_resume(&mut self, program: u8) {
        let Some(target) = self.target.as_mut().filter(|target| target.program == program) else { return };
        // The first piece removes the record in any case.
        if C::RESUMES && target.partial.forbid() && target.untouched.is_none() {
            self.void(program);
        }
    }

    /// Removes the record of a program, then erases all its sectors that are not erased.
    pub(crate) fn erase_all(&mut self, program: u8, region: Region) {
        self.open(program, region, true, region.size, Partial::begin(0, region.base));
        if let Some(target) = &mut self.target {
            (target.clearing, target.opened) = (true, false);
        }
    }

    /// Removes the record of a program. The record of the target marks it as half erased until the
    /// work on it has ended.
    pub(crate) fn void(&mut self, program: u8) {
        self.voids |= bit(program);
    }

    /// The same if this part of the program's flash may be written: for its first piece, or for a password,
    /// which needs no data.
    pub(crate) fn void_if_writable(&mut self, program: u8, region: Region) {
        self.unwritten = Some(region);
        self.void(program);
    }

    /// The program was sent completely, with this date.
    pub(crate) fn complete(&mut self, expected: Expected, date: u32) {
        if let Some(target) = &mut self.target {
            self.source.complete(expected, date);
            // Bytes without a piece belong to the program, too, and must read FFh.
            target.ahead = target.ahead.max(target.region.base + expected.size);
        }
    }

    /// Replaces the record of a program. With `confirms`, the change marks a program that has
    /// returned the device; no host waits for it, and other work is accepted meanwhile.
    /// [`may_store`](Self::may_store) must be true.
    pub(crate) fn record(
        &mut self,
        parameters: &mut impl Parameters,
        program: u8,
        record: ProgramRecord,
        confirms: bool,
    ) {
        let change = if confirms { Change::Confirm } else { Change::Record };
        self.job = Some(store(parameters, change, program, record.value()));
    }

    /// Replaces the record of the RAM image in staging.
    ///
    /// # Errors
    /// [`may_replace`](Self::may_replace).
    pub(crate) fn record_image(
        &mut self,
        parameters: &mut impl Parameters,
        record: RenewalRecord,
    ) -> Result<(), FlashError> {
        self.may_replace(BOOTLOADER)?;
        self.job = Some(store(parameters, Change::Record, BOOTLOADER, record.value()));
        Ok(())
    }

    /// Installs the confirmed RAM image.
    pub(crate) fn install(&mut self) {
        self.install = Some(Phase::Counter);
    }

    /// The stored record of the RAM image in staging.
    pub(crate) fn image(&self) -> Option<RenewalRecord> {
        self.renewing.as_ref().and_then(|renewing| renewing.record)
    }

    /// **The rule of staging**: whether a download of this program, or a command that erases it,
    /// may go on now.
    ///
    /// - Nothing removes the record of a *confirmed* image but its installation. Until then neither
    ///   the last program nor another image takes its flash.
    /// - Data are not changed while a record for them is valid: an image waits until a program that
    ///   reaches into staging was cleared.
    ///
    /// The answer may change while a download is open, by another one or by an installation that
    /// failed. So `control` asks at the beginning of each transfer and each command, and once more
    /// before anything is lost for the first data; [`may_replace`](Self::may_replace) asks last.
    ///
    /// # Errors
    /// [`FlashError::Busy`] for a confirmed image; [`FlashError::NotCleared`], with the program as the
    /// [detail](Self::take_detail).
    pub(crate) fn may_take(&mut self, program: u8) -> Result<(), FlashError> {
        let Some(renewing) = self.renewing.as_ref().filter(|_| C::RENEWS) else { return Ok(()) };
        let last = renewing.last_program();
        if program != BOOTLOADER && program != last {
            return Ok(());
        }
        if renewing.is_confirmed() {
            return Err(FlashError::Busy);
        }
        if program == BOOTLOADER && renewing.is_occupied {
            self.detail = last;
            return Err(FlashError::NotCleared);
        }
        Ok(())
    }

    /// Whether the record of a program may be replaced or removed now. That of a confirmed image is changed by its
    /// installation alone, which does not ask; each other [`store`] of a record that may be the image's does.
    fn may_replace(&self, program: u8) -> Result<(), FlashError> {
        let is_kept = C::RENEWS
            && program == BOOTLOADER
            && !self.is_installing()
            && self.renewing.as_ref().is_some_and(Renewing::is_confirmed);
        (!is_kept).then_some(()).ok_or(FlashError::Busy)
    }

    /// The two places of a RAM image.
    fn places(&self) -> Places {
        self.renewing.map_or(Places::NONE, |renewing| renewing.places())
    }

    /// Whether a RAM image is being installed.
    pub(crate) fn is_installing(&self) -> bool {
        C::RENEWS && self.install.is_some()
    }

    /// The installation has failed.
    fn stop_installing(&mut self) {
        if C::RENEWS {
            self.install = None;
        }
    }

    /// Stores node-ID and bit rate.
    pub(crate) fn store_node(&mut self, parameters: &mut impl Parameters, node: NodeParameters) {
        parameters.store(Key::NODE, node.value());
        self.job = Some(Job::Store(Change::Node, 0));
    }

    /// Discards the received data. A value that is being stored is still completed.
    pub(crate) fn abort(&mut self) {
        self.source.clear();
        self.target = None;
        if !self.is_storing() {
            self.job = None;
        }
    }

    /// [`ProgramRecord::half_erased`] of a program that has just been written.
    pub(crate) fn is_half_erased(&self) -> bool {
        self.target.as_ref().is_none_or(|target| target.half_erased)
    }

    /// More about the error that ended the last work, once: the number of the protected sector,
    /// [`SUPPLY_DETAIL`], or that of a damage of a new RAM image; 0 for other errors.
    pub(crate) fn take_detail(&mut self) -> u8 {
        core::mem::take(&mut self.detail)
    }

    /// The program that is being downloaded.
    pub(crate) fn program(&self) -> Option<u8> {
        self.target.map(|target| target.program)
    }

    /// Whether [`step`](Self::step) has work to do. The flash cannot be read meanwhile.
    pub(crate) fn is_busy(&self) -> bool {
        self.has_work() || self.is_storing()
    }

    /// Whether a value is being stored, or the store is being compacted.
    pub(crate) fn is_storing(&self) -> bool {
        matches!(self.job, Some(Job::Store(..)))
    }

    /// Whether another value can be stored: only a compaction goes on, or nothing.
    pub(crate) fn may_store(&self) -> bool {
        !self.has_work() && (!self.is_storing() || self.is_compacting())
    }

    /// Whether the store is being compacted.
    pub(crate) fn is_compacting(&self) -> bool {
        matches!(self.job, Some(Job::Store(Change::Compact, _)))
    }

    /// Compacts the store, if at least `used` of its places are used. Returns whether it begins.
    pub(crate) fn compact(&mut self, parameters: &mut impl Parameters, used: u32) -> bool {
        if self.job.is_some() || !self.may_compact || !parameters.compact(used) {
            return false;
        }
        self.may_compact = false;
        self.job = Some(Job::Store(Change::Compact, 0));
        true
    }

    /// Whether there is work that a command must wait for.
    pub(crate) fn has_work(&self) -> bool {
        let confirming =
            matches!(self.job, Some(Job::Store(Change::Confirm | Change::Note | Change::Compact, _)));
        (self.job.is_some() || self.running.is_some()) && !confirming
            || self.voids != 0
            || self.is_installing()
            || self.source.has_work()
            || self.target.as_ref().is_some_and(|target| target.clearing || target.erased < target.ahead)
    }

    /// Whether it works on a command or on the end of a program, so that no further block of that
    /// program is accepted; or on discarded work, so that no command is accepted.
    pub(crate) fn is_busy_with(&self, program: u8) -> bool {
        let current = self.program() == Some(program);
        let ending = match self.job {
            Some(Job::Store(Change::Record | Change::Clear, of)) => of == program,
            Some(Job::Verify { .. }) => current,
            _ => false,
        };
        let waiting =
            |target: &Target| target.clearing || self.source.is_complete() || !self.source.has_room();
        let installing = self.is_installing() && program == BOOTLOADER;
        ending
            || installing
            || self.target.as_ref().map_or(self.has_work(), |target| current && waiting(target))
    }

    /// The program that was sent completely, or whose record is being stored: its host believes
    /// that this is done, and a reset now would undo it.
    pub(crate) fn finishing(&self) -> Option<u8> {
        match self.job {
            Some(Job::Store(Change::Record, of)) => Some(of),
            Some(Job::Verify { .. }) => self.program(),
            _ => self.program().filter(|_| self.source.is_complete()),
        }
    }

    /// Whether [`abort`](Self::abort) undoes nothing that a host believes to be done.
    pub(crate) fn is_abortable(&self) -> bool {
        let clearing = self.target.as_ref().is_some_and(|target| target.clearing && !target.opened);
        !clearing && !self.is_installing() && self.finishing().is_none() && !self.is_storing_node()
    }

    /// Whether all of this program was erased for a command, or is being erased, and no download has begun
    /// since.
    pub(crate) fn has_cleared(&self, program: u8) -> bool {
        self.target.as_ref().is_some_and(|target| target.program == program && !target.opened)
    }

    /// Whether node-ID and bit rate are being stored.
    pub(crate) fn is_storing_node(&self) -> bool {
        matches!(self.job, Some(Job::Store(Change::Node, _)))
    }

    /// Continues the work with one step. `note` returns a value that must be stored although no host
    /// waits for it, once; it is stored before anything else is done.
    pub(crate) fn step<F: Flash>(
        &mut self,
        parameters: &mut impl Parameters,
        flash: &mut F,
        note: impl FnOnce() -> Option<(Key, Value)>,
    ) -> (Step, Option<Event>) {
        let mut outcome = Ok(());
        loop {
            if let Some(running) = self.running {
                let Poll::Ready(ended) = flash.poll() else { return (running, None) };
                self.running = None;
                outcome = ended;
            }
            if self.job.is_none() {
                return match self.choose(parameters, flash, note) {
                    Ok(None) => (Step::Idle, None),
                    Ok(job) => {
                        self.job = job;
                        (Step::Again, None)
                    }
                    Err(error) => (Step::Again, self.fail(error, false)),
                };
            }
            match self.next(parameters, flash, outcome) {
                Next::Start(operation) => {
                    outcome = flash.start(operation);
                    if outcome.is_ok() {
                        self.running = Some(match operation {
                            Operation::Erase(_) => Step::Erasing,
                            Operation::Program { .. } => Step::Programming,
                        });
                    }
                }
                Next::Again => return (Step::Again, None),
                Next::Done(result) => return (Step::Again, self.done(result)),
            }
        }
    }

    /// The next action of the job.
    fn next<F: Flash>(
        &mut self,
        parameters: &mut impl Parameters,
        flash: &F,
        outcome: Result<(), FlashFault>,
    ) -> Next<FlashError> {
        let next = match (&mut self.job, outcome) {
            (Some(Job::Store(..)), outcome) => {
                return match parameters.next(flash, outcome) {
                    Next::Start(operation) => Next::Start(operation),
                    Next::Again => Next::Again,
                    Next::Done(result) => Next::Done(result.map_err(|_| FlashError::NvData)),
                };
            }
            (_, Err(fault)) => Err(fault),
            (Some(Job::Erase { sector, .. }), _) => Ok(sector.take().map(Operation::Erase)),
            (Some(Job::Process), _) => return Next::Done(self.source.step(flash, parameters)),
            (Some(Job::Write(write)), _) => {
                let source = &self.source;
                write.next(flash, move |at| source.byte(at))
            }
            (Some(Job::Verify { crc, .. }), _) => {
                return match crc.step(flash, self.crc_kind, self.crc_step) {
                    true => Next::Done(Ok(())),
                    false => Next::Again,
                };
            }
            (Some(Job::Install), _) if C::RENEWS => {
                let places = self.places();
                let record = self.image();
                let step = self.crc_step;
                match self
                    .install
                    .as_mut()
                    .zip(record)
                    .map(|(install, record)| install.next(flash, places, &record, step))
                {
                    Some(Next::Start(operation)) => Ok(Some(operation)),
                    Some(Next::Again) => return Next::Again,
                    Some(Next::Done(Err(fault))) => Err(fault),
                    Some(Next::Done(Ok(()))) | None => Ok(None),
                }
            }
            (Some(Job::Install) | None, _) => Ok(None),
        };
        match next {
            Ok(Some(operation)) => Next::Start(operation),
            Ok(None) => Next::Done(Ok(())),
            Err(FlashFault::Protected) => {
                let at = match (&self.job, &self.install) {
                    (Some(Job::Erase { until, .. }), _) => until - 1,
                    (Some(Job::Write(write)), _) => write.at(),
                    (Some(Job::Install), Some(install)) if C::RENEWS => install.at(),
                    _ => 0,
                };
                self.detail = flash.sector_at(at).map_or(0, |sector| sector.number);
                Next::Done(Err(FlashError::Secured))
            }
            Err(FlashFault::Supply) => Next::Done(Err(self.low_supply())),
            Err(_) => Next::Done(Err(FlashError::Write)),
        }
    }

    /// The error of a supply that is too low: nothing was written.
    fn low_supply(&mut self) -> FlashError {
        self.detail = SUPPLY_DETAIL;
        FlashError::NoAccess
    }

    /// Ends the job.
    fn done(&mut self, result: Result<(), FlashError>) -> Option<Event> {
        let job = self.job.take()?;
        if matches!(job, Job::Store(change, _) if change != Change::Compact) {
            self.may_compact = true;
        }
        match (job, result) {
            (Job::Store(Change::Node, _), result) => Some(Event::NodeStored(result)),
            (Job::Store(Change::Permit, _), Ok(())) if C::RENEWS => {
                let places = self.places();
                self.install = Some(Phase::erase(places));
                Some(Event::Stored { program: BOOTLOADER, ends: false })
            }
            // A compaction that fails loses nothing.
            (Job::Store(Change::Compact, _), _) => None,
            (Job::Store(Change::Value | Change::Note, _) | Job::Process | Job::Install, Ok(())) => None,
            (Job::Store(change, program), result) => {
                // A record whose counter could not be stored stays, too.
                if matches!(change, Change::Void | Change::Value) {
                    self.voids &= !bit(program);
                    self.kept = false;
                }
                if change == Change::Record {
                    self.source.stored(result);
                }
                match result {
                    Ok(()) => {
                        let ends = matches!(change, Change::Record | Change::Clear);
                        Some(Event::Stored { program, ends })
                    }
                    // The consequence is only another rescue window.
                    Err(_) if change == Change::Confirm => None,
                    Err(error) => {
                        // A value of something else, which cannot be stored, does not end an installation.
                        if program == BOOTLOADER {
                            self.stop_installing();
                        }
                        // If the record cannot be removed, its data must not be changed.
                        let mut program = program;
                        if let Some(of) = self.program().filter(|of| change == Change::Void || *of == program)
                        {
                            self.abort();
                            program = of;
                        }
                        Some(Event::Failed { program, error, erasing: false })
                    }
                }
            }
            (job, Err(error)) => self.fail(error, matches!(job, Job::Erase { .. })),
            (Job::Erase { until, .. }, Ok(())) => {
                self.target.as_mut()?.erased = until;
                None
            }
            (Job::Write(_), Ok(())) => {
                if C::RESUMES {
                    self.note();
                }
                self.source.written();
                None
            }
            (Job::Verify { expected, crc }, Ok(())) => {
                Some(Event::Written { program: self.program()?, expected, crc: crc.value() })
            }
        }
    }

    /// Notes the progress of a download that could go on, sixteen times in the program.
    fn note(&mut self) {
        let (Some(target), Some(piece)) = (&mut self.target, self.source.piece()) else { return };
        if target.partial.note(piece.address + piece.size, target.ahead - target.region.base) {
            let program = target.program;
            self.void(program);
        }
    }

    fn fail(&mut self, error: FlashError, erasing: bool) -> Option<Event> {
        self.source.fail(error);
        // The signature of a request for rights belongs to no program.
        let program = if self.is_installing() { BOOTLOADER } else { self.program().unwrap_or(0) };
        self.stop_installing();
        self.abort();
        Some(Event::Failed { program, error, erasing })
    }

    /// Chooses the next work for an idle flash: the first of these that there is.
    fn choose<F: Flash>(
        &mut self,
        parameters: &mut impl Parameters,
        flash: &F,
        note: impl FnOnce() -> Option<(Key, Value)>,
    ) -> Result<Option<Job>, FlashError> {
        if let Some(job) = note().map(|note| store_note(parameters, note)).or_else(|| self.process_first()) {
            return Ok(Some(job));
        }
        if C::RENEWS {
            while self.install.is_some() {
                if let Some(job) = self.go_on_installing(parameters, flash)? {
                    return Ok(Some(job));
                }
            }
        }
        let piece = self.piece();
        if self.unwritten.is_none() {
            self.give_up_old(flash, piece)?;
        }
        if C::RENEWS {
            self.give_up_staging(piece);
        }
        if let Some(region) = self.unwritten.take() {
            self.check_writable(flash, region).inspect_err(|_| self.voids = 0)?;
        }
        if let Some(job) = self.remove_record(parameters, flash)? {
            return Ok(Some(job));
        }
        let Some(target) = &mut self.target else { return Ok(None) };
        if let Some(job) = target.erase(flash, piece)? {
            return Ok(Some(job));
        }
        if let Some(job) = target.end_clear(parameters) {
            return Ok(Some(job));
        }
        match piece {
            Some(piece) => target.write::<C>(flash, piece).map(Some),
            None => self.complete_program(parameters),
        }
    }

    /// The next piece of the source. The blocks of a new RAM image have the addresses of home, and are
    /// written to staging.
    fn piece(&self) -> Option<Piece> {
        let piece = self.source.piece()?;
        match &self.renewing {
            Some(renewing) if C::RENEWS && self.program() == Some(BOOTLOADER) => {
                Some(renewing.placed(piece, self.source.unsealer.is_active()))
            }
            _ => Some(piece),
        }
    }

    /// Does what is urgent in the source.
    fn process_first(&self) -> Option<Job> {
        self.source.is_urgent().then_some(Job::Process)
    }

    /// With the first piece, or for CLEAR, the old program is given up: its record must be removed
    /// first.
    fn give_up_old<F: Flash>(&mut self, flash: &F, piece: Option<Piece>) -> Result<(), FlashError> {
        let Some(target) = &mut self.target else { return Ok(()) };
        if piece.is_none() && !target.clearing && !self.source.is_sized() {
            return Ok(());
        }
        let Some(ahead) = target.untouched else { return Ok(()) };
        if C::RENEWS {
            // Nothing was lost: the download ends.
            let program = target.program;
            self.may_take(program)?;
            if program == BOOTLOADER {
                judge_image(self.renewing.as_ref(), &self.source, piece, &mut self.detail)?;
            }
        }
        let Some(target) = &mut self.target else { return Ok(()) };
        // Nothing is lost for a program that the flash does not take.
        let region = target.region;
        let size = match (self.source.size(), ahead - region.base) {
            (Some(size), _) => size,
            (None, 0) => region.size,
            (None, announced) => announced,
        };
        target.untouched = None;
        target.ahead = target.ahead.max(ahead);
        if C::RESUMES && target.partial.is_resumed() {
            // The data end within a sector that was erased for them; or at the start of one that
            // may be half erased.
            let sector = flash.sector_at(target.erased).ok_or(FlashError::Address)?;
            if sector.region.base != target.erased {
                target.erased = sector.region.end();
            }
        }
        let program = target.program;
        self.void_if_writable(program, Region::new(region.base, size));
        Ok(())
    }

    /// The next job of an installation.
    fn go_on_installing<F: Flash>(
        &mut self,
        parameters: &mut impl Parameters,
        flash: &F,
    ) -> Result<Option<Job>, FlashError> {
        let Some(record) = self.image() else { return Err(FlashError::NoValidProgram) };
        let Some(install) = &self.install else { return Ok(None) };
        let (change, state) = match install {
            Phase::Counter => {
                // It was good when it was loaded. Home is not given up for one that has decayed since.
                // Its record goes, and the installation ends without one.
                let Some(Header { counter, .. }) = self.staged(flash, &record) else {
                    return Ok(Some(store(parameters, Change::Void, BOOTLOADER, RenewalRecord::NONE)));
                };
                let raised = self.raised_counter(parameters, flash, counter);
                self.install = Some(Phase::Permit);
                return Ok(raised.map(|counter| store_counter(parameters, BOOTLOADER, counter)));
            }
            Phase::Permit => (Change::Permit, State::Confirmed),
            Phase::Done => (Change::Record, State::Installed),
            Phase::Erase(_) | Phase::Copy(_) | Phase::Check(_) => return Ok(Some(Job::Install)),
        };
        let value = value(&record, state);
        if change == Change::Record {
            self.install = None;
        } else {
            self.check_writable(flash, self.places().home)?;
        }
        Ok(Some(store(parameters, change, BOOTLOADER, value)))
    }

    /// The header of the image in staging, if the whole image is still that of the record.
    fn staged<F: Flash>(&self, flash: &F, record: &RenewalRecord) -> Option<Header> {
        let renewing = self.renewing.as_ref()?;
        let image = check(flash, renewing.places().staging, renewing.layout, renewing.host);
        image.ok().filter(|image| image.crc == record.crc)
    }

    /// The stored counter of the bootloader with this lowest value; `None` on a device that takes no sealed
    /// images.
    fn raised_counter<F: Flash>(
        &self,
        parameters: &impl Parameters,
        flash: &F,
        lowest: u32,
    ) -> Option<Value> {
        if !self.source.unsealer.is_present() {
            return None;
        }
        let key = Key::counter(BOOTLOADER);
        let [counter, epoch, installed, _] = parameters.get(flash, key).unwrap_or([0; 4]);
        Some([counter.max(lowest), epoch, installed, 0])
    }

    /// A program that reaches into staging takes its flash: the record of the image there is removed first.
    fn give_up_staging(&mut self, piece: Option<Piece>) {
        let (Some(target), Some(renewing)) = (&self.target, &self.renewing) else { return };
        if target.untouched.is_some() {
            return;
        }
        let end = piece.map_or(target.ahead, |piece| target.ahead.max(piece.address + piece.size));
        if renewing.is_reached(target.program, end) {
            self.void(BOOTLOADER);
        }
    }

    /// Whether all sectors of a region may be written now.
    pub(crate) fn check_writable<F: Flash>(&mut self, flash: &F, region: Region) -> Result<(), FlashError> {
        if flash.supply() == Supply::Low {
            return Err(self.low_supply());
        }
        let mut at = region.base;
        while at < region.end() {
            let sector = flash.sector_at(at).ok_or(FlashError::Address)?;
            if flash.is_protected(sector) {
                self.detail = sector.number;
                return Err(FlashError::Secured);
            }
            at = sector.region.end();
        }
        Ok(())
    }

    /// Removes the record of a program, or writes the progress of its download into it.
    fn remove_record(
        &mut self,
        parameters: &mut impl Parameters,
        flash: &impl Flash,
    ) -> Result<Option<Job>, FlashError> {
        if self.voids == 0 {
            return Ok(None);
        }
        let program = of_bit::<C>(self.voids.trailing_zeros() as u8);
        // A record that stays is not asked for again.
        self.may_replace(program).inspect_err(|_| self.voids = 0)?;
        // The counter that a program has proved must survive its record.
        if let Some(counter) = self.source.proved(flash, parameters, program) {
            if !core::mem::replace(&mut self.kept, true) {
                return Ok(Some(store_counter(parameters, program, counter)));
            }
        }
        let stored = parameters.get(flash, Key::program(program));
        let mut half_erased = stored.is_some_and(ProgramRecord::is_half_erased);
        let mut partial = Partial::NONE;
        if let Some(target) = self.target.as_mut().filter(|target| target.program == program) {
            // From the second time on, the stored value is that of the present work.
            target.half_erased &= core::mem::replace(&mut half_erased, true);
            partial = target.partial;
        }
        let value = ProgramRecord::none(half_erased, partial.words());
        Ok(Some(store(parameters, Change::Void, program, value)))
    }

    /// All pieces are written: continues as the source demands.
    fn complete_program(&mut self, parameters: &mut impl Parameters) -> Result<Option<Job>, FlashError> {
        let Some(target) = &mut self.target else { return Ok(None) };
        let program = target.program;
        if C::DATES && program != BOOTLOADER {
            if let Some(date) = self.source.take_date() {
                parameters.store(Key::date(program), date);
                return Ok(Some(Job::Store(Change::Value, program)));
            }
        }
        Ok(match self.source.next()? {
            Demand::Wait => None,
            Demand::Process => Some(Job::Process),
            Demand::Counter(counter) => Some(store_counter(parameters, program, counter)),
            Demand::Keep(record) => {
                self.may_replace(program)?;
                Some(store(parameters, Change::Record, program, record))
            }
            Demand::Verify(expected) => {
                let crc = FlashCrc::new(Region::new(target.region.base, expected.size));
                Some(Job::Verify { expected, crc })
            }
        })
    }
}

impl Target {
    /// Erases the flash for the piece, or ahead of it.
    fn erase<F: Flash>(&self, flash: &F, piece: Option<Piece>) -> Result<Option<Job>, FlashError> {
        let needed = piece.map_or(self.ahead, |piece| piece.address + piece.size);
        let sector = flash.sector_at(self.erased);
        // A sector that was looked at in part may still have to be erased, and data with it.
        let is_within = sector.is_some_and(|sector| sector.region.base != self.erased);
        if self.erased >= needed && !(self.clearing && is_within) {
            return Ok(None);
        }
        let sector = sector.ok_or(FlashError::Address)?;
        let place = Region::new(self.erased, BLANK_STEP);
        if self.clearing && !self.half_erased && flash.is_blank(place) {
            return Ok(Some(Job::Erase { sector: None, until: place.end() }));
        }
        Ok(Some(Job::Erase { sector: Some(sector), until: sector.region.end() }))
    }

    /// All of it is erased for a command: stores that no erase is unfinished, unless a download has begun
    /// meanwhile.
    fn end_clear(&mut self, parameters: &mut impl Parameters) -> Option<Job> {
        if !self.clearing || self.erased < self.region.end() {
            return None;
        }
        (self.clearing, self.half_erased) = (false, false);
        let value = ProgramRecord::none(false, [0; 2]);
        (!self.opened).then(|| store(parameters, Change::Clear, self.program, value))
    }

    /// Writes the piece.
    fn write<C: Choices>(&self, flash: &impl Flash, piece: Piece) -> Result<Job, FlashError> {
        let again = C::RESUMES && self.partial.is_resumed();
        WritePiece::new(flash, piece, again).map(Job::Write).ok_or(FlashError::NotCleared)
    }
}

/// Judges a new RAM image by its first piece.
fn judge_image(
    renewing: Option<&Renewing>,
    source: &Source<'_>,
    piece: Option<Piece>,
    detail: &mut u8,
) -> Result<(), FlashError> {
    let (Some(renewing), Some(piece)) = (renewing, piece) else { return Err(FlashError::Format) };
    if piece.address != renewing.places().staging.base || piece.size < Header::SIZE {
        return Err(FlashError::Format);
    }
    let mut header = [0; Header::SIZE as usize];
    for (at, byte) in header.iter_mut().enumerate() {
        *byte = source.byte(at);
    }
    let unsealer = &source.unsealer;
    renewing.judge(&header, unsealer.is_active().then(|| unsealer.edition().counter), detail)
}

/// The program of a bit in `voids`: [`bit`] has 31 for the bootloader.
fn of_bit<C: Choices>(bit: u8) -> u8 {
    match bit {
        31 if C::RENEWS => BOOTLOADER,
        bit => bit,
    }
}

/// The bit of a program in `voids`.
fn bit(program: u8) -> u32 {
    1_u32.wrapping_shl(program.into())
}

/// Starts to store a value of a program.
fn store(parameters: &mut impl Parameters, change: Change, program: u8, value: Value) -> Job {
    parameters.store(Key::program(program), value);
    Job::Store(change, program)
}

/// Starts to store a value for which no host waits.
fn store_note(parameters: &mut impl Parameters, (key, value): (Key, Value)) -> Job {
    parameters.store(key, value);
    Job::Store(Change::Note, 0)
}

/// Starts to store the security counter of a program.
fn store_counter(parameters: &mut impl Parameters, program: u8, counter: Value) -> Job {
    parameters.store(Key::counter(program), counter);
    Job::Store(Change::Value, program)
}
