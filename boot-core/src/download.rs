//! Program download by block file: 1F50h takes the blocks, 1F51h the commands, 1F57h tells what became of them.
//!
//! Two halves that never wait for each other. The **SDO half** (`block_…`, [`Downloader::command`]) judges what comes in: it
//! refuses at once, with an abort and a status, or accepts and leaves work behind. The **flash half**
//! ([`Downloader::step`]) carries the work through, an operation or a bounded computation at a time; meanwhile the
//! status is busy. Nothing reaches the flash that the SDO half has not checked in full.

use core::task::Poll;

use canopen::program::{FlashError, FlashStatus, ProgramControl};
use canopen::sdo::AbortCode;
use shared_abi::block_file::{
    Control, Header, Last, CRC_SIZE, FRAMING, HEADER_SIZE, NUMBER_CONTROL, NUMBER_LAST,
};
use shared_abi::geometry::Region;
use shared_abi::layout::Layout;
use shared_abi::warm_start::BootRequest;

use crate::crc32;
use crate::flash::{is_blank, Flash, FlashFault, SectorEraser, WordWriter, ERASED};
use crate::node::NodeParameters;
use crate::parameters::{Journal, Key, Store, StoreError, Value};
use crate::program::{check_vectors, FlashCrc, ProgramRecord};

/// Bytes of flash that one step of a CRC covers: at 10 cycles a byte and 168 MHz, some 60 µs.
const CRC_STEP: u32 = 1024;

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

/// Why a block or a command is refused: the status that 1F57h shows, and the abort that the client gets.
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
}

/// How far the download of a program is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Session {
    /// No block was taken yet.
    Idle,
    /// Blocks are being taken; `next` is the number of the next one.
    Open { next: u32 },
}

/// The block that is being received. `len` bytes of it are in the buffer.
#[derive(Clone, Copy, Debug)]
enum Reception {
    Idle,
    /// The header is not complete.
    Header {
        program: u8,
        len: usize,
    },
    /// The header was judged good.
    Data {
        program: u8,
        len: usize,
        header: Header,
    },
}

/// What is being done to the flash. A piece of work belongs to one program.
enum Work {
    /// CLEAR: the record goes first, so that a program that is partly erased is no program.
    Invalidate { program: u8, store: Store },
    /// CLEAR: then the sectors.
    Erase { program: u8, eraser: SectorEraser },
    /// A data block. `offset` is where its first word is in the buffer.
    Write { program: u8, number: u32, offset: usize, words: usize, writer: WordWriter },
    /// The last block: is the flash what the host meant?
    Verify { program: u8, last: Last, crc: FlashCrc },
    /// The record of a program: after verification, and when the signature changes.
    Record { program: u8, record: ProgramRecord, store: Store },
    /// Node-ID and bit rate; of no program.
    Node { store: Store },
}

/// The download of programs into flash. `PROGRAMS` is the number of programs in the layout.
pub struct Downloader<'b, const PROGRAMS: usize> {
    layout: &'static Layout,
    journal: Journal,
    programs: [Program; PROGRAMS],
    /// Holds one block, framing included.
    buffer: &'b mut [u8],
    reception: Reception,
    work: Option<Work>,
    /// A request that waits for the device to leave the bootloader.
    leave: Option<BootRequest>,
    /// How a piece of work on a program ended, or a block that was damaged; to be told.
    outcome: Option<(u8, Result<(), FlashError>)>,
    /// How the last storing of node-ID and bit rate ended.
    node_stored: Result<(), StoreError>,
}

impl<'b, const PROGRAMS: usize> Downloader<'b, PROGRAMS> {
    /// Starts from what the parameters tell. The size of `buffer` is the largest block that can be taken, framing
    /// included.
    pub fn new<F: Flash>(layout: &'static Layout, flash: &F, buffer: &'b mut [u8]) -> Self {
        let journal = Journal::open(flash, layout.parameters);
        let mut number = 0;
        let programs = [(); PROGRAMS].map(|()| {
            number += 1;
            let record = ProgramRecord::load(&journal, flash, number);
            Program {
                record,
                identification: record.map_or(0, |record| record.crc),
                error: None,
                session: Session::Idle,
            }
        });
        Self {
            layout,
            journal,
            programs,
            buffer,
            reception: Reception::Idle,
            work: None,
            leave: None,
            outcome: None,
            node_stored: Ok(()),
        }
    }

