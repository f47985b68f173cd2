//! The SDO server: one transfer at a time, for one client.
//!
//! - A frame that is not the request identifier's, is remote or extended, or does not have 8 bytes
//!   is no SDO (CiA 301 section 7.2.4.3: all are 8 bytes long) and gets silence.
//! - Every other request gets an answer or an abort; only an abort gets silence.
//! - An initiate ends the transfer that was going on. Within a sub-block of a block download an
//!   initiate cannot be told from a segment: there an abort ends the transfer, or the time-out.
//! - A transfer in which the client stays silent for the time-out is aborted with 05040000h.
//! - A block download whose sub-block stops short is acknowledged as far as it came, so that the
//!   client repeats the rest.

use crate::frame::{CobId, Frame, NodeId};
use crate::od::{self, Address, DataType, Entry, Kind, Objects};
#[cfg(feature = "block-upload")]
use crate::sdo::block::{check_blksize, Crc16};
use crate::sdo::block::{Receiver, BLKSIZE_MAX, SEGMENT};
#[cfg(feature = "block-upload")]
use crate::sdo::wire::BlockEnd;
use crate::sdo::wire::{BlockAck, BlockSegment, Chunk, Payload, Request, Response, Segment};
use crate::sdo::AbortCode;
use crate::time::Instant;

/// The longest variable or string, in bytes. Longer things are domains.
pub const VALUE_MAX: usize = 64;

/// How long an answer is held back for want of room before the device is asked for room in its
/// reserve, in milliseconds.
pub const HOLD_MS: u32 = 2;

/// What can be chosen about a server.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Config {
    /// How long the client may stay silent within a transfer, in milliseconds.
    pub timeout_ms: u32,
    /// How long a sub-block of a block download may pause before what came is acknowledged and the
    /// rest asked for again, in milliseconds. Longer than a client ever pauses between two
    /// segments, shorter than it waits for an answer.
    pub repeat_ms: u32,
    /// Segments of a sub-block of a block download: at most 127, and no more than the receive path
    /// can queue.
    pub blksize: u8,
    /// The abort for a request that is none of CiA 301's, or not of this moment.
    pub unknown_request: AbortCode,
}

impl Config {
    /// Two seconds, half a second, 127 segments, 05040001h.
    pub const DEFAULT: Self =
        Self { timeout_ms: 2000, repeat_ms: 500, blksize: BLKSIZE_MAX, unknown_request: AbortCode::COMMAND };
}

impl Default for Config {
    fn default() -> Self {
        Self::DEFAULT
    }
}

/// An SDO server on the identifiers of the predefined connection set.
#[derive(Debug)]
pub struct SdoServer {
    node: NodeId,
    config: Config,
    /// What the transfer is about that is going on, or was last.
    at: Address,
    state: State,
    /// When the transfer that is going on last moved.
    moved: Instant,
    /// The answer that waits to be fetched.
    answer: Option<Response>,
    /// A variable or string on its way in or out.
    value: [u8; VALUE_MAX],
}

#[derive(Debug)]
enum State {
    Idle,
    Download {
        incoming: Incoming,
        toggle: bool,
    },
    Upload {
        outgoing: Outgoing,
        toggle: bool,
    },
    BlockDownload {
        incoming: Incoming,
        receiver: Receiver,
    },
    #[cfg(feature = "block-upload")]
    BlockUpload {
        outgoing: Outgoing,
        sender: Sender,
    },
}

impl State {
    fn incoming(&mut self) -> Option<&mut Incoming> {
        match self {
            Self::Download { incoming, .. } | Self::BlockDownload { incoming, .. } => Some(incoming),
            _ => None,
        }
    }
}

/// Data on their way into the device.
#[derive(Clone, Copy, Debug)]
struct Incoming {
    data_type: DataType,
    announced: Option<u32>,
    received: u32,
}

/// Data on their way out of the device.
#[derive(Clone, Copy, Debug)]
struct Outgoing {
    domain: bool,
    size: Option<u32>,
    offset: u32,
}

