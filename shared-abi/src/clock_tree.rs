//! The clock tree of a board, and the rules that it follows on its chip (RM0090 sections 3.5 and 7; RM0390
//! sections 3.4 and 6 say the same).

use crate::bit_timing::BitTiming;
use crate::geometry::Limits;

/// How a board makes its clocks from its crystal.
#[derive(Clone, Copy, Debug)]
pub struct ClockTree {
    /// The crystal, in Hz.
    pub hse: u32,
    /// Whether OSC_IN has a clock instead of a crystal.
    pub hse_bypass: bool,
    /// Input of the PLL in Hz: 1 to 2 MHz; it must divide the crystal and the 16 MHz of HSI.
    pub pll_input: u32,
    /// The PLL's multiplier, 50 to 432.
    pub pll_n: u32,
    /// The PLL's output divider: 2, 4, 6 or 8.
    pub pll_p: u32,
    /// Divider of APB1, which clocks the CAN controller: 1, 2, 4, 8 or 16.
    pub apb1: u32,
    /// Divider of APB2.
    pub apb2: u32,
    /// Wait states of the flash at this clock and the board's supply (RM0090 table 11, RM0402, RM0430).
    pub wait_states: u32,
}

/// The PLL runs at no more than this, in Hz (RM0090 section 7.3.2).
const FASTEST_VCO: u32 = 432_000_000;

/// The core's clock after a reset, in Hz.
pub const HSI: u32 = 16_000_000;

impl ClockTree {
    /// The tree with HSI in place of the crystal. The core is as fast as it may be when HSI is 5 % too fast,
    /// and the CAN controller can be set to the same of these bit rates (in bit/s).
    ///
    /// # Panics
    /// At compile time, if there is none.
    #[must_use]
    pub const fn internal(self, limits: &Limits, bit_rates: &[u32]) -> Self {
        let mut internal = Self { hse: HSI, ..self };
        while !internal.is_within(limits) || !internal.makes_those_of(&self, bit_rates) {
            assert!(internal.pll_n > 50, "board: with HSI the PLL cannot make the bit rates of the crystal");
            internal.pll_n -= 1;
        }
        internal
    }

    /// The PLL's own frequency in Hz.
    const fn vco(&self) -> u32 {
        self.pll_input * self.pll_n
    }

    /// Whether the clocks are within these limits, and the flash has enough wait states for them, when their source is
    /// 5 % too fast.
    const fn is_within(&self, limits: &Limits) -> bool {
        let fastest = self.sysclk() / 20 * 21;
        fastest <= limits.sysclk
            && fastest / self.apb1 <= limits.apb1
            && fastest / self.apb2 <= limits.apb2
            && (fastest - 1) / limits.per_wait_state <= self.wait_states
            && self.vco() / 20 * 21 <= FASTEST_VCO
    }

    /// Whether the CAN controller can be set to each of these bit rates to which it can be set with the other tree.
    const fn makes_those_of(&self, other: &Self, rates: &[u32]) -> bool {
        let mut i = 0;
        while i < rates.len() {
            let has = BitTiming::new(self.apb1_clock(), rates[i]).is_some();
            if !has && BitTiming::new(other.apb1_clock(), rates[i]).is_some() {
                return false;
            }
            i += 1;
        }
        true
    }

    /// The core's clock in Hz.
    #[must_use]
    pub const fn sysclk(&self) -> u32 {
        self.vco() / self.pll_p
    }

    /// The PLL's second output divider, 3 to 9: the clock for USB, SDIO and RNG is at most 48 MHz, also while
    /// nothing uses it (DS8626, main PLL characteristics: 75 MHz at most, which HSI does not exceed either).
    #[must_use]
    pub const fn pll_q(&self) -> u32 {
        self.vco().div_ceil(48_000_000)
    }

    /// The clock of APB1 in Hz.
    #[must_use]
    pub const fn apb1_clock(&self) -> u32 {
        self.sysclk() / self.apb1
    }

    /// Returns the tree if a chip with these limits can run with it.
    ///
    /// # Panics
    /// At compile time, with the message of the broken rule.
    #[must_use]
    pub const fn checked(self, limits: &Limits) -> Self {
        match self.check(limits) {
            Ok(()) => self,
            Err(rule) => panic!("{}", rule),
        }
    }

