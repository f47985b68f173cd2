//! Frames to and from the device, with time limits on the adapter's clock.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::time::Duration;

use canopen::nmt::{NmtCommand, NmtState};
use canopen::{CobId, Frame, NodeId};

use coboot_can::{Adapter, AdapterError};
use coflash_core::device::{Error, Session, Timing};
use coflash_core::update::Payload;

/// Switches the power of the device on or off.
pub type Power<'p> = Box<dyn FnMut(bool) -> Result<(), String> + 'p>;

/// What the checks may use.
pub struct Means<'p> {
    /// The longest time for an answer of the device.
    pub answer: Duration,
    /// The program for the checks that install one.
    pub image: Option<Payload>,
    /// The power of the device.
    pub power: Option<Power<'p>>,
}

impl Means<'_> {
    /// Checks that install nothing.
    #[must_use]
    pub const fn of(answer: Duration) -> Self {
        Self { answer, image: None, power: None }
    }
}

/// Why a check ends without passing.
#[derive(Debug)]
pub enum Stop {
    /// The device does not conform: what it did.
    Failed(String),
    /// It cannot be judged: why.
    Skipped(String),
    /// The bus is lost, or the user has cancelled.
    Bus(Error),
}

impl From<AdapterError> for Stop {
    fn from(error: AdapterError) -> Self {
        Self::Bus(error.into())
    }
}

/// How long the bus must carry no answer before it counts as quiet.
const QUIET: Duration = Duration::from_millis(30);
/// How long a frame that must not be answered is given for an answer.
const UNANSWERED: Duration = Duration::from_millis(100);
/// How long the first heartbeat is waited for.
const HEARTBEAT: Duration = Duration::from_millis(2100);
/// The most that [`Bench::settle`] reads from a bus that never gets quiet.
const SETTLE: Duration = Duration::from_secs(2);
/// How long one wait lasts before the flag of Ctrl-C is looked at.
const TURN: Duration = Duration::from_millis(100);

/// The most answers of other devices that are looked at.
const MOST_ANSWERS: usize = 128;

/// The device on its bus.
pub struct Bench<'a> {
    adapter: &'a mut dyn Adapter,
    pub(super) node: NodeId,
    /// Whether the answers of layer setting services can be judged, or why not; `None` until this
    /// was looked at.
    pub(super) lss: Option<Result<(), String>>,
    /// The multiplexor that an abort must have.
    at: [u8; 3],
    means: Means<'a>,
    cancelled: &'a Arc<AtomicBool>,
}

pub(super) fn failed<T>(what: impl Into<String>) -> Result<T, Stop> {
    Err(Stop::Failed(what.into()))
}

pub(super) fn skipped<T>(why: impl Into<String>) -> Result<T, Stop> {
    Err(Stop::Skipped(why.into()))
}

/// Goes on if this holds; otherwise the check has failed, and the words say what the device did.
macro_rules! ensure {
    ($holds:expr, $($words:tt)+) => {
        if !$holds {
            return Err($crate::bench::Stop::Failed(format!($($words)+)));
        }
    };
}

/// Goes on if this holds; otherwise the check is skipped, and the words say why.
macro_rules! need {
    ($holds:expr, $($words:tt)+) => {
        if !$holds {
            return Err($crate::bench::Stop::Skipped(format!($($words)+)));
        }
    };
}
pub(super) use {ensure, need};

/// An SDO request of eight bytes for an object.
pub(super) const fn request(command: u8, index: u16, sub: u8, data: [u8; 4]) -> [u8; 8] {
    let [low, high] = index.to_le_bytes();
    [command, low, high, sub, data[0], data[1], data[2], data[3]]
}

/// An abort code in an answer.
pub(super) fn abort_of(answer: &[u8; 8]) -> Option<u32> {
    (answer[0] == 0x80).then(|| u32::from_le_bytes([answer[4], answer[5], answer[6], answer[7]]))
}

/// The multiplexor of an abort to a request that has none and belongs to no transfer.
const NONE: [u8; 3] = [0; 3];

/// Whether a request has a multiplexor (CiA 301 clause 7.2.4.3): the initiates of all services.
const fn initiates(command: u8) -> bool {
    matches!(command >> 5, 1 | 2) || matches!(command & 0xE3, 0xA0 | 0xC0 | 0xC2)
}

/// Whether a transfer has ended with this answer: it was the last segment, all data were in the initiate, or
/// it is the end of a block transfer.
const fn ends(asked: u8, answer: u8) -> bool {
    match asked >> 5 {
        1 => asked & 2 != 0,
        2 => answer & 2 != 0,
        3 => answer & 1 != 0,
        0 | 6 => asked & 1 != 0,
        5 => answer & 0xE2 == 0x42,
        _ => false,
    }
}

