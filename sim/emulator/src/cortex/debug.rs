//! The parts of the debug architecture that a program reaches without a debugger (DDI 0403E section
//! C1): breakpoints and patches of the FPB, the registers of the DWT's comparators, and what the
//! DebugMonitor exception needs. All of it is in the debug power domain: a reset of the core leaves it
//! (Cortex-M4 technical reference manual, "Power-on reset" and "System reset").
//!
//! **What is missing.** Patches of vectors, matches of the DWT's comparators, vector catches.

use crate::memory::PAGE;
use crate::peripheral::Unmodelled;

/// `DFSR` (C1.6): a step is done.
pub const DFSR_HALTED: u32 = 1 << 0;
/// `DFSR`: a breakpoint.
pub const DFSR_BKPT: u32 = 1 << 1;
const DFSR_MASK: u32 = 0x1F;

const DEMCR_MON_EN: u32 = 1 << 16;
const DEMCR_MON_PEND: u32 = 1 << 17;
const DEMCR_MON_STEP: u32 = 1 << 18;
const DEMCR_MON_REQ: u32 = 1 << 19;
const DEMCR_TRCENA: u32 = 1 << 24;
/// The vector catches.
const DEMCR_VC: u32 = 0x7F1;
/// The bits that a system reset clears (C1.6): all bits of the monitor. Only a power-on reset
/// clears the rest.
const DEMCR_MON: u32 = DEMCR_MON_EN | DEMCR_MON_STEP | DEMCR_MON_REQ;

const ENABLE: u32 = 1 << 0;
const FP_CTRL_KEY: u32 = 1 << 1;
/// The Cortex-M4's (its technical reference manual, FPB): six code comparators, two literal ones.
const FP_CTRL_SIZE: u32 = 0x260;
const CODE_COMPARATORS: usize = 6;
/// The comparators of the FPB.
pub const COMPARATORS: usize = 8;
/// Remapping is there: `RMPSPT`.
const FP_REMAP_SUPPORTED: u32 = 1 << 29;
const FP_REMAP_MASK: u32 = 0x1FFF_FFE0;
/// The table of the new words is in SRAM: bits 31 to 29 of its address.
const SRAM: u32 = 0x2000_0000;
/// The registers of the DWT's four comparators, COMP, MASK and FUNCTION (C1.8).
const WATCHPOINTS: std::ops::RangeInclusive<u32> = 0x20..=0x5C;
const COMP_MASK: u32 = 0x1FFF_FFFC;
const COMP_REPLACE: u32 = 0b11 << 30;

/// Breakpoints and the debug monitor.
#[derive(Clone, Debug, Default)]
pub struct Debug {
    demcr: u32,
    dfsr: u32,
    /// A word that a monitor and its debugger share.
    pub dcrdr: u32,
    enabled: bool,
    remap: u32,
    comparators: [u32; COMPARATORS],
    watchpoints: [u32; 16],
    /// DHCSR.C_DEBUGEN: only a debug probe can write it.
    pub is_attached: bool,
}

impl Debug {
    /// What a reset other than the power-on's leaves of it: breakpoints stay, the monitor is off.
    #[must_use]
    pub fn after_reset(&self) -> Self {
        Self { demcr: self.demcr & !DEMCR_MON, ..self.clone() }
    }

    /// Whether the exception is enabled.
    #[must_use]
    pub fn monitors(&self) -> bool {
        self.demcr & DEMCR_MON_EN != 0
    }

    /// Whether the exception follows the next instruction that runs below its priority.
    #[must_use]
    pub fn steps(&self) -> bool {
        self.monitors() && self.demcr & DEMCR_MON_STEP != 0
    }

    /// Records a debug event in `DFSR`.
    pub fn note(&mut self, event: u32) {
        self.dfsr |= event;
    }

    /// `DFSR`.
    #[must_use]
    pub fn read_dfsr(&self) -> u32 {
        self.dfsr
    }

