//! Block download.

use crate::abort::AbortCode;
use crate::od::Objects;
use crate::sdo::block::Receiver;
use crate::sdo::fields::{self, scs};

use super::{Incoming, SdoServer, State};

impl SdoServer {
    pub(super) fn initiate_block_download(
        &mut self,
        bytes: &[u8; 8],
        objects: &mut impl Objects,
    ) -> Result<(), AbortCode> {
        let at = fields::address(bytes);
        let data_type = self.writable(at, objects)?.data_type;
        let size = (bytes[0] & fields::BLOCK_SIZE_TOLD != 0).then(|| fields::number(bytes));
        let incoming = Incoming::start(at, data_type, size, objects)?;
        let receiver = Receiver::new(bytes[0] & fields::CRC != 0);
        self.state = State::BlockDownload { incoming, receiver };
        let command = scs::INITIATE_BLOCK_DOWNLOAD | fields::CRC;
        self.answer_initiate(command, 0);
        Ok(())
    }

    /// A frame within a sub-block.
    pub(super) fn block_segment(
        &mut self,
        bytes: &[u8; 8],
        objects: &mut impl Objects,
    ) -> Result<(), AbortCode> {
        // No segment has the number 0, so an abort differs from all segments. No other request
        // does.
        if bytes[0] == fields::ABORT {
            self.reset(objects);
            return Ok(());
        }
        let State::BlockDownload { receiver, .. } = &mut self.state else { return Err(AbortCode::COMMAND) };
        let received = receiver.take(bytes)?;
        if received.is_data {
            self.take(&bytes[1..], objects)?;
        }
        if let Some(ackseq) = received.ackseq {
            self.answer_transfer(scs::ACK_BLOCK_DOWNLOAD, ackseq, 0);
        }
        Ok(())
    }

    /// Whether this is the last segment once more, where the end is expected.
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
        self.finish_download(objects)?;
        self.answer_transfer(scs::END_BLOCK_DOWNLOAD, 0, 0);
        Ok(())
    }
}

impl Receiver {
    /// Puts the block size into the answer that opens the next sub-block, and opens it, if there is
    /// room for a segment. Behind the last segment no sub-block follows; the answer then carries
    /// the largest block size, as the field must not be 0.
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
