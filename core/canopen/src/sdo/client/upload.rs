//! Reading a value.

use crate::abort::AbortCode;
use crate::frame::{Frame, NodeId};
use crate::od::Address;
use crate::sdo::block::{Receiver, BLKSIZE_MAX};
use crate::sdo::client::transfer::{Block, Config, Link, Next, SdoError, Step, Transfer};
use crate::sdo::fields;
use crate::sdo::wire::{BlockAck, Payload, Request, Response};
use crate::time::Instant;

/// The target of an upload.
pub trait Sink {
    /// The server announces this many bytes. Not called if it announces none.
    ///
    /// # Errors
    /// Sent to the server as abort.
    fn announce(&mut self, size: u32) -> Result<(), AbortCode> {
        let _ = size;
        Ok(())
    }

    /// The next bytes.
    ///
    /// # Errors
    /// Sent to the server as abort.
    fn write(&mut self, data: &[u8]) -> Result<(), AbortCode>;
}

impl<S: Sink + ?Sized> Sink for &mut S {
    fn announce(&mut self, size: u32) -> Result<(), AbortCode> {
        (**self).announce(size)
    }

    fn write(&mut self, data: &[u8]) -> Result<(), AbortCode> {
        (**self).write(data)
    }
}

/// A borrowed buffer as the target of an upload. Data that do not fit abort it with 05040005h.
#[derive(Debug)]
pub struct Buffer<'b> {
    bytes: &'b mut [u8],
    len: usize,
}

impl<'b> Buffer<'b> {
    /// An empty target.
    pub fn new(bytes: &'b mut [u8]) -> Self {
        Self { bytes, len: 0 }
    }

    /// The data that have arrived.
    #[must_use]
    pub fn filled(&self) -> &[u8] {
        &self.bytes[..self.len]
    }
}

impl Sink for Buffer<'_> {
    fn announce(&mut self, size: u32) -> Result<(), AbortCode> {
        if size as usize > self.bytes.len() {
            return Err(AbortCode::OUT_OF_MEMORY);
        }
        Ok(())
    }

    fn write(&mut self, data: &[u8]) -> Result<(), AbortCode> {
        let end = self.len + data.len();
        self.bytes.get_mut(self.len..end).ok_or(AbortCode::OUT_OF_MEMORY)?.copy_from_slice(data);
        self.len = end;
        Ok(())
    }
}

/// The vector grows with the data that arrive; an announced size reserves no memory.
#[cfg(feature = "alloc")]
impl Sink for alloc::vec::Vec<u8> {
    fn write(&mut self, data: &[u8]) -> Result<(), AbortCode> {
        self.extend_from_slice(data);
        Ok(())
    }
}

/// Reads a value, expedited, segmented or as blocks, as the server sends it.
#[derive(Debug)]
pub struct Upload<S> {
    link: Link,
    sink: S,
    /// Bytes that the server announced.
    announced: Option<u32>,
    state: State,
    block: Block,
}

#[derive(Debug)]
enum State {
    Initiating,
    Segments {
        /// Toggle bit of the segment that was requested.
        toggle: bool,
    },
    InitiatingBlock,
    Blocks(Receiver),
}

impl<S: Sink> Upload<S> {
    /// Reads `at` of `node` into `sink`. Nothing is sent before the first [`poll`](Transfer::poll).
    pub fn new(node: NodeId, at: Address, sink: S, config: Config) -> Self {
        let link = Link::new(node, at, config, Request::InitiateUpload(at));
        Self { link, sink, announced: None, state: State::Initiating, block: Block::default() }
    }

    /// Reads the value by block transfer.
    pub fn as_blocks(node: NodeId, at: Address, sink: S, config: Config, block: Block) -> Self {
        let mut upload = Self::new(node, at, sink, config);
        let blksize = block.blksize.clamp(1, BLKSIZE_MAX);
        upload.block = Block { blksize, ..block };
        upload.link.request = Some(Request::InitiateBlockUpload { at, crc: true, blksize, pst: block.pst });
        upload.state = State::InitiatingBlock;
        upload
    }

    /// Whether the transfer has ended because the server does not support block transfer, as far as
    /// its abort of the initiate tells.
    pub fn refuses_blocks(&self) -> bool {
        self.link.refused_as_unknown() && matches!(self.state, State::InitiatingBlock)
    }

    /// The target: it contains all data after the transfer has ended without an error.
    pub fn sink(&self) -> &S {
        &self.sink
    }

    /// Returns the target.
    pub fn into_sink(self) -> S {
        self.sink
    }

