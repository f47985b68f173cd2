//! The block file: each SDO transfer is one block (SYS TEC manual L-1112d_10, chapter 5.1;
//! `shared_abi::block_file`).
//!
//! A block is judged three times: by its length where the client tells it, by its header as soon as
//! that is there, and as a whole by its CRC.

use canopen::program::FlashError;
use canopen::sdo::AbortCode;
use shared_abi::block_file::{
    Control, Header, Last, CONTROL_MAX, CRC_SIZE, FRAMING, HEADER_SIZE, MAX_BLOCK_SIZE, NUMBER_CONTROL,
    NUMBER_LAST,
};
use shared_abi::geometry::Region;

use super::{Begin, Destination, Format, Judge, Recognition, SMALLEST_PROGRAM};
use crate::program::Expected;
use crate::queue::Queue;
use crate::refusal::Refusal;
use crate::session::Session;

const TOO_LONG: Refusal = Refusal(FlashError::Format, AbortCode::LENGTH_TOO_HIGH);

/// One block, as far as it came.
pub(super) struct BlockFile {
    /// Bytes that came.
    len: usize,
    header: [u8; HEADER_SIZE],
    /// The data of the first and of the last block; those of the others go to the queue.
    fields: [u8; CONTROL_MAX],
    /// The CRC as the block tells it.
    told: [u8; CRC_SIZE],
    /// Over what came of header and data.
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
        // Blocks are counted, and no flash holds as many as that.
        if number > 0xFFFF && number != NUMBER_LAST {
            return Recognition::No;
        }
        Recognition::Yes(Self {
            len: 0,
            header: [0; HEADER_SIZE],
            fields: [0; CONTROL_MAX],
            told: [0; CRC_SIZE],
            crc: 0,
        })
    }

    fn begin(&mut self, size: Option<u32>, _judge: &Judge<'_>, queue: &Queue<'_>) -> Result<(), Refusal> {
        if size.is_some_and(|size| size as usize > largest(queue)) {
            return Err(TOO_LONG);
        }
        Ok(())
    }

    fn data(&mut self, mut bytes: &[u8], to: &mut Destination<'_, '_>) -> Result<(), Refusal> {
        if self.len + bytes.len() > largest(to.queue) {
            return Err(TOO_LONG);
        }
        while !bytes.is_empty() {
            let header = Header::parse(&self.header);
            let data_end = HEADER_SIZE + if self.len < HEADER_SIZE { 0 } else { header.size as usize };
            let end = if self.len < HEADER_SIZE { HEADER_SIZE } else { data_end };
            let (part, rest) = bytes.split_at(bytes.len().min(end.saturating_sub(self.len)));
            if part.is_empty() {
                // The CRC; what is more than that is told by its length.
                for (byte, at) in bytes.iter().zip(self.len - data_end..CRC_SIZE) {
                    self.told[at] = *byte;
                }
                self.len += bytes.len();
                return Ok(());
            }
            self.crc = to.judge.policy.crc.resume(self.crc, part);
            if self.len < HEADER_SIZE {
                self.header[self.len..self.len + part.len()].copy_from_slice(part);
            } else if is_data(&header) {
                if !to.queue.push(header.flash_address, part) {
                    return Err(TOO_LONG);
                }
            } else {
                let at = self.len - HEADER_SIZE;
                for (byte, place) in part.iter().zip(self.fields.iter_mut().skip(at)) {
                    *place = *byte;
                }
            }
            self.len += part.len();
            if self.len == HEADER_SIZE {
                judge_header(Header::parse(&self.header), to)?;
            }
            bytes = rest;
        }
        Ok(())
    }

    fn end(&mut self, to: &mut Destination<'_, '_>) -> Result<(), Refusal> {
        let header = Header::parse(&self.header);
        if self.len < HEADER_SIZE {
            return Err(Refusal(FlashError::Format, AbortCode::LENGTH_TOO_LOW));
        }
        if self.len != FRAMING + header.size as usize {
            return Err(Refusal(FlashError::Format, AbortCode::LENGTH));
        }
        if self.crc != u32::from_le_bytes(self.told) {
            return Err(Refusal::unfit(FlashError::Crc));
        }
        let malformed = Refusal::unfit(FlashError::Format);
        let fields = self.fields.get(..header.size as usize);
        match header.number {
            NUMBER_CONTROL => {
                let control = fields.and_then(Control::parse).ok_or(malformed)?;
                to.judge.check_identity(&control)?;
                to.progress.begins = Some(match control {
                    Control::Plain => Begin { size: 0, version: 0 },
                    Control::Identity(identity) => Begin { size: identity.app_size, version: 0 },
                    Control::Dated { identity, version, .. } => Begin { size: identity.app_size, version },
                });
            }
            NUMBER_LAST => {
                let last = fields.and_then(Last::parse).ok_or(malformed)?;
                if last.program_size < SMALLEST_PROGRAM {
                    return Err(malformed);
                }
                if last.program_size > to.judge.region().size {
                    return Err(Refusal::unfit(FlashError::Address));
                }
                to.progress.complete =
                    Some(Expected { size: last.program_size, crc: Some(last.program_crc) });
            }
            _ => {
                to.queue.commit();
                to.progress.block = true;
            }
        }
        Ok(())
    }
}

/// Whether a block holds data of the program.
fn is_data(header: &Header) -> bool {
    header.number != NUMBER_CONTROL && header.number != NUMBER_LAST
}

/// The largest block that can be taken.
fn largest(queue: &Queue<'_>) -> usize {
    queue.capacity().min(MAX_BLOCK_SIZE)
}

/// What the first twelve bytes tell: refuses before the rest is sent.
fn judge_header(header: Header, to: &Destination<'_, '_>) -> Result<(), Refusal> {
    if header.size as usize > largest(to.queue).saturating_sub(FRAMING) {
        return Err(TOO_LONG);
    }
    match (header.number, to.judge.session) {
        // The sequence begins anew, over what is there.
        (NUMBER_CONTROL, Session::Open { .. }) => return Ok(()),
        (NUMBER_CONTROL, _) => return to.judge.may_begin(),
        (NUMBER_LAST, Session::Open { next }) if next > 1 => return Ok(()),
        (number, Session::Open { next }) if number == next => {}
        _ => return Err(Refusal::untimely(FlashError::Sequence)),
    }
    if header.size == 0 {
        return Err(Refusal::unfit(FlashError::Format));
    }
    to.judge.check_place(Region::new(header.flash_address, header.size))
}
