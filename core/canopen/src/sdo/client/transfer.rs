//! What all transfers have in common.

use core::fmt;

use crate::abort::AbortCode;
use crate::frame::{CobId, Frame, NodeId};
use crate::od::Address;
use crate::sdo::block::BLKSIZE_MAX;
use crate::sdo::wire::{Request, Response};
use crate::time::Instant;

/// The configuration of a transfer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Config {
    /// How long to wait for an answer of the server, in milliseconds.
    pub timeout_ms: u32,
}

impl Default for Config {
    /// One second.
    fn default() -> Self {
        Self { timeout_ms: 1000 }
    }
}

/// The configuration of a block transfer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Block {
    /// Whether to start again segmented if the server does not support block transfer.
    pub fallback: bool,
    /// Upload: segments of a sub-block, 1 to 127.
    pub blksize: u8,
    /// Upload: protocol switch threshold. Up to this many bytes the server may answer without
    /// blocks; 0 for never.
    pub pst: u8,
    /// Upload: how long a sub-block may pause before the received part is acknowledged, in
    /// milliseconds. It must be less than the server's time-out.
    pub repeat_ms: u32,
}

impl Default for Block {
    /// With fallback, 127 segments, without blocks up to 21 bytes, 300 ms.
    fn default() -> Self {
        Self { fallback: true, blksize: BLKSIZE_MAX, pst: 21, repeat_ms: 300 }
    }
}

/// Why a transfer failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SdoError {
    /// The server did not answer in time; the transfer was aborted with 05040000h.
    NoAnswer,
    /// The server aborted.
    Server(AbortCode),
    /// This side aborted: the server's answer broke the protocol, or the target of an upload
    /// refused.
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

/// The next action for a transfer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Step {
    /// Send this frame, and ask again.
    Send(Frame),
    /// Wait for frames, at most until this time.
    Wait(Instant),
    /// The transfer has ended; every later call returns this, too.
    Done(Result<(), SdoError>),
}

/// A running transfer.
pub trait Transfer {
    /// Processes any received frame; frames that do not answer this transfer are ignored.
    fn handle(&mut self, frame: &Frame, now: Instant);

    /// Returns the next action.
    fn poll(&mut self, now: Instant) -> Step;

    /// The number of data bytes that the server has acknowledged, or that have arrived here.
    fn progress(&self) -> u32;

    /// Ends the transfer: the server gets this abort.
    fn abort(&mut self, code: AbortCode);
}

/// Common data of download and upload: the server, the time-out, and the next request.
#[derive(Debug)]
pub(super) struct Link {
    pub(super) node: NodeId,
    pub(super) at: Address,
    pub(super) timeout_ms: u32,
    /// The request that `poll` sends next.
    pub(super) request: Option<Request>,
    /// The time of the last sent or received frame.
    pub(super) moved: Instant,
    pub(super) result: Option<Result<(), SdoError>>,
    pub(super) progress: u32,
}

/// The consequence of an answer.
pub(super) enum Next {
    Send(Request),
    Wait,
    /// The frame is ignored. It does not restart the time-out, because answers to another client
    /// could otherwise keep this transfer waiting forever.
    Ignore,
    /// The transfer was successful; with a last request to the server, if the protocol has one.
    Done(Option<Request>),
}

impl Link {
    pub(super) fn new(node: NodeId, at: Address, config: Config, request: Request) -> Self {
        Self {
            node,
            at,
            timeout_ms: config.timeout_ms,
            request: Some(request),
            moved: Instant::default(),
            result: None,
            progress: 0,
        }
    }

    /// The eight bytes of an answer, if the frame is one and the transfer waits for one.
    pub(super) fn answer<'f>(&self, frame: &'f Frame) -> Option<&'f [u8; 8]> {
        let waiting = self.result.is_none() && self.request.is_none();
        if !waiting || !frame.has_cob_id(CobId::sdo_response(self.node)) {
            return None;
        }
        frame.exactly()
    }

    pub(super) fn deadline(&self) -> Instant {
        self.moved + self.timeout_ms
    }

    pub(super) fn poll(&mut self, now: Instant) -> Step {
        if let Some(request) = self.request.take() {
            return self.send(request.emit(), now);
        }
        match self.result {
            Some(result) => Step::Done(result),
            None if now.has_reached(self.deadline()) => {
                self.result = Some(Err(SdoError::NoAnswer));
                self.send(Request::Abort(self.at, AbortCode::TIMEOUT).emit(), now)
            }
            None => Step::Wait(self.deadline()),
        }
    }

    pub(super) fn send(&mut self, bytes: [u8; 8], now: Instant) -> Step {
        self.moved = now;
        Step::Send(Frame::full(CobId::sdo_request(self.node), bytes))
    }

    /// Carries out the consequence of an answer.
    pub(super) fn advance(&mut self, next: Result<Next, SdoError>, now: Instant) {
        if !matches!(next, Ok(Next::Ignore)) {
            self.moved = now;
        }
        match next {
            Ok(Next::Send(request)) => self.request = Some(request),
            Ok(Next::Wait | Next::Ignore) => {}
            Ok(Next::Done(farewell)) => {
                self.request = farewell;
                self.result = Some(Ok(()));
            }
            Err(SdoError::Client(code)) => self.abort(code),
            Err(error) => self.result = Some(Err(error)),
        }
    }

    pub(super) fn abort(&mut self, code: AbortCode) {
        if self.result.is_none() {
            self.request = Some(Request::Abort(self.at, code));
            self.result = Some(Err(SdoError::Client(code)));
        }
    }

    /// An answer that does not fit here. A late answer to the initiate of an earlier transfer is
    /// ignored.
    pub(super) fn unexpected(&self, response: Option<Response>) -> Result<Next, SdoError> {
        match response {
            Some(Response::Abort(_, code)) => Err(SdoError::Server(code)),
            Some(
                Response::InitiateDownload(at)
                | Response::InitiateUpload(at, _)
                | Response::InitiateBlockDownload { at, .. }
                | Response::InitiateBlockUpload { at, .. },
            ) if at != self.at => Ok(Next::Ignore),
            _ => Err(SdoError::Client(AbortCode::COMMAND)),
        }
    }
}

/// Whether this is the abort of a server that does not support block transfer. Some servers use the
/// general error for it.
pub(super) fn means_unknown(code: AbortCode) -> bool {
    matches!(code, AbortCode::COMMAND | AbortCode::UNSUPPORTED_ACCESS | AbortCode::GENERAL)
}
