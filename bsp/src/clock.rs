//! The clock tree at the level of its registers (RM0090 sections 3.5 and 7; RM0390 sections 3.4 and
//! 6 say the same), for code that has to be small, and to be able to leave it as a reset does. An
//! application takes the HAL's way, [`crate::clocks`].

/// How a board makes its clocks out of its crystal.
#[derive(Clone, Copy, Debug)]
pub struct ClockTree {
    /// The crystal, in Hz.
    pub hse: u32,
    /// Whether there is a clock on OSC_IN in place of a crystal.
    pub hse_bypass: bool,
    /// Input of the PLL in Hz: 1 to 2 MHz, and a divisor of the crystal and of the 16 MHz of HSI.
    pub pll_input: u32,
    /// The PLL's multiplier, 50 to 432.
    pub pll_n: u32,
    /// The divider behind it: 2, 4, 6 or 8.
    pub pll_p: u32,
    /// Divider of APB1, to which the CAN controller belongs: 1, 2, 4, 8 or 16.
    pub apb1: u32,
    /// Divider of APB2.
    pub apb2: u32,
    /// Wait states of the flash at this clock (table 10).
    pub wait_states: u32,
}

/// What the PLL runs from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Source {
    /// The internal oscillator: there at once, to 1 %.
    Internal,
    /// The crystal: exact, after some milliseconds.
    Crystal,
}

/// What the core runs from after a reset, in Hz.
pub const HSI: u32 = 16_000_000;

impl ClockTree {
    /// The core's clock in Hz.
    #[must_use]
    pub const fn sysclk(&self) -> u32 {
        self.pll_input * self.pll_n / self.pll_p
    }

    /// The clock of APB1 in Hz.
    #[must_use]
    pub const fn apb1_clock(&self) -> u32 {
        self.sysclk() / self.apb1
    }

    /// The tree, if the chip can run with it.
    ///
    /// # Panics
    /// At compile time, with the rule that is broken (RM0090 sections 7.3.2 and 7.3.3, DS8626 table
    /// 14).
    #[must_use]
    pub const fn checked(self) -> Self {
        let vco = self.pll_input * self.pll_n;
        assert!(
            self.hse.is_multiple_of(self.pll_input) && HSI.is_multiple_of(self.pll_input),
            "board: the PLL's input must be a divisor of the crystal and of 16 MHz"
        );
        assert!(
            self.pll_input >= 1_000_000 && self.pll_input <= 2_000_000,
            "board: the PLL's input must be 1 to 2 MHz"
        );
        assert!(vco >= 100_000_000 && vco <= 432_000_000, "board: the PLL must run at 100 to 432 MHz");
        // Chips that can do 180 MHz need over-drive for more than this, which nothing here switches
        // on.
        assert!(
            self.sysclk() <= 168_000_000,
            "board: the core is too fast: 168 MHz at most, without over-drive"
        );
        assert!(
            self.apb1_clock() <= 42_000_000,
            "board: APB1 is too fast: 42 MHz at most, without over-drive"
        );
        assert!(
            self.sysclk() / self.apb2 <= 84_000_000,
            "board: APB2 is too fast: 84 MHz at most, without over-drive"
        );
        assert!(
            is_divider(self.apb1) && is_divider(self.apb2),
            "board: APB1 and APB2 are divided by 1, 2, 4, 8 or 16"
        );
        assert!(
            self.pll_p >= 2 && self.pll_p <= 8 && self.pll_p.is_multiple_of(2),
            "board: behind the PLL, the divider is 2, 4, 6 or 8"
        );
        assert!(
            self.wait_states >= (self.sysclk() - 1) / 30_000_000 && self.wait_states <= 15,
            "board: the flash needs a wait state for every 30 MHz"
        );
        self
    }
}

/// Whether a bus can be divided by this.
const fn is_divider(value: u32) -> bool {
    value <= 16 && value.is_power_of_two()
}

/// The same on the chip.
#[cfg(target_arch = "arm")]
mod registers {
    use shared_abi::reset;
    use stm32f4xx_hal::pac;

    use super::{ClockTree, Source, HSI};

