//! Program download by block file: 1F50h takes the blocks, 1F51h the commands, 1F57h tells what
//! became of them.
//!
//! Two halves that never wait for each other. The **SDO half** (`block_…`, [`Downloader::command`])
//! judges what comes in: it refuses at once, with an abort and a status, or accepts and leaves work
//! behind. The **flash half** ([`Downloader::step`]) carries the work through, an operation or a
//! bounded computation at a time.
//!
//! Between them lies a queue of blocks. While it has room for another block the status is not busy,
//! although the flash works: a host that looks at the status between blocks sends the next one
//! while those before are being programmed, and sectors are erased ahead of the data.
//!
//! Nothing of an installed program is lost before the first block of another one was judged good:
//! CLEAR is carried out with it (SYS TEC manual L-1112d_10, figure 12), see [`Erase`].

#[cfg(feature = "intel-hex")]
mod ihex;
mod queue;
#[cfg(feature = "streams")]
mod stream;

use core::task::Poll;

use canopen::program::{FlashError, FlashStatus, ProgramControl, ProgramState};
use canopen::sdo::AbortCode;
use shared_abi::block_file::{
    Control, Header, Last, CONTROL_MAX, CRC_SIZE, FRAMING, HEADER_SIZE, LAST_SIZE, MAX_BLOCK_SIZE,
    NUMBER_CONTROL, NUMBER_LAST,
};
use shared_abi::geometry::Region;
#[cfg(feature = "streams")]
use shared_abi::label;
use shared_abi::layout::Layout;
use shared_abi::warm_start::BootRequest;

use crate::crc;
use crate::flash::{is_blank, Flash, FlashFault, SectorEraser, WordWriter};
use crate::node::NodeParameters;
use crate::parameters::{Key, Parameters, StoreError};
use crate::program::{check_vectors, FlashCrc, ProgramRecord};
use queue::Queue;
#[cfg(feature = "streams")]
use shared_abi::vectors::VectorTable;
#[cfg(feature = "streams")]
use stream::Stream;

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

/// When CLEAR erases.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Erase {
    /// With the first block that is for this device: until then the old program stays, and can be
    /// started. Sectors are erased as the data need them. A second CLEAR, with no block in between,
    /// erases all at once.
    #[default]
    WithFirstBlock,
    /// All sectors of the program, before anything else.
    AtOnce,
}

/// What the integrator's own check says of a program that is about to be downloaded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// Nothing: vendor-ID and product code decide.
    Standard,
    /// It is for this device.
    Accept,
    /// It is not.
    Refuse(FlashError),
}

/// What can be chosen about the download.
#[derive(Clone, Copy, Debug)]
pub struct Policy {
    /// Vendor-ID and product code of the device. A control block that tells others is refused; 0 in
    /// it stands for any.
    pub identity: Option<(u32, u32)>,
    /// The integrator's own check, with all that the control block tells (`TgtProcessAppInfoData`
    /// of the manual).
    pub check: fn(program: u8, control: &Control) -> Verdict,
    /// Whether programs may be changed now; where not, the status is `NO_ACCESS`.
    pub allowed: fn() -> bool,
    /// When CLEAR erases.
    pub erase: Erase,
    /// Whether a complete raw image or Intel HEX download is valid without the signature (83h) that
    /// those who send it know nothing of.
    pub valid_without_signature: bool,
    /// Whether 1F51h = 2 always starts the program, as CiA 302-3 has it; otherwise it does so right
    /// behind a raw image or Intel HEX, and resets the status in all other cases.
    pub reset_starts: bool,
    /// Whether a valid raw image or Intel HEX starts by itself when it is complete.
    pub starts_by_itself: bool,
    /// Whether a raw image or Intel HEX has to carry a label (`shared_abi::label`). A label that it
    /// carries has to fit in any case.
    pub wants_label: bool,
    /// The number of a program that is none, but data of the application: any bytes, never started.
    pub data: Option<u8>,
    /// Whether 1F50h takes nothing before a password has come.
    pub locked: bool,
    /// Whether 1F50h gives back what was stored.
    pub read_back: bool,
    /// Whether a download takes the place of what is there, without CLEAR.
    pub replaces: bool,
    /// Bytes of flash that one step of a CRC covers: the longest that other work of the same
    /// priority is kept waiting.
    pub crc_step: u32,
}

impl Policy {
    /// Anybody's programs at any time; steps of 1 KiB.
    pub const DEFAULT: Self = Self {
        identity: None,
        check: |_, _| Verdict::Standard,
        allowed: || true,
        erase: Erase::WithFirstBlock,
        valid_without_signature: true,
        reset_starts: false,
        starts_by_itself: false,
        wants_label: false,
        data: None,
        locked: false,
        read_back: false,
        replaces: false,
        crc_step: 1024,
    };
}

/// Why a block or a command is refused: the status that 1F57h shows, and the abort that the client
/// gets.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Refusal(FlashError, AbortCode);

/// Cannot be stored: the block itself is wrong.
const fn unfit(error: FlashError) -> Refusal {
    Refusal(error, AbortCode::STORE)
}