    /// Writing 1 clears.
    pub fn write_dfsr(&mut self, value: u32) {
        self.dfsr &= !(value & DFSR_MASK);
    }

    /// `DEMCR`; whether the exception is pending is reported elsewhere.
    #[must_use]
    pub fn read_demcr(&self, pending: bool) -> u32 {
        self.demcr | if pending { DEMCR_MON_PEND } else { 0 }
    }

    /// Writes `DEMCR`; whether the exception is to be pending.
    pub fn write_demcr(&mut self, value: u32) -> bool {
        self.demcr = value & (DEMCR_MON | DEMCR_TRCENA | DEMCR_VC);
        value & DEMCR_MON_PEND != 0
    }

    /// The addresses at which code stops.
    pub fn breakpoints(&self) -> impl Iterator<Item = u32> + '_ {
        let active =
            self.comparators[..CODE_COMPARATORS].iter().filter(|comparator| *comparator & ENABLE != 0);
        active.filter(|_| self.enabled).flat_map(|comparator| {
            let address = comparator & COMP_MASK;
            [(1 << 30, address), (1 << 31, address | 2)]
                .into_iter()
                .filter(move |(half, _)| comparator & half != 0)
                .map(|(_, address)| address)
        })
    }

    /// The words that the FPB replaces in the page of an address, for fetches of `code` or for loads: the number
    /// of the comparator, where the word is in the page, and the address of the new one. An enabled comparator
    /// of code without a half-word is such a patch, and each of literals.
    pub fn patches(&self, address: u32, code: bool) -> impl Iterator<Item = (u32, usize, u32)> + '_ {
        let kind = if code { 0..CODE_COMPARATORS } else { CODE_COMPARATORS..COMPARATORS };
        kind.filter_map(move |n| {
            let value = self.comparators[n];
            let at = (value & COMP_MASK).wrapping_sub(address & !(PAGE - 1));
            let is_patch = self.enabled && value & ENABLE != 0 && value & COMP_REPLACE == 0 && at < PAGE;
            is_patch.then_some((n as u32, at as usize, SRAM + self.remap + 4 * n as u32))
        })
    }

    /// Reads a register of the DWT's comparators, `offset` from E000_1000.
    #[must_use]
    pub fn read_watchpoint(&self, offset: u32) -> Option<u32> {
        WATCHPOINTS.contains(&offset).then(|| self.watchpoints[(offset as usize - 0x20) / 4])
    }

    /// Writes one of them; whether it is one. Without TRCENA the write is ignored (C1.6.5 leaves it to the chip).
    pub fn write_watchpoint(&mut self, offset: u32, value: u32) -> bool {
        let is_one = WATCHPOINTS.contains(&offset);
        if is_one && self.demcr & DEMCR_TRCENA != 0 {
            self.watchpoints[(offset as usize - 0x20) / 4] = value;
        }
        is_one
    }

    /// Reads the word at `offset` from E000_2000, the FPB.
    pub fn read_fpb(&self, offset: u32) -> Result<u32, Unmodelled> {
        Ok(match offset {
            // The key reads as 0.
            0x000 => FP_CTRL_SIZE | u32::from(self.enabled),
            0x004 => FP_REMAP_SUPPORTED | self.remap,
            0x008..=0x024 => self.comparators[(offset as usize - 8) / 4],
            _ => return Err(unknown()),
        })
    }

    /// Writes the word at `offset` from E000_2000.
    pub fn write_fpb(&mut self, offset: u32, value: u32) -> Result<(), Unmodelled> {
        match offset {
            0x000 if value & FP_CTRL_KEY != 0 => self.enabled = value & ENABLE != 0,
            // Without its key the write is ignored.
            0x000 => {}
            0x004 => self.remap = value & FP_REMAP_MASK,
            0x008..=0x024 => {
                let n = (offset as usize - 8) / 4;
                let is_code = n < CODE_COMPARATORS;
                let replace = if is_code { COMP_REPLACE } else { 0 };
                self.comparators[n] = value & (replace | COMP_MASK | ENABLE);
            }
            _ => return Err(unknown()),
        }
        Ok(())
    }
}