    /// Whether a chip with these limits can run with the tree.
    ///
    /// # Errors
    /// The broken rule, in words (RM0090 sections 7.3.2 and 7.3.3; DS8626 tables 38 and 39;
    /// [`Line::limits`](crate::geometry::Line::limits)).
    pub const fn check(&self, limits: &Limits) -> Result<(), &'static str> {
        let (lowest, highest) =
            if self.hse_bypass { (1_000_000, 50_000_000) } else { (4_000_000, 26_000_000) };
        if self.hse < lowest || self.hse > highest {
            return Err(if self.hse_bypass {
                "board: a clock on OSC_IN (hse_bypass) has 1 to 50 MHz"
            } else {
                "board: hse must be a crystal of 4 to 26 MHz; a board without one cannot have coboot: HSI is \
                 too inexact for CAN"
            });
        }
        if self.pll_input == 0
            || !self.hse.is_multiple_of(self.pll_input)
            || !HSI.is_multiple_of(self.pll_input)
        {
            return Err("board: the PLL's input must be a divisor of the crystal and of 16 MHz");
        }
        if self.pll_input < 1_000_000 || self.pll_input > 2_000_000 {
            return Err("board: the PLL's input must be 1 to 2 MHz");
        }
        if self.hse / self.pll_input < 2 || self.hse / self.pll_input > 63 {
            return Err("board: the crystal is divided by 2 to 63 for the PLL (PLLM)");
        }
        if self.pll_n < 50 || self.pll_n > 432 {
            return Err("board: the PLL's multiplier must be 50 to 432");
        }
        if self.vco() < 100_000_000 || self.vco() > FASTEST_VCO {
            return Err("board: the PLL must run at 100 to 432 MHz");
        }
        if !is_divider(self.apb1) || !is_divider(self.apb2) {
            return Err("board: APB1 and APB2 are divided by 1, 2, 4, 8 or 16");
        }
        if self.pll_p < 2 || self.pll_p > 8 || !self.pll_p.is_multiple_of(2) {
            return Err("board: after the PLL, the divider is 2, 4, 6 or 8");
        }
        let is_slow = limits.sysclk <= 100_000_000;
        if self.sysclk() > limits.sysclk {
            return Err(if is_slow {
                "board: the core is too fast: 100 MHz at most on this chip"
            } else if limits.sysclk == 160_000_000 {
                "board: the core is too fast: 160 MHz at most at this supply (supply_mv)"
            } else {
                "board: the core is too fast: 168 MHz at most, without over-drive"
            });
        }
        if self.apb1_clock() > limits.apb1 {
            return Err(if is_slow {
                "board: APB1 is too fast: 50 MHz at most on this chip"
            } else {
                "board: APB1 is too fast: 42 MHz at most, without over-drive"
            });
        }
        if self.sysclk() / self.apb2 > limits.apb2 {
            return Err(if is_slow {
                "board: APB2 is too fast: 100 MHz at most on this chip"
            } else {
                "board: APB2 is too fast: 84 MHz at most, without over-drive"
            });
        }
        if self.wait_states < (self.sysclk() - 1) / limits.per_wait_state || self.wait_states > 15 {
            return Err(match limits.per_wait_state / 1_000_000 {
                30 => "board: the flash needs a wait state for every 30 MHz",
                25 => "board: the flash of this chip needs a wait state for every 25 MHz",
                24 => "board: at this supply (supply_mv) the flash needs a wait state for every 24 MHz",
                22 => "board: at this supply (supply_mv) the flash needs a wait state for every 22 MHz",
                20 => "board: at this supply (supply_mv) the flash needs a wait state for every 20 MHz",
                18 => "board: at this supply (supply_mv) the flash needs a wait state for every 18 MHz",
                _ => "board: at this supply (supply_mv) the flash needs a wait state for every 16 MHz",
            });
        }
        Ok(())
    }
}

/// Whether a bus can have this divider.
const fn is_divider(value: u32) -> bool {
    value >= 1 && value <= 16 && value.is_power_of_two()
}

#[cfg(test)]
mod tests {
    extern crate std;

    use std::format;

    use super::*;
    use crate::geometry::Line;

