//! The flash half of a download: what was accepted is carried through, an operation or a bounded
//! computation at a time.
//!
//! Pieces wait in a queue. Sectors are erased ahead of them, each piece is written and read back,
//! and when all is there the CRC over the program is computed. Beside that it carries through what
//! the store wants written. It knows pieces, addresses and program numbers; no format, no object
//! and no command.
//!
//! **No data are touched while their record stands**: [`Programmer::open`] and
//! [`Programmer::void`] only note that a record has to go, and as long as one has to, nothing is
//! erased or written. The record of an opened program goes with the first piece, not before: what is
//! refused until then, or broken off, has cost nothing.

mod write;

use core::task::Poll;

use canopen::program::FlashError;
use shared_abi::block_file::MAX_BLOCK_SIZE;
use shared_abi::geometry::{Region, Sector};

use crate::crc::CrcKind;
use crate::flash::{Flash, FlashFault, Next, Operation};
use crate::program::{Expected, FlashCrc};
use crate::queue::Queue;
use crate::store::{Key, NodeParameters, Parameters, ProgramRecord, Value};
use crate::unseal::Unsealer;
use write::WritePiece;

/// What came of a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Step {
    /// There is no work.
    Idle,
    /// The flash programs a word, which takes it tens of microseconds.
    Programming,
    /// The flash erases a sector, which takes it hundreds of milliseconds.
    Erasing,
    /// There is more to compute; step again soon.
    Again,
}

/// Bytes that are looked at in one step for whether they are erased; each sector has a multiple of it.
/// A CRC over as many takes about as long.
const BLANK_STEP: u32 = 1024;

/// A piece of work that is over.
pub(crate) enum Event {
    /// The record of a program is stored, or gone; whether that ends a piece of work.
    Stored { program: u8, ends: bool },
    /// A program was written completely; its CRC over flash.
    Written { program: u8, expected: Expected, crc: u32 },
    /// Node-ID and bit rate are stored, or not.
    NodeStored(Result<(), FlashError>),
    /// The work on a program failed. `erasing`: an erasure did.
    Failed { program: u8, error: FlashError, erasing: bool },
}

/// The program whose pieces are taken, and how far its flash is.
#[derive(Clone, Copy, Debug)]
struct Target {
    program: u8,
    region: Region,
    /// Up to here the flash is erased.
    erased: u32,
    /// Up to here it may be erased before there are data.
    ahead: u32,
    /// While nothing is lost yet, because there was no piece and no command to erase: what `ahead`
    /// becomes then.
    untouched: Option<u32>,
    /// All of it is being erased for a command.
    clearing: bool,
    /// See [`ProgramRecord::half_erased`]; without what is being done now.
    half_erased: bool,
    /// To be verified when the queue is empty.
    expected: Option<Expected>,
}

/// What is being done.
enum Job {
    /// A value is on its way into the store; the program that it is about.
    Store(Change, u8),
    /// A sector, until its erasure was started, and its end; or none, and how far the flash was looked
    /// at and found to be erased.
    Erase { sector: Option<Sector>, until: u32 },
    /// The piece at the front of the queue.
    Write(WritePiece),
    /// The sealed image goes on.
    #[cfg(feature = "sealed")]
    Unseal,
    /// Is the flash what the host meant?
    Verify { expected: Expected, crc: FlashCrc },
}

/// What changes in the store.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Change {
    /// The record of a program goes.
    Void,
    /// It becomes another one.
    Record,
    /// As `Record`, but nobody waits for it.
    Confirm,
    /// Node-ID and bit rate.
    Node,
    /// The security counter of a sealed image.
    #[cfg(feature = "sealed")]
    Counter,
    /// An event, or how often rights were granted; nobody waits for it.
    #[cfg(feature = "sealed")]
    Note,
}

/// The flash half. It starts operations and polls them, and never waits for one.
pub(crate) struct Programmer<'b> {
    queue: Queue<'b>,
    unsealer: Unsealer<'b>,
    crc_kind: CrcKind,
    crc_step: u32,
    target: Option<Target>,
    /// Bit n: the record of program n has to go before anything is erased or written.
    voids: u32,
    /// What the next one of them has proved is stored as its counter.
    #[cfg(feature = "sealed")]
    kept: bool,
    job: Option<Job>,
    /// What the flash is doing. Without a job nobody wants its outcome any more.
    running: Option<Step>,
}

impl<'b> Programmer<'b> {
    /// The larger `buffer`, the further the flash may lag behind the bus. One step of a CRC covers
    /// `crc_step` bytes.
    pub(crate) fn new(
        buffer: &'b mut [u8],
        crc_kind: CrcKind,
        crc_step: u32,
        unsealer: Unsealer<'b>,
    ) -> Self {
        Self {
            queue: Queue::new(buffer),
            unsealer,
            crc_kind,
            crc_step,
            target: None,
            voids: 0,
            #[cfg(feature = "sealed")]
            kept: false,
            job: None,
            running: None,
        }
    }

