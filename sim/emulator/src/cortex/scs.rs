//! The system control space: NVIC and SCB registers (PM0214 sections 4.3 and 4.4), SysTick's
//! registers, the FPU's access control (section 4.6), and the cycle counter of the DWT.

use super::debug::Debug;
use super::exceptions::{
    Exceptions, LineSet, Masks, BUS_FAULT, DEBUG_MONITOR, FIRST_LINE, HARD_FAULT, MEM_MANAGE, NMI, PEND_SV,
    SV_CALL, SYS_TICK, USAGE_FAULT,
};
use super::systick::SysTick;
use crate::peripheral::{unmodelled, Unmodelled};
use crate::time::Time;

/// CFSR bits (PM0214 section 4.4.10 and following).
pub mod cfsr {
    /// MemManage: instruction access violation.
    pub const IACCVIOL: u32 = 1 << 0;
    /// BusFault: instruction fetch.
    pub const IBUSERR: u32 = 1 << 8;
    /// BusFault: data access whose instruction the stacked PC names.
    pub const PRECISERR: u32 = 1 << 9;
    /// BusFault: data access that was on its way when the CPU had gone on.
    pub const IMPRECISERR: u32 = 1 << 10;
    /// BusFault on unstacking.
    pub const UNSTKERR: u32 = 1 << 11;
    /// BusFault on stacking.
    pub const STKERR: u32 = 1 << 12;
    /// BFAR holds the address.
    pub const BFARVALID: u32 = 1 << 15;
    /// UsageFault: undefined instruction.
    pub const UNDEFINSTR: u32 = 1 << 16;
    /// UsageFault: Thumb bit clear.
    pub const INVSTATE: u32 = 1 << 17;
    /// UsageFault: bad EXC_RETURN.
    pub const INVPC: u32 = 1 << 18;
    /// UsageFault: coprocessor (FPU) access denied.
    pub const NOCP: u32 = 1 << 19;
    /// UsageFault: unaligned access.
    pub const UNALIGNED: u32 = 1 << 24;
    /// UsageFault: division by zero.
    pub const DIVBYZERO: u32 = 1 << 25;
}

/// HFSR bits (PM0214 section 4.4.14).
pub mod hfsr {
    /// Bus error on a vector fetch.
    pub const VECTTBL: u32 = 1 << 1;
    /// A fault that could not be taken at its own priority.
    pub const FORCED: u32 = 1 << 30;
    /// A debug event without a debugger: BKPT.
    pub const DEBUGEVT: u32 = 1 << 31;
}

/// What the bits of CFSR and HFSR say, for people to read: in the order of the registers.
const CAUSES: [(bool, u32, &str); 14] = [
    (false, cfsr::IACCVIOL, "code in a place that is never executable"),
    (false, cfsr::IBUSERR, "code where nothing is"),
    (false, cfsr::PRECISERR, "a load or store where nothing is"),
    (false, cfsr::IMPRECISERR, "a store where nothing is"),
    (false, cfsr::UNSTKERR, "a stack outside the RAM on the return of an exception"),
    (false, cfsr::STKERR, "a stack outside the RAM on the entry of an exception"),
    (false, cfsr::UNDEFINSTR, "an undefined instruction"),
    (false, cfsr::INVSTATE, "a branch to an even address"),
    (false, cfsr::INVPC, "a wrong EXC_RETURN"),
    (false, cfsr::NOCP, "an FPU instruction while the FPU is off"),
    (false, cfsr::UNALIGNED, "an unaligned access"),
    (false, cfsr::DIVBYZERO, "a division by zero"),
    (true, hfsr::VECTTBL, "a vector table outside the memory"),
    (true, hfsr::DEBUGEVT, "a breakpoint without a debugger"),
];