    fn answer(&mut self, bytes: &[u8; 8]) -> Result<Next, SdoError> {
        match (Response::parse(bytes), &mut self.state) {
            (response, State::Blocks(receiver)) => {
                if receiver.is_complete() {
                    return self.end_of_blocks(bytes, response);
                }
                self.block_segment(bytes)
            }
            (
                Some(Response::InitiateUpload(at, payload)),
                // A server may answer a block upload without blocks: this is the purpose of pst.
                State::Initiating | State::InitiatingBlock,
            ) if at == self.link.at => match payload {
                Payload::Expedited(data) => self.take(&data).map(|()| Next::Done(None)),
                Payload::Unsized(data) => self.take(&data).map(|()| Next::Done(None)),
                Payload::Segmented(announced) => {
                    self.announce(announced)?;
                    self.state = State::Segments { toggle: false };
                    Ok(Next::Send(Request::UploadSegment(false)))
                }
            },
            (Some(Response::UploadSegment(segment)), State::Segments { toggle }) => {
                if segment.toggle != *toggle {
                    return Err(SdoError::Client(AbortCode::TOGGLE));
                }
                *toggle = !*toggle;
                let next = Request::UploadSegment(*toggle);
                self.take(&segment.data)?;
                if segment.last {
                    self.check_length()?;
                    return Ok(Next::Done(None));
                }
                Ok(Next::Send(next))
            }
            (Some(Response::InitiateBlockUpload { at, crc, size }), State::InitiatingBlock)
                if at == self.link.at =>
            {
                self.announce(size)?;
                let mut receiver = Receiver::new(crc);
                receiver.open(self.block.blksize);
                self.state = State::Blocks(receiver);
                Ok(Next::Send(Request::StartBlockUpload))
            }
            // The answer to the initiate of the same read before, which was given up.
            (Some(Response::InitiateUpload(..)), State::Segments { .. }) => Ok(Next::Ignore),
            (response, State::Initiating) => self.link.too_early(response, false),
            (response, State::InitiatingBlock) => self.link.too_early(response, true),
            (response, _) => self.link.unexpected(response),
        }
    }

    /// A frame within a sub-block.
    fn block_segment(&mut self, bytes: &[u8; 8]) -> Result<Next, SdoError> {
        let State::Blocks(receiver) = &mut self.state else { return Ok(Next::Ignore) };
        // No segment has the number 0, so an abort differs from all segments. Other answers do not.
        if bytes[0] == fields::ABORT {
            return self.link.unexpected(Response::parse(bytes));
        }
        let received = receiver.take(bytes, false).map_err(SdoError::Client)?;
        let next = match received.ackseq {
            Some(ackseq) => acknowledge(receiver, ackseq, self.block.blksize),
            None => Next::Wait,
        };
        if received.is_data {
            self.take(&bytes[1..])?;
        }
        Ok(next)
    }

    /// A frame after the last segment.
    fn end_of_blocks(&mut self, bytes: &[u8; 8], response: Option<Response>) -> Result<Next, SdoError> {
        let State::Blocks(receiver) = &mut self.state else { return Ok(Next::Ignore) };
        if receiver.is_last_segment(bytes) {
            return Ok(Next::Ignore);
        }
        let Some(Response::EndBlockUpload(end)) = response else { return self.link.unexpected(response) };
        let tail = receiver.finish(end.unused, end.crc).map_err(SdoError::Client)?;
        self.take(&tail)?;
        self.check_length()?;
        Ok(Next::Done(Some(Request::EndBlockUpload)))
    }

    fn announce(&mut self, size: Option<u32>) -> Result<(), SdoError> {
        self.announced = size;
        match size {
            Some(size) => self.sink.announce(size).map_err(SdoError::Client),
            None => Ok(()),
        }
    }

    /// Passes data on. More bytes than announced are refused.
    fn take(&mut self, data: &[u8]) -> Result<(), SdoError> {
        let total = self.link.progress.checked_add(data.len() as u32);
        let total = total.filter(|total| *total <= self.announced.unwrap_or(u32::MAX));
        self.link.progress = total.ok_or(SdoError::Client(AbortCode::LENGTH))?;
        self.sink.write(data).map_err(SdoError::Client)
    }

    fn check_length(&self) -> Result<(), SdoError> {
        match self.announced {
            Some(size) if size != self.link.progress => Err(SdoError::Client(AbortCode::LENGTH)),
            _ => Ok(()),
        }
    }
}

/// Acknowledges a sub-block, which opens the next one.
fn acknowledge(receiver: &mut Receiver, ackseq: u8, blksize: u8) -> Next {
    if !receiver.is_complete() {
        receiver.open(blksize);
    }
    Next::Send(Request::AckBlockUpload(BlockAck { ackseq, blksize }))
}

impl<S: Sink> Transfer for Upload<S> {
    fn handle(&mut self, frame: &Frame, now: Instant) {
        if let Some(bytes) = self.link.answer(frame) {
            let next = self.answer(bytes);
            self.link.advance(next, now);
        }
    }

    fn poll(&mut self, now: Instant) -> Step {
        if let Some(bytes) = self.link.abort_of_blocks(now) {
            let next = self.answer(&bytes);
            self.link.advance(next, now);
        }
        // A sub-block that stopped early: its end was lost.
        if let State::Blocks(receiver) = &mut self.state {
            if self.link.awaits_answer() && receiver.is_within() {
                let repeat = self.link.moved + self.block.repeat_ms.min(self.link.timeout_ms);
                if !now.has_reached(repeat) {
                    return Step::Wait(repeat);
                }
                let ackseq = receiver.close();
                let next = acknowledge(receiver, ackseq, self.block.blksize);
                self.link.advance(Ok(next), now);
            }
        }
        self.link.poll(now)
    }

    fn progress(&self) -> u32 {
        self.link.progress
    }

    fn awaits_answer(&self) -> bool {
        self.link.awaits_answer()
    }

    fn abort(&mut self, code: AbortCode) {
        self.link.abort(code);
    }
}
