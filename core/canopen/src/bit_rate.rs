//! The bit rates of CANopen, and how a device detects the bit rate of its bus.

use crate::time::Instant;

/// The bit rates of CiA 305 table 1; the values are their index there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum BitRate {
    /// 1 Mbit/s.
    K1000 = 0,
    /// 800 kbit/s.
    K800 = 1,
    /// 500 kbit/s.
    K500 = 2,
    /// 250 kbit/s.
    K250 = 3,
    /// 125 kbit/s.
    K125 = 4,
    /// 100 kbit/s; later editions of the standard mark it as reserved.
    K100 = 5,
    /// 50 kbit/s.
    K50 = 6,
    /// 20 kbit/s.
    K20 = 7,
    /// 10 kbit/s.
    K10 = 8,
    /// The device detects the bit rate by listening.
    Auto = 9,
}

impl BitRate {
    /// Whether frames take so long that pauses between frames need more time: 20 kbit/s and below,
    /// where eight bytes take 5 ms and more.
    #[must_use]
    pub const fn is_slow(self) -> bool {
        matches!(self, Self::K20 | Self::K10)
    }

    /// From the index in CiA 305 table 1; `None` for an index that the table does not have.
    #[must_use]
    pub const fn from_index(index: u8) -> Option<Self> {
        Some(match index {
            0 => Self::K1000,
            1 => Self::K800,
            2 => Self::K500,
            3 => Self::K250,
            4 => Self::K125,
            5 => Self::K100,
            6 => Self::K50,
            7 => Self::K20,
            8 => Self::K10,
            9 => Self::Auto,
            _ => return None,
        })
    }

    /// The next slower rate; after the slowest one the fastest.
    const fn next(self) -> Self {
        match Self::from_index(self as u8 + 1) {
            None | Some(Self::Auto) => Self::K1000,
            Some(rate) => rate,
        }
    }

    /// From bit/s, with 0 for [`BitRate::Auto`]; `None` for a rate that CANopen does not have.
    #[must_use]
    pub const fn from_bits_per_second(rate: u32) -> Option<Self> {
        if rate == 0 {
            return Some(Self::Auto);
        }
        let mut i = 0;
        while i < Self::FIXED.len() {
            if Self::FIXED[i].or_zero() == rate {
                return Some(Self::FIXED[i]);
            }
            i += 1;
        }
        None
    }

    /// The rates of [`FIXED`](Self::FIXED) in bit/s; the index of each is its index in CiA 305.
    pub const TABLE: [u32; 9] = {
        let mut table = [0; 9];
        let mut i = 0;
        while i < 9 {
            table[i] = Self::FIXED[i].or_zero();
            i += 1;
        }
        table
    };

    /// In bit/s, 0 for [`BitRate::Auto`].
    #[must_use]
    pub const fn or_zero(self) -> u32 {
        match self.bits_per_second() {
            Some(rate) => rate,
            None => 0,
        }
    }

    /// All rates that a controller can be set to, from fast to slow.
    pub const FIXED: [Self; 9] = [
        Self::K1000,
        Self::K800,
        Self::K500,
        Self::K250,
        Self::K125,
        Self::K100,
        Self::K50,
        Self::K20,
        Self::K10,
    ];

    /// In bit/s; `None` for [`BitRate::Auto`].
    #[must_use]
    pub const fn bits_per_second(self) -> Option<u32> {
        Some(match self {
            Self::K1000 => 1_000_000,
            Self::K800 => 800_000,
            Self::K500 => 500_000,
            Self::K250 => 250_000,
            Self::K125 => 125_000,
            Self::K100 => 100_000,
            Self::K50 => 50_000,
            Self::K20 => 20_000,
            Self::K10 => 10_000,
            Self::Auto => return None,
        })
    }
}

/// What a listening controller has received since the last query.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Heard {
    /// Nothing.
    #[default]
    Nothing,
    /// It did not synchronise: the bus was never idle for 11 bits (ISO 11898-1).
    NeverIdle,
    /// The last event was a good frame.
    Frame,
    /// The last event was an error.
    Error,
}

/// Finds the bit rate of a bus by listening (in the manner of CiA 801): a good frame proves a rate,
/// an error disproves it.
///
/// On a bus where no other node acknowledges, the frames of a lone sender are bad even at the right
/// rate, until it is error passive and its error flags are recessive (ISO 11898-1). The search
/// tries all rates in turn, so it tries the right one again and finds it then.
#[derive(Clone, Copy, Debug)]
pub struct Detector {
    rate: BitRate,
    /// The time at which it began to listen at this rate.
    since: Instant,
}

/// Without idle bus for this time, in milliseconds, the next rate is tried. At the right rate the
/// bus is idle after each frame, and no frame takes longer than 14 ms at 10 kbit/s.
const NEVER_IDLE_MS: u32 = 50;
/// After silence of this length, in milliseconds, the next rate is tried. It is longer than the
/// period of a usual heartbeat. A controller that samples a fast bus slowly may receive nothing at
/// all.
const DWELL_MS: u32 = 1500;

impl Detector {
    /// Starts with this rate, or with the next one that the device `supports`.
    pub fn new(first: BitRate, now: Instant, supports: impl FnMut(BitRate) -> bool) -> Self {
        let rate = if first == BitRate::Auto { BitRate::K1000 } else { first };
        let mut detector = Self { rate, since: now };
        detector.settle(supports);
        detector
    }

    /// The rate to listen at.
    #[must_use]
    pub const fn rate(&self) -> BitRate {
        self.rate
    }

    /// Processes what was heard; returns whether it proves the rate. If not, [`rate`](Self::rate)
    /// may have changed.
    pub fn heard(&mut self, heard: Heard, now: Instant, supports: impl FnMut(BitRate) -> bool) -> bool {
        let go_on = match heard {
            Heard::Frame => return true,
            Heard::Error => true,
            Heard::Nothing => now.since(self.since) >= DWELL_MS,
            Heard::NeverIdle => now.since(self.since) >= NEVER_IDLE_MS,
        };
        if go_on {
            self.rate = self.rate.next();
            self.since = now;
            self.settle(supports);
        }
        false
    }

    /// Skips the rates that the device does not support. If it supports none, the rate stays.
    fn settle(&mut self, mut supports: impl FnMut(BitRate) -> bool) {
        for _ in BitRate::FIXED {
            if supports(self.rate) {
                return;
            }
            self.rate = self.rate.next();
        }
    }
}