/// The cause of faults, from CFSR, HFSR and BFAR, in words.
#[must_use]
pub fn cause(cfsr: u32, hfsr: u32, bfar: u32) -> String {
    let is_set = |&&(is_hard, bit, _): &&(bool, u32, &str)| bit & if is_hard { hfsr } else { cfsr } != 0;
    let words: Vec<&str> = CAUSES.iter().filter(is_set).map(|&(.., words)| words).collect();
    let words = if words.is_empty() { "a fault in the handler of a fault".into() } else { words.join(", ") };
    if cfsr & self::cfsr::BFARVALID != 0 {
        format!("{words} ({bfar:08X}h)")
    } else {
        words
    }
}

const AIRCR_KEY: u32 = 0x05FA << 16;
const AIRCR_KEY_READ: u32 = 0xFA05 << 16;
const AIRCR_SYSRESETREQ: u32 = 1 << 2;
const AIRCR_PRIGROUP: u32 = 7 << 8;
const SCR_SLEEPDEEP: u32 = 1 << 2;
const SCR_MASK: u32 = 0b1_0110;
const CCR_MASK: u32 = 0x31B;
const CCR_UNALIGN_TRP: u32 = 1 << 3;
const CCR_DIV_0_TRP: u32 = 1 << 4;
/// BFHFNMIGN.
const CCR_IGNORES: u32 = 1 << 8;
/// ACTLR: DISMCYCINT, DISDEFWBUF, DISFOLD, DISFPCA, DISOOFP (PM0214 section 4.4.1).
const ACTLR_MASK: u32 = 0x307;
/// DISDEFWBUF: no write buffer, so that every bus fault of a store is precise.
const ACTLR_UNBUFFERED: u32 = 1 << 1;
/// STKALIGN is set by reset on the r0p1 core of the STM32F4.
const CCR_RESET: u32 = 1 << 9;
const CPACR_MASK: u32 = 0xF << 20;
const FPCCR_RESET: u32 = 0xC000_0000;

/// The action that a write requires of the machine.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Effect {
    /// Nothing.
    None,
    /// AIRCR.SYSRESETREQ.
    SystemReset,
    /// What the FPU allows may have changed.
    FpuAccess,
    /// Whether code runs step by step may have changed.
    Stepping,
    /// The traps of CCR may have changed.
    Traps,
}

/// The traps of CCR that are set.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Traps {
    /// DIV_0_TRP.
    pub division: bool,
    /// UNALIGN_TRP.
    pub unaligned: bool,
}

impl Traps {
    /// Whether any is set.
    #[must_use]
    pub fn any(self) -> bool {
        self.division || self.unaligned
    }
}

/// The effect of a store that the bus refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RefusedStore {
    /// The store went through the write buffer and the CPU has gone on: the fault is imprecise and
    /// pending.
    Pended,
    /// The fault is precise, and only BFSR and BFAR show it.
    Ignored,
    /// The fault is precise, and taken at the store.
    Taken,
}

/// The registers from E000_E000 to E000_EFFF.
#[derive(Clone, Debug)]
pub struct Scs {
    /// Exceptions and their priorities.
    pub exceptions: Exceptions,
    /// The system timer.
    pub systick: SysTick,
    /// Vector table offset.
    pub vtor: u32,
    /// Configurable fault status: sticky bits of [`cfsr`].
    pub cfsr: u32,
    /// HardFault status: sticky bits of [`hfsr`].
    pub hfsr: u32,
    /// Address of the last precise bus fault.
    pub bfar: u32,
    /// Breakpoints and the debug monitor.
    pub debug: Debug,
    actlr: u32,
    scr: u32,
    ccr: u32,
    cpacr: u32,
    mmfar: u32,
    fpccr: u32,
    fpcar: u32,
    fpdscr: u32,
    dwt_ctrl: u32,
    /// CYCCNT = cycles - this.
    cyccnt_base: u64,
    /// The active exception, as IPSR has it; the CPU keeps it up to date.
    pub ipsr: u16,
}