/// The sending end of a block upload.
#[cfg(feature = "block-upload")]
#[derive(Debug)]
struct Sender {
    phase: Phase,
    blksize: u8,
    /// The last segment sent of this sub-block.
    seqno: u8,
    /// Where the data of this sub-block begin.
    base: u32,
    /// Bytes of the last segment of all, once it has been sent.
    last: Option<u8>,
    /// Over the data up to `hashed`: what is repeated is not counted again.
    crc: Crc16,
    hashed: u32,
}

#[cfg(feature = "block-upload")]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    /// The client has yet to say "start".
    Initiated,
    Sending,
    /// All of the sub-block is sent.
    Sent,
    /// All data have arrived, and the end is sent.
    Ended,
}

impl SdoServer {
    /// The server of a node.
    #[must_use]
    pub const fn new(node: NodeId, config: Config) -> Self {
        Self {
            node,
            config,
            at: Address::new(0, 0),
            state: State::Idle,
            moved: Instant::from_millis(0),
            answer: None,
            value: [0; VALUE_MAX],
        }
    }

    /// Whether no transfer is going on and no answer waits to be fetched.
    #[must_use]
    pub const fn is_idle(&self) -> bool {
        matches!(self.state, State::Idle) && self.answer.is_none()
    }

    /// When [`poll`](Self::poll) will have something to do although no frame came.
    #[must_use]
    pub fn next_deadline(&self) -> Option<Instant> {
        match &self.state {
            State::Idle => None,
            State::BlockDownload { receiver, .. } if receiver.is_within() => {
                Some(self.moved + self.config.repeat_ms.min(self.config.timeout_ms))
            }
            _ => Some(self.moved + self.config.timeout_ms),
        }
    }

    /// Ends whatever is going on without a word to the client, and forgets an answer that waits.
    pub fn reset(&mut self, objects: &mut impl Objects) {
        self.end(objects);
        self.answer = None;
    }

    /// Takes a frame, whatever it is.
    pub fn handle(&mut self, frame: &Frame, now: Instant, objects: &mut impl Objects) {
        if !frame.has_cob_id(CobId::sdo_request(self.node)) {
            return;
        }
        let Some(bytes) = frame.exactly() else { return };
        self.moved = now;
        let outcome = match &self.state {
            State::BlockDownload { receiver, .. } if !receiver.is_complete() => {
                self.block_segment(bytes, objects)
            }
            _ => self.request(bytes, objects),
        };
        match outcome {
            Ok(None) => {}
            Ok(answer) => self.answer = answer,
            Err(code) => self.abort(code, objects),
        }
    }

    /// The next frame to send, until there is none. A caller whose transmit queue is full asks
    /// again when it is not.
    pub fn poll(&mut self, now: Instant, objects: &mut impl Objects) -> Option<Frame> {
        self.watch(now, objects);
        #[cfg(feature = "block-upload")]
        if self.answer.is_none() {
            match self.next_block_segment(objects) {
                Ok(None) => {}
                Ok(Some(segment)) => return Some(self.send(segment.emit(), now)),
                Err(code) => self.abort(code, objects),
            }
        }
        if !self.grant(now, objects) {
            return None;
        }
        let answer = self.answer.take()?;
        Some(self.send(answer.emit(), now))
    }

    fn send(&mut self, bytes: [u8; 8], now: Instant) -> Frame {
        self.moved = now;
        Frame::full(CobId::sdo_response(self.node), bytes)
    }

    /// What the time brings about.
    fn watch(&mut self, now: Instant, objects: &mut impl Objects) {
        let silent_for = |millis| now.has_reached(self.moved + millis);
        match &mut self.state {
            State::Idle => {}
            _ if silent_for(self.config.timeout_ms) => self.abort(AbortCode::TIMEOUT, objects),
            State::BlockDownload { receiver, .. }
                if receiver.is_within() && silent_for(self.config.repeat_ms) =>
            {
                let ackseq = receiver.close();
                self.answer = Some(Response::AckBlockDownload(BlockAck { ackseq, blksize: 0 }));
            }
            _ => {}
        }
    }

