//! The SDO server: one transfer at a time, for one client.
//!
//! - Frames with another identifier, remote and extended frames, and frames with another length
//!   than 8 bytes are not SDO requests (CiA 301 section 7.2.4.3: all have 8 bytes) and are ignored.
//! - Every request is answered or aborted, except for an abort, and for an expedited download whose
//!   confirmation the device leaves to another program ([`Reply::Withhold`](crate::od::Reply)).
//! - An initiate ends the previous transfer. Within a sub-block of a block download it must first
//!   be distinguished from a segment, see `block_download.rs`.
//! - If the client is silent for the time-out, the transfer is aborted with 05040000h. In a block
//!   download the time-out counts from the last accepted segment, whatever else arrives.
//! - If a sub-block of a block download stops early, the received segments are acknowledged, and
//!   the client repeats the rest.
//! - After the end of a download in the middle of a sub-block, the segments that still come are no
//!   requests, see `under_way.rs`.

use crate::abort::AbortCode;
use crate::bit_rate::BitRate;
use crate::frame::{CobId, Frame, NodeId};
use crate::od::{self, Address, Entry, Objects};
use crate::sdo::block::{Receiver, BLKSIZE_MAX, SEGMENT};
use crate::sdo::fields::{self, ccs, scs};
use crate::time::Instant;

mod block_download;
mod block_upload;
mod incoming;
mod outgoing;
mod segmented;
mod sender;
mod under_way;
mod value;

use incoming::Incoming;
use outgoing::Outgoing;
use sender::Sender;
use under_way::UnderWay;
pub use value::VALUE_MAX;

/// How long an answer is delayed for lack of room before the device is asked for room in its
/// reserve, in milliseconds.
pub const HOLD_MS: u32 = 2;

/// The longest time that the segments of a sub-block take on the bus, in milliseconds. Clients send a
/// sub-block within their time-out, of 100 ms at least.
pub const SUB_BLOCK_MS: u32 = 80;

/// The most bits of a frame with eight bytes, with stuff bits and the space to the next frame (CiA 301
/// leaves them to ISO 11898-1: 111 bits, and 24 stuff bits).
const FRAME_BITS: u32 = 135;

/// The configuration of a server.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Config {
    /// How long the client may be silent within a transfer, in milliseconds; then the transfer is
    /// aborted.
    pub timeout_ms: u32,
    /// How long a sub-block of a block download may pause before the received part is acknowledged,
    /// in milliseconds. It must be longer than a busy client's pause between two segments, and
    /// shorter than a client's time-out: 300 to 500 ms by default in most clients.
    pub pause_ms: u32,
    /// The same where only the last segment of the sub-block is missing: the client waits for the
    /// acknowledgement already. Doubled on a slow bus ([`BitRate::is_slow`]).
    pub last_pause_ms: u32,
    /// The bit rate of the bus, [`BitRate::Auto`] for a fast one. A [`Slave`](crate::slave::Slave)
    /// sets it when it joins the bus.
    pub bit_rate: BitRate,
    /// Segments of a sub-block of a block download: 1 to 127, and no more than the receive queue
    /// can hold. At low bit rates a sub-block has fewer, see [`SUB_BLOCK_MS`].
    pub blksize: u8,
    /// The abort for a request that CiA 301 does not define, or that does not fit into the
    /// transfer.
    pub unknown_request: AbortCode,
    /// The base COB-ID of requests, to which the node-ID is added: 600h in the predefined
    /// connection set. With the largest node-ID the sum must be a COB-ID, at most 7FFh; the same
    /// applies to the next field.
    pub request_base: u16,
    /// The base COB-ID of answers, to which the node-ID is added: 580h in the predefined connection
    /// set.
    pub response_base: u16,
}

impl Config {
    /// Two seconds; 250 ms, 50 ms for the last segment; 127 segments; 05040001h.
    pub const DEFAULT: Self = Self {
        timeout_ms: 2000,
        pause_ms: 250,
        last_pause_ms: 50,
        bit_rate: BitRate::Auto,
        blksize: BLKSIZE_MAX,
        unknown_request: AbortCode::COMMAND,
        request_base: 0x600,
        response_base: 0x580,
    };

