//! The SDO client: one value per transfer, [`Download`] or [`Upload`].
//!
//! A transfer is driven through [`Transfer`]: [`handle`](Transfer::handle) takes frames, whatever they are, and
//! [`poll`](Transfer::poll) tells what to do next. A blocking caller loops over one transfer, a caller with many nodes
//! keeps one transfer per node and passes every frame to all of them.
//!
//! ```
//! use canopen::sdo::client::{Config, Step, Transfer, Upload};
//! use canopen::{Address, Frame, Instant, NodeId};
//!
//! # fn send(_: &Frame) {}
//! # fn receive(_until: Instant) -> Option<Frame> { None }
//! # let mut clock = (0..).step_by(100).map(Instant::from_millis);
//! # let mut now = || clock.next().unwrap();
//! let node = NodeId::new(5).unwrap();
//! let mut upload = Upload::new(node, Address::new(0x1018, 1), Vec::new(), Config::default());
//! let result = loop {
//!     match upload.poll(now()) {
//!         Step::Send(frame) => send(&frame),
//!         Step::Wait(until) => {
//!             if let Some(frame) = receive(until) {
//!                 upload.handle(&frame, now());
//!             }
//!         }
//!         Step::Done(result) => break result,
//!     }
//! };
//! let bytes = upload.into_sink();
//! # assert_eq!(result, Err(canopen::sdo::SdoError::NoAnswer));
//! ```

use core::fmt;

use crate::frame::{CobId, Frame, NodeId};
use crate::od::Address;
use crate::sdo::wire::{Chunk, Payload, Request, Response, Segment};
use crate::sdo::AbortCode;
use crate::time::Instant;

/// What can be chosen about a transfer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Config {
    /// How long the server may take for an answer, in milliseconds.
    pub timeout_ms: u32,
}

impl Default for Config {
    /// One second.
    fn default() -> Self {
        Self { timeout_ms: 1000 }
    }
}

/// Why a transfer failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SdoError {
    /// The server did not answer in time; the transfer was aborted with 05040000h.
    NoAnswer,
    /// The server aborted.
    Server(AbortCode),
    /// This side aborted: the server's answer broke the protocol, or the target of an upload refused.
    Client(AbortCode),
}

impl fmt::Display for SdoError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NoAnswer => f.write_str("the device did not answer in time"),
            Self::Server(code) => write!(f, "the device refused: {code}"),
            Self::Client(code) => write!(f, "transfer aborted from this side: {code}"),
        }
    }
}

impl core::error::Error for SdoError {}

/// What to do next about a transfer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Step {
    /// Send this frame, and ask again.
    Send(Frame),
    /// Wait for frames, until then at the latest.
    Wait(Instant),
    /// It is over; the answer stays the same from now on.
    Done(Result<(), SdoError>),
}

/// A transfer that is going on.
pub trait Transfer {
    /// Takes a frame, whatever it is.
    fn handle(&mut self, frame: &Frame, now: Instant);

    /// Tells what to do next.
    fn poll(&mut self, now: Instant) -> Step;

    /// Bytes of data that have arrived at the other side for certain, or have arrived here.
    fn progress(&self) -> u32;

    /// Gives up: the server is sent this abort.
    fn abort(&mut self, code: AbortCode);
}

/// What both directions share: the server, the clock, and the frame that waits to be sent.
#[derive(Debug)]
struct Link {
    node: NodeId,
    at: Address,
    config: Config,
    /// Waits to be fetched by `poll`.
    request: Option<Request>,
    deadline: Instant,
    result: Option<Result<(), SdoError>>,
    progress: u32,
}

impl Link {
    fn new(node: NodeId, at: Address, config: Config, request: Request) -> Self {
        Self {
            node,
            at,
            config,
            request: Some(request),
            deadline: Instant::default(),
            result: None,
            progress: 0,
        }
    }