    pub(crate) fn into_buffer(self) -> &'b mut [u8] {
        self.queue.into_buffer()
    }

    /// Where the pieces wait.
    pub(crate) fn queue(&self) -> &Queue<'b> {
        &self.queue
    }

    /// See [`queue`](Self::queue).
    pub(crate) fn queue_mut(&mut self) -> &mut Queue<'b> {
        &mut self.queue
    }

    /// Pieces of this program will come, and of no other. With the first one its record goes.
    /// `erase`: its sectors are erased, those of the first `size` bytes before there are data for
    /// them; otherwise each piece has to find its place blank.
    pub(crate) fn open(&mut self, program: u8, region: Region, erase: bool, size: u32) {
        let (erased, ahead) = if erase {
            (region.base, region.base + size.min(region.size))
        } else {
            (region.end(), region.end())
        };
        let (untouched, clearing, half_erased, expected) = (Some(ahead), false, false, None);
        let ahead = erased;
        self.unsealer.rest();
        self.target =
            Some(Target { program, region, erased, ahead, untouched, clearing, half_erased, expected });
    }

    /// What was [opened](Self::open) comes as a sealed image.
    #[cfg(feature = "sealed")]
    pub(crate) fn unseal(&mut self) {
        if let Some(Target { program, region, .. }) = self.target {
            self.unsealer.begin(program, region);
        }
    }

    /// The sealed image, if the program came as one.
    pub(crate) fn unsealer(&self) -> &Unsealer<'b> {
        &self.unsealer
    }

    /// See [`unsealer`](Self::unsealer).
    #[cfg(feature = "sealed")]
    pub(crate) fn unsealer_mut(&mut self) -> &mut Unsealer<'b> {
        &mut self.unsealer
    }

    /// The record of a program goes, then all its sectors are erased that are not.
    pub(crate) fn erase_all(&mut self, program: u8, region: Region) {
        self.open(program, region, true, region.size);
        if let Some(target) = &mut self.target {
            target.clearing = true;
        }
    }

    /// The record of a program goes. That of the target says that it is half erased, until the work on
    /// it has come to its end.
    pub(crate) fn void(&mut self, program: u8) {
        self.voids |= bit(program);
    }

    /// The program was sent completely.
    pub(crate) fn complete(&mut self, expected: Expected) {
        if let Some(target) = &mut self.target {
            target.expected = Some(expected);
            // What no piece has written belongs to the program all the same, and reads FFh.
            target.ahead = target.ahead.max(target.region.base + expected.size);
        }
    }

    /// The record of a program becomes this. `confirms`: it says so of a program that brought the
    /// device back; nobody waits for it, and other work is accepted meanwhile. Nothing may be on its
    /// way into the store.
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

    /// Node-ID and bit rate become these.
    pub(crate) fn store_node(&mut self, parameters: &mut impl Parameters, node: NodeParameters) {
        parameters.store(Key::Node, node.value());
        self.job = Some(Job::Store(Change::Node, 0));
    }

    /// What was received is not wanted any more. What is on its way into the store goes on.
    pub(crate) fn abort(&mut self) {
        self.queue.clear();
        self.unsealer.rest();
        self.target = None;
        if !self.is_storing() {
            self.job = None;
        }
    }

    /// [`ProgramRecord::half_erased`] of a program that has just been written.
    pub(crate) fn is_half_erased(&self) -> bool {
        self.target.as_ref().is_none_or(|target| target.half_erased)
    }

    /// The program whose pieces are taken.
    pub(crate) fn program(&self) -> Option<u8> {
        self.target.map(|target| target.program)
    }

    /// Whether there is work for [`step`](Self::step). The flash cannot be read meanwhile.
    pub(crate) fn is_busy(&self) -> bool {
        self.has_work() || self.is_storing()
    }

    /// Whether a value is on its way into the store.
    pub(crate) fn is_storing(&self) -> bool {
        matches!(self.job, Some(Job::Store(..)))
    }

    /// Whether there is work that a command has to wait for.
    pub(crate) fn has_work(&self) -> bool {
        let confirming = matches!(self.job, Some(Job::Store(Change::Confirm, _)));
        #[cfg(feature = "sealed")]
        let confirming = confirming || matches!(self.job, Some(Job::Store(Change::Note, _)));
        (self.job.is_some() || self.running.is_some()) && !confirming
            || self.voids != 0
            || !self.queue.is_empty()
            || !self.unsealer.waits()
            || self.target.as_ref().is_some_and(|target| {
                target.clearing || target.expected.is_some() || target.erased < target.ahead
            })
    }

    /// Whether it works on a command or on the end of a program, so that no further block of that
    /// program can be taken; or for nobody any more, so that no command can.
    pub(crate) fn is_busy_with(&self, program: u8) -> bool {
        let current = self.program() == Some(program);
        let ending = match self.job {
            Some(Job::Store(Change::Record, of)) => of == program,
            Some(Job::Verify { .. }) => current,
            _ => false,
        };
        let waiting = |target: &Target| target.clearing || target.expected.is_some() || !self.has_room();
        ending || self.target.as_ref().map_or(self.has_work(), |target| current && waiting(target))
    }

    /// The program that was sent completely, or whose record is being stored: what its host was
    /// told is done, and a reset now would take back.
    pub(crate) fn finishing(&self) -> Option<u8> {
        match self.job {
            Some(Job::Store(Change::Record, of)) => Some(of),
            Some(Job::Verify { .. }) => self.program(),
            _ => self
                .program()
                .filter(|_| self.target.as_ref().is_some_and(|target| target.expected.is_some())),
        }
    }

    /// Whether [`abort`](Self::abort) takes nothing back that a host was told is done.
    pub(crate) fn is_abortable(&self) -> bool {
        let clearing = self.target.as_ref().is_some_and(|target| target.clearing);
        !clearing && self.finishing().is_none() && !self.is_storing_node()
    }

    /// Whether node-ID and bit rate are on their way.
    pub(crate) fn is_storing_node(&self) -> bool {
        matches!(self.job, Some(Job::Store(Change::Node, _)))
    }

    /// Whether the queue takes a block of the largest size. (One that is not even as large takes
    /// one at a time.)
    #[inline(never)]
    pub(crate) fn has_room(&self) -> bool {
        self.queue.is_empty() || self.queue.free() >= MAX_BLOCK_SIZE
    }

    /// Carries the work on.
    pub(crate) fn step<F: Flash>(
        &mut self,
        parameters: &mut impl Parameters,
        flash: &mut F,
    ) -> (Step, Option<Event>) {
        let mut outcome = Ok(());
        loop {
            if let Some(running) = self.running {
                let Poll::Ready(ended) = flash.poll() else { return (running, None) };
                self.running = None;
                outcome = ended;
            }
            if self.job.is_none() {
                return match self.choose(parameters, flash) {
                    Ok(None) if self.unsealer.prepare() => (Step::Idle, None),
                    Ok(None) => (Step::Again, None),
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

    /// What the job does next.
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
            #[cfg(feature = "sealed")]
            (Some(Job::Unseal), _) => {
                return Next::Done(self.unsealer.step(flash, parameters, &mut self.queue));
            }
            (Some(Job::Write(write)), _) => {
                let (queue, unsealer) = (&self.queue, &self.unsealer);
                if unsealer.is_active() {
                    write.next(flash, move |at| unsealer.data(at))
                } else {
                    write.next(flash, move |at| queue.data(at))
                }
            }
            (Some(Job::Verify { crc, .. }), _) => {
                return match crc.step(flash, self.crc_kind, self.crc_step) {
                    true => Next::Done(Ok(())),
                    false => Next::Again,
                };
            }
            (None, _) => Ok(None),
        };
        match next {
            Ok(Some(operation)) => Next::Start(operation),
            Ok(None) => Next::Done(Ok(())),
            Err(FlashFault::Protected) => Next::Done(Err(FlashError::Secured)),
            Err(_) => Next::Done(Err(FlashError::Write)),
        }
    }

    /// The job is over.
    fn done(&mut self, result: Result<(), FlashError>) -> Option<Event> {
        match (self.job.take()?, result) {
            (Job::Store(Change::Node, _), result) => Some(Event::NodeStored(result)),
            #[cfg(feature = "sealed")]
            (Job::Store(Change::Counter | Change::Note, _) | Job::Unseal, Ok(())) => None,
            (Job::Store(change, program), result) => {
                if change == Change::Void {
                    self.voids &= !bit(program);
                    #[cfg(feature = "sealed")]
                    {
                        self.kept = false;
                    }
                }
                #[cfg(feature = "sealed")]
                if change == Change::Record && self.unsealer.is_installed() {
                    self.unsealer.end(result);
                }
                match result {
                    Ok(()) => Some(Event::Stored { program, ends: change == Change::Record }),
                    // It costs a rescue window, no more.
                    Err(_) if change == Change::Confirm => None,
                    Err(error) => {
                        // A record that does not go protects its data: nothing of them is touched.
                        if self.program() == Some(program) {
                            self.abort();
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
                if self.unsealer.is_active() {
                    self.unsealer.written();
                } else {
                    self.queue.pop();
                }
                None
            }
            (Job::Verify { expected, crc }, Ok(())) => {
                Some(Event::Written { program: self.program()?, expected, crc: crc.value() })
            }
        }
    }

    // A call is shorter: three ways lead here.
    #[inline(never)]
    fn fail(&mut self, error: FlashError, erasing: bool) -> Option<Event> {
        #[cfg(feature = "sealed")]
        self.unsealer.end(Err(error));
        #[cfg(feature = "sealed")]
        let program = self.program().unwrap_or(0);
        #[cfg(not(feature = "sealed"))]
        let program = self.program()?;
        self.abort();
        Some(Event::Failed { program, error, erasing })
    }

    /// Chooses what to do to an idle flash.
    fn choose<F: Flash>(
        &mut self,
        parameters: &mut impl Parameters,
        flash: &F,
    ) -> Result<Option<Job>, FlashError> {
        #[cfg(feature = "sealed")]
        {
            if let Some((key, value)) = self.unsealer.take_store() {
                parameters.store(key, value);
                return Ok(Some(Job::Store(Change::Note, 0)));
            }
            if self.unsealer.is_asked() {
                return Ok(Some(Job::Unseal));
            }
        }
        let piece = if self.unsealer.is_active() { self.unsealer.piece() } else { self.queue.first() };
        if let Some(target) = &mut self.target {
            // Of a sealed image nothing is known before there is an authentic piece of it.
            if piece.is_some() || target.clearing || (target.expected.is_some() && !self.unsealer.is_active())
            {
                if let Some(ahead) = target.untouched.take() {
                    target.ahead = target.ahead.max(ahead);
                    let program = target.program;
                    self.void(program);
                }
            }
        }
        if self.voids != 0 {
            let program = self.voids.trailing_zeros() as u8;
            // What a program has proved outlives its record.
            #[cfg(feature = "sealed")]
            if !core::mem::replace(&mut self.kept, true) {
                if let Some(counter) = crate::unseal::proved(flash, parameters, program) {
                    parameters.store(Key::Counter(program), counter);
                    return Ok(Some(Job::Store(Change::Counter, program)));
                }
            }
            let mut half_erased = ProgramRecord::load_half_erased(parameters, flash, program);
            if let Some(target) = self.target.as_mut().filter(|target| target.program == program) {
                target.half_erased = core::mem::replace(&mut half_erased, true);
            }
            return Ok(Some(store(parameters, Change::Void, program, ProgramRecord::none(half_erased))));
        }
        let Some(target) = &mut self.target else { return Ok(None) };
        let needed = piece.map_or(target.ahead, |piece| piece.address + piece.size);
        if target.erased < needed {
            let sector = flash.sector_at(target.erased).ok_or(FlashError::Address)?;
            let piece = Region::new(target.erased, BLANK_STEP);
            if target.clearing && !target.half_erased && flash.is_blank(piece) {
                return Ok(Some(Job::Erase { sector: None, until: piece.end() }));
            }
            return Ok(Some(Job::Erase { sector: Some(sector), until: sector.region.end() }));
        }
        if core::mem::take(&mut target.clearing) {
            return Ok(Some(store(parameters, Change::Record, target.program, ProgramRecord::none(false))));
        }
        if let Some(piece) = piece {
            let write = WritePiece::new(flash, piece).ok_or(FlashError::NotCleared)?;
            return Ok(Some(Job::Write(write)));
        }
        #[cfg(feature = "sealed")]
        if self.unsealer.is_active() {
            let ended = target.expected.is_some();
            match (self.unsealer.is_installed(), self.queue.is_empty()) {
                (false, true) if self.unsealer.waits() => {
                    return if ended { Err(FlashError::Format) } else { Ok(None) };
                }
                (false, _) => return Ok(Some(Job::Unseal)),
                (true, false) => return Err(FlashError::Format),
                (true, true) if !ended => return Ok(None),
                (true, true) => target.expected = Some(self.unsealer.expected()),
            }
            let program = target.program;
            // Of the same image, too: its certificate may be of a higher epoch.
            if let Some(counter) = self.unsealer.take_counter() {
                parameters.store(Key::Counter(program), counter);
                return Ok(Some(Job::Store(Change::Counter, program)));
            }
            if self.unsealer.is_same() {
                target.expected = None;
                let value = self.unsealer.same_record();
                return Ok(Some(store(parameters, Change::Record, program, value)));
            }
        }
        Ok(target.expected.take().map(|expected| {
            let crc = FlashCrc::new(Region::new(target.region.base, expected.size));
            Job::Verify { expected, crc }
        }))
    }
}

/// The bit of a program.
fn bit(program: u8) -> u32 {
    1_u32.wrapping_shl(program.into())
}

/// A value of a program is on its way into the store from now on.
fn store(parameters: &mut impl Parameters, change: Change, program: u8, value: Value) -> Job {
    parameters.store(Key::Program(program), value);
    Job::Store(change, program)
}
