//! The clock tree in the registers of the chip (RM0090 section 7).

use cortex_m::peripheral::SCB;
use shared_abi::reset;
use stm32f4xx_hal::pac;

use crate::clock::{ClockTree, Source};
use crate::facts::{CHIP, CLOCK_TREE, INTERNAL, SYSCLK};
use crate::functions::{each_10_ms, HAS_EACH_10_MS};

const HSEON: u32 = 1 << 16;
const HSERDY: u32 = 1 << 17;
const HSEBYP: u32 = 1 << 18;
/// The clock security system.
const CSSON: u32 = 1 << 19;
const PLLON: u32 = 1 << 24;
const PLLRDY: u32 = 1 << 25;
/// RCC_PLLCFGR: the PLL's input is the crystal.
const PLLSRC_HSE: u32 = 1 << 22;
/// RCC_CFGR: the system clock in use, as the chip reports it.
const SWS_PLL: u32 = 0b10 << 2;
const SWS: u32 = 0b11 << 2;
/// Number of checks of a crystal, of the PLL or of the regulator before it is given up: at 16 MHz and
/// 5 to 8 cycles a check this is 47 to 75 ms, ten times the start-up time of a crystal.
const PATIENCE: u32 = 150_000;

impl Source {
    /// The clock tree with this source.
    #[must_use]
    pub const fn tree(self) -> &'static ClockTree {
        match self {
            Self::Internal => &INTERNAL,
            Self::Crystal => &CLOCK_TREE,
        }
    }

    /// Runs the core from the PLL with this source, and returns the source: if the crystal does not start,
    /// or the PLL does not lock to it, that is the internal oscillator, until the next reset.
    pub fn speed_up(self, rcc: &pac::RCC) -> Self {
        // The PLL cannot be changed while it runs (section 7.3.2).
        if rcc.cr().read().bits() & PLLON != 0 {
            slow_down(rcc);
        }
        let tree = self.tree();
        if self == Self::Crystal && !start_crystal(rcc) {
            return Self::Internal.speed_up(rcc);
        }
        let pll = match self {
            Self::Internal => const { pllcfgr(&INTERNAL, 0) },
            Self::Crystal => const { pllcfgr(&CLOCK_TREE, PLLSRC_HSE) },
        };
        // SAFETY: a valid word of PLLCFGR, which `checked` ensures.
        rcc.pllcfgr().write(|w| unsafe { w.bits(pll) });
        // An application that jumped may have spread the clock, which CAN needs exact (section 7.3.23).
        rcc.sscgr().reset();
        raise_voltage(rcc);
        set(rcc, PLLON);
        latency(tree.wait_states);
        if !reaches(rcc.cr().as_ptr(), PLLRDY, PLLRDY) {
            if self == Self::Crystal {
                // A crystal at another frequency, for one.
                return Self::Internal.speed_up(rcc);
            }
            SCB::sys_reset();
        }
        await_voltage();
        // The buses are divided before the clock rises.
        let dividers = (prescaler(tree.apb1) << 10) | (prescaler(tree.apb2) << 13);
        // SAFETY: valid dividers of the buses.
        rcc.cfgr().write(|w| unsafe { w.bits(dividers) });
        // SAFETY: the same, and the PLL as system clock.
        rcc.cfgr().write(|w| unsafe { w.bits(dividers | 0b10) });
        wait(rcc.cfgr().as_ptr(), SWS, SWS_PLL);
        self
    }
}

/// RCC_PLLCFGR for a tree; the reserved bits and R keep their reset values.
const fn pllcfgr(tree: &ClockTree, source: u32) -> u32 {
    let (m, p, q) = (tree.hse / tree.pll_input, tree.pll_p / 2 - 1, tree.pll_q());
    reset::RCC_PLLCFGR & 0xF000_0000 | q << 24 | source | p << 16 | tree.pll_n << 6 | m
}

/// Switches the crystal on. Returns whether it runs before it is given up. One that fails later is an NMI, with the
/// core on HSI (section 7.2.7); without that a PLL would go on at a few MHz, with wrong bit times on the bus.
pub(crate) fn start_crystal(rcc: &pac::RCC) -> bool {
    // The bypass can be selected only while the oscillator is off (section 7.3.1).
    if CLOCK_TREE.hse_bypass {
        set(rcc, HSEBYP);
    }
    set(rcc, HSEON);
    let runs = reaches(rcc.cr().as_ptr(), HSERDY, HSERDY);
    if runs {
        set(rcc, CSSON);
    }
    runs
}