    /// The eight bytes of an answer, if the frame is one and one is waited for.
    fn answer<'f>(&self, frame: &'f Frame) -> Option<&'f [u8; 8]> {
        let waiting = self.result.is_none() && self.request.is_none();
        if !waiting || frame.cob_id() != Some(CobId::sdo_response(self.node)) {
            return None;
        }
        frame.exactly()
    }

    fn poll(&mut self, now: Instant) -> Step {
        let late = self.result.is_none() && self.request.is_none() && now.has_reached(self.deadline);
        if late {
            self.fail(AbortCode::TIMEOUT, SdoError::NoAnswer);
        }
        if let Some(request) = self.request.take() {
            self.deadline = now + self.config.timeout_ms;
            return Step::Send(Frame::of(CobId::sdo_request(self.node), &request.emit()));
        }
        match self.result {
            Some(result) => Step::Done(result),
            None => Step::Wait(self.deadline),
        }
    }

    /// Ends it with an abort to the server.
    fn fail(&mut self, code: AbortCode, error: SdoError) {
        self.request = Some(Request::Abort(self.at, code));
        self.result = Some(Err(error));
    }

    fn advance(&mut self, outcome: Result<Next, SdoError>) {
        match outcome {
            Ok(Next::Send(request)) => self.request = Some(request),
            Ok(Next::Wait) => {}
            Ok(Next::Done) => self.result = Some(Ok(())),
            Err(SdoError::Client(code)) => self.fail(code, SdoError::Client(code)),
            Err(error) => self.result = Some(Err(error)),
        }
    }

    fn abort(&mut self, code: AbortCode) {
        if self.result.is_none() {
            self.fail(code, SdoError::Client(code));
        }
    }
}

/// What follows from an answer.
enum Next {
    Send(Request),
    Wait,
    Done,
}

/// An answer that has no place here. The late answer to an earlier transfer's initiate says nothing about this one.
fn unexpected(at: Address, response: Option<Response>) -> Result<Next, SdoError> {
    match response {
        Some(Response::Abort(_, code)) => Err(SdoError::Server(code)),
        Some(Response::InitiateDownload(other) | Response::InitiateUpload(other, _)) if other != at => {
            Ok(Next::Wait)
        }
        _ => Err(SdoError::Client(AbortCode::COMMAND)),
    }
}

/// Writes a value: expedited up to four bytes, segmented above.
#[derive(Debug)]
pub struct Download<D> {
    link: Link,
    data: D,
    state: DownloadState,
}

#[derive(Debug)]
enum DownloadState {
    Initiating,
    Segments {
        /// Of the segment that is on its way.
        toggle: bool,
        /// Where the data end that are on their way.
        sent: usize,
    },
}

impl<D: AsRef<[u8]>> Download<D> {
    /// Writes `data` to `at` of `node`. Nothing is sent before the first [`poll`](Transfer::poll).
    pub fn new(node: NodeId, at: Address, data: D, config: Config) -> Self {
        let bytes = data.as_ref();
        let payload = match bytes.len() {
            1..=4 => Payload::Expedited(Chunk::new(bytes)),
            // What does not fit into 32 bits is announced as being of unknown size.
            len => Payload::Segmented(u32::try_from(len).ok()),
        };
        let link = Link::new(node, at, config, Request::InitiateDownload(at, payload));
        Self { link, data, state: DownloadState::Initiating }
    }

    fn answer(&mut self, bytes: &[u8; 8]) -> Result<Next, SdoError> {
        let data = self.data.as_ref();
        match (Response::parse(bytes), &mut self.state) {
            (Some(Response::InitiateDownload(at)), DownloadState::Initiating) if at == self.link.at => {
                if (1..=4).contains(&data.len()) {
                    self.link.progress = data.len() as u32;
                    return Ok(Next::Done);
                }
                let (segment, sent) = segment(data, 0, false);
                self.state = DownloadState::Segments { toggle: false, sent };
                Ok(Next::Send(Request::DownloadSegment(segment)))
            }
            (Some(Response::DownloadSegment(answered)), DownloadState::Segments { toggle, sent }) => {
                if answered != *toggle {
                    return Err(SdoError::Client(AbortCode::TOGGLE));
                }
                self.link.progress = *sent as u32;
                if *sent == data.len() {
                    return Ok(Next::Done);
                }
                *toggle = !*toggle;
                let (segment, end) = segment(data, *sent, *toggle);
                *sent = end;
                Ok(Next::Send(Request::DownloadSegment(segment)))
            }
            (response, _) => unexpected(self.link.at, response),
        }
    }
}

/// The segment from `start` on, and where its data end.
fn segment(data: &[u8], start: usize, toggle: bool) -> (Segment, usize) {
    let chunk = Chunk::new(&data[start..]);
    let end = start + chunk.len();
    (Segment { toggle, last: end == data.len(), data: chunk }, end)
}

impl<D: AsRef<[u8]>> Transfer for Download<D> {
    fn handle(&mut self, frame: &Frame, _now: Instant) {
        if let Some(bytes) = self.link.answer(frame) {
            let outcome = self.answer(bytes);
            self.link.advance(outcome);
        }
    }

