//! The CAN controller as a slave sees it: error passive, bus-off, frames lost (CiA 301 section
//! 7.2.7.1, ISO 11898-1).
//!
//! A controller that went bus-off stays off until it is told to come back. It is told after a
//! while, and after a longer one each time it fails again soon: a device that disturbs its bus
//! shall not do so without end, and one that suffered from somebody else's disturbance shall be
//! back by itself.

use crate::bit_rate::Heard;
use crate::time::Instant;

/// How much the controller still trusts itself (ISO 11898-1 fault confinement).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Confinement {
    /// All is well.
    #[default]
    Active,
    /// Many errors: it no longer destroys frames of others.
    Passive,
    /// Too many: it has left the bus.
    BusOff,
}

/// What the controller tells when it is asked.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Status {
    /// Its fault confinement.
    pub confinement: Confinement,
    /// What it heard since it was last asked; matters only while it listens.
    pub heard: Heard,
    /// Frames that were lost since it was last asked, as driver status bits
    /// ([`CONTROLLER_OVERRUN`], [`QUEUE_OVERRUN`]); 0 for none.
    pub lost: u16,
}

/// Driver status: the CAN controller lost a frame (SYS TEC manual L-1112d_10, section 3.4.9).
pub const CONTROLLER_OVERRUN: u16 = 0x0020;
/// Driver status: the receive queue was full.
pub const QUEUE_OVERRUN: u16 = 0x1000;

/// What a device may want to tell of its line, by an emergency.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LineEvent {
    /// Frames were lost; with the driver status bits.
    Lost(u16),
    /// The controller became error passive.
    Passive,
    /// The controller is error active again.
    Active,
    /// The controller was off the bus and is back.
    Recovered,
}

/// First wait before a controller comes back, in milliseconds. Longer than the 128 × 11 bits that
/// coming back takes at 10 kbit/s.
const FIRST_WAIT_MS: u32 = 200;
/// The longest wait.
const LONGEST_WAIT_MS: u32 = 5000;
/// Who was on the bus for so long has recovered: the next wait is the first one again.
const RECOVERED_MS: u32 = 10_000;

/// Lost frames are told at most once in this time, in milliseconds: a flood shall not cause another
/// one.
const LOST_INHIBIT_MS: u32 = 1000;

/// Frames that were lost and have yet to be told.
#[derive(Clone, Copy, Debug, Default)]
pub struct Losses {
    status: u16,
    told: Option<Instant>,
}

impl Losses {
    /// Takes the driver status bits of frames lost, 0 for none; gives those to be told now.
    pub fn observe(&mut self, lost: u16, now: Instant) -> Option<u16> {
        self.status |= lost;
        let inhibited = self.told.is_some_and(|told| now.since(told) < LOST_INHIBIT_MS);
        if self.status == 0 || inhibited {
            return None;
        }
        self.told = Some(now);
        Some(core::mem::take(&mut self.status))
    }
}

/// Follows a controller that takes part in the bus.
#[derive(Clone, Copy, Debug)]
pub struct Monitor {
    state: State,
    /// The next wait in bus-off.
    wait_ms: u32,
}

#[derive(Clone, Copy, Debug)]
enum State {
    /// On the bus since then.
    On { passive: bool, since: Instant },
    /// Bus-off; `told` says that the controller was told to come back before.
    Off { come_back_at: Instant, told: bool },
}

/// What follows from a status.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Consequence {
    /// To be told.
    Tell(LineEvent),
    /// The controller is to come back onto the bus.
    RecoverFromBusOff,
}

impl Monitor {
    /// A controller that has just joined.
    #[must_use]
    pub const fn new(now: Instant) -> Self {
        Self { state: State::On { passive: false, since: now }, wait_ms: FIRST_WAIT_MS }
    }

    /// Takes what the controller tells.
    pub fn observe(&mut self, confinement: Confinement, now: Instant) -> Option<Consequence> {
        let is_passive = confinement == Confinement::Passive;
        match self.state {
            State::On { since, .. } if confinement == Confinement::BusOff => {
                if now.since(since) >= RECOVERED_MS {
                    self.wait_ms = FIRST_WAIT_MS;
                }
                self.state = State::Off { come_back_at: now + self.wait_ms, told: false };
                None
            }
            State::On { passive, since } if passive != is_passive => {
                self.state = State::On { passive: is_passive, since };
                Some(Consequence::Tell(if is_passive { LineEvent::Passive } else { LineEvent::Active }))
            }
            State::On { .. } => None,
            State::Off { told: true, .. } if confinement != Confinement::BusOff => {
                self.state = State::On { passive: is_passive, since: now };
                Some(Consequence::Tell(LineEvent::Recovered))
            }
            // Told again after a while: it may have come back and left again between two looks.
            State::Off { come_back_at, .. } if now.has_reached(come_back_at) => {
                self.wait_ms = (self.wait_ms * 2).min(LONGEST_WAIT_MS);
                self.state = State::Off { come_back_at: now + self.wait_ms, told: true };
                Some(Consequence::RecoverFromBusOff)
            }
            State::Off { .. } => None,
        }
    }
}
