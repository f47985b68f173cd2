//! The SDO server: one transfer at a time, for one client.
//!
//! - A frame that is not the request identifier's, is remote or extended, or does not have 8 bytes is no SDO (CiA 301
//!   section 7.2.4.3: all are 8 bytes long) and gets silence.
//! - Every other request gets an answer or an abort; only an abort gets silence.
//! - An initiate at any time ends the transfer that was going on.
//! - A transfer in which the client stays silent for the time-out is aborted with 05040000h.

use crate::frame::{CobId, Frame, NodeId};
use crate::od::{self, Address, DataType, Kind, Objects};
use crate::sdo::wire::{Chunk, Payload, Request, Response, Segment};
use crate::sdo::AbortCode;
use crate::time::Instant;

/// The longest variable or string, in bytes. Longer things are domains.
pub const VALUE_MAX: usize = 64;

/// What can be chosen about a server.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Config {
    /// How long the client may stay silent within a transfer, in milliseconds.
    pub timeout_ms: u32,
}

impl Default for Config {
    /// Two seconds.
    fn default() -> Self {
        Self { timeout_ms: 2000 }
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
    /// When the transfer that is going on has to have moved.
    deadline: Instant,
    /// The answer that waits to be fetched.
    answer: Option<Response>,
    /// A variable or string on its way in or out.
    value: [u8; VALUE_MAX],
}

#[derive(Debug)]
enum State {
    Idle,
    Download { incoming: Incoming, toggle: bool },
    Upload { outgoing: Outgoing, toggle: bool },
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

impl SdoServer {
    /// The server of a node.
    #[must_use]
    pub const fn new(node: NodeId, config: Config) -> Self {
        Self {
            node,
            config,
            at: Address::new(0, 0),
            state: State::Idle,
            deadline: Instant::from_millis(0),
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
    pub const fn next_deadline(&self) -> Option<Instant> {
        match self.state {
            State::Idle => None,
            _ => Some(self.deadline),
        }
    }

    /// Ends whatever is going on without a word to the client, and forgets an answer that waits.
    pub fn reset(&mut self, objects: &mut impl Objects) {
        self.end(objects);
        self.answer = None;
    }

    /// Takes a frame, whatever it is.
    pub fn handle(&mut self, frame: &Frame, now: Instant, objects: &mut impl Objects) {
        if frame.cob_id() != Some(CobId::sdo_request(self.node)) {
            return;
        }
        let Some(bytes) = frame.exactly() else { return };
        self.deadline = now + self.config.timeout_ms;
        match self.request(bytes, objects) {
            Ok(answer) => self.answer = answer,
            Err(code) => self.abort(code, objects),
        }
    }

    /// The next frame to send, until there is none.
    pub fn poll(&mut self, now: Instant, objects: &mut impl Objects) -> Option<Frame> {
        if !matches!(self.state, State::Idle) && now.has_reached(self.deadline) {
            self.abort(AbortCode::TIMEOUT, objects);
        }
        let answer = self.answer?;
        if let State::Download { incoming, .. } = &self.state {
            if incoming.is_domain() && objects.download_space(self.at) < SEGMENT {
                return None;
            }
        }
        self.answer = None;
        self.deadline = now + self.config.timeout_ms;
        Some(Frame::of(CobId::sdo_response(self.node), &answer.emit()))
    }

    fn request(
        &mut self,
        bytes: &[u8; 8],
        objects: &mut impl Objects,
    ) -> Result<Option<Response>, AbortCode> {
        let answer = match (Request::parse(bytes), &mut self.state) {
            (Some(Request::InitiateDownload(at, payload)), _) => {
                self.initiate_download(at, payload, objects)?
            }
            (Some(Request::InitiateUpload(at)), _) => self.initiate_upload(at, objects)?,
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
            (Some(Request::Abort(..)), _) => {
                self.end(objects);
                return Ok(None);
            }
            _ => return Err(AbortCode::COMMAND),
        };
        Ok(Some(answer))
    }

    fn initiate_download(
        &mut self,
        at: Address,
        payload: Payload,
        objects: &mut impl Objects,
    ) -> Result<Response, AbortCode> {
        self.begin(at, objects);
        let entry = od::find(objects.entries(), at)?;
        if !entry.access.is_writable() {
            return Err(AbortCode::READ_ONLY);
        }
        let data_type = entry.data_type;
        let expedited = match payload {
            Payload::Expedited(data) => Some(data),
            // The type knows better than the frame how many of the four bytes count.
            Payload::Unsized(data) => {
                Some(Chunk::new(&data[..data_type.size().unwrap_or(4).min(4) as usize]))
            }
            Payload::Segmented(_) => None,
        };
        let announced = match (payload, expedited) {
            (Payload::Segmented(size), _) => size,
            (_, data) => data.map(|data| data.len() as u32),
        };
        let incoming = Incoming::start(at, data_type, announced, objects)?;
        self.state = State::Download { incoming, toggle: false };
        if let Some(data) = expedited {
            self.take(&data, objects)?;
            self.finish_download(objects)?;
        }
        Ok(Response::InitiateDownload(at))
    }

    fn initiate_upload(&mut self, at: Address, objects: &mut impl Objects) -> Result<Response, AbortCode> {
        self.begin(at, objects);
        let entry = od::find(objects.entries(), at)?;
        if !entry.access.is_readable() {
            return Err(AbortCode::WRITE_ONLY);
        }
        let domain = entry.data_type == DataType::Domain;
        let size = if domain {
            objects.upload_start(at)?
        } else {
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
            if (1..=4).contains(&len) {
                return Ok(Response::InitiateUpload(at, Payload::Expedited(Chunk::new(&self.value[..len]))));
            }
            Some(len as u32)
        };
        self.state = State::Upload { outgoing: Outgoing { domain, size, offset: 0 }, toggle: false };
        Ok(Response::InitiateUpload(at, Payload::Segmented(size)))
    }

    /// A new transfer: the old one ends, and an abort from here on is about this address.
    fn begin(&mut self, at: Address, objects: &mut impl Objects) {
        self.end(objects);
        self.at = at;
    }

    /// Passes data on to where they belong.
    fn take(&mut self, data: &[u8], objects: &mut impl Objects) -> Result<(), AbortCode> {
        match &mut self.state {
            State::Download { incoming, .. } => incoming.take(self.at, data, &mut self.value, objects),
            _ => Err(AbortCode::COMMAND),
        }
    }

    /// All data are there: the last word is the device's.
    fn finish_download(&mut self, objects: &mut impl Objects) -> Result<(), AbortCode> {
        let State::Download { incoming, .. } = self.state else { return Err(AbortCode::COMMAND) };
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
        if let State::Download { incoming, .. } = core::mem::replace(&mut self.state, State::Idle) {
            if incoming.is_domain() {
                objects.download_cancel(self.at);
            }
        }
    }
}

/// Bytes of a full segment.
const SEGMENT: usize = 7;

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
        self.received = before.checked_add(data.len() as u32).ok_or(AbortCode::LENGTH_TOO_HIGH)?;
        if self.announced.is_some_and(|size| self.received > size) {
            return Err(AbortCode::LENGTH);
        }
        if self.is_domain() {
            return if data.is_empty() { Ok(()) } else { objects.download_data(at, data) };
        }
        let place =
            value.get_mut(before as usize..self.received as usize).ok_or(AbortCode::LENGTH_TOO_HIGH)?;
        place.copy_from_slice(data);
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
