//! What the manuals leave open, or give as a range: the values of one chip.
//!
//! Firmware that is right works with every chip of a line, so a test may draw a chip by a seed. Without
//! a draw a chip is [`TYPICAL`].

use std::fmt;
use std::ops::RangeInclusive;
use std::str::FromStr;

use crate::noise::Noise;

/// The values of one chip.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Silicon {
    /// The low-speed internal oscillator, in Hz: 17 to 47 kHz, 32 typical (datasheet DocID022152, LSI
    /// oscillator characteristics).
    pub lsi_hz: u32,
    /// The high-speed internal oscillator, in Hz: 16 MHz ± 4 % at -10 to 85 °C (datasheet, HSI oscillator
    /// characteristics).
    pub hsi_hz: u32,
    /// How many periods of the LSI a new value of IWDG_PR or IWDG_RLR takes to get to the counter: up to 5
    /// (RM0090 section 21.4.4).
    pub iwdg_update_periods: u32,
    /// Whether these are periods behind the prescaler, as ST's HAL waits for.
    pub iwdg_update_prescaled: bool,
    /// The value of SYST_CVR after a reset: unknown, 24 bits (ARMv7-M B3.3.5).
    pub systick_value: u32,
    /// Whether a wake-up from Standby sets PORRSTF, PINRSTF and BORRSTF, or no flag of RCC_CSR at all. RM0090
    /// section 7.3.21 does not name Standby.
    pub flags_after_standby: bool,
    /// The time from HSEON to HSERDY with a crystal, in µs: some milliseconds, by the crystal (datasheet, HSE
    /// oscillator characteristics: 2 ms typical).
    pub crystal_start_us: u32,
    /// What the oscillator of a PLL does without an input, in Hz. No document says more than "not locked"; an
    /// STM32F407 was seen to go on at 8 MHz in place of 168, which is twice that.
    pub pll_free_hz: u32,
    /// How long after a request on the bus INAK and SLAK come at the earliest, in µs (RM0090 section 32.4
    /// has no time).
    pub can_mode_us: u32,
    /// Whether CAN_TSR and CAN_ESR stand still in sleep mode, so that an abort of a mailbox does not end, and
    /// a last error code that software writes is lost. The manual has the clock of the controller stop there
    /// (RM0090 section 32.4.3).
    pub can_sleeps_deeply: bool,
    /// Whether a controller that is asked to leave a busy bus never does, until MCR.RESET: reported of an F469.
    pub can_sticks: bool,
    /// How far the times of the flash are from the typical to the worst of the datasheet, in thousandths.
    pub flash_slowness_permille: u32,
    /// Whether the caches of the flash interface keep their lines over an erase, so that software which does not
    /// flush them reads old data, and runs old code, which is reported (RM0090 section 3.6.4). Most programs never
    /// meet one.
    pub stale_lines: bool,
    /// Where the thresholds of the supply (PVD, BOR, POR and PDR) are between the lowest (0) and the highest (1000)
    /// of the datasheet, in thousandths; 500 is typical.
    pub threshold_permille: u32,
    /// Whether a peripheral takes some cycles after the store that switches its clock on: an access in the same
    /// straight run of code is lost, unless it has a DSB, or reads a register of RCC before (ES0182, delay after
    /// an RCC peripheral clock enabling: 2 cycles of AHB, or 1 and the divider of APB).
    pub late_clocks: bool,
    /// Whether a request for transmission (TXRQ) is lost before the controller takes part in the bus. RM0090 section
    /// 32.4.2 has the software wait for INAK to be cleared, and does not say what happens to one that does not.
    pub can_forgets_requests: bool,
    /// The time from ODEN to ODRDY, and how long the regulator switches after a change of ODSWEN, in µs: 40 to 100,
    /// 45 typical with HSI (datasheets of F42x, F446 and F469, over-drive switching characteristics, for ODSWEN).
    pub over_drive_us: u32,
    /// The time from LSEON to LSERDY in ms, by the crystal: 2 s typical (datasheet, LSE oscillator
    /// characteristics). ST's HAL waits for 5 s.
    pub lse_start_ms: u32,
}

/// The typical values of the datasheet, and what most programs assume where it has none.
pub const TYPICAL: Silicon = Silicon {
    lsi_hz: 32_000,
    hsi_hz: 16_000_000,
    iwdg_update_periods: 5,
    iwdg_update_prescaled: false,
    systick_value: 0,
    flags_after_standby: false,
    crystal_start_us: 2_000,
    pll_free_hz: 16_000_000,
    can_mode_us: 0,
    can_sleeps_deeply: false,
    can_sticks: false,
    flash_slowness_permille: 0,
    stale_lines: false,
    threshold_permille: 500,
    late_clocks: false,
    can_forgets_requests: false,
    over_drive_us: 45,
    lse_start_ms: 2_000,
};

