//! Between a CANopen slave and the board's port: what the slave says is done, and what it wants to
//! know of its line is read. Bootloader and application have this in common.

use canopen::BitRate;

use crate::can::BitTiming;
use crate::CAN_CLOCK;

/// How the board's CAN controller makes each bit rate.
pub const TIMINGS: [Option<BitTiming>; 9] = BitTiming::table(CAN_CLOCK, BitRate::TABLE);

/// Whether the board's CAN controller can run at this bit rate; at one that it has to find out, it
/// can.
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
    use crate::can::{Errors, Mode};
    use crate::CanPort;

    /// Empties the controller's FIFO, which is three frames deep. `take` gives whether there was room
    /// for a frame: a frame without is lost. The client's time-out repeats it, and an emergency tells.
    #[inline(always)]
    pub fn receive(can: &mut CanPort, mut take: impl FnMut(Frame) -> bool) {
        while let Some(frame) = can.receive() {
            if !take(frame) {
                can.record_overrun();
            }
        }
    }

    /// Does what the slave says. To be called only when the port has room for a frame.
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
        // Another rate is asked for by nobody: `supports` says so.
        if let Some(Some(timing)) = TIMINGS.get(rate as usize) {
            can.configure(*timing, mode);
        }
    }

    /// What the slave wants to know of its line.
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
