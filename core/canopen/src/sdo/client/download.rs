//! Writing a value.

use crate::abort::AbortCode;
use crate::frame::{Frame, NodeId};
use crate::od::Address;
use crate::sdo::block::{check_blksize, Crc16, SEGMENT};
use crate::sdo::client::transfer::{Config, Link, Next, SdoError, Step, Transfer};
use crate::sdo::wire::{BlockAck, BlockEnd, BlockSegment, Chunk, Payload, Request, Response, Segment};
use crate::time::Instant;

/// After this many consecutive sub-blocks without any received segment, the transfer is aborted.
const HOPELESS: u8 = 10;

/// Writes a value: expedited up to four bytes, otherwise segmented or as blocks.
#[derive(Debug)]
pub struct Download<D> {
    link: Link,
    data: D,
    state: State,
}

#[derive(Debug)]
enum State {
    Initiating,
    Segments {
        /// Toggle bit of the segment that was sent last.
        toggle: bool,
        /// Bytes sent.
        sent: usize,
    },
    InitiatingBlock,
    Blocks(SubBlock),
    /// All data have arrived; the server must confirm the end.
    EndingBlock,
}

/// A sub-block that is being sent.
#[derive(Clone, Copy, Debug)]
pub(super) struct SubBlock {
    /// The server checks a CRC.
    crc: bool,
    blksize: u8,
    /// Offset of its first byte in the data.
    base: usize,
    /// Number of the last segment sent, 0 before the first one.
    seqno: u8,
    /// Consecutive sub-blocks before this one of which no segment arrived.
    in_vain: u8,
}

impl<D: AsRef<[u8]>> Download<D> {
    /// Writes `data` to `at` of `node`. Nothing is sent before the first [`poll`](Transfer::poll).
    pub fn new(node: NodeId, at: Address, data: D, config: Config) -> Self {
        let link = Link::new(node, at, config, initiate(at, data.as_ref()));
        Self { link, data, state: State::Initiating }
    }

    /// Writes `data` by block transfer. Up to four bytes are still sent expedited.
    pub fn as_blocks(node: NodeId, at: Address, data: D, config: Config) -> Self {
        let mut download = Self::new(node, at, data, config);
        let len = download.data.as_ref().len();
        if !is_expedited(len) {
            let size = u32::try_from(len).ok();
            download.link.request = Some(Request::InitiateBlockDownload { at, crc: true, size });
            download.state = State::InitiatingBlock;
        }
        download
    }

    /// Whether the transfer has ended because the server does not support block transfer, as far as
    /// its abort of the initiate tells.
    pub fn refuses_blocks(&self) -> bool {
        self.link.refused_as_unknown() && matches!(self.state, State::InitiatingBlock)
    }

    fn answer(&mut self, bytes: &[u8; 8]) -> Result<Next, SdoError> {
        let data = self.data.as_ref();
        match (Response::parse(bytes), &mut self.state) {
            (Some(Response::InitiateDownload(at)), State::Initiating) if at == self.link.at => {
                if is_expedited(data.len()) {
                    self.link.progress = data.len() as u32;
                    return Ok(Next::Done(None));
                }
                let (segment, sent) = segment(data, 0, false);
                self.state = State::Segments { toggle: false, sent };
                Ok(Next::Send(Request::DownloadSegment(segment)))
            }
            (Some(Response::DownloadSegment(answered)), State::Segments { toggle, sent }) => {
                if answered != *toggle {
                    return Err(SdoError::Client(AbortCode::TOGGLE));
                }
                self.link.progress = *sent as u32;
                if *sent == data.len() {
                    return Ok(Next::Done(None));
                }
                *toggle = !*toggle;
                let (segment, end) = segment(data, *sent, *toggle);
                *sent = end;
                Ok(Next::Send(Request::DownloadSegment(segment)))
            }
            (Some(Response::InitiateBlockDownload { at, crc, blksize }), State::InitiatingBlock)
                if at == self.link.at =>
            {
                let blksize = check_blksize(blksize).map_err(SdoError::Client)?;
                self.state = State::Blocks(SubBlock::new(crc, blksize));
                Ok(Next::Wait)
            }
            (Some(Response::AckBlockDownload(ack)), State::Blocks(sub_block)) => {
                let arrived = sub_block.acknowledged(ack, data).map_err(SdoError::Client)?;
                self.link.progress = sub_block.base as u32;
                let Some(crc) = arrived else { return Ok(Next::Wait) };
                self.state = State::EndingBlock;
                Ok(Next::Send(Request::EndBlockDownload(SubBlock::end(crc, data))))
            }
            // The answer to the initiate of the same write before, which was given up, came first.
            (Some(Response::InitiateDownload(..)), State::Segments { .. })
            | (Some(Response::InitiateBlockDownload { .. }), State::Blocks(_)) => Ok(Next::Ignore),
            // The server repeats its acknowledgement.
            (Some(Response::AckBlockDownload(_)), State::EndingBlock) => Ok(Next::Ignore),
            (Some(Response::EndBlockDownload), State::EndingBlock) => Ok(Next::Done(None)),
            (response, State::Initiating) => self.link.too_early(response, false),
            (response, State::InitiatingBlock) => self.link.too_early(response, true),
            (response, _) => self.link.unexpected(response),
        }
    }
}