    /// 168 MHz from 8 MHz, APB1 at 42 and APB2 at 84 MHz.
    const FAST: ClockTree = ClockTree {
        hse: 8_000_000,
        hse_bypass: false,
        pll_input: 2_000_000,
        pll_n: 168,
        pll_p: 2,
        apb1: 4,
        apb2: 2,
        wait_states: 5,
    };
    /// 100 MHz, APB1 at 50 and APB2 at 100 MHz.
    const SLOW: ClockTree = ClockTree { pll_n: 100, apb1: 2, apb2: 1, wait_states: 3, ..FAST };

    /// The general operating conditions of the datasheets, in MHz: core, APB1, APB2 (over-drive
    /// off, regulator at scale 1); and the wait states at the fastest clock (2.7 to 3.6 V). Of a
    /// line of each kind: `tests/it/lines.rs` has the others.
    #[test]
    fn what_is_too_fast_for_a_line_is_refused() {
        for (line, core, apb1, apb2, wait_states) in
            [(Line::F407, 168, 42, 84, 5), (Line::F412, 100, 50, 100, 3), (Line::F413, 100, 50, 100, 3)]
        {
            let limits = line.limits();
            let says = |tree: ClockTree| tree.check(&limits).unwrap_err();
            let fastest = if core == 100 { SLOW } else { FAST };
            assert_eq!(fastest.sysclk(), core * 1_000_000);
            assert_eq!(fastest.wait_states, wait_states);
            assert_eq!(fastest.check(&limits), Ok(()), "{}", line.name());
            let faster = says(ClockTree { pll_n: fastest.pll_n + 2, ..fastest });
            assert!(faster.contains(&format!("core is too fast: {core} MHz")), "{faster}");
            let faster = says(ClockTree { pll_n: 96, apb1: 1, apb2: 2, ..fastest });
            assert!(faster.contains(&format!("APB1 is too fast: {apb1} MHz")), "{faster}");
            if core == 168 {
                let faster = says(ClockTree { apb2: 1, ..fastest });
                assert!(faster.contains(&format!("APB2 is too fast: {apb2} MHz")), "{faster}");
            }
            let fewer = says(ClockTree { wait_states: wait_states - 1, ..fastest });
            assert!(fewer.contains("needs a wait state for every"), "{fewer}");
        }
        // RM0430: two wait states up to 75 MHz on the F413; RM0402: up to 90 MHz on the F412.
        let tree = ClockTree { pll_n: 80, wait_states: 2, ..SLOW };
        assert_eq!(tree.check(&Line::F412.limits()), Ok(()));
        assert!(tree.check(&Line::F413.limits()).unwrap_err().contains("every 25 MHz"));
    }

    /// RM0090 table 11: at 2.4 V 168 MHz need 6 wait states (24 MHz each); below 2.1 V 160 MHz are the most, with
    /// 7 (20 MHz each). RM0430, F413: 20 MHz each at 2.4 V.
    #[test]
    fn a_lower_supply_needs_more_wait_states() {
        let limits = Line::F407.limits_at(2_400);
        assert!(FAST
            .check(&limits)
            .unwrap_err()
            .contains("supply_mv) the flash needs a wait state for every 24 MHz"));
        assert_eq!(ClockTree { wait_states: 6, ..FAST }.check(&limits), Ok(()));
        let limits = Line::F407.limits_at(1_800);
        let most = ClockTree { wait_states: 7, ..FAST };
        assert!(most.check(&limits).unwrap_err().contains("160 MHz at most at this supply"));
        assert_eq!(ClockTree { pll_n: 160, ..most }.check(&limits), Ok(()));
        assert!(SLOW.check(&Line::F413.limits_at(2_400)).unwrap_err().contains("every 20 MHz"));
    }

    /// With HSI 5 % too fast the core must not be above 168 or 100 MHz; by hand: 40 MHz make all bit rates
    /// that 42 MHz make, and 45 those of 50.
    #[test]
    fn with_hsi_the_core_stays_within_its_limits_and_the_bit_rates_stay() {
        for (line, tree, core, apb1) in [
            (Line::F407, FAST, 160, 40),
            (Line::F446, ClockTree { pll_n: 160, ..FAST }, 160, 40),
            (Line::F412, SLOW, 90, 45),
            // It is far below its limits.
            (Line::F407, ClockTree { pll_n: 56, ..FAST }, 56, 14),
        ] {
            let internal = tree.internal(
                &line.limits(),
                &[800_000, 1_000_000, 500_000, 250_000, 125_000, 50_000, 20_000, 10_000],
            );
            assert_eq!(internal.sysclk(), core * 1_000_000);
            assert_eq!(internal.apb1_clock(), apb1 * 1_000_000);
            assert_eq!(internal.check(&line.limits()), Ok(()));
        }
    }

