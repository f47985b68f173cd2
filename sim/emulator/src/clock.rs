//! From CPU cycles to virtual time.

use crate::time::Time;

const PICOS_PER_SECOND: u64 = 1_000_000_000_000;

/// How many whole ticks of a clock of `hz` fit into `picos`.
#[must_use]
pub fn ticks_in(picos: u64, hz: u64) -> u64 {
    match picos.checked_mul(hz) {
        Some(product) => product / PICOS_PER_SECOND,
        None => clamp(u128::from(picos) * u128::from(hz) / u128::from(PICOS_PER_SECOND)),
    }
}

/// How long `ticks` of a clock of `hz` take in picoseconds, rounded up, so that at the end of the
/// span the last tick is over.
#[must_use]
pub fn picos_of(ticks: u64, hz: u64) -> u64 {
    match ticks.checked_mul(PICOS_PER_SECOND) {
        Some(product) => product.div_ceil(hz),
        None => clamp((u128::from(ticks) * u128::from(PICOS_PER_SECOND)).div_ceil(u128::from(hz))),
    }
}

fn clamp(value: u128) -> u64 {
    u64::try_from(value).unwrap_or(u64::MAX)
}

/// Counts the CPU's cycles and knows the virtual time that they took, across changes of the clock,
/// without drift.
#[derive(Clone, Debug)]
pub struct CycleClock {
    hz: u64,
    anchor: Time,
    anchor_cycles: u64,
    /// Cycles since power-on.
    pub cycles: u64,
}

impl CycleClock {
    /// A clock of `hz` that is at `now` with no cycle counted.
    #[must_use]
    pub fn new(now: Time, hz: u32) -> Self {
        Self { hz: u64::from(hz.max(1)), anchor: now, anchor_cycles: 0, cycles: 0 }
    }

    /// The cycles per second.
    #[must_use]
    pub fn hz(&self) -> u64 {
        self.hz
    }

    /// The virtual time of the present cycle.
    #[must_use]
    pub fn now(&self) -> Time {
        self.time_of(self.cycles)
    }

    /// The virtual time of a cycle since the last change of the clock.
    #[must_use]
    pub fn time_of(&self, cycle: u64) -> Time {
        let since = cycle.saturating_sub(self.anchor_cycles);
        Time(self.anchor.0.saturating_add(picos_of(since, self.hz)))
    }

    /// From here on a cycle takes 1/`hz` seconds.
    pub fn set_hz(&mut self, hz: u32) {
        let hz = u64::from(hz.max(1));
        if hz != self.hz {
            self.anchor = self.now();
            self.anchor_cycles = self.cycles;
            self.hz = hz;
        }
    }

    /// The cycle count at which `time` is reached or just passed.
    #[must_use]
    pub fn cycle_at(&self, time: Time) -> u64 {
        let picos = (time - self.anchor).0;
        let whole = ticks_in(picos, self.hz);
        let cycles = if picos_of(whole, self.hz) < picos { whole + 1 } else { whole };
        self.anchor_cycles.saturating_add(cycles)
    }

    /// Lets cycles pass until `time` is reached; never goes back.
    pub fn skip_to(&mut self, time: Time) {
        self.cycles = self.cycles.max(self.cycle_at(time));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_second_has_as_many_cycles_as_hertz_at_any_clock() {
        let mut clock = CycleClock::new(Time(0), 168_000_000);
        clock.skip_to(Time(PICOS_PER_SECOND));
        assert_eq!(clock.cycles, 168_000_000);
        assert_eq!(clock.now(), Time(PICOS_PER_SECOND));
        clock.set_hz(16_000_000);
        clock.skip_to(Time(2 * PICOS_PER_SECOND));
        assert_eq!(clock.cycles, 184_000_000);
        assert_eq!(clock.now(), Time(2 * PICOS_PER_SECOND));
    }

    #[test]
    fn skipping_reaches_the_time_and_passes_it_by_less_than_a_cycle() {
        let mut clock = CycleClock::new(Time(7), 168_000_000);
        for target in [8, 5_959, 5_960, 12_345_678, 1 << 50] {
            clock.skip_to(Time(target));
            assert!(clock.now().0 >= target && clock.now().0 < target + 5_953, "{target}: {}", clock.now().0);
        }
    }
}
