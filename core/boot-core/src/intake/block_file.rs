//! The block file: each SDO transfer is one block (SYS TEC manual L-1112d_10, chapter 5.1;
//! `shared_abi::block_file`).
//!
//! A block is checked three times: its length when the client announces it, its header when it has
//! arrived, and the whole block by its CRC. The block with the start of the program is also checked
//! by its contents: nothing of the old program is lost before this block is good.

use canopen::program::FlashError;
use canopen::AbortCode;
use seal::wire::MAGIC;
use shared_abi::block_file::{
    Control, Header, Last, FRAMING, HEADER_SIZE, LAST_SIZE, LAST_SIZE_2008, LAST_SIZE_AT_2008_OFFSETS,
    MAX_BLOCK_SIZE, NUMBER_CONTROL, NUMBER_LAST,
};
use shared_abi::date::of_control;
use shared_abi::geometry::Region;

use super::format::{Begin, Destination, Format, Recognition, SMALLEST_PROGRAM};
use super::stream::judge_start;
use crate::policy::{AppInfo, Judge};
use crate::program::Expected;
use crate::queue::Queue;
use crate::refusal::Refusal;
use crate::resume::Partial;
use crate::session::{Session, ANY};

const TOO_LONG: Refusal = Refusal(FlashError::Format, AbortCode::LENGTH_TOO_HIGH);

/// One block, as far as it has arrived.
pub(super) struct BlockFile {
    /// The number of bytes that have arrived.
    len: usize,
    /// The header; zeros until it has arrived.
    header: Header,
    /// The first bytes: the header. The data are in the queue.
    start: [u8; HEADER_SIZE],
    /// The number of bytes that the client announced.
    announced: Option<u32>,
    /// The last four bytes after the data: the CRC in the block.
    sent_crc: u32,
    /// The CRC of header and data that have arrived.
    crc: u32,
}

impl Format for BlockFile {
    const IS_STREAM: bool = false;

    fn recognise(first: &[u8], judge: &Judge<'_>) -> Recognition<Self> {
        if judge.is_data() {
            return Recognition::No;
        }
        let Some(word) = first.first_chunk() else { return Recognition::More };
        let number = u32::from_le_bytes(*word);
        // No flash holds that many blocks.
        if number > 0xFFFF && number != NUMBER_LAST {
            return Recognition::No;
        }
        Recognition::Yes(Self {
            len: 0,
            header: Header { number: 0, flash_address: 0, size: 0 },
            start: [0; HEADER_SIZE],
            announced: None,
            sent_crc: 0,
            crc: 0,
        })
    }

    fn begin(&mut self, size: Option<u32>, _judge: &Judge<'_>, queue: &Queue<'_>) -> Result<(), Refusal> {
        if size.is_some_and(|size| size as usize > largest(queue)) {
            return Err(TOO_LONG);
        }
        self.announced = size;
        Ok(())
    }

    fn data(&mut self, bytes: &[u8], to: &mut Destination<'_, '_>) -> Result<(), Refusal> {
        if self.len + bytes.len() > largest(to.queue) {
            return Err(TOO_LONG);
        }
        bytes.iter().try_for_each(|byte| self.push(*byte, to))
    }

    fn end(&mut self, to: &mut Destination<'_, '_>) -> Result<(), Refusal> {
        let header = self.header;
        if self.len < HEADER_SIZE {
            return Err(Refusal(FlashError::Format, AbortCode::LENGTH_TOO_LOW));
        }
        if self.len != FRAMING + header.size as usize {
            return Err(Refusal(FlashError::Format, AbortCode::LENGTH));
        }
        if self.crc != self.sent_crc {
            return Err(Refusal::unfit(FlashError::Crc));
        }
        let malformed = Refusal::unfit(FlashError::Format);
        if let (true, Session::Open { next }) = (is_data(&header), to.judge.session) {
            if self.has_come(next, to)? {
                to.queue.discard();
                return Ok(());
            }
        }
        let mut fields = [0; LAST_SIZE_2008];
        let fields = fields.get_mut(..header.size as usize).map(|fields| {
            to.queue.read_open(0, fields);
            &*fields
        });
        match header.number {
            NUMBER_CONTROL => self.take_control(fields.and_then(Control::parse), to)?,
            NUMBER_LAST if to.judge.images.only_sealed().is_some() => {
                // The manifest of the sealed image describes the program.
                to.queue.discard();
                to.findings.complete = Some(Expected { size: 0, crc: None });
            }
            _ if to.judge.images.only_sealed().is_some() => {
                if header.number == 1 {
                    to.judge.is_allowed()?;
                    if to.queue.open_word() != u32::from_le_bytes(MAGIC) {
                        return Err(Refusal::unfit(FlashError::NoAccess));
                    }
                }
                to.queue.commit_bytes();
                to.findings.block = true;
            }
            NUMBER_LAST => {
                let last = fields.and_then(Last::parse).ok_or(malformed)?;
                to.queue.discard();
                if last.program_size < SMALLEST_PROGRAM {
                    return Err(malformed);
                }
                if last.program_size > to.judge.region.size {
                    return Err(Refusal::unfit(FlashError::Address));
                }
                to.findings.complete =
                    Some(Expected { size: last.program_size, crc: Some(last.program_crc) });
            }
            _ => {
                judge_start(to)?;
                to.queue.commit();
                to.findings.block = true;
            }
        }
        if to.findings.block {
            // A refused block has not come.
            to.queue.last.replace(header.number, self.crc, header.flash_address + header.size);
        }
        Ok(())
    }
}