    /// Whether sub-index `program` of 1F50h, 1F51h, 1F56h and 1F57h exists.
    #[must_use]
    pub fn has(&self, program: u8) -> bool {
        self.index(program).is_some()
    }

    /// 1F57h. Busy while work on this program lasts.
    #[must_use]
    pub fn status(&self, program: u8) -> FlashStatus {
        let error = self.index(program).and_then(|i| self.programs[i].error);
        FlashStatus { busy: self.worked_on() == Some(program), error, detail: 0 }
    }

    /// 1F56h: the CRC over the program, 0 where there is none.
    #[must_use]
    pub fn identification(&self, program: u8) -> u32 {
        self.index(program).map_or(0, |i| self.programs[i].identification)
    }

    /// Whether there is work for [`Downloader::step`].
    #[must_use]
    pub fn busy(&self) -> bool {
        self.work.is_some()
    }

    /// The request to leave the bootloader, once: the answer to the command may still be on its way.
    pub fn take_leave(&mut self) -> Option<BootRequest> {
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
        self.work = Some(Work::Node { store: self.journal.store(Key::Node, node.value()) });
        Ok(())
    }

    /// How the last [`store_node`](Self::store_node) ended.
    pub fn node_stored(&self) -> Poll<Result<(), StoreError>> {
        if matches!(self.work, Some(Work::Node { .. })) {
            Poll::Pending
        } else {
            Poll::Ready(self.node_stored)
        }
    }

    /// 1F51h: a command. It is judged and acknowledged now and carried out by [`Downloader::step`].
    ///
    /// # Errors
    /// The abort that answers it.
    pub fn command(&mut self, program: u8, command: ProgramControl) -> Result<(), AbortCode> {
        let index = self.index(program).ok_or(AbortCode::NO_SUB_INDEX)?;
        if matches!(command, ProgramControl::Stop | ProgramControl::StartBootloader) {
            // No program runs, and the bootloader does: both are so already.
            return Ok(());
        }
        if self.busy() || self.leave.is_some() {
            return Err(self.refuse(program, untimely(FlashError::Busy)));
        }
        let state = &mut self.programs[index];
        state.error = None;
        match command {
            ProgramControl::Stop | ProgramControl::StartBootloader | ProgramControl::ResetStat => {}
            ProgramControl::Clear => {
                self.reception = Reception::Idle;
                state.session = Session::Idle;
                state.identification = 0;
                self.work = Some(if state.record.take().is_some() {
                    let store = self.journal.store(Key::Program(program), ProgramRecord::NONE);
                    Work::Invalidate { program, store }
                } else {
                    self.erase(program)
                });
            }
            ProgramControl::Start => match state.record {
                Some(record) if record.signed => self.leave = Some(BootRequest::Start(program)),
                Some(_) => self.leave = Some(BootRequest::Trial(program)),
                None => state.error = Some(FlashError::NoValidProgram),
            },
            ProgramControl::SetSignature | ProgramControl::ClrSignature => match state.record {
                Some(record) => {
                    let signed = command == ProgramControl::SetSignature;
                    if record.signed != signed {
                        self.work = Some(self.store_record(program, ProgramRecord { signed, ..record }));
                    }
                }
                None if command == ProgramControl::SetSignature => {
                    state.error = Some(FlashError::NoValidProgram)
                }
                None => {}
            },
        }
        Ok(())
    }