impl Scs {
    /// As after reset, with `lines` interrupt lines, a core clock of `hclk` Hz and this value of SysTick.
    #[must_use]
    pub fn new(lines: u16, hclk: u64, systick_value: u32) -> Self {
        Self {
            exceptions: Exceptions::new(lines),
            systick: SysTick::new(hclk, systick_value),
            vtor: 0,
            cfsr: 0,
            hfsr: 0,
            bfar: 0,
            debug: Debug::default(),
            actlr: 0,
            scr: 0,
            ccr: CCR_RESET,
            cpacr: 0,
            mmfar: 0,
            fpccr: FPCCR_RESET,
            fpcar: 0,
            fpdscr: 0,
            dwt_ctrl: 0,
            cyccnt_base: 0,
            ipsr: 0,
        }
    }

    /// Whether the FPU may be used (CPACR, CP10 and CP11; privileged access suffices, our code is
    /// privileged).
    #[must_use]
    pub fn fpu_enabled(&self) -> bool {
        self.cpacr >> 20 & 0b101 == 0b101
    }

    /// SCR.SLEEPONEXIT.
    #[must_use]
    pub fn sleeps_on_exit(&self) -> bool {
        self.scr & 1 << 1 != 0
    }

    /// CCR.DIV_0_TRP and CCR.UNALIGN_TRP.
    #[must_use]
    pub fn traps(&self) -> Traps {
        Traps { division: self.ccr & CCR_DIV_0_TRP != 0, unaligned: self.ccr & CCR_UNALIGN_TRP != 0 }
    }

    /// CCR.STKALIGN.
    #[must_use]
    pub fn aligns_stack(&self) -> bool {
        self.ccr & CCR_RESET != 0
    }

    /// A store to `address` came back with a bus error.
    ///
    /// As a rule it went through the write buffer (the peripherals are Device memory, whose stores
    /// are buffered), so that the fault is imprecise: asynchronous, pending until the priority of
    /// the code that runs lets it in, as BusFault if that is enabled and as HardFault if not. It
    /// does not lock the core up, and BFHFNMIGN does not stop it: that bit is about precise faults
    /// (DDI 0403E B3.2.8; PM0214 section 4.4.7 is silent about which). With ACTLR.DISDEFWBUF the
    /// fault is precise, and code at priority -1 (FAULTMASK) or -2 goes on after the store if
    /// BFHFNMIGN is set.
    pub fn refuse_store(&mut self, address: u32, masks: Masks) -> RefusedStore {
        if self.actlr & ACTLR_UNBUFFERED == 0 {
            self.cfsr |= cfsr::IMPRECISERR;
            if self.exceptions.is_enabled(BUS_FAULT) {
                self.exceptions.pend(BUS_FAULT);
            } else {
                self.hfsr |= hfsr::FORCED;
                self.exceptions.pend(HARD_FAULT);
            }
            return RefusedStore::Pended;
        }
        if self.ccr & CCR_IGNORES == 0 || self.exceptions.execution_priority(masks) >= 0 {
            return RefusedStore::Taken;
        }
        self.cfsr |= cfsr::PRECISERR | cfsr::BFARVALID;
        self.bfar = address;
        RefusedStore::Ignored
    }

    /// SCR.SLEEPDEEP, for the caller to see at WFI.
    #[must_use]
    pub fn sleeps_deeply(&self) -> bool {
        self.scr & SCR_SLEEPDEEP != 0
    }

