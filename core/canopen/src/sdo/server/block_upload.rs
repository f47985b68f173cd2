//! Block upload.

use crate::abort::AbortCode;
use crate::od::Objects;
use crate::sdo::block::check_blksize;
use crate::sdo::fields::{self, ccs, scs};

use super::sender::{Phase, Sender};
use super::{SdoServer, State};

impl SdoServer {
    /// A request of a block upload, with this command specifier.
    pub(super) fn block_upload(
        &mut self,
        specifier: u8,
        bytes: &[u8; 8],
        objects: &mut impl Objects,
    ) -> Result<(), AbortCode> {
        match specifier {
            ccs::INITIATE_BLOCK_UPLOAD => self.initiate_block_upload(bytes, objects),
            ccs::START_BLOCK_UPLOAD => self.start_block_upload(),
            ccs::ACK_BLOCK_UPLOAD => self.ack_block_upload(bytes),
            ccs::END_BLOCK_UPLOAD => self.end_block_upload(),
            _ => Err(self.config.unknown_request),
        }
    }

    fn initiate_block_upload(
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
        let indicated = if size.is_some() { fields::BLOCK_SIZE_INDICATED } else { 0 };
        let command = scs::INITIATE_BLOCK_UPLOAD | fields::CRC | indicated;
        self.answer_initiate(command, size.unwrap_or(0));
        Ok(())
    }

    fn start_block_upload(&mut self) -> Result<(), AbortCode> {
        match &mut self.state {
            State::BlockUpload { sender, .. } if sender.phase == Phase::Initiated => {
                sender.phase = Phase::Sending;
                Ok(())
            }
            _ => Err(self.config.unknown_request),
        }
    }

    fn ack_block_upload(&mut self, bytes: &[u8; 8]) -> Result<(), AbortCode> {
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

    fn end_block_upload(&mut self) -> Result<(), AbortCode> {
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
