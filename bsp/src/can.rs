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
    for (bank, four) in identifiers.chunks(4).enumerate() {
        // A bank lists four identifiers; a shorter row repeats its first one.
        let entry = |i| ListEntry16::data_frames_with_id(four.get(i).copied().unwrap_or(four[0]));
        filters.enable_bank(bank as u8, Fifo::Fifo0, [entry(0), entry(1), entry(2), entry(3)]);
    }
}

/// The identifier of this value; only its 11 bits count.
#[must_use]
pub fn standard_id(raw: u16) -> StandardId {
    StandardId::new(raw & 0x7FF).unwrap_or(StandardId::MAX)
}

/// The next frame from the FIFO, `None` when it is empty. An overrun is left for the caller's next round: the frames that
/// are there are still good.
pub fn receive<I: Instance, F: embedded_can::Frame>(fifo: &mut bxcan::Rx0<I>) -> Option<F> {
    loop {
        match fifo.receive() {
            Ok(frame) => return convert(&frame),
            Err(nb::Error::WouldBlock) => return None,
            Err(nb::Error::Other(bxcan::OverrunError { .. })) => {}
        }
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

/// The transmit side: mailboxes, and the one frame that may wait for them.
pub struct Transmitter<I: Instance> {
    mailboxes: bxcan::Tx<I>,
    waiting: Option<bxcan::Frame>,
}

impl<I: Instance> Transmitter<I> {
    /// Takes the mailboxes.
    pub const fn new(mailboxes: bxcan::Tx<I>) -> Self {
        Self { mailboxes, waiting: None }
    }

    /// Acknowledges the mailbox interrupt, then sends what `next` gives for as long as the mailboxes take it.
    ///
    /// Frames of one identifier leave in order: the mailboxes take the second only when the first is on its way.
    pub fn pump<F: embedded_can::Frame>(&mut self, mut next: impl FnMut() -> Option<F>) {
        self.mailboxes.clear_interrupt_flags();
        while let Some(frame) = self.waiting.take().or_else(|| next().as_ref().and_then(convert)) {
            match self.mailboxes.transmit(&frame) {
                // A frame of lower priority may have had to leave its mailbox: it goes next.
                Ok(status) => self.waiting = status.dequeued_frame().cloned(),
                Err(_) => {
                    self.waiting = Some(frame);
                    break;
                }
            }
        }
    }

    /// Whether everything given to it is on the bus and acknowledged.
    pub fn is_idle(&self) -> bool {
        self.waiting.is_none() && self.mailboxes.is_idle()
    }
}
