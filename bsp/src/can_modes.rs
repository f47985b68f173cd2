//! The operating modes of bxCAN, register by register (RM0090 section 32.4). `bxcan` waits without a bound
//! for a controller that does not follow, and goes from one mode to another through sleep, where status
//! bits stand still. Here each wait is bounded, and the order is that of the drivers in the field:
//! initialisation, bit timing, normal mode.

use core::marker::PhantomData;
use core::mem::{transmute_copy, ManuallyDrop};

use bxcan::{Can, Instance};

/// The controller's mode on the bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// It receives, acknowledges and sends.
    Normal,
    /// It only listens; it neither acknowledges nor sends error frames.
    Silent,
}

/// Offsets of the registers, in bytes (RM0090 section 32.9.5).
const MCR: usize = 0x00;
const MSR: usize = 0x04;
const TSR: usize = 0x08;
const BTR: usize = 0x1C;
/// `CAN_MCR`: initialisation is requested.
const INRQ: u32 = 1 << 0;
/// `CAN_MCR`: sleep is requested.
const SLEEP: u32 = 1 << 1;
/// `CAN_MCR`: the controller leaves bus-off without a command. Here the slave decides when.
const ABOM: u32 = 1 << 6;
/// `CAN_MCR`: FIFOs and `CAN_MCR` are as after a reset, and the controller sleeps.
const RESET: u32 = 1 << 15;
/// `CAN_MSR`: initialisation is entered.
const INAK: u32 = 1 << 0;
/// `CAN_MSR`: initialisation and sleep end with the first 11 recessive bits.
const INAK_SLAK: u32 = 0b11;
/// `CAN_TSR`: requests to drop the frames of the three mailboxes; each bit is set until that is
/// done.
const ABRQ: u32 = 1 << 7 | 1 << 15 | 1 << 23;
/// `CAN_BTR`: the controller only listens.
const SILM: u32 = 1 << 31;

/// Number of checks of a status bit before the controller is reset. Ten cycles each at 168 MHz are 30 ms:
/// a controller leaves the bus when the frame is over, and no frame takes more than 16 ms (160 bits at 10
/// kbit/s).
const PATIENCE: u32 = 500_000;

/// The same for 11 bits on an idle bus: 0.3 ms. They take 0.22 ms at 50 kbit/s; below, the next look at the
/// controller finds it.
const SOON: u32 = 5_000;

/// The registers of a controller that `bxcan` does not make public.
pub(crate) struct Modes<I>(PhantomData<I>);

impl<I: Instance> Modes<I> {
    /// Those of this controller, which has its clock. It exists once, and who has it has this, too.
    pub fn of(_: &I) -> Self {
        Self(PhantomData)
    }

    /// `bxcan`'s driver of this controller, which keeps its mode: the constructors of `bxcan` wait without a
    /// bound, at first for initialisation and then for sleep.
    pub fn driver(controller: I) -> Can<I> {
        const { assert!(size_of::<Can<I>>() == size_of::<I>(), "bxcan: a driver is more than its controller") };
        // SAFETY: the controller is the only field of bxcan's `Can`, which has its size, so it is at the
        // beginning. It moves: nothing drops the original.
        unsafe { transmute_copy(&ManuallyDrop::new(controller)) }
    }

    /// Enters initialisation (section 32.4.1). Returns false if the controller did not follow and was
    /// reset: reports exist of a busy bus on which it never does.
    pub fn initialise(&mut self) -> bool {
        let is_in = self.enter(self.read(MCR) & !SLEEP | INRQ);
        if !is_in {
            // Not every manual says that the bit timing stays.
            let timing = self.read(BTR);
            self.write(MCR, RESET);
            self.enter(INRQ);
            self.write(BTR, timing);
        }
        is_in
    }

    fn enter(&mut self, request: u32) -> bool {
        self.write(MCR, request);
        (0..PATIENCE).any(|_| self.read(MSR) & INAK_SLAK == INAK)
    }

    /// Sets the bit timing, in initialisation (section 32.7.7).
    pub fn set_bit_timing(&mut self, timing: u32, mode: Mode) {
        let silent = if mode == Mode::Silent { SILM } else { 0 };
        self.write(BTR, timing | silent);
    }

    /// Drops the frames of the mailboxes. In initialisation no frame is on its way (section 32.7.1), and
    /// the status bits follow, which they do not in sleep.
    pub fn abort_all(&mut self) {
        self.write(TSR, ABRQ);
        let _ = (0..PATIENCE).any(|_| self.read(TSR) & ABRQ == 0);
    }

    /// Leaves initialisation: the controller waits for 11 recessive bits by itself (section 32.4.2). On an
    /// idle bus they are over soon, and no frame has to wait for the next look at the controller.
    pub fn join(&mut self) {
        self.write(MCR, self.read(MCR) & !(INRQ | SLEEP | ABOM));
        let _ = (0..SOON).any(|_| self.is_on_bus());
    }

    /// Whether the controller has seen the bus idle, and takes part.
    pub fn is_on_bus(&self) -> bool {
        self.read(MSR) & INAK_SLAK == 0
    }

    /// Reads a register of control and status (section 32.9.2), at this offset in bytes.
    pub fn read(&self, offset: usize) -> u32 {
        // SAFETY: `Instance` promises the registers, and the offset is one of the constants of this file or
        // of `can.rs`; reading them has no effect.
        unsafe { I::REGISTERS.cast::<u32>().byte_add(offset).read_volatile() }
    }

    /// Writes it.
    pub fn write(&mut self, offset: usize, value: u32) {
        // SAFETY: as above; section 32.9.2 allows the values in these modes, and they are not addresses.
        unsafe { I::REGISTERS.cast::<u32>().byte_add(offset).write_volatile(value) }
    }
}

#[cfg(test)]
mod tests {
    use bxcan::RegisterBlock;

    use super::*;

    /// The words of the registers, up to the filters (RM0090 section 32.9.5).
    static mut REGISTERS: [u32; 0x200 / 4] = [0; _];

    /// A controller that enters initialisation and never sleeps.
    #[derive(Debug, PartialEq)]
    struct Restless(u64);

    // SAFETY: only one test has this controller. The registers beyond these words are those of the filters,
    // which it does not use.
    unsafe impl Instance for Restless {
        const REGISTERS: *mut RegisterBlock = &raw mut REGISTERS as *mut RegisterBlock;
    }

    #[test]
    fn a_controller_that_never_sleeps_gets_its_driver() {
        let mut modes = Modes::of(&Restless(7));
        modes.write(MSR, INAK);
        assert!(modes.initialise());
        assert_eq!(Modes::driver(Restless(7)).free(), Restless(7));
    }
}
