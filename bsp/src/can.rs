//! The bxCAN driver for all boards: bit timing, filters, frames, and the state of the controller
//! (RM0090 section 32).

use bxcan::{Can, Data, Instance, Interrupts, RegisterBlock, StandardId};
use embedded_can::Frame;
pub use shared_abi::bit_timing::BitTiming;
use shared_abi::bxcan::receive;

pub use crate::can_modes::Mode;
use crate::can_modes::Modes;
use crate::clock::Source;

/// The controller's error state (`CAN_ESR` and `CAN_MSR`, RM0090 section 32.9.2).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Errors {
    /// Bus-off.
    pub off: bool,
    /// Error passive.
    pub passive: bool,
    /// The controller has seen the bus idle since it was configured, and takes part.
    pub joined: bool,
    /// The result of the last frame since the previous call: `None` without a frame, otherwise
    /// whether it was good.
    pub last: Option<Result<(), ()>>,
}

/// Offsets of registers, in bytes (RM0090 section 32.9.5).
const RF0R: usize = 0x0C;
const ESR: usize = 0x18;
/// `CAN_RF0R`: a frame was lost because the FIFO was full; writing 1 clears it.
const FOVR0: u32 = 1 << 4;
const EPVF: u32 = 1 << 1;
const BOFF: u32 = 1 << 2;
/// The last error code: only software writes 7; 0 is a good frame, and the state after a reset.
const LEC: u32 = 7 << 4;

/// Offsets of the filter registers. The master has the filters for itself and for the slave.
const FMR: usize = 0x200;
const FM1R: usize = 0x204;
const FS1R: usize = 0x20C;
const FFA1R: usize = 0x214;
const FA1R: usize = 0x21C;
const F0R1: usize = 0x240;
/// `CAN_FMR`: the filters are being set; meanwhile nothing is received.
const FINIT: u32 = 1 << 0;

/// A controller and the place of its acceptance filters (RM0090 section 32.7.4).
///
/// # Safety
/// `MASTER` must be the base of the registers of the controller that has the filters, and that
/// controller must have its clock. The owner of this controller must own its part of the filters,
/// too.
pub unsafe trait Controller: Instance {
    /// The master of the two controllers: this one or the other one.
    const MASTER: *mut RegisterBlock;
    /// Whether this controller is the slave: it has the filter banks from `CAN_FMR.CAN2SB` on; the
    /// master has those below.
    const IS_SLAVE: bool;
}

/// A bxCAN controller and one frame that may wait for a mailbox.
pub struct Port<I: Controller> {
    can: Can<I>,
    modes: Modes<I>,
    /// The source of the controller's clock.
    clock: Source,
    /// The last error code was 7 since the bit timing was set: what it says now has been heard since.
    listens: bool,
    waiting: Option<bxcan::Frame>,
    /// If a frame waits, it is a heartbeat: it waits for the one before, on a bus that is full
    /// with frames of higher priority. It must not hold up an answer, which takes its place.
    heartbeat_waits: bool,
    /// A boot-up is waiting; no frame may overtake it, whatever its priority.
    boot_up: bool,
    lost: Lost,
}

/// Base of the COB-ID of boot-up (CiA 301 section 7.2.8.3.3); the node-ID is added, and the state
/// is 0.
const BOOT_UP: u16 = 0x700;

/// The places where frames were lost.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Lost {
    /// In the controller: its FIFO was full.
    pub in_controller: bool,
    /// In software: the receiver of frames from the FIFO had no room.
    pub in_queue: bool,
}

impl<I: Controller> Port<I> {
    /// Takes the controller, and the source of its clock. It receives and sends nothing before
    /// [`configure`](Self::configure) and [`accept`](Self::accept). Interrupts of receive FIFO 0 and of
    /// the mailboxes are on.
    pub fn new(controller: I, clock: Source) -> Self {
        let mut modes = Modes::of(&controller);
        modes.initialise();
        let can = Modes::driver(controller);
        let (waiting, lost) = (None, Lost::default());
        let mut port =
            Self { can, modes, clock, listens: false, waiting, heartbeat_waits: false, boot_up: false, lost };
        port.enable_interrupts();
        port
    }

    fn enable_interrupts(&mut self) {
        self.can.enable_interrupts(Interrupts::FIFO0_MESSAGE_PENDING | Interrupts::TRANSMIT_MAILBOX_EMPTY);
    }

    /// The source of the controller's clock.
    pub fn clock(&self) -> Source {
        self.clock
    }

    /// Sets bit timing and mode, and joins the bus with empty mailboxes.
    ///
    /// Joining takes 11 recessive bits on the bus. The controller waits for them by itself.
    pub fn configure(&mut self, timing: u32, mode: Mode) {
        self.leave_bus();
        self.waiting = None;
        self.modes.set_bit_timing(timing, mode);
        self.modes.abort_all();
        self.listens = self.forget_last_error();
        self.modes.join();
    }

    /// Starts the recovery from bus-off: it ends when the bus was idle for 128 × 11 bits.
    pub fn recover_from_bus_off(&mut self) {
        self.leave_bus();
        self.modes.join();
    }

    /// Enters initialisation. A controller that had to be reset for it may have lost frames.
    fn leave_bus(&mut self) {
        if !self.modes.initialise() {
            self.lost.in_controller = true;
            self.enable_interrupts();
        }
    }

