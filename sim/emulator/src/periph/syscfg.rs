//! System configuration controller (RM0090 section 9).

use crate::peripheral::{unmodelled, Peripheral, Unmodelled};
use crate::time::Time;

/// SYSCFG_MEMRMP.
const MEM_MODE: u32 = 0b111;
/// Of chips with two banks.
const UFB_MODE: u32 = 1 << 8;

/// SYSCFG: memory remap, the EXTI multiplexers, the compensation cell.
#[derive(Clone, Debug, Default)]
pub struct Syscfg {
    memrmp: u32,
    pmc: u32,
    exticr: [u32; 4],
    cmpcr: u32,
}

impl Syscfg {
    /// Whether the system memory is at address 0, in place of the flash (section 9.2.1).
    #[must_use]
    pub fn maps_system_memory(&self) -> bool {
        self.memrmp & MEM_MODE == 1
    }

    /// The boot pins, or BFB2, have chosen the system memory.
    pub fn boot_from_system_memory(&mut self) {
        self.memrmp = 1;
    }

    /// UFB_MODE: whether the second bank of the flash is in the place of the first (section 9.3.1).
    #[must_use]
    pub fn swaps_banks(&self) -> bool {
        self.memrmp & UFB_MODE != 0
    }

    /// Sets UFB_MODE.
    pub fn swap_banks(&mut self, swap: bool) {
        self.memrmp = self.memrmp & !UFB_MODE | if swap { UFB_MODE } else { 0 };
    }

    /// The port whose pin an EXTI line from 0 to 15 follows; 0 is port A (section 9.2.3).
    #[must_use]
    pub fn port_of(&self, line: u8) -> usize {
        (self.exticr[usize::from(line / 4 % 4)] >> (4 * u32::from(line % 4)) & 0xF) as usize
    }
}

impl Peripheral for Syscfg {
    fn name(&self) -> &'static str {
        "SYSCFG"
    }

    fn read(&mut self, offset: u32, _now: Time) -> Result<u32, Unmodelled> {
        Ok(match offset {
            0x00 => self.memrmp,
            0x04 => self.pmc,
            0x08..=0x14 => self.exticr[(offset as usize - 8) / 4],
            // READY follows at once when the cell is powered.
            0x20 => self.cmpcr | self.cmpcr << 8,
            _ => return unmodelled("SYSCFG has no such register"),
        })
    }

    fn write(&mut self, offset: u32, value: u32, _now: Time) -> Result<(), Unmodelled> {
        match offset {
            0x00 if value & 7 < 2 => self.memrmp = value & (1 | UFB_MODE),
            0x00 => {
                return unmodelled(
                    "memory remap (SYSCFG_MEMRMP) to RAM or external memory: address 0 stays as it is",
                )
            }
            0x04 => self.pmc = value & 1 << 23,
            0x08..=0x14 => self.exticr[(offset as usize - 8) / 4] = value & 0xFFFF,
            0x20 => self.cmpcr = value & 1,
            _ => return unmodelled("SYSCFG has no such register"),
        }
        Ok(())
    }

    fn reset(&mut self) {
        *self = Self::default();
    }
}