/// The ends of the ranges that do most harm: the watchdog bites early, the core is too fast, the first period of
/// SysTick is the longest, and a supply that falls is noticed late.
pub const WORST: Silicon = Silicon {
    lsi_hz: *LSI.end(),
    hsi_hz: *HSI.end(),
    iwdg_update_periods: *UPDATE.end(),
    iwdg_update_prescaled: true,
    systick_value: *SYSTICK.end(),
    flags_after_standby: false,
    crystal_start_us: *CRYSTAL_START.end(),
    pll_free_hz: *PLL_FREE.start(),
    can_mode_us: *CAN_MODE.end(),
    can_sleeps_deeply: true,
    can_sticks: true,
    flash_slowness_permille: *FLASH_SLOWNESS.end(),
    stale_lines: true,
    threshold_permille: *THRESHOLD.start(),
    late_clocks: true,
    can_forgets_requests: true,
    over_drive_us: *OVER_DRIVE.end(),
    lse_start_ms: *LSE_START.end(),
};

const LSI: RangeInclusive<u32> = 17_000..=47_000;
const HSI: RangeInclusive<u32> = 15_360_000..=16_640_000;
const UPDATE: RangeInclusive<u32> = 1..=5;
const SYSTICK: RangeInclusive<u32> = 0..=0x00FF_FFFF;
const CRYSTAL_START: RangeInclusive<u32> = 300..=20_000;
const PLL_FREE: RangeInclusive<u32> = 4_000_000..=64_000_000;
const CAN_MODE: RangeInclusive<u32> = 0..=30;
const FLASH_SLOWNESS: RangeInclusive<u32> = 0..=1_000;
const THRESHOLD: RangeInclusive<u32> = 0..=1_000;
const OVER_DRIVE: RangeInclusive<u32> = 40..=100;
const LSE_START: RangeInclusive<u32> = 500..=4_500;

impl Silicon {
    /// A chip that the seed chooses.
    #[must_use]
    pub fn drawn(seed: u64) -> Self {
        // Of a generator of its own: what RAM holds does not depend on it. A new value is drawn after the
        // others, which keep theirs.
        let mut noise = Noise(seed ^ 0x5111_C011_5111_C011);
        let mut draw = |range: RangeInclusive<u32>| {
            let count = u64::from(range.end() - range.start()) + 1;
            // Less than `count`, which fits.
            range.start() + (noise.word() % count) as u32
        };
        Self {
            lsi_hz: draw(LSI),
            hsi_hz: draw(HSI),
            iwdg_update_periods: draw(UPDATE),
            systick_value: draw(SYSTICK),
            flags_after_standby: draw(0..=1) == 1,
            crystal_start_us: draw(CRYSTAL_START),
            can_mode_us: draw(CAN_MODE),
            can_sleeps_deeply: draw(0..=1) == 1,
            can_sticks: draw(0..=1) == 1,
            flash_slowness_permille: draw(FLASH_SLOWNESS),
            stale_lines: draw(0..=1) == 1,
            pll_free_hz: draw(PLL_FREE),
            iwdg_update_prescaled: draw(0..=1) == 1,
            threshold_permille: draw(THRESHOLD),
            late_clocks: draw(0..=1) == 1,
            can_forgets_requests: draw(0..=1) == 1,
            over_drive_us: draw(OVER_DRIVE),
            lse_start_ms: draw(LSE_START),
        }
    }
}

impl Default for Silicon {
    fn default() -> Self {
        TYPICAL
    }
}

