//! The control of a machine by a debugger outside the chip: halt, continue, single step,
//! breakpoints.
//!
//! A breakpoint belongs to an address, not to the code there: it stays in force in RAM that is
//! overwritten and in flash that is programmed later. The program cannot see it. While a machine is
//! halted, no virtual time passes.

use super::{Entry, Error, Machine, Stop};
use crate::cpu::Exit;

/// Why a machine is halted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Halt {
    /// The debugger asked for it.
    Asked,
    /// The next instruction has a breakpoint, or is one (BKPT).
    Breakpoint,
    /// The step is done.
    Stepped,
    /// The CPU has locked up.
    Lockup,
}

/// The state of the debugger's control.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Debugger {
    attached: bool,
    pub(super) halted: Option<Halt>,
    step: bool,
    /// The address at which the machine went on: a breakpoint there does not stop the CPU at once.
    over: Option<u32>,
}

impl Debugger {
    /// The chip starts anew.
    pub(super) fn restarted(&mut self) {
        self.over = None;
    }

    /// The CPU has locked up.
    pub(super) fn locked_up(&mut self) {
        if self.attached {
            self.halted = Some(Halt::Lockup);
        }
    }

    /// An instruction was carried out alone, or an exception was taken.
    fn moved(&mut self) {
        self.over = None;
        if std::mem::take(&mut self.step) {
            self.halted = Some(Halt::Stepped);
        }
    }
}

impl Machine {
    /// Halts the machine for a debugger that takes over.
    pub fn attach_debugger(&mut self) {
        self.debugger = Debugger { attached: true, halted: Some(Halt::Asked), ..Debugger::default() };
    }

    /// The debugger leaves: its breakpoints go, and the machine goes on.
    pub fn detach_debugger(&mut self) {
        self.debugger = Debugger::default();
        let chip = self.cpu.chip_mut();
        chip.stops.clear();
        chip.breakpoints_changed = true;
    }

    /// Why the machine is halted, if it is.
    #[must_use]
    pub fn halted(&self) -> Option<Halt> {
        self.debugger.halted
    }

    /// Halts the machine where it is.
    pub fn halt(&mut self) {
        self.debugger.step = false;
        self.debugger.halted = Some(Halt::Asked);
    }

    /// Lets a halted machine go on, or execute one instruction. A step over WFI does not sleep; one
    /// may end at the first instruction of an exception's handler.
    pub fn resume(&mut self, step: bool) {
        self.debugger.halted = None;
        self.debugger.step = step;
        self.debugger.over = Some(self.cpu.pc() & !1);
    }

    /// Sets or removes a breakpoint. Addresses are those that the program runs at.
    pub fn set_breakpoint(&mut self, address: u32, set: bool) {
        let chip = self.cpu.chip_mut();
        let changed = if set { chip.stops.insert(address & !1) } else { chip.stops.remove(&(address & !1)) };
        chip.breakpoints_changed |= changed;
    }

    /// r0 to r12, SP, LR, PC, xPSR.
    pub fn core_registers(&mut self) -> [u32; 17] {
        self.cpu.core_registers()
    }

    /// Sets a register, numbered as in [`Self::core_registers`]. Of xPSR, the flags alone change.
    ///
    /// # Panics
    /// For a number above 16.
    pub fn set_core_register(&mut self, number: usize, value: u32) {
        self.cpu.set_core_register(number, value);
    }

    /// Writes memory as a debug probe does: RAM, flash (without erasing it), or a register.
    ///
    /// # Errors
    /// [`Error::Address`] where nothing can be written.
    pub fn poke(&mut self, address: u32, bytes: &[u8]) -> Result<(), Error> {
        if self.write_ram(address, bytes).is_ok() || self.load_bin(address, bytes).is_ok() {
            return Ok(());
        }
        let nothing = || Error::Address { address, len: bytes.len(), wanted: "memory or registers" };
        let &[a, b, c, d] = bytes else { return Err(nothing()) };
        if !address.is_multiple_of(4) || self.register(address).is_none() {
            return Err(nothing());
        }
        let chip = self.cpu.chip_mut();
        chip.store(address, 4, u32::from_le_bytes([a, b, c, d]));
        // No instruction made these accesses.
        chip.unlocated.clear();
        Ok(())
    }

    /// The stop to report where the machine is to run and is halted.
    pub(super) fn is_held(&self) -> Option<Stop> {
        self.debugger.halted.map(|_| Stop::Halted)
    }

    /// Carries out code up to the end of the slice, or what the debugger wants of it; nothing where
    /// a breakpoint holds it up.
    pub(super) fn run_code(&mut self) -> Option<Exit> {
        let pc = self.cpu.pc() & !1;
        let single = self.debugger.step || self.debugger.over == Some(pc);
        if !single && self.cpu.chip().stops.contains(&pc) {
            self.debugger.halted = Some(Halt::Breakpoint);
            return None;
        }
        let step = self.debugger.step;
        let exit = self.cpu.run(single);
        if single && exit != Exit::FlashBusy {
            self.debugger.moved();
        }
        match exit {
            Exit::Breakpoint if self.debugger.attached => {
                self.debugger.halted = Some(Halt::Breakpoint);
                None
            }
            // A step does not sleep.
            Exit::WaitForInterrupt | Exit::WaitForEvent if step => None,
            exit => Some(exit),
        }
    }

    /// An exception was taken: a step ends there.
    pub(super) fn note_exception(&mut self, entry: Entry) -> Entry {
        if entry == Entry::Taken && self.debugger.step {
            self.debugger.moved();
        }
        entry
    }
}