    /// Whether the answer that waits may go: one that makes the client send data waits until there
    /// is room for them. An answer that opens a sub-block is told here how large it may be.
    fn grant(&mut self, now: Instant, objects: &mut impl Objects) -> bool {
        let Some(answer) = &mut self.answer else { return false };
        let Some(incoming) = self.state.incoming() else { return true };
        let mut space =
            if incoming.is_domain() { objects.download_space(self.at, false) } else { usize::MAX };
        if space < SEGMENT && now.has_reached(self.moved + HOLD_MS) {
            space = objects.download_space(self.at, true).min(SEGMENT);
        }
        let most = self.config.blksize.clamp(1, BLKSIZE_MAX);
        let granted = (space / SEGMENT).min(usize::from(most)) as u8;
        let State::BlockDownload { receiver, .. } = &mut self.state else { return granted != 0 };
        // Behind the last segment there is nothing to make room for; the field wants a number all
        // the same.
        let granted = if receiver.is_complete() { most } else { granted };
        if let Response::InitiateBlockDownload { blksize, .. }
        | Response::AckBlockDownload(BlockAck { blksize, .. }) = answer
        {
            *blksize = granted;
            if !receiver.is_complete() {
                receiver.open(granted);
            }
        }
        granted != 0
    }

    fn request(
        &mut self,
        bytes: &[u8; 8],
        objects: &mut impl Objects,
    ) -> Result<Option<Response>, AbortCode> {
        let answer = match (Request::parse(bytes), &mut self.state) {
            (_, State::BlockDownload { receiver, .. }) if receiver.is_duplicate_of_tail(bytes) => {
                return Ok(None)
            }
            (Some(Request::InitiateDownload(at, payload)), _) => {
                self.initiate_download(at, payload, objects)?
            }
            (Some(Request::InitiateUpload(at)), _) => {
                let outgoing = self.readable(at, objects)?;
                self.initiate_upload(at, outgoing)
            }
            (Some(Request::DownloadSegment(segment)), State::Download { toggle, .. }) => {
                if segment.toggle != *toggle {
                    return Err(AbortCode::TOGGLE);
                }
                *toggle = !*toggle;
                self.take(&segment.data, objects)?;
                if segment.last {
                    self.finish_download(objects)?;
                }
                Response::DownloadSegment(segment.toggle)
            }
            (Some(Request::UploadSegment(asked)), State::Upload { outgoing, toggle }) => {
                if asked != *toggle {
                    return Err(AbortCode::TOGGLE);
                }
                *toggle = !*toggle;
                let (data, last) = outgoing.next(self.at, &self.value, objects)?;
                if last {
                    self.state = State::Idle;
                }
                Response::UploadSegment(Segment { toggle: asked, last, data })
            }
            (Some(Request::InitiateBlockDownload { at, crc, size }), _) => {
                let data_type = self.writable(at, objects)?.data_type;
                let incoming = Incoming::start(at, data_type, size, objects)?;
                self.state = State::BlockDownload { incoming, receiver: Receiver::new(crc) };
                Response::InitiateBlockDownload { at, crc: true, blksize: 0 }
            }
            (Some(Request::EndBlockDownload(end)), State::BlockDownload { receiver, .. }) => {
                let tail = receiver.finish(&end)?;
                self.take(&tail, objects)?;
                self.finish_download(objects)?;
                Response::EndBlockDownload
            }
            #[cfg(feature = "block-upload")]
            (Some(request), _) if request.is_block_upload() => return self.block_upload(request, objects),
            (Some(Request::Abort(..)), _) => {
                self.reset(objects);
                return Ok(None);
            }
            _ => return Err(self.config.unknown_request),
        };
        Ok(Some(answer))
    }