    /// 1F50h: the client announces a block, and its size if it knows it.
    ///
    /// # Errors
    /// The abort that answers it.
    pub fn block_start(&mut self, program: u8, size: Option<u32>) -> Result<(), AbortCode> {
        self.index(program).ok_or(AbortCode::NO_SUB_INDEX)?;
        if self.busy() || self.leave.is_some() {
            return Err(self.refuse(program, untimely(FlashError::Busy)));
        }
        if let Some(size) = size {
            if size as usize > self.buffer.len() {
                return Err(self.refuse(program, Refusal(FlashError::Format, AbortCode::LENGTH_TOO_HIGH)));
            }
            if (size as usize) < FRAMING {
                return Err(self.refuse(program, Refusal(FlashError::Format, AbortCode::LENGTH_TOO_LOW)));
            }
        }
        self.reception = Reception::Header { program, len: 0 };
        Ok(())
    }

    /// 1F50h: the next bytes of the block.
    ///
    /// # Errors
    /// The abort that ends the transfer.
    pub fn block_data(&mut self, data: &[u8]) -> Result<(), AbortCode> {
        let (program, len) = match self.reception {
            Reception::Idle => return Err(AbortCode::DEVICE_STATE),
            Reception::Header { program, len } | Reception::Data { program, len, .. } => (program, len),
        };
        let end = len + data.len();
        let Some(space) = self.buffer.get_mut(len..end) else {
            return Err(self.refuse(program, Refusal(FlashError::Format, AbortCode::LENGTH_TOO_HIGH)));
        };
        space.copy_from_slice(data);
        self.reception = match self.reception {
            Reception::Data { header, .. } => Reception::Data { program, len: end, header },
            _ => match self.buffer[..end].first_chunk::<HEADER_SIZE>() {
                None => Reception::Header { program, len: end },
                Some(bytes) => {
                    let header = Header::parse(bytes);
                    match self.judge_header(program, header) {
                        Ok(()) => Reception::Data { program, len: end, header },
                        Err(refusal) => return Err(self.refuse(program, refusal)),
                    }
                }
            },
        };
        Ok(())
    }

    /// 1F50h: the block is complete. Judges it in full and leaves the work behind.
    ///
    /// # Errors
    /// The abort that answers instead of the last acknowledgement.
    pub fn block_end<F: Flash>(&mut self, flash: &F) -> Result<(), AbortCode> {
        let reception = core::mem::replace(&mut self.reception, Reception::Idle);
        match reception {
            Reception::Idle => Err(AbortCode::DEVICE_STATE),
            Reception::Header { program, .. } => {
                Err(self.refuse(program, Refusal(FlashError::Format, AbortCode::LENGTH_TOO_LOW)))
            }
            Reception::Data { program, len, header } => match self.accept(flash, program, len, header) {
                Ok(work) => {
                    self.work = work;
                    if let Some(index) = self.index(program) {
                        self.programs[index].error = None;
                    }
                    Ok(())
                }
                Err(refusal) => Err(self.refuse(program, refusal)),
            },
        }
    }

    /// 1F50h: the transfer ended before the block did. The block may be sent again.
    pub fn block_cancel(&mut self) {
        self.reception = Reception::Idle;
    }

