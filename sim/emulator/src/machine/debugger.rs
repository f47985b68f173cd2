//! The control of a machine by a debugger outside the chip: halt, continue, single step,
//! breakpoints.
//!
//! A breakpoint belongs to an address, not to the code there: it stays in force in RAM that is
//! overwritten and in flash that is programmed later. The program cannot see it. While a machine is
//! halted, no virtual time passes.

use crate::cpu::{Cpu, Entry, Exit};

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
    /// A debugger takes over: the machine is halted.
    pub(super) fn attached() -> Self {
        Self { attached: true, halted: Some(Halt::Asked), ..Self::default() }
    }

    /// Halts the machine where it is.
    pub(super) fn halt(&mut self) {
        self.step = false;
        self.halted = Some(Halt::Asked);
    }

    /// The machine goes on at `pc`, or executes one instruction.
    pub(super) fn resume(&mut self, step: bool, pc: u32) {
        self.halted = None;
        self.step = step;
        self.over = Some(pc & !1);
    }

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

    /// Carries out code up to the end of the slice, or what the debugger wants of it; nothing where
    /// a breakpoint holds it up.
    pub(super) fn run_code(&mut self, cpu: &mut Cpu) -> Option<Exit> {
        let pc = cpu.pc() & !1;
        let single = self.step || self.over == Some(pc);
        if !single && cpu.chip().slice.stops.contains(&pc) {
            self.halted = Some(Halt::Breakpoint);
            return None;
        }
        let step = self.step;
        let exit = cpu.run(single);
        if single && exit != Exit::FlashBusy {
            self.moved();
        }
        match exit {
            Exit::Breakpoint if self.attached => {
                self.halted = Some(Halt::Breakpoint);
                None
            }
            // A step does not sleep.
            Exit::WaitForInterrupt | Exit::WaitForEvent if step => None,
            exit => Some(exit),
        }
    }

    /// An exception was taken: a step ends there.
    pub(super) fn note_exception(&mut self, entry: Entry) -> Entry {
        if entry == Entry::Taken && self.step {
            self.moved();
        }
        entry
    }
}
