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
    /// 127 segments, without blocks up to 21 bytes, 300 ms.
    fn default() -> Self {
        Self { blksize: BLKSIZE_MAX, pst: 21, repeat_ms: 300 }
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

    /// Whether the transfer waits for an answer: it has nothing to send, and has not ended.
    fn awaits_answer(&self) -> bool;

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
    /// Whether an answer was ignored that no server gives to the initiate of this transfer.
    odd: bool,
    /// An abort that was ignored, since it names another object; and the time at which it is taken for the
    /// answer to the initiate of a block transfer, if none comes.
    misnamed: Option<(AbortCode, Instant)>,
}

/// How long the answer to an initiate is awaited after an abort that names another object, in milliseconds.
///
/// Some servers abort the initiate of a block transfer that they do not support with the object of the
/// transfer before (CANopenNode, without its option for block transfer). A late abort of that transfer looks
/// the same, but after it comes the answer to the initiate: a server answers in the order of the requests.
const MISNAMED_MS: u32 = 100;

/// The consequence of an answer.
pub(super) enum Next {
    Send(Request),
    Wait,
    /// The frame is ignored. It does not restart the time-out, because answers to another client
    /// could otherwise keep this transfer waiting forever.
    Ignore,
    /// The same for an abort that names another object, in the initiate of a block transfer: the server may
    /// not support them.
    Doubt(AbortCode),
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
            odd: false,
            misnamed: None,
        }
    }

    /// The eight bytes of an answer, if the frame is one and the transfer waits for one.
    pub(super) fn answer<'f>(&self, frame: &'f Frame) -> Option<&'f [u8; 8]> {
        if !self.awaits_answer() || !frame.has_cob_id(CobId::sdo_response(self.node)) {
            return None;
        }
        frame.exactly()
    }

    /// Whether the server has refused the transfer as one that it does not support.
    pub(super) fn refused_as_unknown(&self) -> bool {
        matches!(self.result, Some(Err(SdoError::Server(code))) if means_unknown(code))
    }

    pub(super) fn awaits_answer(&self) -> bool {
        self.result.is_none() && self.request.is_none()
    }

    pub(super) fn deadline(&self) -> Instant {
        let timeout = self.moved + self.timeout_ms;
        self.misnamed.map_or(timeout, |(_, until)| timeout.earlier(until))
    }

    /// The abort of the initiate of a block transfer, as its server should have sent it.
    pub(super) fn abort_of_blocks(&mut self, now: Instant) -> Option<[u8; 8]> {
        let (code, _) = self.misnamed.take_if(|(_, until)| now.has_reached(*until))?;
        Some(Request::Abort(self.at, code).emit())
    }

    pub(super) fn poll(&mut self, now: Instant) -> Step {
        if let Some(request) = self.request.take() {
            return self.send(request.emit(), now);
        }
        match self.result {
            Some(result) => Step::Done(result),
            None if now.has_reached(self.deadline()) => {
                let (error, code) = match self.odd {
                    true => (SdoError::Client(AbortCode::COMMAND), AbortCode::COMMAND),
                    false => (SdoError::NoAnswer, AbortCode::TIMEOUT),
                };
                self.result = Some(Err(error));
                self.send(Request::Abort(self.at, code).emit(), now)
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
        if !matches!(next, Ok(Next::Ignore | Next::Doubt(_))) {
            self.moved = now;
            self.misnamed = None;
        }
        match next {
            Ok(Next::Send(request)) => self.request = Some(request),
            Ok(Next::Wait | Next::Ignore) => {}
            Ok(Next::Doubt(code)) => self.misnamed = self.misnamed.or(Some((code, now + MISNAMED_MS))),
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

    /// An answer that does not fit here. A late answer to the initiate of an earlier transfer, or
    /// its abort, is ignored.
    pub(super) fn unexpected(&self, response: Option<Response>) -> Result<Next, SdoError> {
        match response {
            Some(Response::Abort(at, code)) if concerns(at, self.at) => Err(SdoError::Server(code)),
            Some(Response::Abort(..)) => Ok(Next::Ignore),
            Some(
                Response::InitiateDownload(at)
                | Response::InitiateUpload(at, _)
                | Response::InitiateBlockDownload { at, .. }
                | Response::InitiateBlockUpload { at, .. },
            ) if at != self.at => Ok(Next::Ignore),
            _ => Err(SdoError::Client(AbortCode::COMMAND)),
        }
    }

    /// An answer before the server has answered the initiate. The server answers in the order of
    /// the requests, so one that does not fit answers the transfer before, which this side has given
    /// up. It is ignored; if nothing else comes, it is the error at the time-out.
    pub(super) fn too_early(
        &mut self,
        response: Option<Response>,
        of_blocks: bool,
    ) -> Result<Next, SdoError> {
        match (response, self.unexpected(response)) {
            (_, Err(SdoError::Client(_))) => {
                self.odd = true;
                Ok(Next::Ignore)
            }
            (Some(Response::Abort(_, code)), Ok(_)) if of_blocks && means_unknown(code) => {
                Ok(Next::Doubt(code))
            }
            (_, next) => next,
        }
    }
}

/// Whether an abort with this object ends the transfer of `at`: it names the object of the transfer
/// that it ends (CiA 301 clause 7.2.4.3.17). Some servers name none (0000h), which may be any.
pub(super) fn concerns(named: Address, at: Address) -> bool {
    named == at || named.index == 0
}

/// Whether this is the abort of a server that does not support block transfer. Some servers use the
/// general error for it.
fn means_unknown(code: AbortCode) -> bool {
    matches!(code, AbortCode::COMMAND | AbortCode::UNSUPPORTED_ACCESS | AbortCode::GENERAL)
}