    const HSEON: u32 = 1 << 16;
    const HSERDY: u32 = 1 << 17;
    const HSEBYP: u32 = 1 << 18;
    const PLLON: u32 = 1 << 24;
    const PLLRDY: u32 = 1 << 25;
    /// RCC_CFGR: what the system clock runs from, as told back.
    const SWS_PLL: u32 = 0b10 << 2;
    const SWS: u32 = 0b11 << 2;
    /// How often a crystal is looked at before it is given up: at 16 MHz and 8 cycles a look 50 ms,
    /// ten times what one takes.
    const PATIENCE: u32 = 100_000;

    impl ClockTree {
        /// Runs the core from the PLL. A crystal that does not start is done without, as long as
        /// the board has power: a device that can be reached badly is better than none.
        pub fn speed_up(&self, rcc: &pac::RCC, wanted: Source) -> Source {
            // The PLL cannot be changed over while it runs (section 7.3.2).
            if rcc.cr().read().bits() & PLLON != 0 {
                self.slow_down(rcc);
            }
            let mut source = Source::Internal;
            if wanted == Source::Crystal {
                // The bypass can be chosen only while the oscillator is off (section 7.3.1).
                if self.hse_bypass {
                    set(rcc, HSEBYP);
                }
                set(rcc, HSEON);
                if (0..PATIENCE).any(|_| rcc.cr().read().bits() & HSERDY != 0) {
                    source = Source::Crystal;
                }
            }
            let (from, bit) = match source {
                Source::Internal => (HSI, 0),
                Source::Crystal => (self.hse, 1 << 22),
            };
            let pll = (from / self.pll_input) | (self.pll_n << 6) | ((self.pll_p / 2 - 1) << 16) | bit;
            // SAFETY: a valid word of PLLCFGR, as `checked` has seen to; the reserved bits and Q
            // keep their reset values.
            rcc.pllcfgr().write(|w| unsafe { w.bits(reset::RCC_PLLCFGR & 0xFF00_0000 | pll) });
            set(rcc, PLLON);
            latency(self.wait_states);
            while rcc.cr().read().bits() & PLLRDY == 0 {}
            // SAFETY: dividers of the buses and the PLL as system clock.
            rcc.cfgr().write(|w| unsafe {
                w.bits((prescaler(self.apb1) << 10) | (prescaler(self.apb2) << 13) | 0b10)
            });
            while rcc.cfgr().read().bits() & SWS != SWS_PLL {}
            source
        }

        /// Back to the clocks as after a reset.
        pub fn slow_down(&self, rcc: &pac::RCC) {
            // SAFETY: the reset value.
            rcc.cfgr().write(|w| unsafe { w.bits(0) });
            while rcc.cfgr().read().bits() & SWS != 0 {}
            // SAFETY: the reset values; nothing runs from PLL or crystal any more.
            rcc.cr().write(|w| unsafe { w.bits(reset::RCC_CR) });
            while rcc.cr().read().bits() & PLLRDY != 0 {}
            // SAFETY: the reset value.
            rcc.pllcfgr().write(|w| unsafe { w.bits(reset::RCC_PLLCFGR) });
            latency(0);
        }
    }

    fn set(rcc: &pac::RCC, bit: u32) {
        // SAFETY: a switch of CR in addition to those that are on.
        rcc.cr().modify(|r, w| unsafe { w.bits(r.bits() | bit) });
    }

    /// Wait states of the flash; the rest of its access control stays. The new value holds once it
    /// reads back (section 3.5.1).
    fn latency(wait_states: u32) {
        // SAFETY: the access control register is this module's as far as the wait states go; the
        // flash driver does not touch them, and no other priority runs while clocks change.
        let acr = unsafe { &*pac::FLASH::ptr() }.acr();
        // SAFETY: 0 to 15.
        acr.modify(|r, w| unsafe { w.bits((r.bits() & !0xF) | wait_states) });
        while acr.read().bits() & 0xF != wait_states {}
    }

    /// The bits of PPRE1 and PPRE2.
    const fn prescaler(divider: u32) -> u32 {
        match divider {
            2 => 0b100,
            4 => 0b101,
            8 => 0b110,
            16 => 0b111,
            _ => 0,
        }
    }
}
