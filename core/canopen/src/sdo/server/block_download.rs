//! Block download.
//!
//! # Requests between segments
//!
//! Byte 0 of a segment is its number, 1 to 127, with bit 7 set in the last segment of the transfer.
//! The command specifiers of the initiates (20h, 40h, A0h, C0h with their flags) are also such
//! numbers, and CiA 301 has no rule to distinguish the two. A client that is switched off in the
//! middle of a download must however not block other clients until the time-out. A frame is
//! therefore taken for a request if
//!
//! 1. it is out of order: a client sends the segments of a sub-block in a row, and CAN neither
//!    changes the order of frames nor repeats one after a later one ([`Receiver::take`]),
//! 2. it reads as an initiate for an object that the device has, and
//! 3. no segment follows it for as long as the last segment may take.
//!
//! The request then ends the download and is carried out. A segment is mistaken for a request if
//! the previous segment was lost, nothing follows it (it is the last of the transfer, or the rest
//! of the sub-block was lost, too), and three bytes of its data happen to be the address of an
//! object. A request is mistaken for a segment if it arrives when exactly its number is due: then
//! the CRC of the transfer, or of the block, does not match, and the request is answered when it is
//! repeated. A client that continues its download is not disturbed by a client that sends requests
//! between its segments.

use crate::abort::AbortCode;
use crate::od::{self, Objects};
use crate::sdo::block::Receiver;
use crate::sdo::fields::{self, scs};
use crate::time::Instant;

use super::{Incoming, SdoServer, State};

impl SdoServer {
    pub(super) fn initiate_block_download(
        &mut self,
        bytes: &[u8; 8],
        objects: &mut impl Objects,
    ) -> Result<(), AbortCode> {
        let at = fields::address(bytes);
        let data_type = self.writable(at, objects)?.data_type;
        let size = (bytes[0] & fields::BLOCK_SIZE_INDICATED != 0).then(|| fields::number(bytes));
        let incoming = Incoming::start(at, data_type, size, objects)?;
        let receiver = Receiver::new(bytes[0] & fields::CRC != 0);
        self.forget_under_way();
        self.state = State::BlockDownload { incoming, receiver };
        let command = scs::INITIATE_BLOCK_DOWNLOAD | fields::CRC;
        self.answer_initiate(command, 0);
        Ok(())
    }

    /// A frame within a sub-block.
    pub(super) fn block_segment(
        &mut self,
        bytes: &[u8; 8],
        now: Instant,
        objects: &mut impl Objects,
    ) -> Result<(), AbortCode> {
        // No segment has the number 0, so an abort differs from all segments.
        if bytes[0] == fields::ABORT {
            self.reset(objects);
            return Ok(());
        }
        let State::BlockDownload { receiver, .. } = &mut self.state else { return Err(AbortCode::COMMAND) };
        let doubted = receiver.is_doubtful;
        let received = receiver.take(bytes, true)?;
        // A client that repeats its request does not delay its own answer.
        if !(doubted && receiver.is_doubtful) {
            self.heard = now;
        }
        if received.is_data {
            self.moved = now;
            self.take(&bytes[1..], objects)?;
        }
        if let Some(ackseq) = received.ackseq {
            self.answer_transfer(scs::ACK_BLOCK_DOWNLOAD, ackseq, 0);
        }
        Ok(())
    }

    /// Whether it waits for more segments of a sub-block that has begun, or for the absence of
    /// segments after a possible request.
    pub(super) fn is_within(&self) -> bool {
        matches!(&self.state, State::BlockDownload { receiver, .. }
            if receiver.is_within() || receiver.is_doubtful)
    }

    /// The length of this wait in milliseconds.
    pub(super) fn pause_ms(&self) -> u32 {
        let is_short = matches!(&self.state, State::BlockDownload { receiver, incoming }
            if receiver.is_doubtful || receiver.is_in_order() && (receiver.misses_one() || incoming.misses_one()));
        if is_short {
            self.config.last_pause_ms << u32::from(self.config.bit_rate.is_slow())
        } else {
            self.config.pause_ms
        }
    }

    /// The wait has ended: no segment will arrive.
    pub(super) fn pause(&mut self, now: Instant, objects: &mut impl Objects) {
        let State::BlockDownload { receiver, .. } = &mut self.state else { return };
        let frame = receiver.frame;
        if receiver.is_doubtful && od::find(objects.entries(), fields::address(&frame)).is_ok() {
            self.serve(&frame, now, objects);
        } else if receiver.is_within() {
            let ackseq = receiver.close();
            self.answer_transfer(scs::ACK_BLOCK_DOWNLOAD, ackseq, 0);
        } else {
            receiver.is_doubtful = false;
        }
    }

    /// Whether this frame repeats the last segment, where the end is expected.
    pub(super) fn repeats_last_segment(&self, bytes: &[u8; 8]) -> bool {
        matches!(&self.state, State::BlockDownload { receiver, .. } if receiver.is_last_segment(bytes))
    }

    pub(super) fn end_block_download(
        &mut self,
        bytes: &[u8; 8],
        objects: &mut impl Objects,
    ) -> Result<(), AbortCode> {
        let State::BlockDownload { receiver, .. } = &mut self.state else {
            return Err(self.config.unknown_request);
        };
        let data = receiver.finish(fields::unused_of_blocks(bytes[0]), fields::crc(bytes))?;
        self.take(&data, objects)?;
        self.finish_download(false, objects)?;
        self.answer_transfer(scs::END_BLOCK_DOWNLOAD, 0, 0);
        Ok(())
    }
}

impl Receiver {
    /// Writes the block size into the answer that opens the next sub-block, and opens the
    /// sub-block, if there is room for a segment. After the last segment no sub-block follows; the
    /// answer then contains the largest block size, because the field must not be 0.
    pub(super) fn grant(&mut self, answer: &mut [u8; 8], granted: u8, most: u8) -> bool {
        let blksize = if self.is_complete() { most } else { granted };
        if !self.is_complete() {
            self.open(blksize);
        }
        let field = if answer[0] == scs::ACK_BLOCK_DOWNLOAD { 2 } else { 4 };
        answer[field] = blksize;
        blksize != 0
    }
}