    /// Carries the work on.
    pub fn step<F: Flash>(&mut self, flash: &mut F) -> Step {
        let Some(mut work) = self.work.take() else { return Step::Idle };
        let chip = self.layout.chip;
        let (program, outcome) = match &mut work {
            Work::Node { store } => {
                return match store.poll(&mut self.journal, flash, chip) {
                    Poll::Pending => {
                        self.work = Some(work);
                        Step::Programming
                    }
                    Poll::Ready(outcome) => {
                        self.node_stored = outcome;
                        Step::Idle
                    }
                };
            }
            Work::Invalidate { program, store } => {
                let program = *program;
                match store.poll(&mut self.journal, flash, chip) {
                    Poll::Pending => (program, Poll::Pending),
                    Poll::Ready(Err(_)) => (program, Poll::Ready(Err(FlashError::NvData))),
                    Poll::Ready(Ok(())) => {
                        self.work = Some(self.erase(program));
                        return Step::Again;
                    }
                }
            }
            Work::Erase { program, eraser } => (*program, eraser.poll(flash, chip).map_err(write_error)),
            Work::Write { program, number, offset, words, writer } => {
                let data = &self.buffer[*offset..];
                let outcome = writer.poll(flash, *words, |i| word_at(data, i)).map_err(write_error);
                if outcome == Poll::Ready(Ok(())) {
                    if let Some(index) = self.index(*program) {
                        self.programs[index].session = Session::Open { next: number.wrapping_add(1) };
                    }
                }
                (*program, outcome)
            }
            Work::Verify { program, last, crc } => {
                let (program, last) = (*program, *last);
                let Some(crc) = crc.step(flash, CRC_STEP) else {
                    self.work = Some(work);
                    return Step::Again;
                };
                if let Some(index) = self.index(program) {
                    self.programs[index].identification = crc;
                    self.programs[index].session = Session::Idle;
                }
                let region = self.layout.program(program);
                let plausible =
                    region.is_some_and(|region| check_vectors(flash, region, self.layout).is_ok());
                if crc == last.program_crc && plausible {
                    let record = ProgramRecord { size: last.program_size, crc, signed: false };
                    self.work = Some(self.store_record(program, record));
                    return Step::Again;
                }
                (program, Poll::Ready(Err(FlashError::NoValidProgram)))
            }
            Work::Record { program, record, store } => {
                let outcome = store.poll(&mut self.journal, flash, chip).map_err(|_| FlashError::NvData);
                if outcome == Poll::Ready(Ok(())) {
                    if let Some(index) = self.index(*program) {
                        self.programs[index].record = Some(*record);
                    }
                }
                (*program, outcome)
            }
        };
        match outcome {
            Poll::Pending => {
                let step = if matches!(work, Work::Erase { .. }) { Step::Erasing } else { Step::Programming };
                self.work = Some(work);
                step
            }
            Poll::Ready(outcome) => {
                if let Some(index) = self.index(program) {
                    let state = &mut self.programs[index];
                    state.error = outcome.err();
                    if outcome.is_err() {
                        // Half a program is in flash, or none: only CLEAR makes a new beginning.
                        state.session = Session::Idle;
                    }
                }
                self.outcome = Some((program, outcome));
                Step::Idle
            }
        }
    }

    fn index(&self, program: u8) -> Option<usize> {
        let index = usize::from(program).checked_sub(1)?;
        (index < PROGRAMS).then_some(index)
    }

    fn worked_on(&self) -> Option<u8> {
        match self.work.as_ref()? {
            Work::Invalidate { program, .. }
            | Work::Erase { program, .. }
            | Work::Write { program, .. }
            | Work::Verify { program, .. }
            | Work::Record { program, .. } => Some(*program),
            Work::Node { .. } => None,
        }
    }

    /// Ends a reception and shows why.
    fn refuse(&mut self, program: u8, Refusal(error, abort): Refusal) -> AbortCode {
        self.reception = Reception::Idle;
        if let Some(index) = self.index(program) {
            self.programs[index].error = Some(error);
        }
        if error == FlashError::Crc {
            self.outcome = Some((program, Err(error)));
        }
        abort
    }

    fn region(&self, program: u8) -> Region {
        self.layout.program(program).unwrap_or(Region::new(0, 0))
    }

    fn erase(&self, program: u8) -> Work {
        Work::Erase { program, eraser: SectorEraser::new(self.region(program)) }
    }

    fn store_record(&self, program: u8, record: ProgramRecord) -> Work {
        let value: Value = record.value();
        Work::Record { program, record, store: self.journal.store(Key::Program(program), value) }
    }