    /// Reads the word at `offset` from E000_E000.
    pub fn read(&mut self, offset: u32, now: Time) -> Result<u32, Unmodelled> {
        let row = offset & 0x7F;
        Ok(match offset {
            // Number of lines in groups of 32, less one.
            0x004 => u32::from((self.exceptions.count() - FIRST_LINE).div_ceil(32)) - 1,
            0x008 => self.actlr,
            0x010 => self.systick.read_csr(),
            0x014 => self.systick.read_reload(),
            0x018 => self.systick.read_value(now),
            // SYST_CALIB: TENMS is 18750 (1 ms at 150 MHz / 8), NOREF 0, SKEW 1 (PM0214 section 4.5.4).
            0x01C => 0x4000_493E,
            0x100..=0x13C | 0x180..=0x1BC => self.exceptions.lines(LineSet::Enabled, row / 4),
            0x200..=0x23C | 0x280..=0x2BC => self.exceptions.lines(LineSet::Pending, row / 4),
            0x300..=0x33C => self.exceptions.lines(LineSet::Active, row / 4),
            0x400..=0x4EC => self.priorities(FIRST_LINE + line_of(offset - 0x400)),
            0xD00 => 0x410F_C241,
            0xD04 => self.icsr(),
            0xD08 => self.vtor,
            0xD0C => AIRCR_KEY_READ | u32::from(self.exceptions.prigroup) << 8,
            0xD10 => self.scr,
            0xD14 => self.ccr,
            0xD18..=0xD20 => self.priorities(4 + line_of(offset - 0xD18)),
            0xD24 => self.shcsr(),
            0xD28 => self.cfsr,
            0xD2C => self.hfsr,
            0xD30 => self.debug.read_dfsr(),
            0xD3C => 0,
            0xD34 => self.mmfar,
            0xD38 => self.bfar,
            // Processor features: Thumb-2, two-stack programmers' model.
            0xD40 => 0x0000_0030,
            0xD44 => 0x0000_0200,
            0xD48 => 0x0010_0000,
            0xD4C | 0xD54 | 0xD5C => 0,
            0xD50 => 0x0010_0030,
            0xD58 => 0x0100_0000,
            0xD60 => 0x0110_1110,
            0xD64 => 0x0211_2000,
            0xD68 => 0x2123_2231,
            0xD6C => 0x0111_1131,
            0xD70 => 0x0131_0132,
            0xD88 => self.cpacr,
            // MPU_TYPE says eight regions; MPU_CTRL says off.
            0xD90 => 0x0000_0800,
            0xD94 => 0,
            // DHCSR.C_DEBUGEN.
            0xDF0 => u32::from(self.debug.is_attached),
            0xDF8 => self.debug.dcrdr,
            0xDFC => self.debug.read_demcr(self.exceptions.is_pending(DEBUG_MONITOR)),
            0xF34 => self.fpccr,
            0xF38 => self.fpcar,
            0xF3C => self.fpdscr,
            0xF40 => 0x1011_0021,
            0xF44 => 0x1100_0011,
            _ => return Err(unknown(offset)),
        })
    }