impl BlockFile {
    /// Whether this block of data has come before.
    fn has_come(&self, next: u32, to: &Destination<'_, '_>) -> Result<bool, Refusal> {
        let Header { number, flash_address, size } = self.header;
        let last = &to.queue.last;
        let is_repeat = if last.is_again(next, number) {
            // A client that sends to several devices repeats a block until all of them have it.
            last.has_crc(self.crc)
        } else if to.judge.images.only_sealed().is_some() && next == ANY && flash_address != last.end() {
            // The bytes of a sealed image are processed in order, and each once.
            flash_address + size <= last.end()
        } else {
            return Ok(false);
        };
        if is_repeat {
            Ok(true)
        } else {
            Err(Refusal::untimely(FlashError::Sequence))
        }
    }

    /// The control block begins the program.
    fn take_control(&self, control: Option<Control>, to: &mut Destination<'_, '_>) -> Result<(), Refusal> {
        to.judge.check_identity(&AppInfo::of_block(control, to.queue))?;
        to.queue.discard();
        let (size, version, date) = match control {
            None | Some(Control::Plain) => (0, 0, 0),
            Some(Control::Identity(identity)) => (identity.app_size, 0, 0),
            Some(Control::Dated { identity, version, date }) => {
                (identity.app_size, version, of_control(date))
            }
        };
        // A control block without a size is the same for too many programs.
        let id = if size == 0 { 0 } else { self.crc };
        let partial = Partial::begin(id, to.judge.region.base);
        to.findings.begins = Some(Begin { size, version, date, partial });
        if let Some(linked) = to.judge.images.only_sealed() {
            // The sequence begins again over what was processed, if it is that of the same file.
            if to.judge.has_begun() && !to.judge.partial.is_same(partial) {
                return Err(Refusal::untimely(FlashError::Sequence));
            }
            to.findings.begins = Some(Begin { size: 0, version: 0, date: 0, partial });
            to.findings.sealed = Some(linked);
        }
        Ok(())
    }

    /// Takes the next byte.
    fn push(&mut self, byte: u8, to: &mut Destination<'_, '_>) -> Result<(), Refusal> {
        let at = self.len;
        self.len += 1;
        if at >= HEADER_SIZE + self.header.size as usize {
            // The CRC. Further bytes are detected by the length.
            self.sent_crc = self.sent_crc >> 8 | u32::from(byte) << 24;
            return Ok(());
        }
        self.crc = to.judge.policy.crc.resume(self.crc, &[byte]);
        let Some(place) = self.start.get_mut(at) else {
            let joins = to.queue.push(self.header.flash_address, &[byte]);
            return if joins { Ok(()) } else { Err(TOO_LONG) };
        };
        *place = byte;
        match self.len {
            HEADER_SIZE => {
                self.header = Header::parse(&self.start);
                if self.header.number == NUMBER_LAST && self.header.size == LAST_SIZE as u32 {
                    // The size field of the manual of 2008 does not include the reserved bytes.
                    self.header.size = match self.announced {
                        Some(OF_2008) => LAST_SIZE_2008 as u32,
                        Some(AT_2008_OFFSETS) => LAST_SIZE_AT_2008_OFFSETS as u32,
                        _ => LAST_SIZE as u32,
                    };
                }
                judge_header(self.header, to)
            }
            _ => Ok(()),
        }
    }
}

/// The bytes of the last block in the two readings of the manual of 2008.
const OF_2008: u32 = (FRAMING + LAST_SIZE_2008) as u32;
const AT_2008_OFFSETS: u32 = (FRAMING + LAST_SIZE_AT_2008_OFFSETS) as u32;

/// Whether a block holds data of the program.
fn is_data(header: &Header) -> bool {
    header.number != NUMBER_CONTROL && header.number != NUMBER_LAST
}

/// The largest acceptable block.
fn largest(queue: &Queue<'_>) -> usize {
    queue.capacity().min(MAX_BLOCK_SIZE)
}

/// Checks the first twelve bytes, so that a refusal comes before the rest is sent.
fn judge_header(header: Header, to: &Destination<'_, '_>) -> Result<(), Refusal> {
    if header.size as usize > largest(to.queue).saturating_sub(FRAMING) {
        return Err(TOO_LONG);
    }
    match (header.number, to.judge.session) {
        // The sequence begins again over the existing pieces.
        (NUMBER_CONTROL, Session::Open { .. }) => return Ok(()),
        (NUMBER_CONTROL, _) => return to.judge.may_begin(false),
        (NUMBER_LAST, Session::Open { next }) if next != 1 => return Ok(()),
        (number, Session::Open { next }) if to.queue.last.may_follow(next, number, header.flash_address) => {}
        _ => return Err(Refusal::untimely(FlashError::Sequence)),
    }
    if header.size == 0 {
        return Err(Refusal::unfit(FlashError::Format));
    }
    to.judge.check_place(Region::new(header.flash_address, header.size))?;
    // The first data are the start of the program, which shows whether it can run here.
    let (base, is_sealed) = (to.judge.region.base, to.judge.images.only_sealed().is_some());
    if to.queue.last.end() == base && header.flash_address != base && !is_sealed {
        return Err(Refusal::unfit(FlashError::Address));
    }
    Ok(())
}