    /// Sets the acceptance filters to exactly these identifiers (data frames, 11 bits), all into
    /// FIFO 0: 1 to 56 of them, in 14 banks. The other controller's filters stay as they are.
    pub fn accept<const N: usize>(&mut self, identifiers: [u16; N]) {
        const { assert!(N > 0 && N <= 56, "CAN: 1 to 56 identifiers, in 14 filter banks") };
        let change = |offset: usize, clear: u32, set: u32| {
            // SAFETY: the offset is one of a register above, in the registers of the master. Only
            // the bits of this controller change, which this port owns.
            unsafe {
                let register = I::MASTER.cast::<u32>().byte_add(offset);
                let before = register.read_volatile();
                register.write_volatile(before & !clear | set);
                before
            }
        };
        let border = change(FMR, 0, FINIT) >> 8 & 31;
        let from_border = u32::MAX << border;
        let (first, share) = if I::IS_SLAVE { (border, from_border) } else { (0, !from_border) };
        change(FA1R, share, 0);
        // A list of four identifiers of 16 bits in each bank; one of them may appear twice. STID is
        // at 15:5, and RTR and IDE are clear.
        let banks = ((1 << N.div_ceil(4)) - 1) << first;
        change(FM1R, 0, banks);
        change(FS1R, banks, 0);
        change(FFA1R, banks, 0);
        let pair = |low: u16, high: u16| u32::from(low) << 5 | u32::from(high) << 21;
        for bank in 0..N.div_ceil(4) {
            // By place, and not by chunk: this loop is none where there are four identifiers.
            let id = |n: usize| *identifiers.get(4 * bank + n).unwrap_or(&identifiers[0]);
            let words = F0R1 + 8 * (first as usize + bank);
            change(words, u32::MAX, pair(id(0), id(1)));
            change(words + 4, u32::MAX, pair(id(2), id(3)));
        }
        change(FA1R, 0, banks);
        change(FMR, FINIT, 0);
    }

    /// The next frame from the FIFO, `None` when it is empty. The filters pass only data frames with
    /// identifiers of 11 bits. (A frame of `bxcan` is not read: with a data length code above 8 it panics.)
    pub fn receive<F: Frame>(&mut self) -> Option<F> {
        // SAFETY: `Instance` promises the registers, and this port has the controller.
        let frame = unsafe { receive(I::REGISTERS.cast()) }?;
        F::new(embedded_can::StandardId::new(frame.id())?, frame.data())
    }

    /// Records that the receiver of frames had no room for one.
    pub fn record_overrun(&mut self) {
        self.lost.in_queue = true;
    }

    /// Acknowledges the mailbox interrupt and moves a waiting frame into a mailbox. Returns whether
    /// there is room for another frame now.
    pub fn has_room(&mut self) -> bool {
        self.can.clear_tx_interrupt();
        self.put_waiting();
        self.boot_up &= self.waiting.is_some() || !self.can.is_transmitter_idle();
        (self.waiting.is_none() || self.heartbeat_waits) && !self.boot_up
    }

    /// Sends a data frame with an identifier of 11 bits. Call it only when there is room; otherwise
    /// a waiting frame would be lost.
    ///
    /// Frames of one identifier leave in order: the mailboxes take the second only when the first
    /// is on its way.
    pub fn send<F: Frame>(&mut self, frame: &F) {
        let (embedded_can::Id::Standard(id), Some(data)) = (frame.id(), Data::new(frame.data())) else {
            return;
        };
        self.heartbeat_waits = id.as_raw() & 0x780 == BOOT_UP;
        self.boot_up = self.heartbeat_waits && data[..] == [0];
        let id = StandardId::new(id.as_raw()).unwrap_or(StandardId::MAX);
        self.waiting = Some(bxcan::Frame::new_data(id, data));
        self.put_waiting();
    }

    /// Moves the waiting frame, if any, into a mailbox if one is free and the controller is on the bus.
    fn put_waiting(&mut self) {
        if !self.modes.is_on_bus() {
            return;
        }
        if let Some(Ok(status)) = self.waiting.as_ref().map(|frame| self.can.transmit(frame)) {
            // A frame of lower priority may have been removed from its mailbox: it is sent next.
            self.waiting = status.dequeued_frame().cloned();
        }
    }

    /// Whether all frames are on the bus and acknowledged.
    pub fn is_idle(&mut self) -> bool {
        // A caller that only polls this must acknowledge the interrupt, too: otherwise it would
        // come again and again.
        self.can.clear_tx_interrupt();
        self.waiting.is_none() && self.can.is_transmitter_idle()
    }

    /// Reads the controller's error state.
    pub fn errors(&mut self) -> Errors {
        let status = self.modes.read(ESR);
        let last = match status & LEC {
            _ if !self.listens => None,
            LEC => None,
            0 => Some(Ok(())),
            _ => Some(Err(())),
        };
        self.listens |= self.forget_last_error();
        let joined = self.modes.is_on_bus();
        Errors { off: status & BOFF != 0, passive: status & EPVF != 0, joined, last }
    }

    /// Sets the last error code to "none"; returns whether it is.
    fn forget_last_error(&mut self) -> bool {
        self.modes.write(ESR, LEC);
        self.modes.read(ESR) & LEC == LEC
    }

    /// The places where frames were lost since the previous call.
    pub fn take_overruns(&mut self) -> Lost {
        if self.modes.read(RF0R) & FOVR0 != 0 {
            self.modes.write(RF0R, FOVR0);
            self.lost.in_controller = true;
        }
        core::mem::take(&mut self.lost)
    }
}
