//! The supply VDD as a voltage that changes in time, and the circuits that hold the chip in reset while it
//! is too low (RM0090 sections 5.2.1 and 5.2.2).
//!
//! The thresholds are those of the datasheet (DocID022152, "Embedded reset and power control block
//! characteristics"); where a chip is in their ranges is drawn.

use crate::silicon::Silicon;
use crate::time::{Span, Time};

/// VDD of most boards, in mV.
pub const NOMINAL: u32 = 3_300;

/// Power-down and power-on reset.
const POWER: Threshold = Threshold { falling: [1_600, 1_680, 1_760], rising: [1_640, 1_720, 1_800] };
/// Brown-out reset by the option bits BOR_LEV: level 3, 2, 1.
const BROWN_OUT: [Threshold; 3] = [
    Threshold { falling: [2_750, 2_830, 2_880], rising: [2_850, 2_920, 2_970] },
    Threshold { falling: [2_440, 2_500, 2_560], rising: [2_530, 2_590, 2_630] },
    Threshold { falling: [2_130, 2_190, 2_240], rising: [2_230, 2_290, 2_330] },
];

/// Below this voltage the RAM forgets, in mV. No document of ST has a value; static RAM keeps its contents
/// far below the voltage at which it works.
const RETENTION: u32 = 1_000;
/// The RAM keeps all of its contents for so long without a supply, and none for so long.
const RAM_KEPT: Span = Span::from_millis(10);
const RAM_LOST: Span = Span::from_millis(1_000);
/// The shortest step in which a voltage changes.
const STEP: Span = Span::from_micros(1);

/// A threshold of the supply with its hysteresis, in mV: lowest, typical and highest of all chips.
#[derive(Clone, Copy)]
pub(crate) struct Threshold {
    pub(crate) falling: [u32; 3],
    pub(crate) rising: [u32; 3],
}

impl Threshold {
    /// The falling and the rising one of this chip.
    pub(crate) fn of(self, silicon: Silicon) -> (u32, u32) {
        let within = |[lowest, typical, highest]: [u32; 3]| match silicon.threshold_permille {
            low @ 0..500 => lowest + (typical - lowest) * low / 500,
            high => typical + (highest - typical) * (high - 500) / 500,
        };
        (within(self.falling), within(self.rising))
    }
}

/// VDD: constant, or on its way to another value in a straight line.
#[derive(Clone, Debug)]
pub struct Supply {
    start: (Time, u32),
    end: (Time, u32),
}

impl Supply {
    /// A constant voltage in mV.
    #[must_use]
    pub fn new(mv: u32) -> Self {
        Self { start: (Time(0), mv), end: (Time(0), mv) }
    }

    /// Lets the voltage go from its value at `now` to `mv` within a time.
    pub fn go_to(&mut self, mv: u32, within: Span, now: Time) {
        *self = Self { start: (now, self.at(now)), end: (now + within, mv) };
    }

    /// The voltage in mV.
    #[must_use]
    pub fn at(&self, now: Time) -> u32 {
        let ((start, from), (end, to)) = (self.start, self.end);
        if now >= end {
            return to;
        }
        let (passed, whole) = (now.0.saturating_sub(start.0), end.0 - start.0);
        let change = (i128::from(to) - i128::from(from)) * i128::from(passed) / i128::from(whole);
        u32::try_from(i128::from(from) + change).unwrap_or(0)
    }

    /// When the voltage has changed by about 1 mV, if it changes.
    #[must_use]
    pub fn next_change(&self, now: Time) -> Option<Time> {
        let ((start, from), (end, to)) = (self.start, self.end);
        let step = (end.0 - start.0) / u64::from(to.abs_diff(from).max(1));
        (now < end).then(|| end.min(now + Span(step.max(STEP.0))))
    }
}

/// What the supervisor of the supply does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Change {
    /// The chip goes into reset.
    Falls,
    /// The chip comes out of reset.
    Rises {
        /// The supply was below the threshold of the power-down reset.
        powered_down: bool,
        /// How many per mille of the RAM have lost their contents.
        ram_lost: u32,
    },
}

/// The reset by the supply.
#[derive(Clone, Debug)]
pub struct Supervisor {
    silicon: Silicon,
    held: Option<InReset>,
}

/// The chip is held in reset.
#[derive(Clone, Copy, Debug, Default)]
struct InReset {
    powered_down: bool,
    /// Since when the RAM has no supply.
    dark_since: Option<Time>,
    /// How long it had none before.
    dark: Span,
}

impl Supervisor {
    /// That of this chip, which it does not hold in reset.
    #[must_use]
    pub fn new(silicon: Silicon) -> Self {
        Self { silicon, held: None }
    }

    /// Whether the chip is held in reset.
    #[must_use]
    pub fn holds(&self) -> bool {
        self.held.is_some()
    }