impl fmt::Display for Silicon {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { lsi_hz, hsi_hz, iwdg_update_periods, systick_value, flags_after_standby, .. } = self;
        let Self { crystal_start_us, pll_free_hz, can_mode_us, can_sleeps_deeply, can_sticks, .. } = self;
        let (slowness, stale_lines) = (self.flash_slowness_permille, self.stale_lines);
        let Self { threshold_permille: threshold, late_clocks, can_forgets_requests, .. } = self;
        let Self { over_drive_us, lse_start_ms, .. } = self;
        let of = if self.iwdg_update_prescaled { "prescaled LSI" } else { "LSI" };
        let flags = if *flags_after_standby { "those of a power-on" } else { "none" };
        write!(
            f,
            "LSI {lsi_hz} Hz, HSI {hsi_hz} Hz, {of} periods per write to the watchdog: {iwdg_update_periods}, SysTick \
             after a reset: {systick_value:06X}h, reset flags after Standby: {flags}, crystal: {crystal_start_us} µs, \
             PLL without an input: {pll_free_hz} Hz, \
             INAK and SLAK: {can_mode_us} µs, CAN registers stand still in sleep: {can_sleeps_deeply}, CAN sticks \
             on a busy bus: {can_sticks}, flash: {slowness} ‰ from typical to worst, stale lines of its caches: {stale_lines}, \
             thresholds of the supply: {threshold} ‰ from lowest to highest, \
             clocks of peripherals are late: {late_clocks}, CAN forgets early requests: \
             {can_forgets_requests}, over-drive: {over_drive_us} µs, crystal of 32 kHz: {lse_start_ms} ms"
        )
    }
}

/// Which chips a bench has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Choice {
    /// [`TYPICAL`].
    Typical,
    /// [`WORST`].
    Worst,
    /// Each board has a chip of its own, the first one this seed's.
    Seed(u64),
}

impl Choice {
    /// The chip of a board; 0 is the first.
    #[must_use]
    pub fn of_board(self, board: u64) -> Silicon {
        match self {
            Self::Typical => TYPICAL,
            Self::Worst => WORST,
            Self::Seed(seed) => Silicon::drawn(seed.wrapping_add(board)),
        }
    }
}

impl fmt::Display for Choice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Typical => f.write_str("typical"),
            Self::Worst => f.write_str("worst"),
            Self::Seed(seed) => write!(f, "{seed}"),
        }
    }
}

impl FromStr for Choice {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "typical" => Ok(Self::Typical),
            "worst" => Ok(Self::Worst),
            _ => text
                .parse()
                .map(Self::Seed)
                .map_err(|_| format!("say `typical`, `worst`, or a number from 0 to {} as a seed", u64::MAX)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Datasheet DocID022152, sections 5.3.9 and 5.3.10; RM0090 section 21.4.4.
    #[test]
    fn each_seed_draws_a_chip_within_the_ranges_and_the_same_one_each_time() {
        let chips: Vec<Silicon> = (0..2_000).map(Silicon::drawn).collect();
        for (seed, chip) in (0..).zip(&chips) {
            assert!((17_000..=47_000).contains(&chip.lsi_hz), "{seed}: {chip}");
            assert!((15_360_000..=16_640_000).contains(&chip.hsi_hz), "{seed}: {chip}");
            assert!((1..=5).contains(&chip.iwdg_update_periods), "{seed}: {chip}");
            assert!(chip.systick_value < 1 << 24, "{seed}: {chip}");
            assert!((300..=20_000).contains(&chip.crystal_start_us), "{seed}: {chip}");
            assert!(chip.can_mode_us <= 30, "{seed}: {chip}");
            assert!(chip.flash_slowness_permille <= 1_000, "{seed}: {chip}");
            assert!(chip.threshold_permille <= 1_000, "{seed}: {chip}");
            assert!((40..=100).contains(&chip.over_drive_us), "{seed}: {chip}");
            assert!(chip.lse_start_ms < 5_000, "{seed}: ST's HAL gives up: {chip}");
            assert_eq!(Silicon::drawn(seed), *chip, "{seed}");
        }
        // The ends are reached, or nearly.
        assert!(
            chips.iter().any(|chip| chip.lsi_hz < 17_300) && chips.iter().any(|chip| chip.lsi_hz > 46_700)
        );
        assert!(chips.iter().any(|chip| chip.flags_after_standby));
        assert!(chips.iter().any(|chip| !chip.flags_after_standby));
        assert!(chips.iter().any(|chip| chip.stale_lines) && chips.iter().any(|chip| !chip.stale_lines));
    }

    #[test]
    fn a_choice_is_a_word_or_a_seed() {
        for (text, choice) in [
            ("typical", Choice::Typical),
            ("worst", Choice::Worst),
            ("0", Choice::Seed(0)),
            ("18446744073709551615", Choice::Seed(u64::MAX)),
        ] {
            assert_eq!(text.parse(), Ok(choice));
        }
        for text in ["", "best", "-1", "1.5", "0x10", "18446744073709551616", "Worst"] {
            let error = text.parse::<Choice>().unwrap_err();
            assert!(error.contains("`typical`, `worst`, or a number"), "{text}: {error}");
        }
        // The last seed has a second board, too.
        assert_ne!(Choice::Seed(u64::MAX).of_board(0), Choice::Seed(u64::MAX).of_board(1));
    }
}