    /// Writes the word at `offset` from E000_E000.
    pub fn write(&mut self, offset: u32, value: u32, now: Time) -> Result<Effect, Unmodelled> {
        let row = offset & 0x7F;
        match offset {
            0x008 => self.actlr = value & ACTLR_MASK,
            0x010 => self.systick.write_csr(value, now),
            0x014 => self.systick.write_reload(value, now),
            0x018 => self.systick.write_value(now),
            0x100..=0x13C => self.each_line(row / 4, value, |e, n| e.set_enabled(n, true)),
            0x180..=0x1BC => self.each_line(row / 4, value, |e, n| e.set_enabled(n, false)),
            0x200..=0x23C => self.each_line(row / 4, value, Exceptions::pend),
            0x280..=0x2BC => self.each_line(row / 4, value, Exceptions::unpend),
            // IABR is read-only.
            0x300..=0x33C => {}
            0x400..=0x4EC => self.set_priorities(FIRST_LINE + line_of(offset - 0x400), value),
            0xD04 => self.write_icsr(value),
            // The F4's table is aligned to 512 bytes at least; the bits below do not exist.
            0xD08 => self.vtor = value & 0xFFFF_FE00,
            0xD0C => return self.write_aircr(value),
            0xD10 => self.scr = value & SCR_MASK,
            0xD14 => {
                self.ccr = value & CCR_MASK;
                return Ok(Effect::Traps);
            }
            0xD18..=0xD20 => self.set_priorities(4 + line_of(offset - 0xD18), value),
            0xD24 => self.write_shcsr(value),
            0xD28 => self.cfsr &= !value,
            0xD2C => self.hfsr &= !value,
            0xD30 => self.debug.write_dfsr(value),
            0xD3C => {}
            0xD34 => self.mmfar = value,
            0xD38 => self.bfar = value,
            0xD88 => {
                self.cpacr = value & CPACR_MASK;
                return Ok(Effect::FpuAccess);
            }
            0xD94 if value == 0 => {}
            0xD94 => return unmodelled("the MPU is switched on; it is not modelled"),
            0xDF8 => self.debug.dcrdr = value,
            0xDFC => {
                if self.debug.write_demcr(value) {
                    self.exceptions.pend(DEBUG_MONITOR);
                } else {
                    self.exceptions.unpend(DEBUG_MONITOR);
                }
                self.exceptions.set_enabled(DEBUG_MONITOR, self.debug.monitors());
                return Ok(Effect::Stepping);
            }
            0xF00 => self.exceptions.pend(FIRST_LINE + u16::try_from(value & 0x1FF).unwrap_or(0)),
            // Lazy stacking is not visible to a program: the whole frame is stacked at once.
            0xF34 => self.fpccr = value & FPCCR_RESET,
            0xF38 => self.fpcar = value & !7,
            0xF3C => self.fpdscr = value & 0x07C0_0000,
            _ => return Err(unknown(offset)),
        }
        Ok(Effect::None)
    }

    /// Reads the word at `offset` from E000_1000, the DWT; `cycles` is the CPU's cycle count.
    pub fn read_dwt(&self, offset: u32, cycles: u64) -> Result<u32, Unmodelled> {
        match offset {
            // Four comparators; profiling counters are not there.
            0x000 => Ok(0x4000_0000 | self.dwt_ctrl),
            0x004 => Ok(self.cyccnt(cycles)),
            _ => self.debug.read_watchpoint(offset).ok_or_else(unknown_dwt),
        }
    }

    /// Writes the word at `offset` from E000_1000.
    pub fn write_dwt(&mut self, offset: u32, value: u32, cycles: u64) -> Result<(), Unmodelled> {
        match offset {
            0x000 => {
                let count = self.cyccnt(cycles);
                self.dwt_ctrl = value & 1;
                self.set_cyccnt(count, cycles);
                Ok(())
            }
            0x004 => {
                self.set_cyccnt(value, cycles);
                Ok(())
            }
            // The lock access register: nothing is locked for the CPU.
            0xFB0 => Ok(()),
            _ => self.debug.write_watchpoint(offset, value).then_some(()).ok_or_else(unknown_dwt),
        }
    }

    #[allow(clippy::cast_possible_truncation)] // a 32-bit counter wraps
    fn cyccnt(&self, cycles: u64) -> u32 {
        if self.dwt_ctrl & 1 != 0 {
            cycles.wrapping_sub(self.cyccnt_base) as u32
        } else {
            self.cyccnt_base as u32
        }
    }

    fn set_cyccnt(&mut self, count: u32, cycles: u64) {
        let count = u64::from(count);
        self.cyccnt_base = if self.dwt_ctrl & 1 != 0 { cycles.wrapping_sub(count) } else { count };
    }

    fn each_line(&mut self, word: u32, bits: u32, act: impl Fn(&mut Exceptions, u16)) {
        for bit in (0..32).filter(|bit| bits & 1 << bit != 0) {
            act(&mut self.exceptions, FIRST_LINE + u16::try_from(32 * word + bit).unwrap_or(u16::MAX / 2));
        }
    }

    fn priorities(&self, first: u16) -> u32 {
        u32::from_le_bytes([0, 1, 2, 3].map(|i| self.exceptions.priority(first + i)))
    }