    /// The COB-ID of the requests to a node.
    #[must_use]
    pub const fn request(&self, node: NodeId) -> CobId {
        from_base(self.request_base, node)
    }

    /// The COB-ID of the answers of a node.
    #[must_use]
    pub const fn response(&self, node: NodeId) -> CobId {
        from_base(self.response_base, node)
    }
}

/// What follows from a bit rate.
#[derive(Clone, Copy)]
struct Pace {
    /// The segments that take [`SUB_BLOCK_MS`] at most.
    segments: u8,
    /// The longest time between two segments of a sub-block whose download has ended, in milliseconds.
    gap_ms: u8,
}

/// For each bit rate, by its index.
const PACES: [Pace; 10] = {
    let mut paces = [Pace { segments: BLKSIZE_MAX, gap_ms: 2 }; 10];
    let mut index = 0;
    while index < paces.len() {
        if let Some(rate) = BitRate::from_index(index as u8) {
            if let Some(bits) = rate.bits_per_second() {
                let segments = bits / 1000 * SUB_BLOCK_MS / FRAME_BITS;
                let segments = if segments < BLKSIZE_MAX as u32 { segments as u8 } else { BLKSIZE_MAX };
                // The clock of the device counts whole milliseconds.
                let gap_ms = 1 + (under_way::FRAMES * FRAME_BITS).div_ceil(bits / 1000) as u8;
                paces[index] = Pace { segments, gap_ms };
            }
        }
        index += 1;
    }
    paces
};

/// An impossible COB-ID becomes that of NMT, which no server uses.
const fn from_base(base: u16, node: NodeId) -> CobId {
    match CobId::from_base(base, node) {
        Some(id) => id,
        None => CobId::NMT,
    }
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
    /// The COB-ID of answers: the client's of the last request.
    response: CobId,
    /// The object of the running transfer, or of the last request. An abort has it (CiA 301 clause
    /// 7.2.4.3.17): 0000h/00 after a request without an object that belongs to no transfer.
    at: Address,
    state: State,
    /// The time of the transfer's last progress: the time-out counts from here.
    moved: Instant,
    /// The time at which a segment of a block download was last received, or something was sent:
    /// the pause of a sub-block counts from here.
    heard: Instant,
    /// The answer that waits to be fetched by [`SdoServer::poll`].
    answer: Option<[u8; 8]>,
    /// Segments that may still arrive of a sub-block whose download has ended.
    under_way: Option<UnderWay>,
    /// The value of the transferred variable or string.
    value: [u8; VALUE_MAX],
}

#[derive(Debug)]
enum State {
    Idle,
    Download { incoming: Incoming, toggle: bool },
    Upload { outgoing: Outgoing, toggle: bool },
    BlockDownload { incoming: Incoming, receiver: Receiver },
    BlockUpload { outgoing: Outgoing, sender: Sender },
}

impl State {
    fn incoming(&mut self) -> Option<&mut Incoming> {
        match self {
            Self::Download { incoming, .. } | Self::BlockDownload { incoming, .. } => Some(incoming),
            _ => None,
        }
    }
}

impl SdoServer {
    /// The server of a node.
    #[must_use]
    pub const fn new(node: NodeId, config: Config) -> Self {
        Self {
            node,
            config,
            response: config.response(node),
            at: Address::new(0, 0),
            state: State::Idle,
            moved: Instant::from_millis(0),
            heard: Instant::from_millis(0),
            answer: None,
            under_way: None,
            value: [0; VALUE_MAX],
        }
    }

    /// Whether no transfer runs and no answer waits to be fetched.
    #[must_use]
    pub const fn is_idle(&self) -> bool {
        matches!(self.state, State::Idle) && self.answer.is_none()
    }