    /// The supply has this voltage now; `level` is BOR_LEV, 3 for off.
    pub fn watch(&mut self, mv: u32, level: u8, now: Time) -> Option<Change> {
        let power_down = POWER.of(self.silicon);
        let brown_out = BROWN_OUT.get(usize::from(level)).map(|threshold| threshold.of(self.silicon));
        let (falling, rising) = brown_out.unwrap_or(power_down);
        let Some(held) = &mut self.held else {
            if mv >= falling {
                return None;
            }
            self.held = Some(InReset::default());
            self.watch(mv, level, now);
            return Some(Change::Falls);
        };
        held.powered_down |= mv < power_down.0;
        match (held.dark_since, mv < RETENTION) {
            (None, true) => held.dark_since = Some(now),
            (Some(since), false) => {
                held.dark = Span(held.dark.0 + (now - since).0);
                held.dark_since = None;
            }
            _ => {}
        }
        if mv < rising {
            return None;
        }
        let (powered_down, ram_lost) = (held.powered_down, ram_lost(held.dark));
        self.held = None;
        Some(Change::Rises { powered_down, ram_lost })
    }
}

/// How many per mille of the RAM are lost after a time without a supply.
fn ram_lost(dark: Span) -> u32 {
    let beyond = dark.0.saturating_sub(RAM_KEPT.0).min(RAM_LOST.0 - RAM_KEPT.0);
    u32::try_from(beyond * 1_000 / (RAM_LOST.0 - RAM_KEPT.0)).unwrap_or(1_000)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::silicon::TYPICAL;

    fn ms(n: u64) -> Time {
        Time(0) + Span::from_millis(n)
    }

    #[test]
    fn a_voltage_changes_in_a_straight_line() {
        let mut supply = Supply::new(3_300);
        assert_eq!((supply.at(ms(9)), supply.next_change(ms(9))), (3_300, None));
        supply.go_to(2_300, Span::from_millis(1_000), ms(10));
        assert_eq!(
            [10, 11, 510, 1_010, 5_000].map(|n| supply.at(ms(n))),
            [3_300, 3_299, 2_800, 2_300, 2_300]
        );
        assert_eq!(supply.next_change(ms(10)), Some(ms(11)));
        assert_eq!(supply.next_change(ms(1_010)), None);
        // It turns round on its way.
        supply.go_to(3_300, Span(0), ms(510));
        assert_eq!((supply.at(ms(510)), supply.next_change(ms(510))), (3_300, None));
        // An hour, and a step.
        supply.go_to(0, Span::from_millis(3_600_000), ms(1_000));
        assert_eq!(supply.at(ms(1_000 + 1_800_000)), 1_650);
        supply.go_to(0, Span(1), ms(9_000_000));
        assert_eq!(supply.at(ms(9_000_001)), 0);
    }

    /// Datasheet: the thresholds have a hysteresis of 40 and about 100 mV. Typical, and at their ends.
    #[test]
    fn the_level_of_the_option_bytes_decides_where_the_reset_is() {
        for (threshold_permille, level, falling, rising) in [
            (500, 3, 1_680, 1_720),
            (500, 2, 2_190, 2_290),
            (500, 1, 2_500, 2_590),
            (500, 0, 2_830, 2_920),
            (0, 3, 1_600, 1_640),
            (0, 0, 2_750, 2_850),
            (1_000, 1, 2_560, 2_630),
            (1_000, 0, 2_880, 2_970),
        ] {
            let mut supervisor = Supervisor::new(Silicon { threshold_permille, ..TYPICAL });
            assert_eq!(supervisor.watch(falling, level, ms(1)), None);
            assert_eq!(supervisor.watch(falling - 1, level, ms(2)), Some(Change::Falls), "level {level}");
            assert!(supervisor.holds());
            assert_eq!(supervisor.watch(rising - 1, level, ms(3)), None, "level {level}");
            let powered_down = level == 3;
            let rises = Change::Rises { powered_down, ram_lost: 0 };
            assert_eq!(supervisor.watch(rising, level, ms(4)), Some(rises), "level {level}");
            assert!(!supervisor.holds());
        }
    }

    #[test]
    fn the_ram_forgets_with_the_time_without_a_supply() {
        for (off, lost) in [(1, 0), (10, 0), (505, 500), (1_000, 1_000), (3_600_000, 1_000)] {
            let mut supervisor = Supervisor::new(TYPICAL);
            supervisor.watch(0, 3, ms(5));
            let rises = Change::Rises { powered_down: true, ram_lost: lost };
            assert_eq!(supervisor.watch(3_300, 3, ms(5 + off)), Some(rises), "{off} ms");
        }
        // Above its retention voltage, it forgets nothing.
        let mut supervisor = Supervisor::new(TYPICAL);
        supervisor.watch(1_200, 3, ms(5));
        let rises = Change::Rises { powered_down: true, ram_lost: 0 };
        assert_eq!(supervisor.watch(3_300, 3, ms(9_000)), Some(rises));
    }
}