/// Whether this many bytes fit into the initiate.
const fn is_expedited(len: usize) -> bool {
    matches!(len, 1..=4)
}

fn initiate(at: Address, data: &[u8]) -> Request {
    let payload = if is_expedited(data.len()) {
        Payload::Expedited(Chunk::new(data))
    } else {
        // A size of more than 32 bits is announced as unknown.
        Payload::Segmented(u32::try_from(data.len()).ok())
    };
    Request::InitiateDownload(at, payload)
}

/// The segment from offset `start` on, and the offset where its data end.
fn segment(data: &[u8], start: usize, toggle: bool) -> (Segment, usize) {
    let chunk = Chunk::new(&data[start..]);
    let end = start + chunk.len();
    (Segment { toggle, last: end == data.len(), data: chunk }, end)
}

impl SubBlock {
    /// The first one.
    pub(super) const fn new(crc: bool, blksize: u8) -> Self {
        Self { crc, blksize, base: 0, seqno: 0, in_vain: 0 }
    }

    /// The end of a transfer with this CRC.
    pub(super) fn end(crc: u16, data: &[u8]) -> BlockEnd {
        let unused = data.len().next_multiple_of(SEGMENT).max(SEGMENT) - data.len();
        BlockEnd { unused: unused as u8, crc }
    }

    /// Whether this is the number of its last segment, and all are sent.
    pub(super) const fn is_whole(&self, ackseq: u8) -> bool {
        ackseq == self.seqno
    }

    /// Whether the segments up to this one are sent.
    pub(super) const fn has_sent(&self, ackseq: u8) -> bool {
        ackseq <= self.seqno
    }

    /// The offset of the end of the sent data.
    fn sent(&self, data: &[u8]) -> usize {
        (self.base + usize::from(self.seqno) * SEGMENT).min(data.len())
    }

    /// Whether everything is sent. Empty data have one segment, too.
    pub(super) fn is_sent(&self, data: &[u8]) -> bool {
        self.seqno == self.blksize || (self.seqno > 0 && self.sent(data) == data.len())
    }

    pub(super) fn next(&mut self, data: &[u8]) -> BlockSegment {
        let chunk = Chunk::<SEGMENT>::new(&data[self.sent(data)..]);
        self.seqno += 1;
        let mut bytes = [0; SEGMENT];
        bytes[..chunk.len()].copy_from_slice(&chunk);
        BlockSegment { last: self.sent(data) == data.len(), seqno: self.seqno, data: bytes }
    }

    /// Continues with the next sub-block after the last segment that arrived. If that was the last
    /// segment of the transfer, returns the CRC of all data, 0 if the server does not check it.
    pub(super) fn acknowledged(&mut self, ack: BlockAck, data: &[u8]) -> Result<Option<u16>, AbortCode> {
        let blksize = check_blksize(ack.blksize)?;
        if ack.ackseq > self.seqno {
            // Before everything is sent: the acknowledgement of the previous sub-block again.
            return if self.is_sent(data) { Err(AbortCode::SEQUENCE_NUMBER) } else { Ok(None) };
        }
        let all = self.is_sent(data) && ack.ackseq == self.seqno && self.sent(data) == data.len();
        self.in_vain = if ack.ackseq == 0 { self.in_vain + 1 } else { 0 };
        if self.in_vain == HOPELESS {
            return Err(AbortCode::SEQUENCE_NUMBER);
        }
        self.base = (self.base + usize::from(ack.ackseq) * SEGMENT).min(data.len());
        self.blksize = blksize;
        self.seqno = 0;
        if !all {
            return Ok(None);
        }
        let mut crc = Crc16::new();
        if self.crc {
            crc.update(data);
        }
        Ok(Some(crc.get()))
    }
}

impl<D: AsRef<[u8]>> Transfer for Download<D> {
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
        let data = self.data.as_ref();
        match &mut self.state {
            State::Blocks(sub_block) if self.link.result.is_none() && !sub_block.is_sent(data) => {
                let segment = sub_block.next(data);
                self.link.send(segment.emit(), now)
            }
            _ => self.link.poll(now),
        }
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