/// Cannot be stored now: right block or command, wrong moment.
const fn untimely(error: FlashError) -> Refusal {
    Refusal(error, AbortCode::DEVICE_STATE)
}

/// One program as the objects 1F50h–1F57h show it.
#[derive(Clone, Copy, Debug)]
struct Program {
    /// What the journal holds; kept here because the flash cannot be read while it is busy.
    record: Option<ProgramRecord>,
    /// 1F56h: the CRC that was computed last, or the stored one.
    identification: u32,
    /// How the last block or command ended.
    error: Option<FlashError>,
    session: Session,
    /// The version that the last control block told.
    version: u32,
    /// A raw image or Intel HEX came last, completely, and no command since.
    streamed: bool,
    /// A password is missing.
    locked: bool,
}

/// How far the download of a program is.
// Not to be compared as a whole, which costs 140 bytes of flash: `matches!` looks at what is asked
// for.
#[derive(Clone, Copy, Debug)]
enum Session {
    /// No block was taken yet.
    Idle,
    /// CLEAR was acknowledged; nothing is lost yet. `just`: no block was sent since.
    Cleared { just: bool },
    /// Blocks are being taken.
    Open {
        /// Number of the next one.
        next: u32,
        /// Up to here the flash is erased.
        erased: u32,
        /// Up to here it may be erased before there are data.
        ahead: u32,
    },
    /// Half a program is in flash: only CLEAR makes a new beginning.
    Failed,
}

/// The block that is being received; its bytes are the open ones of the queue.
#[derive(Clone, Copy, Debug)]
enum Reception {
    Idle,
    /// Too few bytes to know what it is, of as many as were announced.
    #[cfg(feature = "streams")]
    Unknown {
        program: u8,
        size: Option<u32>,
    },
    /// A whole program.
    #[cfg(feature = "streams")]
    Stream {
        program: u8,
        stream: Stream,
    },
    /// The header is not complete.
    Header {
        program: u8,
    },
    /// The header was judged good.
    Data {
        program: u8,
        header: Header,
    },
}

impl Reception {
    /// Which program it is of.
    fn program(&self) -> Option<u8> {
        match *self {
            Self::Idle => None,
            #[cfg(feature = "streams")]
            Self::Unknown { program, .. } | Self::Stream { program, .. } => Some(program),
            Self::Header { program } | Self::Data { program, .. } => Some(program),
        }
    }
}

/// What is being done to the flash.
enum Work {
    /// The record goes first, so that a program that is partly erased is no program. `all`: then
    /// every sector.
    Invalidate { program: u8, all: bool },
    /// All sectors.
    Erase { program: u8, eraser: SectorEraser },
    /// One sector ahead of the data.
    EraseNext { program: u8, until: u32, eraser: SectorEraser },
    /// The block at the front of the queue. `edges` are its first and last word, filled up with
    /// what is there.
    Write { program: u8, header: Header, edges: [u32; 2], writer: WordWriter },
    /// What was being done does not matter any more, but the flash has yet to finish it.
    Settle,
    /// The last block: is the flash what the host meant?
    Verify { program: u8, expected: Expected, crc: FlashCrc },
    /// The record of a program: after verification, and when the signature changes.
    Record { program: u8, record: ProgramRecord },
    /// Node-ID and bit rate; of no program.
    Node,
}

/// What a program has to be that was sent completely.
#[derive(Clone, Copy, Debug)]
struct Expected {
    size: u32,
    /// `None`: what is in flash, word for word what was sent.
    crc: Option<u32>,
}

/// The first two vectors at least: without them under the CRC nothing can be started.
const SMALLEST_PROGRAM: u32 = 8;

/// The download of programs into flash. `PROGRAMS` is the number of programs in the layout.
pub struct Downloader<'b, P, const PROGRAMS: usize> {
    layout: &'static Layout,
    policy: &'static Policy,
    parameters: P,
    programs: [Program; PROGRAMS],
    queue: Queue<'b>,
    /// Whose blocks are in the queue.
    owner: u8,
    reception: Reception,
    work: Option<Work>,
    /// To be verified when the queue is empty.
    expected: Option<Expected>,
    /// The program is started when it is verified: its host did not wait for that.
    start_verified: bool,
    /// The abort for whoever goes on sending when the flash has failed.
    fault: AbortCode,
    /// A request that waits for the device to leave the bootloader.
    leave: Option<BootRequest>,
    /// How a piece of work on a program ended, or a block that was damaged; to be told.
    outcome: Option<(u8, Result<(), FlashError>)>,
    /// How the last storing of node-ID and bit rate ended.
    node_stored: Result<(), StoreError>,
}