    /// A new transfer begins, and the old one ends. An abort from here on is about this address.
    fn begin(&mut self, at: Address, objects: &mut impl Objects) -> Result<&'static Entry, AbortCode> {
        self.end(objects);
        self.at = at;
        od::find(objects.entries(), at)
    }

    fn writable(&mut self, at: Address, objects: &mut impl Objects) -> Result<&'static Entry, AbortCode> {
        let entry = self.begin(at, objects)?;
        if entry.access.is_writable() {
            Ok(entry)
        } else {
            Err(AbortCode::READ_ONLY)
        }
    }

    fn initiate_download(
        &mut self,
        at: Address,
        payload: Payload,
        objects: &mut impl Objects,
    ) -> Result<Response, AbortCode> {
        let data_type = self.writable(at, objects)?.data_type;
        let (expedited, announced) = match payload {
            Payload::Segmented(size) => (None, size),
            Payload::Expedited(data) => (Some(data), Some(data.len() as u32)),
            Payload::Unsized(data) => {
                // The type knows better than the frame how many of the four bytes count.
                let len = data_type.size().unwrap_or(4).min(4);
                (Some(Chunk::new(&data[..len as usize])), Some(len))
            }
        };
        let incoming = Incoming::start(at, data_type, announced, objects)?;
        self.state = State::Download { incoming, toggle: false };
        if let Some(data) = expedited {
            self.take(&data, objects)?;
            self.finish_download(objects)?;
        }
        Ok(Response::InitiateDownload(at))
    }

    fn initiate_upload(&mut self, at: Address, outgoing: Outgoing) -> Response {
        let payload = match outgoing.size {
            Some(len @ 1..=4) if !outgoing.domain => {
                Payload::Expedited(Chunk::new(&self.value[..len as usize]))
            }
            size => {
                self.state = State::Upload { outgoing, toggle: false };
                Payload::Segmented(size)
            }
        };
        Response::InitiateUpload(at, payload)
    }

    /// Begins an upload: what there is to send. A variable or string is read at once.
    fn readable(&mut self, at: Address, objects: &mut impl Objects) -> Result<Outgoing, AbortCode> {
        let entry = self.begin(at, objects)?;
        if !entry.access.is_readable() {
            return Err(AbortCode::WRITE_ONLY);
        }
        if entry.data_type == DataType::Domain {
            return Ok(Outgoing { domain: true, size: objects.upload_start(at)?, offset: 0 });
        }
        let len = match (entry.access, entry.kind) {
            (od::Access::Const, Kind::Array(highest) | Kind::Record(highest)) => {
                od::put(&mut self.value, &[highest])?
            }
            _ => objects.read(at, &mut self.value)?,
        };
        // A value of another length than its type would be the device's own mistake.
        if len > VALUE_MAX || entry.data_type.size().is_some_and(|size| size as usize != len) {
            return Err(AbortCode::INTERNAL);
        }
        Ok(Outgoing { domain: false, size: Some(len as u32), offset: 0 })
    }

    /// A frame within a sub-block of a block download.
    fn block_segment(
        &mut self,
        bytes: &[u8; 8],
        objects: &mut impl Objects,
    ) -> Result<Option<Response>, AbortCode> {
        let State::BlockDownload { receiver, .. } = &mut self.state else { return Err(AbortCode::COMMAND) };
        let Some(segment) = BlockSegment::parse(bytes) else {
            // No segment has sequence number 0, and an abort is the one request that looks like
            // this.
            return match Request::parse(bytes) {
                Some(Request::Abort(..)) => {
                    self.reset(objects);
                    Ok(None)
                }
                _ => Err(AbortCode::SEQUENCE_NUMBER),
            };
        };
        let received = receiver.take(&segment)?;
        if let Some(data) = received.data {
            self.take(&data, objects)?;
        }
        Ok(received.ackseq.map(|ackseq| Response::AckBlockDownload(BlockAck { ackseq, blksize: 0 })))
    }

    /// Passes data on to where they belong.
    fn take(&mut self, data: &[u8], objects: &mut impl Objects) -> Result<(), AbortCode> {
        let incoming = self.state.incoming().ok_or(AbortCode::COMMAND)?;
        incoming.take(self.at, data, &mut self.value, objects)
    }

    /// All data are there: the last word is the device's.
    fn finish_download(&mut self, objects: &mut impl Objects) -> Result<(), AbortCode> {
        let incoming = *self.state.incoming().ok_or(AbortCode::COMMAND)?;
        incoming.check()?;
        // From here on the consumer is not cancelled any more: it hears the end itself.
        self.state = State::Idle;
        incoming.finish(self.at, &self.value, objects)
    }

    fn abort(&mut self, code: AbortCode, objects: &mut impl Objects) {
        self.end(objects);
        self.answer = Some(Response::Abort(self.at, code));
    }

    /// Back to idle; the consumer of an unfinished domain is told.
    fn end(&mut self, objects: &mut impl Objects) {
        if self.state.incoming().is_some_and(|incoming| incoming.is_domain()) {
            objects.download_cancel(self.at);
        }
        self.state = State::Idle;
    }
}