    fn poll(&mut self, now: Instant) -> Step {
        self.link.poll(now)
    }

    fn progress(&self) -> u32 {
        self.link.progress
    }

    fn abort(&mut self, code: AbortCode) {
        self.link.abort(code);
    }
}

/// Where an upload goes.
pub trait Sink {
    /// The server announces this many bytes. Not called where it does not.
    ///
    /// # Errors
    /// The abort that the server gets.
    fn announce(&mut self, size: u32) -> Result<(), AbortCode> {
        let _ = size;
        Ok(())
    }

    /// The next bytes.
    ///
    /// # Errors
    /// The abort that the server gets.
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

/// A borrowed buffer as the target of an upload. What does not fit aborts it with 05040005h.
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

    /// What has arrived.
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

/// It grows with what really arrives; what a server merely announces takes no memory.
#[cfg(feature = "alloc")]
impl Sink for alloc::vec::Vec<u8> {
    fn write(&mut self, data: &[u8]) -> Result<(), AbortCode> {
        self.extend_from_slice(data);
        Ok(())
    }
}

/// Reads a value, as the server wants to send it.
#[derive(Debug)]
pub struct Upload<S> {
    link: Link,
    sink: S,
    state: UploadState,
}

#[derive(Debug)]
enum UploadState {
    Initiating,
    Segments {
        /// Of the segment that was asked for.
        toggle: bool,
        announced: Option<u32>,
    },
}

impl<S: Sink> Upload<S> {
    /// Reads `at` of `node` into `sink`. Nothing is sent before the first [`poll`](Transfer::poll).
    pub fn new(node: NodeId, at: Address, sink: S, config: Config) -> Self {
        let link = Link::new(node, at, config, Request::InitiateUpload(at));
        Self { link, sink, state: UploadState::Initiating }
    }

    /// What has arrived; all of it once the transfer is done and well.
    pub fn sink(&self) -> &S {
        &self.sink
    }

    /// The target back.
    pub fn into_sink(self) -> S {
        self.sink
    }

    fn answer(&mut self, bytes: &[u8; 8]) -> Result<Next, SdoError> {
        match (Response::parse(bytes), &mut self.state) {
            (Some(Response::InitiateUpload(at, payload)), UploadState::Initiating) if at == self.link.at => {
                match payload {
                    Payload::Expedited(data) => self.take(&data, None).map(|()| Next::Done),
                    Payload::Unsized(data) => self.take(&data, None).map(|()| Next::Done),
                    Payload::Segmented(announced) => {
                        if let Some(size) = announced {
                            self.sink.announce(size).map_err(SdoError::Client)?;
                        }
                        self.state = UploadState::Segments { toggle: false, announced };
                        Ok(Next::Send(Request::UploadSegment(false)))
                    }
                }
            }
            (Some(Response::UploadSegment(segment)), UploadState::Segments { toggle, announced }) => {
                if segment.toggle != *toggle {
                    return Err(SdoError::Client(AbortCode::TOGGLE));
                }
                *toggle = !*toggle;
                let (next, announced) = (*toggle, *announced);
                self.take(&segment.data, announced)?;
                if !segment.last {
                    return Ok(Next::Send(Request::UploadSegment(next)));
                }
                match announced {
                    Some(size) if size != self.link.progress => Err(SdoError::Client(AbortCode::LENGTH)),
                    _ => Ok(Next::Done),
                }
            }
            (response, _) => unexpected(self.link.at, response),
        }
    }

    /// Passes data on; more than was announced are refused.
    fn take(&mut self, data: &[u8], announced: Option<u32>) -> Result<(), SdoError> {
        let total = self.link.progress.checked_add(data.len() as u32);
        let total = total.filter(|total| *total <= announced.unwrap_or(u32::MAX));
        self.link.progress = total.ok_or(SdoError::Client(AbortCode::LENGTH))?;
        self.sink.write(data).map_err(SdoError::Client)
    }
}

impl<S: Sink> Transfer for Upload<S> {
    fn handle(&mut self, frame: &Frame, _now: Instant) {
        if let Some(bytes) = self.link.answer(frame) {
            let outcome = self.answer(bytes);
            self.link.advance(outcome);
        }
    }

    fn poll(&mut self, now: Instant) -> Step {
        self.link.poll(now)
    }

    fn progress(&self) -> u32 {
        self.link.progress
    }

    fn abort(&mut self, code: AbortCode) {
        self.link.abort(code);
    }
}