impl<'a> Bench<'a> {
    pub(super) fn new(
        adapter: &'a mut dyn Adapter,
        node: NodeId,
        means: Means<'a>,
        cancelled: &'a Arc<AtomicBool>,
    ) -> Self {
        Self { adapter, node, lss: None, at: NONE, means, cancelled }
    }

    /// Does something with the client of updates; its error is the device's failure.
    pub(super) fn with<R>(
        &mut self,
        act: impl FnOnce(&mut Session<'_>) -> Result<R, Error>,
    ) -> Result<R, Stop> {
        let timing = Timing::default().sdo(self.means.answer);
        let mut session = Session::new(&mut *self.adapter, self.node, timing);
        session.cancel_by(Arc::clone(self.cancelled));
        act(&mut session).map_err(|error| match error {
            Error::Adapter(_) | Error::Cancelled => Stop::Bus(error),
            error => Stop::Failed(error.to_string()),
        })
    }

    /// The program to install.
    pub(super) fn image(&self) -> Result<&Payload, Stop> {
        self.means.image.as_ref().ok_or_else(|| Stop::Skipped("no program is given".to_string()))
    }

    pub(super) fn has_power(&self) -> bool {
        self.means.power.is_some()
    }

    /// Switches the power on or off.
    pub(super) fn power(&mut self, on: bool) -> Result<(), Stop> {
        match &mut self.means.power {
            Some(power) => power(on).map_err(Stop::Skipped),
            None => skipped("no command for the power is given"),
        }
    }

    /// Brings the device into a known state: pre-operational, no transfer, LSS waiting.
    pub(super) fn settle(&mut self) -> Result<(), Error> {
        self.adapter.send(&NmtCommand::EnterPreOperational.emit(Some(self.node)))?;
        self.adapter.send(&Frame::full(CobId::LSS_REQUEST, [4, 0, 0, 0, 0, 0, 0, 0]))?;
        let abort = request(0x80, 0, 0, 0x0800_0000_u32.to_le_bytes());
        self.adapter.send(&Frame::full(CobId::sdo_request(self.node), abort))?;
        self.at = NONE;
        let response = CobId::sdo_response(self.node);
        let begun = self.adapter.now();
        let mut quiet = begun;
        while self.adapter.now() < quiet + QUIET && self.adapter.now() < begun + SETTLE {
            if let Some(frame) = self.adapter.receive(QUIET)? {
                if frame.has_cob_id(response) {
                    quiet = self.adapter.now();
                }
            }
        }
        Ok(())
    }

    /// The NMT state that the next heartbeat reports, if one comes.
    pub(super) fn state(&mut self) -> Result<Option<NmtState>, Stop> {
        let frame = self.hear(CobId::heartbeat(self.node), HEARTBEAT)?;
        Ok(frame.and_then(|frame| frame.exactly::<1>().and_then(|[byte]| NmtState::from_byte(*byte))))
    }

    /// Leaves the device without a transfer, and in this state.
    pub(super) fn leave(&mut self, state: Option<NmtState>) -> Result<(), Error> {
        self.settle()?;
        let command = match state {
            Some(NmtState::Operational) => NmtCommand::Start,
            Some(NmtState::Stopped) => NmtCommand::Stop,
            _ => return Ok(()),
        };
        Ok(self.adapter.send(&command.emit(Some(self.node)))?)
    }

    pub(super) fn now(&self) -> Duration {
        self.adapter.now()
    }

    pub(super) fn send(&mut self, frame: &Frame) -> Result<(), Stop> {
        // A reset of the communication ends a transfer.
        if frame.has_cob_id(CobId::NMT) {
            self.at = NONE;
        }
        Ok(self.adapter.send(frame)?)
    }

    /// The next data frame with this COB-ID, within `time`.
    pub(super) fn hear(&mut self, id: CobId, time: Duration) -> Result<Option<Frame>, Stop> {
        let deadline = self.adapter.now() + time;
        loop {
            if self.cancelled.load(Ordering::Relaxed) {
                return Err(Stop::Bus(Error::Cancelled));
            }
            let left = deadline.saturating_sub(self.adapter.now());
            match self.adapter.receive(left.min(TURN))? {
                Some(frame) if frame.has_cob_id(id) => return Ok(Some(frame)),
                _ if self.adapter.now() >= deadline => return Ok(None),
                _ => {}
            }
        }
    }

    /// All data frames with this COB-ID within `time`: several devices may answer.
    pub(super) fn hear_all(&mut self, id: CobId, time: Duration) -> Result<Vec<Frame>, Stop> {
        let end = self.now() + time;
        let mut frames = Vec::new();
        while let Some(frame) = self.hear(id, end.saturating_sub(self.now()))? {
            frames.push(frame);
            if frames.len() == MOST_ANSWERS || self.now() >= end {
                break;
            }
        }
        Ok(frames)
    }

    /// Whether a device with this node-ID answers SDO requests.
    pub(super) fn reaches(&mut self, node: NodeId) -> Result<bool, Stop> {
        self.send(&Frame::full(CobId::sdo_request(node), request(0x40, 0x1000, 0, [0; 4])))?;
        Ok(self.hear(CobId::sdo_response(node), self.means.answer)?.is_some())
    }

    /// The next SDO answer.
    pub(super) fn heard(&mut self) -> Result<[u8; 8], Stop> {
        match self.hear(CobId::sdo_response(self.node), self.means.answer)? {
            Some(frame) => match frame.exactly::<8>() {
                Some(data) => self.names_its_object(*data),
                None => failed(format!("the SDO answer has not 8 bytes: {frame}")),
            },
            None => failed(format!("no SDO answer within {} ms", self.means.answer.as_millis())),
        }
    }

    /// An answer; an abort must have the multiplexor of its request, or of the transfer that the request
    /// belongs to (CiA 301 clause 7.2.4.3.17).
    pub(super) fn names_its_object(&mut self, answer: [u8; 8]) -> Result<[u8; 8], Stop> {
        if answer[0] == 0x80 {
            let right = std::mem::replace(&mut self.at, NONE);
            let [[i, j, sub], [k, l, other]] = [right, [answer[1], answer[2], answer[3]]];
            ensure!(
                [k, l, other] == right,
                "the abort names {l:02X}{k:02X}h/{other} in place of {j:02X}{i:02X}h/{sub}"
            );
        }
        Ok(answer)
    }

    /// Sends an SDO request and returns the answer.
    pub(super) fn ask(&mut self, data: [u8; 8]) -> Result<[u8; 8], Stop> {
        self.send_sdo(data)?;
        let answer = self.heard()?;
        if ends(data[0], answer[0]) {
            self.at = NONE;
        }
        Ok(answer)
    }

    /// Sends a frame of the SDO client that has no answer.
    pub(super) fn send_sdo(&mut self, data: [u8; 8]) -> Result<(), Stop> {
        if initiates(data[0]) {
            self.at = [data[1], data[2], data[3]];
        } else if matches!(data[0], 0x80 | 0xA1) {
            self.at = NONE;
        }
        self.send(&Frame::full(CobId::sdo_request(self.node), data))
    }

    /// Aborts the transfer of an object.
    pub(super) fn abort(&mut self, index: u16, sub: u8) -> Result<(), Stop> {
        self.send_sdo(request(0x80, index, sub, 0x0800_0000_u32.to_le_bytes()))
    }

    /// Sends an SDO request and expects an answer with this command byte.
    pub(super) fn takes(&mut self, data: [u8; 8], command: u8) -> Result<[u8; 8], Stop> {
        let answer = self.ask(data)?;
        match abort_of(&answer) {
            _ if answer[0] == command => Ok(answer),
            Some(code) => failed(format!("abort {code:08X}h in place of {command:02X}h")),
            None => failed(format!("{:02X}h in place of {command:02X}h", answer[0])),
        }
    }

    /// Expects that the device refuses a request with this abort code.
    pub(super) fn refuses(&mut self, data: [u8; 8], code: u32) -> Result<(), Stop> {
        let answer = self.ask(data)?;
        match abort_of(&answer) {
            Some(given) if given == code => Ok(()),
            Some(given) => failed(format!("abort {given:08X}h in place of {code:08X}h")),
            None => failed(format!("{:02X}h in place of abort {code:08X}h", answer[0])),
        }
    }

    /// Expects that a frame is not answered on `id`, and that the server works afterwards.
    pub(super) fn ignores(&mut self, frame: &Frame, id: CobId) -> Result<(), Stop> {
        self.send(frame)?;
        match self.hear(id, self.means.answer.min(UNANSWERED))? {
            Some(answer) => failed(format!("{frame} was answered with {answer}")),
            None => self.works(),
        }
    }

    /// Expects that 1000h can be read.
    pub(super) fn works(&mut self) -> Result<(), Stop> {
        self.value(0x1000, 0, 4).map(drop)
    }

    /// A number of `len` bytes by expedited upload, with all the answer's fields checked.
    pub(super) fn value(&mut self, index: u16, sub: u8, len: u8) -> Result<u32, Stop> {
        let asked = request(0x40, index, sub, [0; 4]);
        let answer = self.ask(asked)?;
        if let Some(code) = abort_of(&answer) {
            return failed(format!("{index:04X}h/{sub} is refused: abort {code:08X}h"));
        }
        let right = 0x43 | (4 - len) << 2;
        ensure!(
            answer[0] == right,
            "{index:04X}h/{sub}: command byte {:02X}h in place of {right:02X}h",
            answer[0]
        );
        ensure!(answer[1..4] == asked[1..4], "{index:04X}h/{sub}: the answer is for another object");
        Ok(u32::from_le_bytes([answer[4], answer[5], answer[6], answer[7]]) & (u32::MAX >> (8 * (4 - len))))
    }
}
