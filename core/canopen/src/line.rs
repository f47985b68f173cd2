//! State of the CAN controller: error passive, bus-off, frames lost (CiA 301 section 7.2.7.1, ISO
//! 11898-1).
//!
//! A controller in bus-off stays there until its owner starts the recovery. [`Monitor`] requests
//! this after a wait, which doubles each time the controller soon fails again. A device that
//! disturbs its bus therefore does so rarely, and a disturbed device returns by itself.

use crate::bit_rate::Heard;
use crate::time::Instant;

/// The state of fault confinement (ISO 11898-1).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Confinement {
    /// Error active: few errors.
    #[default]
    Active,
    /// Error passive: many errors; its error flags no longer destroy frames.
    Passive,
    /// Bus-off: too many errors; it takes no part in the bus.
    BusOff,
}

/// The state of the controller, as its owner reads it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Status {
    /// Its fault confinement.
    pub confinement: Confinement,
    /// What it has heard since the last query; used only while it listens.
    pub heard: Heard,
    /// The frames lost since the last query, as driver status bits ([`CONTROLLER_OVERRUN`],
    /// [`QUEUE_OVERRUN`]); 0 for none.
    pub lost: u16,
}

/// Driver status: the CAN controller lost a frame (SYS TEC manual L-1112d_10, section 3.4.9).
pub const CONTROLLER_OVERRUN: u16 = 0x0020;
/// Driver status: the receive queue was full.
pub const QUEUE_OVERRUN: u16 = 0x1000;

/// An event that a device may report by an emergency.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LineEvent {
    /// Frames were lost; with the driver status bits.
    Lost(u16),
    /// The controller became error passive.
    Passive,
    /// The controller is error active again.
    Active,
    /// The controller was bus-off and has recovered.
    Recovered,
}

/// First wait in bus-off, in milliseconds. It is longer than the 128 × 11 bits of a recovery at 10
/// kbit/s.
const FIRST_WAIT_MS: u32 = 200;
/// The longest wait, in milliseconds.
const LONGEST_WAIT_MS: u32 = 5000;
/// After this time on the bus, in milliseconds, the wait is the first one again.
const RECOVERED_MS: u32 = 10_000;

/// Lost frames are reported at most once in this time, in milliseconds: a flood of frames must not
/// cause a flood of emergencies.
const LOST_INHIBIT_MS: u32 = 1000;

/// Lost frames that must still be reported.
#[derive(Clone, Copy, Debug, Default)]
pub struct Losses {
    status: u16,
    /// The time of the last report.
    reported: Option<Instant>,
}

impl Losses {
    /// Adds the driver status bits of lost frames, 0 for none; returns the bits to report now.
    pub fn observe(&mut self, lost: u16, now: Instant) -> Option<u16> {
        self.status |= lost;
        let inhibited = self.reported.is_some_and(|reported| now.since(reported) < LOST_INHIBIT_MS);
        if self.status == 0 || inhibited {
            return None;
        }
        self.reported = Some(now);
        Some(core::mem::take(&mut self.status))
    }
}

/// Monitors a controller that takes part in the bus.
#[derive(Clone, Copy, Debug)]
pub struct Monitor {
    state: State,
    /// The next wait in bus-off.
    wait_ms: u32,
}

#[derive(Clone, Copy, Debug)]
enum State {
    /// On the bus since `since`.
    On { passive: bool, since: Instant },
    /// Bus-off; `recovering`: the owner was asked to start the recovery.
    Off { recover_at: Instant, recovering: bool },
}

/// The consequence of a status.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Consequence {
    /// The device must report this event.
    Tell(LineEvent),
    /// The owner must start the recovery from bus-off.
    RecoverFromBusOff,
}

impl Monitor {
    /// A controller that has just joined.
    #[must_use]
    pub const fn new(now: Instant) -> Self {
        Self { state: State::On { passive: false, since: now }, wait_ms: FIRST_WAIT_MS }
    }

    /// Processes the state of fault confinement; returns the consequence.
    pub fn observe(&mut self, confinement: Confinement, now: Instant) -> Option<Consequence> {
        let is_passive = confinement == Confinement::Passive;
        match self.state {
            State::On { since, .. } if confinement == Confinement::BusOff => {
                if now.since(since) >= RECOVERED_MS {
                    self.wait_ms = FIRST_WAIT_MS;
                }
                self.state = State::Off { recover_at: now + self.wait_ms, recovering: false };
                None
            }
            State::On { passive, since } if passive != is_passive => {
                self.state = State::On { passive: is_passive, since };
                Some(Consequence::Tell(if is_passive { LineEvent::Passive } else { LineEvent::Active }))
            }
            State::On { .. } => None,
            State::Off { recovering: true, .. } if confinement != Confinement::BusOff => {
                self.state = State::On { passive: is_passive, since: now };
                Some(Consequence::Tell(LineEvent::Recovered))
            }
            // The request is repeated after a wait: the controller may have recovered and failed
            // again between two calls.
            State::Off { recover_at, .. } if now.has_reached(recover_at) => {
                self.wait_ms = (self.wait_ms * 2).min(LONGEST_WAIT_MS);
                self.state = State::Off { recover_at: now + self.wait_ms, recovering: true };
                Some(Consequence::RecoverFromBusOff)
            }
            State::Off { .. } => None,
        }
    }
}