#[cfg(feature = "block-upload")]
impl SdoServer {
    fn block_upload(
        &mut self,
        request: Request,
        objects: &mut impl Objects,
    ) -> Result<Option<Response>, AbortCode> {
        match (request, &mut self.state) {
            (Request::InitiateBlockUpload { at, crc: _, blksize, pst }, _) => {
                let outgoing = self.readable(at, objects)?;
                let blksize = check_blksize(blksize)?;
                let size = outgoing.size;
                if pst != 0 && size.is_some_and(|size| size <= u32::from(pst)) {
                    // So little that the client prefers it without blocks.
                    return Ok(Some(self.initiate_upload(at, outgoing)));
                }
                self.state = State::BlockUpload { outgoing, sender: Sender::new(blksize) };
                Ok(Some(Response::InitiateBlockUpload { at, crc: true, size }))
            }
            (Request::StartBlockUpload, State::BlockUpload { sender, .. })
                if sender.phase == Phase::Initiated =>
            {
                sender.phase = Phase::Sending;
                Ok(None)
            }
            (Request::AckBlockUpload(ack), State::BlockUpload { outgoing, sender })
                if matches!(sender.phase, Phase::Sending | Phase::Sent) =>
            {
                sender.acknowledged(ack, outgoing)
            }
            (Request::EndBlockUpload, State::BlockUpload { sender, .. }) if sender.phase == Phase::Ended => {
                self.state = State::Idle;
                Ok(None)
            }
            // The client's acknowledgement once more.
            (Request::AckBlockUpload(_), State::BlockUpload { sender, .. })
                if sender.phase == Phase::Ended =>
            {
                Ok(None)
            }
            _ => Err(AbortCode::COMMAND),
        }
    }

    /// The next segment of a block upload that is under way.
    fn next_block_segment(&mut self, objects: &mut impl Objects) -> Result<Option<BlockSegment>, AbortCode> {
        match &mut self.state {
            State::BlockUpload { outgoing, sender } if sender.phase == Phase::Sending => {
                let start = outgoing.offset;
                let (data, last) = outgoing.next(self.at, &self.value, objects)?;
                Ok(Some(sender.next(start, &data, last)))
            }
            _ => Ok(None),
        }
    }
}

#[cfg(feature = "block-upload")]
impl Sender {
    fn new(blksize: u8) -> Self {
        Self { phase: Phase::Initiated, blksize, seqno: 0, base: 0, last: None, crc: Crc16::new(), hashed: 0 }
    }

    fn next(&mut self, start: u32, data: &Chunk<SEGMENT>, last: bool) -> BlockSegment {
        if start == self.hashed {
            self.crc.update(data);
            self.hashed += data.len() as u32;
        }
        self.seqno += 1;
        self.last = last.then_some(data.len() as u8);
        if last || self.seqno == self.blksize {
            self.phase = Phase::Sent;
        }
        let mut bytes = [0; SEGMENT];
        bytes[..data.len()].copy_from_slice(data);
        BlockSegment { last, seqno: self.seqno, data: bytes }
    }

    /// On with the next sub-block, from behind the last segment that arrived; or the end.
    ///
    /// A client that misses a segment may say so before the sub-block is over.
    fn acknowledged(
        &mut self,
        ack: BlockAck,
        outgoing: &mut Outgoing,
    ) -> Result<Option<Response>, AbortCode> {
        let blksize = check_blksize(ack.blksize)?;
        if ack.ackseq > self.seqno {
            return match self.phase {
                // More than was sent: the acknowledgement of the sub-block before, once more.
                Phase::Sending => Ok(None),
                _ => Err(AbortCode::SEQUENCE_NUMBER),
            };
        }
        if let (Some(len), true) = (self.last, ack.ackseq == self.seqno) {
            self.phase = Phase::Ended;
            let end = BlockEnd { unused: SEGMENT as u8 - len, crc: self.crc.get() };
            return Ok(Some(Response::EndBlockUpload(end)));
        }
        self.base += u32::from(ack.ackseq) * SEGMENT as u32;
        outgoing.offset = self.base;
        self.blksize = blksize;
        self.seqno = 0;
        self.last = None;
        self.phase = Phase::Sending;
        Ok(None)
    }
}