    /// Whether an answer waits to be fetched.
    #[must_use]
    pub const fn has_answer(&self) -> bool {
        self.answer.is_some()
    }

    /// Sets the value of [`Config::bit_rate`].
    pub fn set_bit_rate(&mut self, bit_rate: BitRate) {
        self.config.bit_rate = bit_rate;
    }

    /// The segments that follow are those of a new download of this client, or it has aborted.
    fn forget_under_way(&mut self) {
        let response = self.response;
        self.under_way.take_if(|segments| segments.response == response);
    }

    /// What follows from the bit rate.
    fn pace(&self) -> Pace {
        PACES[self.config.bit_rate as usize]
    }

    /// Ends the transfer without a message to the client, and drops a waiting answer.
    pub fn reset(&mut self, objects: &mut impl Objects) {
        self.end(objects);
        self.forget_under_way();
        self.answer = None;
    }

    /// Processes any received frame; frames that are not SDO requests to this server are ignored.
    pub fn handle<O: Objects>(&mut self, frame: &Frame, now: Instant, objects: &mut O) {
        let mut response = self.config.response(self.node);
        if !frame.has_cob_id(self.config.request(self.node)) {
            let second = objects.second_server();
            if !O::has_second_server() || !frame.has_cob_id(second.request) {
                return;
            }
            response = second.response;
        }
        let Some(bytes) = frame.exactly() else { return };
        // A client that has begun another transfer sends no more segments.
        let may_be = self.response != response || matches!(self.state, State::Idle);
        let due = self.under_way.filter(|segments| may_be && segments.is_next(bytes, response, objects));
        if due.is_some_and(|segments| !segments.is_over(now, self.pace().gap_ms)) {
            self.under_way = UnderWay::behind(bytes, response, now);
            return;
        }
        // A frame of the other server is no segment, and ends its transfer.
        if O::has_second_server() && self.response != response {
            self.end(objects);
            self.response = response;
        }
        let may_continue = match &self.state {
            State::BlockDownload { receiver, .. } if !receiver.is_complete() => {
                if let Err(code) = self.block_segment(bytes, now, objects) {
                    self.abort(code, objects);
                }
                true
            }
            _ => {
                self.serve(bytes, now, objects);
                due.is_some()
            }
        };
        if may_continue && self.answer.is_some_and(|answer| answer[0] == fields::ABORT) {
            self.under_way = UnderWay::behind(bytes, response, now);
        }
    }

    /// Carries out a request.
    fn serve(&mut self, bytes: &[u8; 8], now: Instant, objects: &mut impl Objects) {
        if self.repeats_last_segment(bytes) {
            return;
        }
        self.moved = now;
        if let Err(code) = self.request(bytes, objects) {
            self.abort(code, objects);
        }
    }

    /// The next frame to send; `None` if there is none. If the caller's transmit queue is full, it
    /// calls again later.
    pub fn poll<O: Objects>(&mut self, now: Instant, objects: &mut O) -> Option<Frame> {
        self.check_time(now, objects);
        if O::has_block_upload() && self.answer.is_none() {
            if let Err(code) = self.next_block_segment(objects) {
                self.abort(code, objects);
            }
        }
        if !self.may_answer(now, objects) {
            return None;
        }
        let answer = self.answer.take()?;
        self.heard = now;
        // A request to repeat a whole sub-block is not progress.
        if answer[..2] != [scs::ACK_BLOCK_DOWNLOAD, 0] {
            self.moved = now;
        }
        Some(Frame::full(self.response, answer))
    }

    /// Aborts a transfer with a silent client, and acknowledges a sub-block that stopped early.
    fn check_time(&mut self, now: Instant, objects: &mut impl Objects) {
        if matches!(self.state, State::Idle) {
            return;
        }
        if now.has_reached(self.moved + self.config.timeout_ms) {
            self.abort(AbortCode::TIMEOUT, objects);
        } else if self.is_within() && now.has_reached(self.heard + self.pause_ms()) {
            self.pause(now, objects);
        }
    }