    /// What the first twelve bytes tell: refuses before the rest is sent.
    fn judge_header(&self, program: u8, header: Header) -> Result<(), Refusal> {
        let Some(index) = self.index(program) else { return Err(unfit(FlashError::Unspecified)) };
        let state = &self.programs[index];
        if header.size as usize > self.buffer.len() - FRAMING {
            return Err(Refusal(FlashError::Format, AbortCode::LENGTH_TOO_HIGH));
        }
        match header.number {
            NUMBER_CONTROL => {
                if state.record.is_some() {
                    return Err(untimely(FlashError::NotCleared));
                }
            }
            number => match state.session {
                Session::Open { next } if number == next || (number == NUMBER_LAST && next > 1) => {}
                _ => return Err(untimely(FlashError::Sequence)),
            },
        }
        if !matches!(header.number, NUMBER_CONTROL | NUMBER_LAST) {
            let target = (header.flash_address, header.size);
            if header.size == 0 {
                return Err(unfit(FlashError::Format));
            }
            if !self.region(program).contains(target.0, target.1) {
                let secured = [self.layout.bootloader, self.layout.parameters[0], self.layout.parameters[1]];
                let touches = |region: &Region| {
                    // `u64`: an address near the end of the address space must not wrap.
                    u64::from(region.base) < u64::from(target.0) + u64::from(target.1)
                        && target.0 < region.end()
                };
                let secured = secured.iter().any(touches);
                return Err(unfit(if secured { FlashError::Secured } else { FlashError::Address }));
            }
        }
        Ok(())
    }

    /// Judges a whole block and says what is to be done with it.
    fn accept<F: Flash>(
        &mut self,
        flash: &F,
        program: u8,
        len: usize,
        header: Header,
    ) -> Result<Option<Work>, Refusal> {
        let data_end = HEADER_SIZE + header.size as usize;
        if len != data_end + CRC_SIZE {
            return Err(Refusal(FlashError::Format, AbortCode::LENGTH));
        }
        if crc32(&self.buffer[..data_end]) != word_at(&self.buffer[data_end..], 0) {
            return Err(unfit(FlashError::Crc));
        }
        let region = self.region(program);
        match header.number {
            NUMBER_CONTROL => {
                Control::parse(&self.buffer[HEADER_SIZE..data_end]).ok_or(unfit(FlashError::Format))?;
                if let Some(index) = self.index(program) {
                    self.programs[index].session = Session::Open { next: 1 };
                }
                Ok(None)
            }
            NUMBER_LAST => {
                let last =
                    Last::parse(&self.buffer[HEADER_SIZE..data_end]).ok_or(unfit(FlashError::Format))?;
                // The first two vectors at least: without them under the CRC nothing can be started.
                if last.program_size < 8 {
                    return Err(unfit(FlashError::Format));
                }
                if last.program_size > region.size {
                    return Err(unfit(FlashError::Address));
                }
                let crc = FlashCrc::new(Region::new(region.base, last.program_size));
                Ok(Some(Work::Verify { program, last, crc }))
            }
            number => {
                let target = Region::new(header.flash_address, header.size);
                if !is_blank(flash, target) {
                    return Err(untimely(FlashError::NotCleared));
                }
                // Flash is programmed by words: fill the first and the last one up with what is there already. The
                // header in front and the CRC behind have served and make room for it.
                let before = (target.base % 4) as usize;
                let after = (target.end().wrapping_neg() % 4) as usize;
                let offset = HEADER_SIZE - before;
                flash.read(target.base - before as u32, &mut self.buffer[offset..HEADER_SIZE]);
                flash.read(target.end(), &mut self.buffer[data_end..data_end + after]);
                let words = (data_end + after - offset) / 4;
                let writer = WordWriter::new(target.base - before as u32);
                Ok(Some(Work::Write { program, number, offset, words, writer }))
            }
        }
    }
}

fn write_error(fault: FlashFault) -> FlashError {
    match fault {
        FlashFault::Protected => FlashError::Secured,
        FlashFault::Failed | FlashFault::Verify => FlashError::Write,
    }
}

/// The `i`-th little-endian word.
fn word_at(bytes: &[u8], i: usize) -> u32 {
    bytes.get(4 * i..).and_then(|rest| rest.first_chunk()).map_or(ERASED, |word| u32::from_le_bytes(*word))
}
