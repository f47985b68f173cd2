//! Exception entry and return, and faults (DDI 0403E section B1.5).

use unicorn_engine::RegisterARM;

use super::{
    Cpu, Entry, Fault, CONTROL_FPCA, CONTROL_NPRIV, CONTROL_SFPA, CONTROL_SPSEL, XPSR_IT_T_IPSR, XPSR_T,
};
use crate::cortex::exceptions::{BUS_FAULT, HARD_FAULT, NMI, SV_CALL};
use crate::cortex::scs::{cfsr, hfsr};

/// Cycles from recognition of an exception to its first instruction (PM0214 section 2.3.7).
const ENTRY_CYCLES: u64 = 12;
/// Cycles of an exception return.
const RETURN_CYCLES: u64 = 10;

const XPSR_ALIGNED: u32 = 1 << 9;

/// Words of the basic and of the extended stack frame.
const BASIC_FRAME: u32 = 8;
const EXTENDED_FRAME: u32 = 26;

impl Cpu {
    /// The exception that is to be taken now.
    #[must_use]
    pub fn deliverable(&mut self) -> Option<u16> {
        if !self.chip().slice.check_exceptions {
            return None;
        }
        let masks = self.privileged(|cpu| cpu.masks());
        self.chip().scs.exceptions.deliverable(masks)
    }

    /// Whether WFI ends.
    #[must_use]
    pub fn wakes(&mut self) -> bool {
        let masks = self.privileged(|cpu| cpu.masks());
        self.chip().scs.exceptions.wakes(masks)
    }

    /// Where the vector of `exception` is.
    #[must_use]
    pub fn vector_address(&self, exception: u16) -> u32 {
        self.chip().scs.vtor.wrapping_add(4 * u32::from(exception))
    }

    /// Enters `exception` (DDI 0403E B1.5.6), or what comes before it if that faults.
    pub fn enter_exception(&mut self, exception: u16) -> Entry {
        use RegisterARM as R;
        let thread = self.ipsr() == 0;
        let control = self.register(R::CONTROL);
        let on_psp = thread && control & CONTROL_SPSEL != 0;
        let floating = control & CONTROL_FPCA != 0;
        let words = if floating { EXTENDED_FRAME } else { BASIC_FRAME };
        let sp = self.register(R::SP);
        let aligns = self.chip().scs.aligns_stack() || floating;
        let padding = aligns && sp & 4 != 0;
        let frame = sp.wrapping_sub(4 * words).wrapping_sub(if padding { 4 } else { 0 });
        let xpsr = self.register(R::XPSR) & !XPSR_ALIGNED | if padding { XPSR_ALIGNED } else { 0 };
        let mut contents = vec![
            self.register(R::R0),
            self.register(R::R1),
            self.register(R::R2),
            self.register(R::R3),
            self.register(R::R12),
            self.register(R::LR),
            self.pc(),
            xpsr,
        ];
        if floating {
            contents.extend((0..16).map(|n| self.single(n)));
            contents.extend([self.register(R::FPSCR), 0]);
        }
        let stacked = contents
            .iter()
            .enumerate()
            .fold(true, |ok, (n, word)| self.poke(frame.wrapping_add(4 * n as u32), *word) && ok);
        let exception = if stacked { exception } else { self.stacking_failed(exception) };
        let Some((exception, handler)) = self.vector_of(exception) else { return Entry::Lockup };
        self.set(R::SP, frame);
        let return_to = match (thread, on_psp) {
            (false, _) => 0xFFFF_FFF1,
            (true, false) => 0xFFFF_FFF9,
            (true, true) => 0xFFFF_FFFD,
        } & if floating { !0x10_u32 } else { !0 };
        if control & (CONTROL_SPSEL | CONTROL_FPCA) != 0 {
            self.set_mode(control & CONTROL_NPRIV, u32::from(exception));
        }
        self.set(R::LR, return_to);
        let flags = self.register(R::XPSR) & !XPSR_IT_T_IPSR;
        let thumb = if handler & 1 != 0 { XPSR_T } else { 0 };
        self.set(R::XPSR_NZCVQG, flags | thumb | u32::from(exception));
        self.set(R::PC, handler);
        self.renew_mode();
        let chip = self.chip_mut();
        chip.scs.exceptions.enter(exception);
        chip.slice.check_exceptions = chip.scs.exceptions.any_pending();
        chip.clock.cycles += ENTRY_CYCLES;
        if let Some(count) = chip.counters.exceptions.get_mut(usize::from(exception)) {
            *count += 1;
        }
        Entry::Taken
    }

    /// The frame of `original` could not be written: that is a BusFault, which becomes pending
    /// beside it. Returns the one of the two that comes first; the stack pointer moves as if the
    /// frame were there (DDI 0403E B1.5.11, derived exceptions).
    fn stacking_failed(&mut self, original: u16) -> u16 {
        let masks = self.privileged(|cpu| cpu.masks());
        let scs = &mut self.chip_mut().scs;
        scs.cfsr |= cfsr::STKERR;
        let preempted = scs.exceptions.execution_priority(masks);
        scs.exceptions.pend(original);
        if scs.exceptions.is_enabled(BUS_FAULT) && scs.exceptions.group_priority(BUS_FAULT) < preempted {
            scs.exceptions.pend(BUS_FAULT);
        } else if preempted > -1 {
            scs.hfsr |= hfsr::FORCED;
            scs.exceptions.pend(HARD_FAULT);
        }
        scs.exceptions.first_pending().map_or(original, |(first, _)| first)
    }