    /// Whether the waiting answer may be sent. An answer after which the client sends data waits
    /// until there is room for a segment. If the answer opens a sub-block, its block size is set
    /// here.
    fn may_answer(&mut self, now: Instant, objects: &mut impl Objects) -> bool {
        let most = self.config.blksize.max(1).min(self.pace().segments);
        let Some(answer) = &mut self.answer else { return false };
        let Some(incoming) = self.state.incoming() else { return true };
        let mut space =
            if incoming.is_domain() { objects.download_space(self.at, false) } else { usize::MAX };
        if space < SEGMENT && now.has_reached(self.moved + HOLD_MS) {
            space = objects.download_space(self.at, true).min(SEGMENT);
        }
        let granted = (space / SEGMENT).min(usize::from(most)) as u8;
        match &mut self.state {
            State::BlockDownload { receiver, .. } => receiver.grant(answer, granted, most),
            _ => granted != 0,
        }
    }

    /// A request outside the sub-blocks of a block download.
    fn request<O: Objects>(&mut self, bytes: &[u8; 8], objects: &mut O) -> Result<(), AbortCode> {
        if matches!(self.state, State::Idle) {
            self.at = Address::new(0, 0);
        }
        match fields::specifier(bytes[0]) {
            ccs::INITIATE_DOWNLOAD => self.initiate_download(bytes, objects),
            ccs::DOWNLOAD_SEGMENT => self.download_segment(bytes, objects),
            ccs::INITIATE_UPLOAD => self.initiate_upload(bytes, objects),
            ccs::UPLOAD_SEGMENT => self.upload_segment(bytes, objects),
            ccs::INITIATE_BLOCK_DOWNLOAD if O::has_block_download() => {
                self.initiate_block_download(bytes, objects)
            }
            ccs::INITIATE_BLOCK_DOWNLOAD => self.leave_out(bytes, objects),
            ccs::INITIATE_BLOCK_UPLOAD if !O::has_block_upload() => self.leave_out(bytes, objects),
            ccs::END_BLOCK_DOWNLOAD if O::has_block_download() => self.end_block_download(bytes, objects),
            fields::ABORT => {
                self.reset(objects);
                Ok(())
            }
            specifier if O::has_block_upload() => self.block_upload(specifier, bytes, objects),
            _ => Err(self.config.unknown_request),
        }
    }

    /// Refuses the initiate of a service that this device leaves out.
    fn leave_out(&mut self, bytes: &[u8; 8], objects: &mut impl Objects) -> Result<(), AbortCode> {
        let _ = self.begin(fields::address(bytes), objects);
        Err(self.config.unknown_request)
    }

    /// Starts a transfer and ends the previous one. An abort from here on names this object.
    fn begin(&mut self, at: Address, objects: &mut impl Objects) -> Result<&'static Entry, AbortCode> {
        self.end(objects);
        self.at = at;
        od::find(objects.entries(), at)
    }

    fn abort(&mut self, code: AbortCode, objects: &mut impl Objects) {
        self.end(objects);
        self.answer_initiate(fields::ABORT, code.0);
    }

    /// An answer that contains the object: to an initiate, or an abort.
    fn answer_initiate(&mut self, command: u8, number: u32) {
        self.answer = Some(fields::with_address(command, self.at, number.to_le_bytes()));
    }

    /// An answer within a transfer.
    fn answer_transfer(&mut self, command: u8, a: u8, b: u8) {
        self.answer = Some(fields::without_address(command, a, b));
    }

    /// Returns to idle, and informs the receiver of an unfinished domain.
    fn end(&mut self, objects: &mut impl Objects) {
        if let State::BlockDownload { receiver, .. } = &self.state {
            self.under_way =
                receiver.due().map(|next| UnderWay { response: self.response, next, heard: self.heard });
        }
        if self.state.incoming().is_some_and(|incoming| incoming.is_domain()) {
            objects.download_cancel(self.at);
        }
        self.state = State::Idle;
    }
}
