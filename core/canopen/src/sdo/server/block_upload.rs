//! Block upload.

use crate::abort::AbortCode;
use crate::od::Objects;
use crate::sdo::block::{check_blksize, Crc16, SEGMENT};
use crate::sdo::fields::{self, scs};

use super::{Outgoing, SdoServer, State};

/// The sending end of a block upload.
#[derive(Debug)]
pub(super) struct Sender {
    phase: Phase,
    /// Segments of this sub-block, 1 to 127.
    blksize: u8,
    /// The number of the last segment sent, 0 before the first one.
    seqno: u8,
    /// The offset of this sub-block in the data.
    base: u32,
    /// The number of bytes in the last segment of the transfer, after it was sent.
    last: Option<u8>,
    /// The CRC of the data up to `hashed`: a repeated segment is not counted again.
    crc: Crc16,
    hashed: u32,
}

#[derive(Debug, PartialEq, Eq)]
enum Phase {
    /// The client has not sent "start" yet.
    Initiated,
    Sending,
    /// The whole sub-block is sent.
    Sent,
    /// All data have arrived, and the end is sent.
    Ended,
}

impl SdoServer {
    pub(super) fn initiate_block_upload(
        &mut self,
        bytes: &[u8; 8],
        objects: &mut impl Objects,
    ) -> Result<(), AbortCode> {
        let outgoing = self.readable(fields::address(bytes), objects)?;
        let [_, _, _, _, blksize, pst, ..] = *bytes;
        let blksize = check_blksize(blksize)?;
        let size = outgoing.size();
        if pst != 0 && size.is_some_and(|size| size <= u32::from(pst)) {
            // Below the protocol switch threshold the client prefers an ordinary upload.
            self.answer_upload(outgoing);
            return Ok(());
        }
        self.state = State::BlockUpload { outgoing, sender: Sender::new(blksize) };
        let told = if size.is_some() { fields::BLOCK_SIZE_TOLD } else { 0 };
        let command = scs::INITIATE_BLOCK_UPLOAD | fields::CRC | told;
        self.answer_initiate(command, size.unwrap_or(0));
        Ok(())
    }

    pub(super) fn start_block_upload(&mut self) -> Result<(), AbortCode> {
        match &mut self.state {
            State::BlockUpload { sender, .. } if sender.phase == Phase::Initiated => {
                sender.phase = Phase::Sending;
                Ok(())
            }
            _ => Err(self.config.unknown_request),
        }
    }

    pub(super) fn ack_block_upload(&mut self, bytes: &[u8; 8]) -> Result<(), AbortCode> {
        match &mut self.state {
            State::BlockUpload { outgoing, sender } if sender.phase != Phase::Initiated => {
                if let Some(end) = sender.acknowledged(bytes[1], bytes[2], outgoing)? {
                    self.answer = Some(end);
                }
                Ok(())
            }
            _ => Err(self.config.unknown_request),
        }
    }

    pub(super) fn end_block_upload(&mut self) -> Result<(), AbortCode> {
        match &self.state {
            State::BlockUpload { sender, .. } if sender.phase == Phase::Ended => {
                self.state = State::Idle;
                Ok(())
            }
            _ => Err(self.config.unknown_request),
        }
    }

    /// Makes the next segment, if a block upload runs and it is the server's turn.
    pub(super) fn next_block_segment(&mut self, objects: &mut impl Objects) -> Result<(), AbortCode> {
        let State::BlockUpload { outgoing, sender } = &mut self.state else { return Ok(()) };
        if sender.phase != Phase::Sending {
            return Ok(());
        }
        let start = outgoing.offset;
        let mut bytes = [0; 8];
        let (len, last) = outgoing.next(self.at, &self.value, &mut bytes, objects)?;
        bytes[0] = sender.count(start, &bytes[1..=len], last);
        self.answer = Some(bytes);
        Ok(())
    }
}

impl Sender {
    fn new(blksize: u8) -> Self {
        Self { phase: Phase::Initiated, blksize, seqno: 0, base: 0, last: None, crc: Crc16::new(), hashed: 0 }
    }

    /// Records the next segment, with data from this offset on; returns its byte 0.
    fn count(&mut self, start: u32, data: &[u8], last: bool) -> u8 {
        if start == self.hashed {
            self.crc.update(data);
            self.hashed += data.len() as u32;
        }
        self.seqno += 1;
        self.last = last.then_some(data.len() as u8);
        if last || self.seqno == self.blksize {
            self.phase = Phase::Sent;
        }
        if last {
            fields::LAST_OF_BLOCKS | self.seqno
        } else {
            self.seqno
        }
    }

    /// Continues with the next sub-block after the last segment that arrived, or sends the end.
    ///
    /// A client that misses a segment may report it before the end of the sub-block.
    fn acknowledged(
        &mut self,
        ackseq: u8,
        blksize: u8,
        outgoing: &mut Outgoing,
    ) -> Result<Option<[u8; 8]>, AbortCode> {
        if self.phase == Phase::Ended {
            // The client repeats its acknowledgement.
            return Ok(None);
        }
        let blksize = check_blksize(blksize)?;
        if ackseq > self.seqno {
            return match self.phase {
                // More than was sent: the acknowledgement of the previous sub-block again.
                Phase::Sending => Ok(None),
                _ => Err(AbortCode::SEQUENCE_NUMBER),
            };
        }
        if let (Some(len), true) = (self.last, ackseq == self.seqno) {
            self.phase = Phase::Ended;
            let [low, high] = self.crc.get().to_le_bytes();
            let command = scs::END_BLOCK_UPLOAD | (SEGMENT as u8 - len) << 2;
            return Ok(Some(fields::without_address(command, low, high)));
        }
        self.base += u32::from(ackseq) * SEGMENT as u32;
        outgoing.offset = self.base;
        self.blksize = blksize;
        self.seqno = 0;
        self.last = None;
        self.phase = Phase::Sending;
        Ok(None)
    }
}
