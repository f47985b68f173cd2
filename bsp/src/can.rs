//! What every board does with its bxCAN: bit timing, filters, frames.

use bxcan::filter::ListEntry16;
use bxcan::{Can, Fifo, Instance, Interrupts, MasterInstance, StandardId};

/// A bit timing that bxCAN can be set to (RM0090 section 32.7.7).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BitTiming {
    /// Time quanta are this many clock cycles, 1–1024.
    pub prescaler: u16,
    /// Quanta from the sync segment to the sample point, 1–16.
    pub segment_1: u8,
    /// Quanta from the sample point to the end of the bit, 1–8.
    pub segment_2: u8,
}

impl BitTiming {
    /// The timing that makes `bit_rate` (bit/s) out of `clock` (Hz) exactly, with the sample point as near to 87.5 %
    /// as it gets (the point that CiA 301 recommends) and as many quanta as fit; `None` where the clock cannot make it.
    #[must_use]
    pub const fn new(clock: u32, bit_rate: u32) -> Option<Self> {
        if bit_rate == 0 || !clock.is_multiple_of(bit_rate) {
            return None;
        }
        let cycles = clock / bit_rate;
        let mut quanta = 25;
        while quanta >= 8 {
            if cycles.is_multiple_of(quanta) && cycles / quanta <= 1024 {
                // 1 quantum of sync, then the segments; 1/8 of the bit, rounded, behind the sample point.
                let segment_2 = (quanta + 4) / 8;
                let segment_1 = quanta - 1 - segment_2;
                if segment_1 <= 16 {
                    return Some(Self {
                        prescaler: (cycles / quanta) as u16,
                        segment_1: segment_1 as u8,
                        segment_2: segment_2 as u8,
                    });
                }
            }
            quanta -= 1;
        }
        None
    }

    /// The value of `CAN_BTR`; resynchronisation by up to 1 quantum.
    #[must_use]
    pub const fn register(&self) -> u32 {
        (self.prescaler as u32 - 1) | (self.segment_1 as u32 - 1) << 16 | (self.segment_2 as u32 - 1) << 20
    }
}

/// Configures the controller for one bit timing and the data frames of a few identifiers, and lets it join the bus.
///
/// Joining takes 11 recessive bits on the bus; the controller waits for them by itself and this function does not.
/// Interrupts of receive FIFO 0 and of the mailboxes are on.
///
/// # Panics
/// Never: identifiers beyond the 28 filters in pairs of 2 are not configured (and no caller has so many).
pub fn start<I>(controller: I, timing: BitTiming, identifiers: &[StandardId]) -> Can<I>
where
    I: Instance + MasterInstance + bxcan::FilterOwner,
{
    let mut can = Can::builder(controller).set_bit_timing(timing.register()).leave_disabled();
    set_filters(&mut can, identifiers);
    can.enable_interrupts(Interrupts::FIFO0_MESSAGE_PENDING | Interrupts::TRANSMIT_MAILBOX_EMPTY);
    // WouldBlock says that the bus was not idle yet; it is the controller's to wait.
    let _: nb::Result<(), _> = can.enable_non_blocking();
    can
}

/// Sets the acceptance filters to exactly these identifiers (data frames, 11 bits), all into FIFO 0.
fn set_filters<I: MasterInstance + bxcan::FilterOwner>(can: &mut Can<I>, identifiers: &[StandardId]) {
    let mut filters = can.modify_filters();
    filters.clear();
    for (bank, pair) in identifiers.chunks(2).enumerate() {
        let [first, second] = [pair[0], pair[pair.len() - 1]].map(ListEntry16::data_frames_with_id);
        filters.enable_bank(bank as u8, Fifo::Fifo0, [first, second]);
    }
}

/// The same frame in another crate's type. Both ends are checked types, so the conversion cannot fail.
#[must_use]
pub fn convert<F: embedded_can::Frame, G: embedded_can::Frame>(frame: &F) -> Option<G> {
    if frame.is_remote_frame() {
        G::new_remote(frame.id(), frame.dlc())
    } else {
        G::new(frame.id(), frame.data())
    }
}