impl<'b, P: Parameters, const PROGRAMS: usize> Downloader<'b, P, PROGRAMS> {
    /// Starts from what the parameters tell. The larger `buffer`, the further the flash may lag
    /// behind the bus; blocks larger than it, or than [`MAX_BLOCK_SIZE`], are refused.
    pub fn new<F: Flash>(
        layout: &'static Layout,
        policy: &'static Policy,
        parameters: P,
        flash: &F,
        buffer: &'b mut [u8],
    ) -> Self {
        let mut number = 0;
        let programs = [(); PROGRAMS].map(|()| {
            number += 1;
            let record = ProgramRecord::load(&parameters, flash, number);
            Program {
                record,
                identification: record.map_or(0, |record| record.crc),
                error: None,
                session: Session::Idle,
                version: 0,
                streamed: false,
                locked: policy.locked,
            }
        });
        Self {
            layout,
            policy,
            parameters,
            programs,
            queue: Queue::new(buffer),
            owner: 0,
            reception: Reception::Idle,
            work: None,
            expected: None,
            start_verified: false,
            fault: AbortCode::DEVICE_STATE,
            leave: None,
            outcome: None,
            node_stored: Ok(()),
        }
    }

    /// Ends here, whatever is being done; gives the buffer back.
    pub fn into_buffer(self) -> &'b mut [u8] {
        self.queue.into_buffer()
    }

    /// Whether sub-index `program` of 1F50h, 1F51h, 1F56h and 1F57h exists.
    #[must_use]
    pub fn has(&self, program: u8) -> bool {
        self.state_of(program).is_some()
    }

    /// 1F57h. Busy while a command of this program is carried out, or while no further block can be
    /// taken.
    #[must_use]
    pub fn status(&self, program: u8) -> FlashStatus {
        let error = self.state_of(program).and_then(|state| state.error);
        let busy = match self.work {
            Some(
                Work::Invalidate { program: of, all: true, .. }
                | Work::Erase { program: of, .. }
                | Work::Verify { program: of, .. }
                | Work::Record { program: of, .. },
            ) => of == program,
            _ => false,
        };
        let full = self.owner == program && (self.expected.is_some() || !self.has_room());
        FlashStatus { busy: busy || full, error, detail: 0 }
    }

    /// Whether the queue takes a block of the largest size. (One that is not even as large takes
    /// one at a time.)
    fn has_room(&self) -> bool {
        self.queue.is_empty() || self.queue.free() >= MAX_BLOCK_SIZE
    }

    /// 1F51h: no program runs, whether or not there is one.
    #[must_use]
    pub fn control(&self, program: u8) -> ProgramState {
        match self.state_of(program).and_then(|state| state.record) {
            Some(_) => ProgramState::Stopped,
            None => ProgramState::Absent,
        }
    }

    /// 1F56h: the CRC over the program, 0 where there is none.
    #[must_use]
    pub fn identification(&self, program: u8) -> u32 {
        self.state_of(program).map_or(0, |state| state.identification)
    }

    /// Whether there is work for [`Downloader::step`].
    #[must_use]
    pub fn busy(&self) -> bool {
        self.work.is_some()
            || self.expected.is_some()
            || !self.queue.is_empty()
            || self.sector_ahead().is_some()
    }

    /// The request to leave the bootloader, once: the answer to the command may still be on its
    /// way.
    pub fn take_boot_request(&mut self) -> Option<BootRequest> {
        self.leave.take()
    }

    /// How a piece of work on a program ended, or a block that was damaged, once.
    pub fn take_outcome(&mut self) -> Option<(u8, Result<(), FlashError>)> {
        self.outcome.take()
    }

    /// Stores node-ID and bit rate in the background.
    ///
    /// # Errors
    /// If other work goes on.
    pub fn store_node(&mut self, node: NodeParameters) -> Result<(), FlashError> {
        if self.busy() || self.leave.is_some() {
            return Err(FlashError::Busy);
        }
        self.parameters.store(Key::Node, node.value());
        self.work = Some(Work::Node);
        Ok(())
    }

    /// How the last [`store_node`](Self::store_node) ended.
    pub fn node_stored(&self) -> Poll<Result<(), StoreError>> {
        if matches!(self.work, Some(Work::Node)) {
            Poll::Pending
        } else {
            Poll::Ready(self.node_stored)
        }
    }

    /// A password came: 1F50h takes data from now on, and CLEAR is as good as given. `at_once`: the
    /// old program is void now, and not only when there is another one.
    ///
    /// # Errors
    /// If other work goes on.
    #[cfg(feature = "password")]
    pub fn unlock(&mut self, program: u8, at_once: bool) -> Result<(), AbortCode> {
        if self.leave.is_some() || self.expected.is_some() || !self.is_downloading() {
            return Err(self.refuse(program, untimely(FlashError::Busy)));
        }
        let state = self.state(program).ok_or(AbortCode::NO_SUB_INDEX)?;
        state.locked = false;
        state.error = None;
        state.streamed = false;
        state.session = Session::Cleared { just: false };
        self.reception = Reception::Idle;
        self.owner = program;
        self.abort_work();
        if at_once && self.work.is_none() {
            self.work = Some(self.invalidate(program, false));
        }
        Ok(())
    }

    /// 1F50h is about to be read back: gives the size of what is stored.
    ///
    /// # Errors
    /// The abort that answers it.
    #[cfg(feature = "read-back")]
    pub fn stored(&self, program: u8) -> Result<Region, AbortCode> {
        let state = self.state_of(program).ok_or(AbortCode::NO_SUB_INDEX)?;
        if !self.policy.read_back {
            return Err(AbortCode::WRITE_ONLY);
        }
        // While it works the flash cannot be read.
        if state.locked || self.busy() {
            return Err(AbortCode::DEVICE_STATE);
        }
        self.installed(program).map(|(place, _)| place).ok_or(AbortCode::NO_DATA)
    }

    /// Where a program is stored, and its CRC.
    #[cfg(feature = "read-back")]
    pub(crate) fn installed(&self, program: u8) -> Option<(Region, u32)> {
        let record = self.state_of(program)?.record?;
        Some((Region::new(self.region(program).base, record.size), record.crc))
    }

    /// 1F51h: a command. It is judged and acknowledged now and carried out by [`Downloader::step`].
    ///
    /// # Errors
    /// The abort that answers it.
    pub fn command(&mut self, program: u8, command: ProgramControl) -> Result<(), AbortCode> {
        use ProgramControl::{Clear, ClrSignature, ResetStat, SetSignature, Start, StartBootloader, Stop};

        let &Program { streamed, locked, .. } = self.state_of(program).ok_or(AbortCode::NO_SUB_INDEX)?;
        if matches!(command, Stop | StartBootloader) {
            // No program runs, and the bootloader does: both are so already.
            return Ok(());
        }
        // A new beginning does not wait for the end of the old one.
        let broken_off =
            command == Clear && self.owner == program && self.expected.is_none() && self.is_downloading();
        // Who sends a program in one go means by 2 what CiA 302-3 says: reset the program, which
        // starts it.
        let command = match command {
            ResetStat if streamed || self.policy.reset_starts => Start,
            command => command,
        };
        if command == Start && streamed && self.leave.is_none() && self.is_finishing() {
            self.start_verified = true;
            return Ok(());
        }
        if self.leave.is_some() || (self.busy() && !broken_off) {
            return Err(self.refuse(program, untimely(FlashError::Busy)));
        }
        let changes = matches!(command, Clear | SetSignature | ClrSignature);
        if changes && (locked || !(self.policy.allowed)()) {
            return Err(self.refuse(program, untimely(FlashError::NoAccess)));
        }
        let data = self.policy.data;
        let state = self.state(program).ok_or(AbortCode::NO_SUB_INDEX)?;
        state.error = None;
        state.streamed = false;
        // Data are never started.
        let record = state.record.filter(|_| data != Some(program));
        match (command, record) {
            (Clear, _) => {
                let again = matches!(state.session, Session::Cleared { just: true });
                state.session = Session::Cleared { just: true };
                self.reception = Reception::Idle;
                self.abort_work();
                if self.work.is_none() && (again || self.policy.erase == Erase::AtOnce) {
                    self.work = Some(self.invalidate(program, true));
                }
            }
            (Start, Some(record)) => self.start(program, record),
            (SetSignature | ClrSignature, Some(record)) => {
                // Also where it is so already: after a power cut it may read so now and otherwise
                // later.
                let signed = command == SetSignature;
                self.work = Some(self.store_record(program, ProgramRecord { signed, ..record }));
            }
            (Start | SetSignature, None) => state.error = Some(FlashError::NoValidProgram),
            (Stop | StartBootloader | ResetStat | ClrSignature, _) => {}
        }
        Ok(())
    }

    fn start(&mut self, program: u8, record: ProgramRecord) {
        let request = if record.signed { BootRequest::Start } else { BootRequest::Trial };
        self.leave = Some(request(program));
    }

    /// What was received is not wanted any more.
    fn abort_work(&mut self) {
        self.queue.clear();
        self.work = match self.work.take() {
            Some(Work::EraseNext { .. } | Work::Write { .. }) => Some(Work::Settle),
            // A record is gone, or there, only when this is through.
            work => work,
        };
    }

    /// Whether a program was sent completely, or a command acknowledged, and it is not carried
    /// through yet: whoever resets the device now takes that back.
    #[must_use]
    pub fn is_finishing(&self) -> bool {
        self.expected.is_some() || matches!(self.work, Some(Work::Verify { .. } | Work::Record { .. }))
    }

    /// Whether the flash works on blocks and nothing else.
    fn is_downloading(&self) -> bool {
        matches!(
            self.work,
            None | Some(
                Work::Invalidate { all: false, .. }
                    | Work::EraseNext { .. }
                    | Work::Write { .. }
                    | Work::Settle
            )
        )
    }

    /// 1F50h: the client announces a block, and its size if it knows it.
    ///
    /// # Errors
    /// The abort that answers it.
    pub fn block_start(&mut self, program: u8, size: Option<u32>) -> Result<(), AbortCode> {
        if !self.has(program) {
            return Err(AbortCode::NO_SUB_INDEX);
        }
        let others = self.owner != program && self.busy();
        if self.leave.is_some()
            || self.expected.is_some()
            || others
            || !self.is_downloading()
            || !self.has_room()
        {
            return Err(self.refuse(program, untimely(FlashError::Busy)));
        }
        if self.state_of(program).is_some_and(|state| state.locked) {
            return Err(self.refuse(program, untimely(FlashError::NoAccess)));
        }
        if let Some(size) = size {
            if !cfg!(feature = "streams") && size as usize > self.largest() {
                return Err(self.refuse(program, Refusal(FlashError::Format, AbortCode::LENGTH_TOO_HIGH)));
            }
            if (size as usize) < FRAMING && self.policy.data != Some(program) {
                return Err(self.refuse(program, Refusal(FlashError::Format, AbortCode::LENGTH_TOO_LOW)));
            }
        }
        // A second CLEAR erases all, but not behind a block: it may come from a host that tries the
        // same wrong file again.
        if let Some(Session::Cleared { just }) = self.session(program) {
            *just = false;
        }
        if let Some(state) = self.state(program) {
            state.streamed = false;
        }
        self.owner = program;
        self.queue.discard_open();
        #[cfg(feature = "streams")]
        let reception = Reception::Unknown { program, size };
        #[cfg(not(feature = "streams"))]
        let reception = Reception::Header { program };
        self.reception = reception;
        Ok(())
    }

    /// 1F50h: the next bytes of the block.
    ///
    /// # Errors
    /// The abort that ends the transfer.
    pub fn block_data(&mut self, data: &[u8]) -> Result<(), AbortCode> {
        let program = self.reception.program().ok_or(self.fault)?;
        self.take(program, data).map_err(|refusal| self.refuse(program, refusal))
    }

    fn take(&mut self, program: u8, data: &[u8]) -> Result<(), Refusal> {
        #[cfg(feature = "streams")]
        if let Reception::Stream { stream, .. } = self.reception {
            return self.stream_data(program, stream, data);
        }
        if self.queue.open() + data.len() > self.largest() || !self.queue.push(data) {
            return Err(Refusal(FlashError::Format, AbortCode::LENGTH_TOO_HIGH));
        }
        #[cfg(feature = "streams")]
        if let Reception::Unknown { size, .. } = self.reception {
            self.detect_format(program, size)?;
        }
        if matches!(self.reception, Reception::Header { .. }) && self.queue.open() >= HEADER_SIZE {
            let header = Header::parse(&self.queue.of_open(0));
            self.judge_header(program, header)?;
            self.reception = Reception::Data { program, header };
        }
        Ok(())
    }

    /// 1F50h: the block is complete. Judges it in full and leaves the work behind.
    ///
    /// # Errors
    /// The abort that answers instead of the last acknowledgement.
    pub fn block_end(&mut self) -> Result<(), AbortCode> {
        let program = self.reception.program().ok_or(self.fault)?;
        let outcome = match self.reception {
            Reception::Data { header, .. } => self.accept(program, header),
            #[cfg(feature = "streams")]
            Reception::Stream { stream, .. } => self.stream_end(program, stream),
            _ => Err(Refusal(FlashError::Format, AbortCode::LENGTH_TOO_LOW)),
        };
        outcome.map_err(|refusal| self.refuse(program, refusal))?;
        self.reception = Reception::Idle;
        if let Some(state) = self.state(program) {
            state.error = None;
        }
        Ok(())
    }

    /// 1F50h: the transfer ended before the block did. The block may be sent again.
    pub fn block_cancel(&mut self) {
        #[cfg(feature = "streams")]
        self.abort_stream();
        self.reception = Reception::Idle;
        self.queue.discard_open();
    }

    /// Carries the work on.
    pub fn step<F: Flash>(&mut self, flash: &mut F) -> Step {
        let Some(mut work) = self.work.take() else {
            return self.next_work(flash);
        };
        let chip = self.layout.chip;
        let (program, outcome) = match &mut work {
            Work::Node => match self.parameters.poll(flash) {
                Poll::Pending => (0, Poll::Pending),
                Poll::Ready(outcome) => {
                    self.node_stored = outcome;
                    return Step::Again;
                }
            },
            Work::Settle => match flash.poll() {
                Poll::Pending => (0, Poll::Pending),
                Poll::Ready(_) => return Step::Again,
            },
            Work::Invalidate { program, all } => {
                let (program, all) = (*program, *all);
                let outcome = self.parameters.poll(flash);
                if let Poll::Ready(Ok(())) = outcome {
                    if let Some(state) = self.state(program) {
                        state.record = None;
                        state.identification = 0;
                    }
                    if all {
                        let eraser = SectorEraser::new(self.region(program));
                        self.work = Some(Work::Erase { program, eraser });
                    }
                    return Step::Again;
                }
                (program, outcome.map_err(|_| FlashError::NvData))
            }
            Work::Erase { program, eraser } => (*program, eraser.poll(flash, chip).map_err(write_error)),
            Work::EraseNext { program, until, eraser } => {
                let (program, until) = (*program, *until);
                let outcome = eraser.poll(flash, chip);
                if let Poll::Ready(Ok(())) = outcome {
                    if let Some(Session::Open { erased, .. }) = self.session(program) {
                        *erased = until;
                    }
                    return Step::Again;
                }
                (program, outcome.map_err(write_error))
            }
            Work::Write { program, header, edges, writer } => {
                let (program, header) = (*program, *header);
                let (queue, edges, words) = (&self.queue, &*edges, words_of(&header));
                let outcome = writer.poll(flash, words, |i| word(queue, &header, edges, i, words));
                if let Poll::Ready(Ok(())) = outcome {
                    self.queue.pop(header.size as usize + FRAMING);
                    return Step::Again;
                }
                (program, outcome.map_err(write_error))
            }
            Work::Verify { program, expected, crc } => {
                let (program, expected) = (*program, *expected);
                let Some(crc) = crc.step(flash, self.policy.crc_step) else {
                    self.work = Some(work);
                    return Step::Again;
                };
                if let Some(state) = self.state(program) {
                    state.identification = crc;
                    state.session = Session::Idle;
                }
                let sound = self.check_stored(flash, program, &expected, crc);
                if let Ok(version) = sound {
                    let signed = expected.crc.is_none() && self.policy.valid_without_signature;
                    let record = ProgramRecord { size: expected.size, crc, signed, version };
                    self.work = Some(self.store_record(program, record));
                    return Step::Again;
                }
                (program, Poll::Ready(sound.map(drop)))
            }
            Work::Record { program, record } => {
                let outcome = self.parameters.poll(flash).map_err(|_| FlashError::NvData);
                if outcome == Poll::Ready(Ok(())) {
                    if let Some(state) = self.state(*program) {
                        state.record = Some(*record);
                    }
                }
                (*program, outcome)
            }
        };
        let Poll::Ready(outcome) = outcome else {
            let erasing = matches!(work, Work::Erase { .. } | Work::EraseNext { .. } | Work::Settle);
            self.work = Some(work);
            return if erasing { Step::Erasing } else { Step::Programming };
        };
        self.fault = match work {
            Work::Erase { .. } | Work::EraseNext { .. } => AbortCode::GENERAL,
            _ => AbortCode::HARDWARE,
        };
        self.end(program, outcome);
        Step::Again
    }

    /// What is in flash, against what it should be; gives its version.
    fn check_stored<F: Flash>(
        &self,
        flash: &F,
        program: u8,
        expected: &Expected,
        crc: u32,
    ) -> Result<u32, FlashError> {
        let region = self.region(program);
        let version = self.state_of(program).map_or(0, |state| state.version);
        if self.policy.data == Some(program) {
            return Ok(version);
        }
        if expected.crc.is_some_and(|told| told != crc) || check_vectors(flash, region, self.layout).is_err()
        {
            return Err(FlashError::NoValidProgram);
        }
        #[cfg(feature = "streams")]
        if expected.crc.is_none() {
            let mut label = [0; label::SIZE];
            // Behind the program's end is nothing of it.
            if expected.size >= label::OFFSET + label::SIZE as u32 {
                flash.read(region.base + label::OFFSET, &mut label);
            }
            return self.check_label(program, &label).map_err(|Refusal(error, _)| error);
        }
        Ok(version)
    }

    /// A piece of work is over.
    fn end(&mut self, program: u8, outcome: Result<(), FlashError>) {
        if let Some(state) = self.state(program) {
            state.error = outcome.err();
            if outcome.is_err() {
                state.streamed = false;
                if !matches!(state.session, Session::Idle) {
                    state.session = Session::Failed;
                }
                self.queue.clear();
                self.reception = Reception::Idle;
                self.expected = None;
            }
        }
        let start = core::mem::take(&mut self.start_verified);
        let record = self.state_of(program).and_then(|state| state.record);
        if let (true, Ok(()), Some(record)) = (start, outcome, record) {
            self.start(program, record);
        }
        self.outcome = Some((program, outcome));
    }

    /// Chooses what to do to an idle flash.
    fn next_work<F: Flash>(&mut self, flash: &F) -> Step {
        let program = self.owner;
        let sector = |address: u32| self.layout.chip.sector_at(address).map(|sector| sector.region);
        let erase_next = |region: Region| Work::EraseNext {
            program,
            until: region.end(),
            eraser: SectorEraser::new(region),
        };
        let work = if self.queue.is_empty() {
            match (self.expected, self.sector_ahead()) {
                (Some(expected), None) => {
                    self.expected = None;
                    let crc = FlashCrc::new(Region::new(self.region(program).base, expected.size));
                    Work::Verify { program, expected, crc }
                }
                (_, Some(ahead)) => match sector(ahead) {
                    Some(region) => erase_next(region),
                    None => return Step::Idle,
                },
                (None, None) => return Step::Idle,
            }
        } else {
            let header = Header::parse(&self.queue.first());
            let target = Region::new(header.flash_address, header.size);
            match self.session_of(program) {
                Some(Session::Open { erased, .. }) if erased < target.end() => match sector(erased) {
                    Some(region) => erase_next(region),
                    None => return self.fail(program, FlashError::Address),
                },
                _ if !is_blank(flash, target) => return self.fail(program, FlashError::NotCleared),
                _ => {
                    let (first, last) = (target.base & !3, (target.end() - 1) & !3);
                    let edges = [flash.read_word(first), flash.read_word(last)];
                    Work::Write { program, header, edges, writer: WordWriter::new(first) }
                }
            }
        };
        self.work = Some(work);
        Step::Again
    }

    fn fail(&mut self, program: u8, error: FlashError) -> Step {
        self.end(program, Err(error));
        Step::Again
    }

    /// Where the next sector begins that can be erased before there are data for it.
    fn sector_ahead(&self) -> Option<u32> {
        match self.session_of(self.owner)? {
            Session::Open { erased, ahead, .. } if erased < ahead => Some(erased),
            _ => None,
        }
    }

    /// A program, if there is one of this number.
    fn state_of(&self, program: u8) -> Option<&Program> {
        self.programs.get(usize::from(program).checked_sub(1)?)
    }

    /// See [`state_of`](Self::state_of).
    fn state(&mut self, program: u8) -> Option<&mut Program> {
        self.programs.get_mut(usize::from(program).checked_sub(1)?)
    }

    fn session_of(&self, program: u8) -> Option<Session> {
        self.state_of(program).map(|state| state.session)
    }

    fn session(&mut self, program: u8) -> Option<&mut Session> {
        self.state(program).map(|state| &mut state.session)
    }

    /// Ends a reception and shows why. The error that ended a session stays to be seen.
    fn refuse(&mut self, program: u8, Refusal(error, abort): Refusal) -> AbortCode {
        if let Some(state) = self.state(program) {
            if !matches!(state.session, Session::Failed) || state.error.is_none() {
                state.error = Some(error);
            }
        }
        #[cfg(feature = "streams")]
        let streaming = matches!(self.reception, Reception::Unknown { .. } | Reception::Stream { .. });
        #[cfg(not(feature = "streams"))]
        let streaming = false;
        if error == FlashError::Crc || streaming {
            self.outcome = Some((program, Err(error)));
        }
        self.block_cancel();
        abort
    }

    fn region(&self, program: u8) -> Region {
        self.layout.program(program).unwrap_or(Region::new(0, 0))
    }

    /// The largest block that can be taken.
    fn largest(&self) -> usize {
        self.queue.capacity().min(MAX_BLOCK_SIZE)
    }

    fn invalidate(&mut self, program: u8, all: bool) -> Work {
        self.parameters.store(Key::Program(program), ProgramRecord::NONE);
        Work::Invalidate { program, all }
    }

    fn store_record(&mut self, program: u8, record: ProgramRecord) -> Work {
        self.parameters.store(Key::Program(program), record.value());
        Work::Record { program, record }
    }

    /// What the first twelve bytes tell: refuses before the rest is sent.
    fn judge_header(&self, program: u8, header: Header) -> Result<(), Refusal> {
        let Some(state) = self.state_of(program) else { return Err(unfit(FlashError::Unspecified)) };
        if header.size as usize > self.largest() - FRAMING {
            return Err(Refusal(FlashError::Format, AbortCode::LENGTH_TOO_HIGH));
        }
        match (header.number, state.session) {
            // The sequence begins anew, over what is there.
            (NUMBER_CONTROL, Session::Open { .. }) => return Ok(()),
            (NUMBER_CONTROL, _) => return self.may_begin(program),
            (NUMBER_LAST, Session::Open { next, .. }) if next > 1 => return Ok(()),
            (number, Session::Open { next, .. }) if number == next => {}
            _ => return Err(untimely(FlashError::Sequence)),
        }
        if header.size == 0 {
            return Err(unfit(FlashError::Format));
        }
        self.check_place(program, Region::new(header.flash_address, header.size))
    }

    /// Whether the download of a program may begin.
    fn may_begin(&self, program: u8) -> Result<(), Refusal> {
        let Some(state) = self.state_of(program) else { return Err(unfit(FlashError::Unspecified)) };
        let replaces = self.policy.replaces;
        match state.session {
            Session::Idle if state.record.is_some() && !replaces => Err(untimely(FlashError::NotCleared)),
            Session::Failed if !replaces => Err(untimely(FlashError::Sequence)),
            Session::Open { .. } => Err(untimely(FlashError::Sequence)),
            _ if (self.policy.allowed)() => Ok(()),
            _ => Err(untimely(FlashError::NoAccess)),
        }
    }

    /// The download begins, of a program of this size; 0 where that is not known.
    fn open_session(&mut self, program: u8, size: u32) {
        let region = self.region(program);
        let replaces = self.policy.replaces;
        let Some(session) = self.session(program) else { return };
        if replaces && !matches!(*session, Session::Open { .. }) {
            *session = Session::Cleared { just: false };
        }
        let (erased, ahead) = match *session {
            // Known to be erased is nothing; what there are to be data for is erased ahead of them.
            Session::Cleared { .. } => (region.base, region.base + size.min(region.size)),
            Session::Open { erased, ahead, .. } => (erased, ahead),
            // No CLEAR: each block finds out whether its place is blank.
            _ => (region.end(), region.end()),
        };
        let cleared = matches!(session, Session::Cleared { .. });
        *session = Session::Open { next: 1, erased, ahead };
        // Also where there is no record: one that a power cut left between 0 and 1 may be there the
        // next time.
        if cleared && self.work.is_none() {
            self.work = Some(self.invalidate(program, false));
        }
    }

    /// The program was sent completely.
    fn expect(&mut self, program: u8, expected: Expected) {
        let end = self.region(program).base + expected.size;
        self.expected = Some(expected);
        // What no block has written belongs to the program all the same, and reads FFh.
        if let Some(Session::Open { ahead, .. }) = self.session(program) {
            *ahead = (*ahead).max(end);
        }
    }

    /// Whether data of this program may go there.
    fn check_place(&self, program: u8, place: Region) -> Result<(), Refusal> {
        let target = (place.base, place.size);
        if !self.region(program).contains(target.0, target.1) {
            let secured = [self.layout.bootloader, self.layout.parameters[0], self.layout.parameters[1]];
            let touches = |region: &Region| {
                // `u64`: an address near the end of the address space must not wrap.
                u64::from(region.base) < u64::from(target.0) + u64::from(target.1) && target.0 < region.end()
            };
            let secured = secured.iter().any(touches);
            return Err(unfit(if secured { FlashError::Secured } else { FlashError::Address }));
        }
        Ok(())
    }

    /// Judges the open block as a whole, and takes it.
    fn accept(&mut self, program: u8, header: Header) -> Result<(), Refusal> {
        let data_end = HEADER_SIZE + header.size as usize;
        if self.queue.open() != data_end + CRC_SIZE {
            return Err(Refusal(FlashError::Format, AbortCode::LENGTH));
        }
        let computed = self.queue.open_slices(data_end).iter().fold(0, |crc, bytes| crc::block(crc, bytes));
        if computed != u32::from_le_bytes(self.queue.of_open(data_end)) {
            return Err(unfit(FlashError::Crc));
        }
        let region = self.region(program);
        match header.number {
            NUMBER_CONTROL => {
                let data: [u8; CONTROL_MAX] = self.queue.of_open(HEADER_SIZE);
                let control = data.get(..header.size as usize).and_then(Control::parse);
                let control = control.ok_or(unfit(FlashError::Format))?;
                let app_size = self.check_identity(program, &control)?;
                let told = if let Control::Dated { version, .. } = control { version } else { 0 };
                if let Some(state) = self.state(program) {
                    state.version = told;
                }
                self.queue.discard_open();
                self.open_session(program, app_size);
            }
            NUMBER_LAST => {
                let data: [u8; LAST_SIZE] = self.queue.of_open(HEADER_SIZE);
                let last = data.get(..header.size as usize).and_then(Last::parse);
                let last = last.ok_or(unfit(FlashError::Format))?;
                if last.program_size < SMALLEST_PROGRAM {
                    return Err(unfit(FlashError::Format));
                }
                if last.program_size > region.size {
                    return Err(unfit(FlashError::Address));
                }
                self.queue.discard_open();
                self.expect(program, Expected { size: last.program_size, crc: Some(last.program_crc) });
            }
            number => {
                self.queue.commit();
                if let Some(Session::Open { next, .. }) = self.session(program) {
                    *next = number.wrapping_add(1);
                }
            }
        }
        Ok(())
    }

    /// Whether a program is for this device; gives the size that it is said to have, 0 where it is
    /// not said.
    fn check_identity(&self, program: u8, control: &Control) -> Result<u32, Refusal> {
        let identity = match control {
            Control::Plain => None,
            Control::Identity(identity) | Control::Dated { identity, .. } => Some(identity),
        };
        match ((self.policy.check)(program, control), identity, self.policy.identity) {
            (Verdict::Refuse(error), ..) => return Err(unfit(error)),
            (Verdict::Standard, Some(told), Some((vendor_id, product_code))) => {
                if told.vendor_id != 0 && told.vendor_id != vendor_id {
                    return Err(unfit(FlashError::WrongVendorId));
                }
                if told.product_code != 0 && told.product_code != product_code {
                    return Err(unfit(FlashError::WrongProductId));
                }
            }
            _ => {}
        }
        Ok(identity.map_or(0, |identity| identity.app_size))
    }
}

fn write_error(fault: FlashFault) -> FlashError {
    match fault {
        FlashFault::Protected => FlashError::Secured,
        FlashFault::Failed | FlashFault::Verify => FlashError::Write,
    }
}

/// Words of flash that a block touches.
fn words_of(header: &Header) -> usize {
    let before = header.flash_address % 4;
    (before + header.size).div_ceil(4) as usize
}

/// The `i`-th of them. Flash is programmed by words: the edges are filled up with what is there
/// already.
fn word(queue: &Queue<'_>, header: &Header, edges: &[u32; 2], i: usize, words: usize) -> u32 {
    let there = edges[usize::from(i + 1 == words)].to_le_bytes();
    let before = (header.flash_address % 4) as usize;
    let mut bytes = if i == 0 || i + 1 == words { there } else { [0; 4] };
    for (j, byte) in bytes.iter_mut().enumerate() {
        let at = (4 * i + j).wrapping_sub(before);
        if at < header.size as usize {
            *byte = queue.byte(HEADER_SIZE + at);
        }
    }
    u32::from_le_bytes(bytes)
}