impl Incoming {
    fn start(
        at: Address,
        data_type: DataType,
        announced: Option<u32>,
        objects: &mut impl Objects,
    ) -> Result<Self, AbortCode> {
        let incoming = Self { data_type, announced, received: 0 };
        if incoming.is_domain() {
            objects.download_start(at, announced)?;
        } else if let Some(size) = announced {
            incoming.check_length(size)?;
        }
        Ok(incoming)
    }

    fn is_domain(&self) -> bool {
        self.data_type == DataType::Domain
    }

    fn take(
        &mut self,
        at: Address,
        data: &[u8],
        value: &mut [u8; VALUE_MAX],
        objects: &mut impl Objects,
    ) -> Result<(), AbortCode> {
        let before = self.received;
        let after = before.checked_add(data.len() as u32).ok_or(AbortCode::LENGTH_TOO_HIGH)?;
        if self.announced.is_some_and(|size| after > size) {
            return Err(AbortCode::LENGTH);
        }
        if self.is_domain() {
            if !data.is_empty() {
                // Held back are the answers; a client that sends without having got one, or
                // expedited, is refused.
                if objects.download_space(at, true) < data.len() {
                    return Err(AbortCode::OUT_OF_MEMORY);
                }
                objects.download_data(at, data)?;
            }
        } else {
            let place = value.get_mut(before as usize..after as usize);
            place.ok_or(AbortCode::LENGTH_TOO_HIGH)?.copy_from_slice(data);
        }
        self.received = after;
        Ok(())
    }

    /// Whether this many bytes make a value of the type.
    fn check_length(&self, len: u32) -> Result<(), AbortCode> {
        let (least, most) = match self.data_type.size() {
            Some(size) => (size, size),
            None => (0, VALUE_MAX as u32),
        };
        if len > most {
            Err(AbortCode::LENGTH_TOO_HIGH)
        } else if len < least {
            Err(AbortCode::LENGTH_TOO_LOW)
        } else {
            Ok(())
        }
    }

    /// Whether what came is what was announced and what the type takes.
    fn check(&self) -> Result<(), AbortCode> {
        if self.announced.is_some_and(|size| self.received != size) {
            Err(AbortCode::LENGTH)
        } else if self.is_domain() {
            Ok(())
        } else {
            self.check_length(self.received)
        }
    }

    fn finish(
        &self,
        at: Address,
        value: &[u8; VALUE_MAX],
        objects: &mut impl Objects,
    ) -> Result<(), AbortCode> {
        if self.is_domain() {
            objects.download_end(at)
        } else {
            objects.write(at, &value[..self.received as usize])
        }
    }
}

impl Outgoing {
    /// The next segment's data, and whether they are the last.
    fn next(
        &mut self,
        at: Address,
        value: &[u8; VALUE_MAX],
        objects: &mut impl Objects,
    ) -> Result<(Chunk<SEGMENT>, bool), AbortCode> {
        let left = self.size.map_or(u32::MAX, |size| size - self.offset);
        let wanted = left.min(SEGMENT as u32) as usize;
        let mut data = [0; SEGMENT];
        let data = &mut data[..wanted];
        let len = if wanted == 0 {
            0
        } else if self.domain {
            objects.upload_data(at, self.offset, data)?.min(wanted)
        } else {
            let offset = self.offset as usize;
            data.copy_from_slice(&value[offset..offset + wanted]);
            wanted
        };
        // A domain that ends before the size that it gave itself.
        if len < wanted && self.size.is_some() {
            return Err(AbortCode::INTERNAL);
        }
        self.offset = self.offset.checked_add(len as u32).ok_or(AbortCode::INTERNAL)?;
        let last = len < SEGMENT || self.size == Some(self.offset);
        Ok((Chunk::new(&data[..len]), last))
    }
}
