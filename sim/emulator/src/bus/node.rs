//! The interface between a CAN controller and the bus.

use crate::bus::confinement::Confinement;
use crate::frame::Frame;
use crate::time::{Span, Time};

/// Which of its two pins a node has on the bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Pins {
    /// What it hears; without it, a recessive line for ever.
    pub rx: bool,
    /// What the others hear of it.
    pub tx: bool,
}

impl Pins {
    /// Both.
    pub const BOTH: Self = Self { rx: true, tx: true };
    /// Neither.
    pub const NONE: Self = Self { rx: false, tx: false };
}

/// Where a node's frames go.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Route {
    /// It sends none.
    Nowhere,
    /// Nobody but the node itself sees them: it has them acknowledged in loop-back mode, and sees a bit
    /// error in the first of their bits otherwise.
    Inside,
    /// The bus.
    Bus,
}

/// How a node that takes part drives and reads the bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Line {
    /// Nominal bit time.
    pub bit: Span,
    /// The sample point within the bit.
    pub sample: Span,
    /// By how much the bits of another node may be longer or shorter, in millionths.
    pub tolerance_ppm: u32,
    /// It never drives the bus dominant: no frames, no acknowledge, no error flags.
    pub silent: bool,
    /// It receives its own frames and nothing else, and needs no acknowledge.
    pub loopback: bool,
    /// Its pins.
    pub pins: Pins,
}

impl Line {
    /// Whether the others hear what it sends.
    #[must_use]
    pub fn drives(&self) -> bool {
        !self.silent && self.pins.tx
    }

    /// Whether it hears the others.
    #[must_use]
    pub fn hears(&self) -> bool {
        !self.loopback && self.pins.rx
    }

    /// Whether it sends onto the bus and hears nothing of it, which it takes for bit errors.
    #[must_use]
    pub fn is_deaf(&self) -> bool {
        !self.loopback && !self.pins.rx
    }

    /// Where its frames go.
    #[must_use]
    pub fn route(&self) -> Route {
        match (self.silent, self.loopback) {
            (true, false) => Route::Nowhere,
            _ if self.drives() => Route::Bus,
            _ => Route::Inside,
        }
    }

    /// The bit rate in bit/s, rounded.
    #[must_use]
    pub fn bit_rate(&self) -> u32 {
        bit_rate(self.bit)
    }
}

/// The bit rate in bit/s that belongs to a bit time, rounded; 0 for a bit time of 0.
#[must_use]
pub fn bit_rate(bit: Span) -> u32 {
    const PICOS: u64 = 1_000_000_000_000;
    (PICOS + bit.0 / 2).checked_div(bit.0).and_then(|rate| u32::try_from(rate).ok()).unwrap_or(0)
}

/// The node waits for the bus to be recessive: to synchronise with it, or to come back from
/// bus-off.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Wait {
    /// Bits before this time do not count.
    pub since: Time,
    /// Sequences of 11 recessive bits that it still needs.
    pub sequences: u32,
    /// Its bit time.
    pub bit: Span,
    /// Whether it hears the bus; what it hears is recessive otherwise.
    pub hears: bool,
}

/// The error of a frame, as the node that counts it sees it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ErrorKind {
    /// Six equal bits in a row.
    Stuff,
    /// A fixed-form bit had the wrong level.
    Form,
    /// Nobody acknowledged.
    Acknowledge,
    /// Sent recessive, saw dominant.
    BitRecessive,
    /// Sent dominant, saw recessive.
    BitDominant,
    /// The CRC sequence did not match.
    Crc,
}

impl ErrorKind {
    /// The error as a phrase for people to read.
    #[must_use]
    pub fn words(self) -> &'static str {
        match self {
            Self::Stuff => "stuff error",
            Self::Form => "form error",
            Self::Acknowledge => "no acknowledge",
            Self::BitRecessive | Self::BitDominant => "bit error",
            Self::Crc => "CRC error",
        }
    }
}

/// An event that the bus reports to a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BusEvent {
    /// A frame begins. `own`: it is the one that the node's [`BusNode::request`] named (the node
    /// may still lose the arbitration).
    Started {
        /// Whether the node is among its transmitters.
        own: bool,
    },
    /// A stronger identifier won; the node receives from here on.
    ArbitrationLost,
    /// Its frame went out and was acknowledged.
    Transmitted,
    /// Its frame failed. `exempt`: the error leaves the transmit error counter alone.
    TransmitFailed {
        /// What it saw.
        kind: ErrorKind,
        /// An error passive transmitter without an acknowledge.
        exempt: bool,
    },
    /// A good frame (in loop-back mode its own).
    Received(Frame),
    /// A frame that others see on the wire was kept from this node by an injected fault: it counts
    /// as good but carries nothing.
    Missed,
    /// A bad frame. `first`: this node saw the error before the others.
    ReceiveFailed {
        /// What it saw.
        kind: ErrorKind,
        /// It saw the error first.
        first: bool,
    },
    /// The line has stayed dominant for 8 more bits after an error flag.
    StaysDominant {
        /// It broke a frame of this node.
        own: bool,
    },
    /// The bus has been recessive for so many sequences of 11 bits that the node waited for.
    Recessive {
        /// How many.
        sequences: u32,
    },
    /// The node asked to leave the bus, and no frame of or for it is under way any more.
    Released,
    /// The frame is over, good or bad, and the node may change its mode or request a frame.
    Ended,
}

/// A controller on the bus. Its answers hold for one point of virtual time; the bus asks in the
/// order of time.
pub trait BusNode {
    /// How it takes part; `None` while it does not (off, initialising, asleep, not synchronised,
    /// bus-off).
    fn line(&self) -> Option<Line>;

    /// Changes whenever the node loses its state (reset, power): a frame begun before is lost.
    fn epoch(&self) -> u32;

    /// Its error counters.
    fn confinement(&self) -> Confinement;

    /// The frame that it wants to send at `now`, if any.
    fn request(&self, now: Time) -> Option<Frame>;

    /// The time of its next request, if it has none at `now` but will have one later.
    fn next_request(&self, now: Time) -> Option<Time>;

    /// Recessive bits that it waits for.
    fn wait(&self) -> Option<Wait>;

    /// The time from which on it wants to leave the bus, as soon as no frame of or for it is under
    /// way.
    fn leaving(&self) -> Option<Time>;

    /// Something happened on the bus at `now`.
    fn event(&mut self, event: BusEvent, now: Time);

    /// The bus has processed everything up to and including `now`.
    fn resolved(&mut self, now: Time);
}