    fn set_priorities(&mut self, first: u16, value: u32) {
        for (number, priority) in (first..).zip(value.to_le_bytes()) {
            self.exceptions.set_priority(number, priority);
        }
    }

    fn icsr(&self) -> u32 {
        let flag = |number, bit: u32| u32::from(self.exceptions.is_pending(number)) << bit;
        let first = self.exceptions.first_pending().map_or(0, |(number, _)| u32::from(number));
        let lines_pending = (0..4).any(|word| self.exceptions.lines(LineSet::Pending, word) != 0);
        u32::from(self.ipsr)
            | u32::from(self.exceptions.active_count() <= 1) << 11
            | first << 12
            | u32::from(lines_pending) << 22
            | flag(SYS_TICK, 26)
            | flag(PEND_SV, 28)
            | flag(NMI, 31)
    }

    fn write_icsr(&mut self, value: u32) {
        let set = |bit: u32| value & 1 << bit != 0;
        if set(25) {
            self.exceptions.unpend(SYS_TICK);
        }
        if set(26) {
            self.exceptions.pend(SYS_TICK);
        }
        if set(27) {
            self.exceptions.unpend(PEND_SV);
        }
        if set(28) {
            self.exceptions.pend(PEND_SV);
        }
        if set(31) {
            self.exceptions.pend(NMI);
        }
    }

    fn write_aircr(&mut self, value: u32) -> Result<Effect, Unmodelled> {
        if value & 0xFFFF_0000 != AIRCR_KEY {
            return unmodelled("AIRCR is written without its key 05FAh: the core ignores it");
        }
        self.exceptions.prigroup = u8::try_from((value & AIRCR_PRIGROUP) >> 8).unwrap_or(0);
        Ok(if value & AIRCR_SYSRESETREQ != 0 { Effect::SystemReset } else { Effect::None })
    }

    /// The bits of SHCSR: (bit, exception, what of it).
    const SHCSR_ACTIVE: [(u32, u16); 7] = [
        (0, MEM_MANAGE),
        (1, BUS_FAULT),
        (3, USAGE_FAULT),
        (7, SV_CALL),
        (8, DEBUG_MONITOR),
        (10, PEND_SV),
        (11, SYS_TICK),
    ];
    const SHCSR_PENDING: [(u32, u16); 4] =
        [(12, USAGE_FAULT), (13, MEM_MANAGE), (14, BUS_FAULT), (15, SV_CALL)];
    const SHCSR_ENABLED: [(u32, u16); 3] = [(16, MEM_MANAGE), (17, BUS_FAULT), (18, USAGE_FAULT)];

    fn shcsr(&self) -> u32 {
        let gather = |bits: &[(u32, u16)], has: fn(&Exceptions, u16) -> bool| {
            bits.iter().fold(0, |word, &(bit, number)| word | u32::from(has(&self.exceptions, number)) << bit)
        };
        gather(&Self::SHCSR_ACTIVE, Exceptions::is_active)
            | gather(&Self::SHCSR_PENDING, Exceptions::is_pending)
            | gather(&Self::SHCSR_ENABLED, Exceptions::is_enabled)
    }

    fn write_shcsr(&mut self, value: u32) {
        for (bit, number) in Self::SHCSR_ACTIVE {
            self.exceptions.set_active(number, value & 1 << bit != 0);
        }
        for (bit, number) in Self::SHCSR_PENDING {
            if value & 1 << bit != 0 {
                self.exceptions.pend(number);
            } else {
                self.exceptions.unpend(number);
            }
        }
        for (bit, number) in Self::SHCSR_ENABLED {
            self.exceptions.set_enabled(number, value & 1 << bit != 0);
        }
    }
}

fn line_of(offset: u32) -> u16 {
    u16::try_from(offset & !3).unwrap_or(0)
}

fn unknown_dwt() -> Unmodelled {
    Unmodelled("only CTRL, CYCCNT and the comparators of the DWT are modelled".into())
}

