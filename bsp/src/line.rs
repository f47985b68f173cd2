//! Connects a CANopen slave with the board's port: it carries out the slave's outputs, and reads
//! the state of the line for it. Bootloader and application share this code.

use canopen::BitRate;

use crate::can::BitTiming;
use crate::facts::CAN_CLOCK;

/// The bit timing of the board's CAN controller for each bit rate; `None` if there is none.
pub const TIMINGS: [Option<BitTiming>; 9] = BitTiming::table(CAN_CLOCK, BitRate::TABLE);
/// Whether the board's CAN controller can run at this bit rate; true for a bit rate that must be
/// detected.
#[must_use]
pub const fn supports(rate: BitRate) -> bool {
    match rate {
        BitRate::Auto => true,
        rate => TIMINGS[rate as usize].is_some(),
    }
}

#[cfg(target_arch = "arm")]
pub use port::{carry_out, receive, status};

#[cfg(target_arch = "arm")]
mod port {
    use canopen::bit_rate::Heard;
    use canopen::line::{Confinement, Status, CONTROLLER_OVERRUN, QUEUE_OVERRUN};
    use canopen::slave::Output;
    use canopen::{BitRate, CobId, Frame};

    use super::TIMINGS;
    use crate::can::{BitTiming, Errors, Mode};
    use crate::clock::Source;
    use crate::facts::INTERNAL;
    use crate::port::CanPort;

    /// The timings while the core runs from HSI.
    const INTERNAL_TIMINGS: [Option<BitTiming>; 9] = BitTiming::table(INTERNAL.apb1_clock(), BitRate::TABLE);

    /// Empties the controller's FIFO, which holds three frames. `take` returns whether there was
    /// room for a frame; without room the frame is lost. The client repeats it after its time-out,
    /// and an emergency reports the loss.
    #[inline(always)]
    pub fn receive(can: &mut CanPort, mut take: impl FnMut(Frame) -> bool) {
        while let Some(frame) = can.receive() {
            if !take(frame) {
                can.record_overrun();
            }
        }
    }

    /// Carries out an output of the slave. Call it only when the port has room for a frame.
    #[inline(always)]
    pub fn carry_out(can: &mut CanPort, output: Output) {
        match output {
            Output::Send(frame) => can.send(&frame),
            Output::Join(rate) => configure(can, rate, Mode::Normal),
            Output::Listen(rate) => configure(can, rate, Mode::Silent),
            Output::RecoverFromBusOff => can.recover_from_bus_off(),
            Output::Accept(ids) => can.accept(ids.map(CobId::get)),
        }
    }

    fn configure(can: &mut CanPort, rate: BitRate, mode: Mode) {
        let timings = match can.clock() {
            Source::Crystal => &TIMINGS,
            Source::Internal => &INTERNAL_TIMINGS,
        };
        // No other bit rate is requested: `supports` refuses it.
        if let Some(Some(timing)) = timings.get(rate as usize) {
            can.configure(*timing, mode);
        }
    }

    /// The state of the line for the slave.
    #[inline(always)]
    pub fn status(can: &mut CanPort) -> Status {
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
            lost: u16::from(lost.in_controller) * CONTROLLER_OVERRUN
                + u16::from(lost.in_queue) * QUEUE_OVERRUN,
        }
    }
}