    /// The vector of `exception`, or of the HardFault if it cannot be fetched, and whose it is; the
    /// exception is pending then. `None` is lockup: NMI and HardFault have nothing above them.
    fn vector_of(&mut self, exception: u16) -> Option<(u16, u32)> {
        if let Some(handler) = self.peek(self.vector_address(exception)) {
            return Some((exception, handler));
        }
        if matches!(exception, HARD_FAULT | NMI) {
            return None;
        }
        let scs = &mut self.chip_mut().scs;
        scs.hfsr |= hfsr::VECTTBL;
        scs.exceptions.pend(exception);
        Some((HARD_FAULT, self.peek(self.vector_address(HARD_FAULT))?))
    }

    /// Leaves the present exception by `value` (DDI 0403E B1.5.8); the fault that a bad value or
    /// stack leads to.
    pub fn return_from_exception(&mut self, value: u32) -> Result<(), Fault> {
        use RegisterARM as R;
        let leaving = u16::try_from(self.ipsr()).unwrap_or(0);
        let (handler, on_psp) = match value & 0xF {
            0x1 => (true, false),
            0x9 => (false, false),
            0xD => (false, true),
            _ => return Err(Fault::usage(cfsr::INVPC)),
        };
        if value | 0x1F != u32::MAX || !self.chip().scs.exceptions.is_active(leaving) {
            return Err(Fault::usage(cfsr::INVPC));
        }
        let nested = self.chip().scs.exceptions.active_count() > 1;
        if handler != nested {
            return Err(Fault::usage(cfsr::INVPC));
        }
        let floating = value & 0x10 == 0;
        let words = if floating { EXTENDED_FRAME } else { BASIC_FRAME };
        let frame = if on_psp { self.register(R::PSP) } else { self.register(R::MSP) };
        let mut contents = Vec::new();
        for n in 0..words {
            match self.peek(frame.wrapping_add(4 * n)) {
                Some(word) => contents.push(word),
                None => return Err(Fault::bus(cfsr::UNSTKERR, None)),
            }
        }
        let xpsr = contents[7];
        let back_to = xpsr & 0x1FF;
        if handler == (back_to == 0) {
            return Err(Fault::usage(cfsr::INVPC));
        }
        let npriv = self.register(R::CONTROL) & CONTROL_NPRIV;
        if leaving != NMI {
            self.set(R::FAULTMASK, 0);
        }
        let sp = frame.wrapping_add(4 * words) + if xpsr & XPSR_ALIGNED != 0 { 4 } else { 0 };
        self.set(if on_psp { R::PSP } else { R::MSP }, sp);
        for (register, word) in [R::R0, R::R1, R::R2, R::R3, R::R12, R::LR].into_iter().zip(&contents) {
            self.set(register, *word);
        }
        if floating {
            for (n, word) in (0..16).zip(&contents[8..24]) {
                self.set_single(n, *word);
            }
            self.set(R::FPSCR, contents[24]);
        }
        let control = npriv
            | if on_psp { CONTROL_SPSEL } else { 0 }
            | if floating { CONTROL_FPCA | CONTROL_SFPA } else { 0 };
        if handler && control & !CONTROL_NPRIV == 0 {
            self.set_ipsr(back_to);
        } else {
            // In thread mode SPSEL comes from the value; in a handler it is 0.
            let control = if handler { control & !CONTROL_SPSEL } else { control };
            self.set_mode(control, back_to);
        }
        self.set(R::XPSR_NZCVQG, xpsr & !XPSR_ALIGNED);
        self.set(R::PC, contents[6] & !1 | xpsr >> 24 & 1);
        self.renew_mode();
        let chip = self.chip_mut();
        chip.scs.exceptions.leave(leaving);
        chip.slice.check_exceptions = chip.scs.exceptions.any_pending();
        chip.clock.cycles += RETURN_CYCLES;
        Ok(())
    }

    fn single_register(n: i32) -> i32 {
        RegisterARM::S0 as i32 + n
    }

    fn single(&self, n: i32) -> u32 {
        self.uc.reg_read(Self::single_register(n)).unwrap_or(0) as u32
    }

    fn set_single(&mut self, n: i32, value: u32) {
        let _ = self.uc.reg_write(Self::single_register(n), u64::from(value));
    }

    /// Takes a fault: at its own priority if it is enabled and high enough, as HardFault otherwise
    /// (DDI 0403E B1.5.10).
    pub fn take_fault(&mut self, fault: Fault) -> Entry {
        let masks = self.privileged(|cpu| cpu.masks());
        let scs = &mut self.chip_mut().scs;
        let current = scs.exceptions.execution_priority(masks);
        let exception = match fault {
            Fault::Configurable { exception, status, address } => {
                scs.cfsr |= status;
                if let Some(address) = address {
                    scs.bfar = address;
                    scs.cfsr |= cfsr::BFARVALID;
                }
                let taken = scs.exceptions.is_enabled(exception)
                    && scs.exceptions.group_priority(exception) < current;
                if taken {
                    exception
                } else {
                    scs.hfsr |= hfsr::FORCED;
                    HARD_FAULT
                }
            }
            Fault::Hard(status) => {
                scs.hfsr |= status;
                HARD_FAULT
            }
        };
        if exception == HARD_FAULT && current <= -1 {
            return Entry::Lockup;
        }
        self.enter_exception(exception)
    }

    /// Carries out SVC: the call is taken if its priority allows, and is a HardFault otherwise.
    pub fn supervisor_call(&mut self) -> Entry {
        let masks = self.privileged(|cpu| cpu.masks());
        let exceptions = &self.chip().scs.exceptions;
        if exceptions.group_priority(SV_CALL) < exceptions.execution_priority(masks) {
            self.enter_exception(SV_CALL)
        } else {
            self.take_fault(Fault::Hard(hfsr::FORCED))
        }
    }
}
