//! Connects a CANopen slave with a CAN controller: it carries out the slave's outputs, and reads
//! the state of the line for it. Bootloader and application share this code.

use canopen::bit_rate::Heard;
use canopen::line::{Confinement, Status, CONTROLLER_OVERRUN, QUEUE_OVERRUN};
use canopen::slave::Output;
use canopen::{BitRate, CobId, Frame};

use crate::can::{BitTiming, Errors, Mode};
use crate::can_driver::CanDriver;
use crate::clock::Source;
use crate::facts::{CAN_CLOCK, INTERNAL};

/// The bit timing of the board's CAN controller for each bit rate, as `CAN_BTR` has it; 0 if there is none.
pub const TIMINGS: [u32; 9] = BitTiming::registers(CAN_CLOCK, BitRate::TABLE);
/// The timings while the core runs from HSI.
const INTERNAL_TIMINGS: [u32; 9] = BitTiming::registers(INTERNAL.apb1_clock(), BitRate::TABLE);

/// Whether the board's CAN controller can run at this bit rate; true for a bit rate that must be
/// detected.
#[must_use]
pub const fn supports(rate: BitRate) -> bool {
    match rate {
        BitRate::Auto => true,
        rate => TIMINGS[rate as usize] != 0,
    }
}

/// The timing of a bit rate with this source of the clock. No other bit rate is requested than those
/// that the controller [`supports`].
#[inline(always)]
pub(crate) fn timing(rate: BitRate, clock: Source) -> Option<u32> {
    let timings = match clock {
        Source::Crystal => &TIMINGS,
        Source::Internal => &INTERNAL_TIMINGS,
    };
    timings.get(rate as usize).copied().filter(|register| *register != 0)
}

/// Empties the controller's FIFO, which holds three frames in bxCAN. `take` returns whether there was
/// room for a frame; without room the frame is lost. The client repeats it after its time-out,
/// and an emergency reports the loss.
#[inline(always)]
pub fn receive(can: &mut impl CanDriver, mut take: impl FnMut(Frame) -> bool) {
    while let Some(frame) = can.receive() {
        if !take(frame) {
            can.record_overrun();
        }
    }
}

/// Carries out an output of the slave. Call it only when the port has room for a frame.
#[inline(always)]
pub fn carry_out(can: &mut impl CanDriver, output: Output) {
    match output {
        Output::Send(frame) => can.send(&frame),
        Output::Join(rate) => can.set_bit_rate(rate, Mode::Normal),
        Output::Listen(rate) => can.set_bit_rate(rate, Mode::Silent),
        Output::RecoverFromBusOff => can.recover_from_bus_off(),
        Output::Accept(ids) => can.accept(ids.map(CobId::get)),
    }
}

/// The state of the line for the slave.
#[inline(always)]
pub fn status(can: &mut impl CanDriver) -> Status {
    let errors = can.errors();
    let lost = can.take_overruns();
    Status {
        confinement: match errors {
            Errors { off: true, .. } => Confinement::BusOff,
            Errors { passive: true, .. } => Confinement::Passive,
            _ => Confinement::Active,
        },
        heard: match errors {
            Errors { joined: false, .. } => Heard::NeverIdle,
            Errors { last: None, .. } => Heard::Nothing,
            Errors { last: Some(Ok(())), .. } => Heard::Frame,
            Errors { last: Some(Err(())), .. } => Heard::Error,
        },
        lost: u16::from(lost.in_controller) * CONTROLLER_OVERRUN + u16::from(lost.in_queue) * QUEUE_OVERRUN,
    }
}
