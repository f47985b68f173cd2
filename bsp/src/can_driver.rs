//! What bootloader and application want of a CAN controller. bxCAN and the serial line in its place do
//! it; a controller of another kind does the same (`docs/can-driver.md`).
//!
//! No function waits. An interrupt of the controller, or a timer, brings the owner here again: for a
//! received frame, and when there is room for one to send.

use canopen::{BitRate, Frame};

use crate::can::{Errors, Lost, Mode};

/// A CAN controller.
pub trait CanDriver {
    /// Leaves the bus, drops what waits to be sent, and joins at this bit rate, which is none to be
    /// detected. It takes part when it has seen 11 recessive bits. A bit rate that it has no timing for is
    /// never asked for ([`crate::line::supports`]); then nothing changes.
    fn set_bit_rate(&mut self, rate: BitRate, mode: Mode);

    /// Starts the recovery from bus-off, which takes 128 × 11 recessive bits. It must not start by
    /// itself: the slave decides when.
    fn recover_from_bus_off(&mut self);

    /// Receives the data frames with exactly these identifiers of 11 bits from now on, and no others.
    /// One may come twice. None is received before.
    fn accept<const N: usize>(&mut self, identifiers: [u16; N]);

    /// The oldest frame that was received, `None` if there is none.
    fn receive(&mut self) -> Option<Frame>;

    /// The owner had no room for a frame that it has received.
    fn record_overrun(&mut self);

    /// Whether [`send`](Self::send) may be called now.
    fn has_room(&mut self) -> bool;

    /// Sends a frame. Frames of one identifier leave in the order of the calls, and a boot-up message
    /// before everything that comes after it.
    fn send(&mut self, frame: &Frame);

    /// Whether all frames are on the bus and were acknowledged: the device may reset.
    fn is_idle(&mut self) -> bool;

    /// The state of the controller. What it has heard is what came since the previous call.
    fn errors(&mut self) -> Errors;

    /// Where frames were lost since the previous call.
    fn take_overruns(&mut self) -> Lost;
}