fn unknown(offset: u32) -> Unmodelled {
    Unmodelled(format!("the core has no modelled register at E000_{:04X}h", 0xE000 + offset))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scs() -> Scs {
        Scs::new(82, 16_000_000, 0)
    }

    #[test]
    fn set_and_clear_enable_reach_the_same_line() {
        let mut scs = scs();
        scs.write(0x100, 1 << 20, Time(0)).unwrap();
        assert!(scs.exceptions.is_enabled(36));
        assert_eq!(scs.read(0x180, Time(0)), Ok(1 << 20));
        scs.write(0x180, 1 << 20, Time(0)).unwrap();
        assert_eq!(scs.read(0x100, Time(0)), Ok(0));
        scs.write(0x108, 1 << 17, Time(0)).unwrap();
        assert!(scs.exceptions.is_enabled(16 + 81));
        scs.write(0x108, 1 << 18, Time(0)).unwrap();
        assert_eq!(scs.read(0x108, Time(0)), Ok(1 << 17), "line 82 does not exist");
    }

    /// IPR5 holds lines 20 to 23; only the upper half of each byte exists.
    #[test]
    fn priorities_are_bytes_with_four_bits() {
        let mut scs = scs();
        scs.write(0x414, 0x4321_FF5A, Time(0)).unwrap();
        assert_eq!(scs.read(0x414, Time(0)), Ok(0x4020_F050));
        assert_eq!(scs.exceptions.priority(16 + 20), 0x50);
        scs.write(0xD20, 0xE0D0_0000, Time(0)).unwrap();
        assert_eq!((scs.exceptions.priority(PEND_SV), scs.exceptions.priority(SYS_TICK)), (0xD0, 0xE0));
    }

    #[test]
    fn aircr_wants_its_key() {
        let mut scs = scs();
        assert!(scs.write(0xD0C, AIRCR_SYSRESETREQ, Time(0)).is_err());
        assert_eq!(scs.write(0xD0C, 0x05FA_0304, Time(0)), Ok(Effect::SystemReset));
        assert_eq!(scs.read(0xD0C, Time(0)), Ok(0xFA05_0300));
    }

    #[test]
    fn icsr_pends_and_shows() {
        let mut scs = scs();
        scs.write(0xD04, 1 << 28 | 1 << 26, Time(0)).unwrap();
        assert_eq!(scs.read(0xD04, Time(0)).unwrap() & 0x143F_F000, 1 << 28 | 1 << 26 | 14 << 12);
        scs.write(0xD04, 1 << 27 | 1 << 25, Time(0)).unwrap();
        assert_eq!(scs.read(0xD04, Time(0)).unwrap() & 0x143F_F000, 0);
    }

    #[test]
    fn the_cycle_counter_counts_when_enabled_and_stands_otherwise() {
        let mut scs = scs();
        assert_eq!(scs.read_dwt(4, 1_000), Ok(0));
        scs.write_dwt(4, 5, 1_000).unwrap();
        scs.write_dwt(0, 1, 2_000).unwrap();
        assert_eq!(scs.read_dwt(4, 2_100), Ok(105));
        scs.write_dwt(0, 0, 2_200).unwrap();
        assert_eq!(scs.read_dwt(4, 9_999), Ok(205));
        scs.write_dwt(4, u32::MAX, 0).unwrap();
        scs.write_dwt(0, 1, 0).unwrap();
        assert_eq!(scs.read_dwt(4, 1), Ok(0), "32 bits wrap");
    }

    #[test]
    fn fault_status_bits_are_cleared_by_writing_one() {
        let mut scs = scs();
        scs.cfsr = cfsr::UNDEFINSTR | cfsr::NOCP;
        scs.write(0xD28, cfsr::NOCP, Time(0)).unwrap();
        assert_eq!(scs.cfsr, cfsr::UNDEFINSTR);
    }
}
