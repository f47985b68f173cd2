//! The sending end of a block upload: what is sent, and what is to be sent again.

use crate::abort::AbortCode;
use crate::sdo::block::{check_blksize, Crc16, SEGMENT};
use crate::sdo::fields::{self, scs};

use super::outgoing::Outgoing;

/// The sending end of a block upload.
#[derive(Debug)]
pub(super) struct Sender {
    pub(super) phase: Phase,
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
pub(super) enum Phase {
    /// The client has not sent "start" yet.
    Initiated,
    Sending,
    /// The whole sub-block is sent.
    Sent,
    /// All data have arrived, and the end is sent.
    Ended,
}

impl Sender {
    pub(super) fn new(blksize: u8) -> Self {
        Self { phase: Phase::Initiated, blksize, seqno: 0, base: 0, last: None, crc: Crc16::new(), hashed: 0 }
    }

    /// Records the next segment, with data from this offset on; returns its byte 0.
    pub(super) fn count(&mut self, start: u32, data: &[u8], last: bool) -> u8 {
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
    pub(super) fn acknowledged(
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