fn unknown() -> Unmodelled {
    Unmodelled("only CTRL, REMAP and the comparators of the FPB are modelled".into())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// DDI 0403E section C1.11; the reset value is that of the Cortex-M4's manual.
    #[test]
    fn the_breakpoint_unit_has_the_registers_of_the_manual() {
        let mut debug = Debug::default();
        assert_eq!(debug.read_fpb(0x000), Ok(0x0000_0260));
        assert_eq!(debug.read_fpb(0x004), Ok(0x2000_0000));
        debug.write_fpb(0x000, 1).unwrap();
        assert_eq!(debug.read_fpb(0x000), Ok(0x0000_0260), "no key");
        debug.write_fpb(0x000, 3).unwrap();
        assert_eq!(debug.read_fpb(0x000), Ok(0x0000_0261), "the key reads as 0");
        debug.write_fpb(0x008, 0xFFFF_FFFF).unwrap();
        assert_eq!(debug.read_fpb(0x008), Ok(0xDFFF_FFFD), "bits 29 and 1 do not exist");
        // Comparator 7 is one of literals, 1 of code; the table is at 2000_0140h (C1.11.4).
        debug.write_fpb(0x004, 0x0000_015F).unwrap();
        debug.write_fpb(0x024, 0xC800_0101).unwrap();
        debug.write_fpb(0x00C, 0x0800_0FFD).unwrap();
        let patches = |at, code| debug.patches(at, code).collect::<Vec<_>>();
        assert_eq!(patches(0x0800_0200, false), [(7, 0x100, 0x2000_015C)]);
        assert_eq!(patches(0x0800_0200, true), [(1, 0xFFC, 0x2000_0144)]);
        assert_eq!(patches(0x0800_1000, true), []);
        assert!(debug.read_fpb(0x028).is_err() && debug.write_fpb(0x028, 0).is_err());
    }

    #[test]
    fn a_comparator_stops_at_the_halfwords_that_it_names() {
        let mut debug = Debug::default();
        for (n, value) in [0x4801_2345_u32, 0x8801_2349, 0xC801_234D, 0x4801_2350].into_iter().enumerate() {
            debug.write_fpb(8 + 4 * n as u32, value).unwrap();
        }
        assert_eq!(debug.breakpoints().count(), 0, "the unit is off");
        debug.write_fpb(0, 3).unwrap();
        let stops: Vec<u32> = debug.breakpoints().collect();
        assert_eq!(stops, [0x0801_2344, 0x0801_234A, 0x0801_234C, 0x0801_234E]);
    }

    #[test]
    fn a_reset_takes_the_monitor_and_leaves_the_breakpoints() {
        let mut debug = Debug::default();
        debug.write_fpb(0, 3).unwrap();
        debug.write_fpb(8, 0x4800_0201).unwrap();
        assert!(!debug.write_demcr(0x010D_0000));
        assert!(debug.write_demcr(0x0107_07FF));
        assert_eq!(debug.read_demcr(true), 0x0107_07F1);
        assert!(debug.write_watchpoint(0x28, 7) && !debug.write_watchpoint(0x60, 7));
        assert!(debug.steps());
        debug.note(DFSR_BKPT | DFSR_HALTED);
        let mut debug = debug.after_reset();
        assert_eq!(debug.read_demcr(false), 0x0100_07F1);
        assert_eq!(debug.read_watchpoint(0x28), Some(7));
        assert_eq!(debug.breakpoints().collect::<Vec<_>>(), [0x0800_0200]);
        assert_eq!(debug.read_dfsr(), 3);
        debug.write_dfsr(1);
        assert_eq!(debug.read_dfsr(), 2);
    }
}