    /// Every multiplier and divider that `check` accepts, with as few wait states as it accepts.
    #[test]
    fn with_hsi_5_percent_too_fast_each_tree_keeps_the_limits_of_its_chip() {
        let (mut trees, mut fewer) = (0, 0);
        for (line, supply_mv) in
            [(Line::F407, 3_300), (Line::F407, 1_800), (Line::F412, 2_400), (Line::F413, 3_300)]
        {
            let limits = line.limits_at(supply_mv);
            for (pll_n, pll_p) in (50..=432).flat_map(|n| [2, 4, 6, 8].map(|p| (n, p))) {
                let tree = ClockTree { pll_input: 1_000_000, pll_n, pll_p, ..FAST };
                let wait_states = tree.sysclk().saturating_sub(1) / limits.per_wait_state;
                let tree = ClockTree { wait_states, ..tree };
                if tree.check(&limits).is_err() {
                    continue;
                }
                let internal = tree.internal(&limits, &[125_000]);
                let fastest = u64::from(internal.sysclk()) * 105 / 100;
                let within = |hz: u64, most: u32| hz <= u64::from(most);
                assert!(within(fastest, limits.per_wait_state * (wait_states + 1)), "{tree:?}: {internal:?}");
                assert!(within(fastest, limits.sysclk) && within(fastest / 4, limits.apb1), "{tree:?}");
                assert!(within(fastest / 2, limits.apb2), "{tree:?}: {internal:?}");
                let vco = internal.pll_input * internal.pll_n;
                assert!(within(u64::from(vco) * 105 / 100, 432_000_000), "{tree:?}: {internal:?}");
                for vco in [vco, pll_n * 1_000_000] {
                    // DS8626, main PLL characteristics.
                    assert!(within(u64::from(vco / tree.pll_q()) * 105 / 100, 75_000_000), "{tree:?}");
                }
                assert!((2..=15).contains(&tree.pll_q()) && (2..=15).contains(&internal.pll_q()), "{tree:?}");
                trees += 1;
                fewer += u32::from(internal.pll_n < pll_n);
            }
        }
        assert!(trees > 2_000 && fewer > 500, "{trees}, {fewer}");
    }

    #[test]
    fn numbers_that_no_tree_has_are_refused() {
        for wrong in [
            ClockTree { hse: 0, ..FAST },
            ClockTree { hse: 2_000_000, ..FAST },
            ClockTree { hse: 3_999_999, pll_input: 1_333_333, ..FAST },
            ClockTree { hse: 28_000_000, ..FAST },
            ClockTree { hse: 80_000_000, ..FAST },
            ClockTree { hse: 52_000_000, hse_bypass: true, ..FAST },
            // By 1 for the PLL.
            ClockTree { hse: 2_000_000, hse_bypass: true, ..FAST },
            ClockTree { pll_input: 0, ..FAST },
            ClockTree { pll_input: 3_000_000, ..FAST },
            ClockTree { pll_input: 4_000_000, ..FAST },
            ClockTree { pll_n: u32::MAX, ..FAST },
            ClockTree { pll_n: 49, ..FAST },
            ClockTree { pll_p: 0, ..FAST },
            ClockTree { pll_p: 3, ..FAST },
            ClockTree { apb1: 0, ..FAST },
            ClockTree { apb2: 3, ..FAST },
            ClockTree { wait_states: 16, ..FAST },
        ] {
            assert!(wrong.check(&Line::F407.limits()).is_err(), "{wrong:?}");
        }
        for right in [
            ClockTree { hse: 4_000_000, ..FAST },
            ClockTree { hse: 26_000_000, ..FAST },
            ClockTree { hse: 50_000_000, hse_bypass: true, ..FAST },
        ] {
            assert_eq!(right.check(&Line::F407.limits()), Ok(()), "{right:?}");
        }
    }
}
