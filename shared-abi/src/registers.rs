//! What the ways of `reentry` read and write: which registers, in which order, and
//! their values. No instruction of the chip is here, so that all of it can be tested on a host.

use crate::reset;

/// The registers of a chip.
pub(crate) trait Registers {
    /// Reads a word.
    fn read(&mut self, register: u32) -> u32;
    /// Writes a word.
    fn write(&mut self, register: u32, value: u32);
}

/// Application interrupt and reset control register (ARMv7-M B3.2.6), and the key for writes to it.
const AIRCR: u32 = 0xE000_ED0C;
const VECTKEY: u32 = 0x05FA_0000;

/// Whether an exception is active, by the value of IPSR (ARMv7-M B1.4.2).
pub(crate) const fn in_handler(ipsr: u32) -> bool {
    ipsr & 0x1FF != 0
}

/// Requests a reset of the chip; the priority grouping stays.
pub(crate) fn request_reset(chip: &mut impl Registers) {
    const PRIGROUP: u32 = 0b111 << 8;
    const SYSRESETREQ: u32 = 1 << 2;
    let grouping = chip.read(AIRCR) & PRIGROUP;
    chip.write(AIRCR, grouping | VECTKEY | SYSRESETREQ);
}

/// How often a flag is read that has to change, before it is given up: 4 ms at 180 MHz and 8 cycles a
/// read. The slowest of them needs 0.3 ms: five periods of the LSI at 17 kHz.
const PATIENCE: u32 = 100_000;

/// Waits until the bits of `mask` read `value`; returns whether they do.
fn wait(chip: &mut impl Registers, register: u32, mask: u32, value: u32) -> bool {
    (0..PATIENCE).any(|_| chip.read(register) & mask == value)
}

/// Makes the independent watchdog run out in two counts of the LSI / 4, after the five periods that the
/// values take to get to the counter (RM0090 section 21.4): of the LSI, or behind the prescaler, as ST's HAL has it.
///
/// CCCCh starts the counter with FFFh, and only AAAAh loads RLR. The values must be there before, and may
/// be written only while no others are on their way. The waits have no bound: nothing else is left to do, and a
/// watchdog that runs bites in them, too.
pub(crate) fn start_watchdog(chip: &mut impl Registers) {
    const KR: u32 = 0x4000_3000;
    const PR: u32 = 0x4000_3004;
    const RLR: u32 = 0x4000_3008;
    const SR: u32 = 0x4000_300C;
    const PVU_AND_RVU: u32 = 0b11;
    chip.write(KR, 0xCCCC);
    while chip.read(SR) & PVU_AND_RVU != 0 {}
    for (register, value) in [(KR, 0x5555), (PR, 0), (RLR, 1)] {
        chip.write(register, value);
    }
    while chip.read(SR) & PVU_AND_RVU != 0 {}
    chip.write(KR, 0xAAAA);
}

/// Clocks, peripherals and flash interface as after a reset (RM0090 sections 3.9.1 and 7.3). Returns
/// whether they are; if a clock does not follow, only a reset helps.
#[must_use]
pub(crate) fn release_peripherals(chip: &mut impl Registers) -> bool {
    const RCC: u32 = 0x4002_3800;
    const CR: u32 = RCC;
    const PLLCFGR: u32 = RCC + 0x04;
    const CFGR: u32 = RCC + 0x08;
    const CIR: u32 = RCC + 0x0C;
    const SSCGR: u32 = RCC + 0x80;
    /// The register with the clocks of the sleep mode comes so far after that with the clocks.
    const LOW_POWER: u32 = 0x20;
    /// AHB1, AHB2, AHB3, APB1, APB2: offset of the reset register, offset of the clock register,
    /// and the clock register's value after a reset.
    const BUSES: [(u32, u32, u32); 5] = [
        (0x10, 0x30, reset::RCC_AHB1ENR),
        (0x14, 0x34, 0),
        (0x18, 0x38, 0),
        (0x20, 0x40, 0),
        (0x24, 0x44, 0),
    ];
    const FLASH_ACR: u32 = 0x4002_3C00;
    const HSION: u32 = 1;
    const HSIRDY: u32 = 1 << 1;
    const PLLRDY: u32 = 1 << 25;
    const SWS: u32 = 0b11 << 2;

    // The core must run from HSI before its previous clock source is switched off.
    let running = chip.read(CR) | HSION;
    chip.write(CR, running);
    if !wait(chip, CR, HSIRDY, HSIRDY) {
        return false;
    }
    chip.write(CFGR, 0);
    if !wait(chip, CFGR, SWS, 0) {
        return false;
    }
    chip.write(CR, reset::RCC_CR);
    if !wait(chip, CR, PLLRDY, 0) {
        return false;
    }
    chip.write(PLLCFGR, reset::RCC_PLLCFGR);
    chip.write(SSCGR, 0);
    chip.write(CIR, 0);
    for (resets, clocks, after) in BUSES {
        chip.write(RCC + resets, u32::MAX);
        chip.write(RCC + resets, 0);
        chip.write(RCC + clocks, after);
        // After a reset each bit that exists is set.
        chip.write(RCC + clocks + LOW_POWER, u32::MAX);
    }
    // The caches can only be cleared while they are disabled.
    chip.write(FLASH_ACR, 0);
    chip.write(FLASH_ACR, 0b11 << 11);
    chip.write(FLASH_ACR, 0);
    true
}

/// The core's own peripherals as after a reset (ARMv7-M B3).
pub(crate) fn release_core(chip: &mut impl Registers) {
    const SYST_CSR: u32 = 0xE000_E010;
    const SYST_CVR: u32 = 0xE000_E018;
    const NVIC_ICER: u32 = 0xE000_E180;
    const NVIC_ICPR: u32 = 0xE000_E280;
    const NVIC_IPR: u32 = 0xE000_E400;
    const ICSR: u32 = 0xE000_ED04;
    const SCR: u32 = 0xE000_ED10;
    const CCR: u32 = 0xE000_ED14;
    const SHPR: u32 = 0xE000_ED18;
    const SHCSR: u32 = 0xE000_ED24;
    const VTOR: u32 = 0xE000_ED08;
    const CPACR: u32 = 0xE000_ED88;
    const MPU_CTRL: u32 = 0xE000_ED94;
    /// The number of register words with one bit for each interrupt: an F4 has up to 112
    /// interrupts.
    const WORDS: u32 = 4;

    chip.write(SYST_CSR, 0);
    // It is unknown after a reset. From 0 the first period is as long as the others.
    chip.write(SYST_CVR, 0);
    for word in 0..WORDS {
        chip.write(NVIC_ICER + 4 * word, u32::MAX);
        chip.write(NVIC_ICPR + 4 * word, u32::MAX);
    }
    for word in 0..8 * WORDS {
        chip.write(NVIC_IPR + 4 * word, 0);
    }
    // SysTick and PendSV are no longer pending.
    chip.write(ICSR, 1 << 25 | 1 << 27);
    for register in [SHPR, SHPR + 4, SHPR + 8, SHCSR, SCR, MPU_CTRL, CPACR, VTOR] {
        chip.write(register, 0);
    }
    chip.write(CCR, 1 << 9);
    chip.write(AIRCR, VECTKEY);
}

#[cfg(test)]
mod tests;
