//! What an attacker sees of a device: its bus, its power and its flash.

use attack::device::Action;
use canopen::Frame;

/// Something that happened on the device or on its bus.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Happened {
    /// A good frame was on the bus.
    Frame {
        /// The device sent it.
        by_device: bool,
        /// The frame.
        frame: Frame,
    },
    /// A good frame of a master was on the bus, and the device was not: it starts, or is bus-off.
    Missed(Frame),
    /// A frame was destroyed.
    Error,
    /// The device made a reset by itself.
    Reset,
    /// A reset that nothing may cause: by the watchdog, or a CPU in lock-up.
    Trouble,
    /// The power failed during an operation of the flash.
    PowerCut,
}

/// A point of time of the device's virtual time, in us, and what happened then.
pub type Event = (u64, Happened);

/// The time without power, in us.
pub const OFF_US: u64 = 5000;

/// The longest time from a request to its answer in virtual time, in us: the request, the answer, a
/// heartbeat and some emergencies of 1.1 ms each at 125 kbit/s, and two ticks of the device.
pub const ANSWER_US: u64 = 15_000;

/// A device in virtual time, on a bus with two masters.
pub trait Target {
    /// The longest time from a request to its answer, in us.
    fn answer_us(&self) -> u64 {
        ANSWER_US
    }

    /// Virtual time in us.
    fn now_us(&self) -> u64;

    /// Master 0 or 1 sends a frame as soon as the bus lets it; this does not wait.
    fn send(&mut self, master: usize, frame: &Frame);

    /// Whether all frames of the masters were on the bus.
    fn is_drained(&mut self) -> bool;

    /// Time passes.
    fn pass_us(&mut self, us: u64);

    /// What has happened since the last call.
    fn events(&mut self) -> Vec<Event>;

    /// The contents of the flash, as a debug probe reads them.
    fn flash(&mut self) -> &[u8];

    /// A number that grows with each flash operation, and whether one runs.
    fn flash_activity(&mut self) -> (u64, bool);

    /// Carries out an action below the frames, if it can: a power cut now or in the middle of a
    /// flash operation, errors on the bus, bytes on a line that are no frame. (Masters send frames.)
    fn act(&mut self, action: &Action);

    /// The masters change to this bit rate, in bit/s, on a bus that has one.
    fn set_bit_rate(&mut self, bit_rate: u32) {
        let _ = bit_rate;
    }

    /// The longest time between two feeds of its watchdog so far, in us; 0 without a watchdog.
    fn longest_between_feeds_us(&mut self) -> u64 {
        0
    }

    /// What the device did that it must not do and no rule names; `None` for nothing.
    fn complaint(&mut self) -> Option<String> {
        None
    }
}