/// Restores the clocks of the reset state.
pub fn slow_down(rcc: &pac::RCC) {
    // SAFETY: the reset value.
    rcc.cfgr().write(|w| unsafe { w.bits(0) });
    wait(rcc.cfgr().as_ptr(), SWS, 0);
    // SAFETY: the reset values; nothing uses the PLL or the crystal any more.
    rcc.cr().write(|w| unsafe { w.bits(reset::RCC_CR) });
    wait(rcc.cr().as_ptr(), PLLRDY, 0);
    // SAFETY: the reset value.
    rcc.pllcfgr().write(|w| unsafe { w.bits(reset::RCC_PLLCFGR) });
    lower_voltage(rcc);
    latency(0);
}

/// Whether the core is faster than the regulator's scale after a reset allows.
const NEEDS_SCALE_1: bool = SYSCLK > CHIP.line.limits().sysclk_after_reset;
/// PWR_CR.VOS of the STM32F412, F413 and F423: scale 1, and scale 2 of the reset state. It
/// takes effect with the PLL, which must be off when it is written (RM0402 and RM0430, PWR_CR).
const VOS: u32 = 0b11 << 14;
const VOS_SCALE_2: u32 = 0b10 << 14;
const PWREN: u32 = 1 << 28;

/// Raises the regulator to scale 1, if the board needs that. The PLL must be off.
pub(crate) fn raise_voltage(rcc: &pac::RCC) {
    if NEEDS_SCALE_1 {
        voltage(rcc, VOS);
    }
}

/// Waits until the regulator has reached its scale; that happens when the PLL runs. The core must not
/// run faster than the scale allows.
fn await_voltage() {
    /// PWR_CSR.
    const VOSRDY: u32 = 1 << 14;
    if NEEDS_SCALE_1 {
        // SAFETY: only its address is taken.
        wait(unsafe { pac::PWR::steal() }.csr().as_ptr(), VOSRDY, VOSRDY);
    }
}

/// Waits until the chip has done what it was told. If it never does, it is reset: a clock or a supply
/// that was too weak can be better after it, and nothing hangs.
fn wait(register: *const u32, bits: u32, value: u32) {
    if !reaches(register, bits, value) {
        SCB::sys_reset();
    }
}

/// Whether bits of a register have a value before they are given up.
fn reaches(register: *const u32, bits: u32, value: u32) -> bool {
    /// Checks between two calls of the board's function: 5 to 8 ms at 16 MHz.
    const PART: u32 = 15_000;
    // SAFETY: the callers pass registers of RCC, PWR and FLASH; reading them has no effect.
    let is_there = |_| unsafe { register.read_volatile() } & bits == value;
    if !HAS_EACH_10_MS {
        return (0..PATIENCE).any(is_there);
    }
    (0..PATIENCE / PART).any(|_| {
        (0..PART).any(is_there) || {
            each_10_ms();
            false
        }
    })
}

/// Restores the regulator's reset state. The PLL must be off.
fn lower_voltage(rcc: &pac::RCC) {
    if NEEDS_SCALE_1 {
        voltage(rcc, VOS_SCALE_2);
        // SAFETY: the power controller's clock is off after a reset.
        rcc.apb1enr().modify(|r, w| unsafe { w.bits(r.bits() & !PWREN) });
    }
}

fn voltage(rcc: &pac::RCC, scale: u32) {
    // SAFETY: it enables the clock of the power controller and leaves the others on.
    rcc.apb1enr().modify(|r, w| unsafe { w.bits(r.bits() | PWREN) });
    // The first access comes two cycles after the clock: reading back takes that long (ES0305 and
    // ES0287, delay after an RCC peripheral clock enabling).
    let _ = rcc.apb1enr().read();
    // SAFETY: nothing else uses it; only the scale in its register is written.
    let pwr = unsafe { pac::PWR::steal() };
    // SAFETY: a scale that the line has (1 or 2); the other bits stay.
    pwr.cr().modify(|r, w| unsafe { w.bits(r.bits() & !VOS | scale) });
}

fn set(rcc: &pac::RCC, bit: u32) {
    // SAFETY: it sets a bit of CR and leaves the others set.
    rcc.cr().modify(|r, w| unsafe { w.bits(r.bits() | bit) });
}

/// Sets the wait states of the flash; the rest of its access control stays. The new value is
/// valid when it reads back (section 3.5.1).
fn latency(wait_states: u32) {
    // SAFETY: this module owns the wait states in the access control register; the flash driver
    // does not change them, and no other priority runs while clocks change.
    let acr = unsafe { &*pac::FLASH::ptr() }.acr();
    // SAFETY: 0 to 15.
    acr.modify(|r, w| unsafe { w.bits((r.bits() & !0xF) | wait_states) });
    wait(acr.as_ptr(), 0xF, wait_states);
}

/// The code of a divider in PPRE1 and PPRE2.
const fn prescaler(divider: u32) -> u32 {
    match divider {
        2 => 0b100,
        4 => 0b101,
        8 => 0b110,
        16 => 0b111,
        _ => 0,
    }
}
