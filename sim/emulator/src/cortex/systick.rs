//! SysTick (PM0214 section 4.5).

use crate::clock::{picos_of, ticks_in};
use crate::time::Time;

const CSR_ENABLE: u32 = 1 << 0;
const CSR_TICKINT: u32 = 1 << 1;
const CSR_CLKSOURCE: u32 = 1 << 2;
const CSR_COUNTFLAG: u32 = 1 << 16;
const COUNTER: u32 = 0x00FF_FFFF;

/// The 24-bit down-counter. It is computed from the time since it was last touched, so it costs
/// nothing while it runs.
#[derive(Clone, Debug)]
pub struct SysTick {
    csr: u32,
    reload: u32,
    /// Counter at `anchor`.
    value: u32,
    anchor: Time,
    /// How often the counter reached zero since `anchor`, as far as it was looked at.
    zeros_seen: u64,
    /// The core's clock.
    hclk: u64,
}

impl SysTick {
    /// As after reset, with a core clock of `hclk` Hz and this value of the counter, which is unknown
    /// on the chip.
    #[must_use]
    pub fn new(hclk: u64, value: u32) -> Self {
        Self { csr: 0, reload: 0, value: value & COUNTER, anchor: Time(0), zeros_seen: 0, hclk }
    }

    fn is_running(&self) -> bool {
        self.csr & CSR_ENABLE != 0
    }

    /// The counter's clock: the core's, or an eighth of it (PM0214 section 4.5.1, CLKSOURCE).
    fn hz(&self) -> u64 {
        if self.csr & CSR_CLKSOURCE != 0 {
            self.hclk
        } else {
            (self.hclk / 8).max(1)
        }
    }

    /// Ticks from the anchor to the first zero.
    fn first_zero(&self) -> u64 {
        if self.value > 0 {
            u64::from(self.value)
        } else {
            u64::from(self.reload) + 1
        }
    }

    /// Counter and number of zeros reached, `ticks` after the anchor.
    fn after(&self, ticks: u64) -> (u32, u64) {
        if self.reload == 0 && ticks >= u64::from(self.value) {
            // A reload value of zero stops the counter at its first zero.
            return (0, u64::from(self.value > 0));
        }
        let down = |from: u64, by: u64| u32::try_from(from - by).unwrap_or(0);
        let first = self.first_zero();
        if ticks < first {
            return match (self.value, ticks) {
                (_, 0) => (self.value, 0),
                (0, _) => (down(u64::from(self.reload), ticks - 1), 0),
                (value, _) => (down(u64::from(value), ticks), 0),
            };
        }
        let period = u64::from(self.reload) + 1;
        let zeros = (ticks - first) / period + 1;
        match (ticks - first) % period {
            0 => (0, zeros),
            rest => (down(u64::from(self.reload), rest - 1), zeros),
        }
    }

    fn now(&self, now: Time) -> (u32, u64) {
        if self.is_running() {
            self.after(ticks_in((now - self.anchor).0, self.hz()))
        } else {
            (self.value, self.zeros_seen)
        }
    }

    fn anchor_at(&mut self, now: Time) {
        let (value, _) = self.now(now);
        self.value = value;
        self.anchor = now;
        self.zeros_seen = 0;
    }

    /// The core's clock is `hclk` Hz from `now` on.
    pub fn set_clock(&mut self, hclk: u64, now: Time) {
        if hclk != self.hclk {
            self.anchor_at(now);
            self.hclk = hclk;
        }
    }

    /// Lets time pass; whether the exception becomes pending.
    pub fn advance(&mut self, now: Time) -> bool {
        let (_, zeros) = self.now(now);
        let reached = zeros > self.zeros_seen;
        if reached {
            self.zeros_seen = zeros;
            self.csr |= CSR_COUNTFLAG;
        }
        reached && self.csr & CSR_TICKINT != 0
    }

    /// When the exception becomes pending next, if it will.
    #[must_use]
    pub fn next_event(&self) -> Option<Time> {
        if !self.is_running() || self.csr & CSR_TICKINT == 0 {
            return None;
        }
        if self.reload == 0 && (self.value == 0 || self.zeros_seen > 0) {
            return None;
        }
        let ticks = self.first_zero() + self.zeros_seen * (u64::from(self.reload) + 1);
        Some(Time(self.anchor.0.saturating_add(picos_of(ticks, self.hz()))))
    }

    /// SYST_CSR; reading clears COUNTFLAG.
    pub fn read_csr(&mut self) -> u32 {
        let csr = self.csr;
        self.csr &= !CSR_COUNTFLAG;
        csr
    }

    /// Writes SYST_CSR.
    pub fn write_csr(&mut self, value: u32, now: Time) {
        self.anchor_at(now);
        let flag = self.csr & CSR_COUNTFLAG;
        self.csr = flag | value & (CSR_ENABLE | CSR_TICKINT | CSR_CLKSOURCE);
    }

    /// SYST_RVR.
    #[must_use]
    pub fn read_reload(&self) -> u32 {
        self.reload
    }

    /// Writes SYST_RVR; it counts from the next reload on. Two stores are a clock of the core apart at
    /// least, also where both come at one time here: a counter at zero has loaded the old value by then.
    pub fn write_reload(&mut self, value: u32, now: Time) {
        self.anchor_at(now);
        if self.is_running() && self.value == 0 && self.csr & CSR_CLKSOURCE != 0 {
            self.value = self.reload;
        }
        self.reload = value & COUNTER;
    }

    /// SYST_CVR.
    #[must_use]
    pub fn read_value(&self, now: Time) -> u32 {
        self.now(now).0
    }

    /// Writes SYST_CVR: any value clears the counter and COUNTFLAG.
    pub fn write_value(&mut self, now: Time) {
        self.anchor_at(now);
        self.value = 0;
        self.csr &= !CSR_COUNTFLAG;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// At 1 MHz a reload value of 9 gives a period of 10 µs.
    #[test]
    fn the_period_is_the_reload_value_plus_one() {
        let mut tick = SysTick::new(1_000_000, 0);
        tick.write_reload(9, Time(0));
        tick.write_value(Time(0));
        tick.write_csr(7, Time(0));
        let micros = |n: u64| Time(n * 1_000_000);
        assert_eq!(tick.next_event(), Some(micros(10)));
        assert_eq!(tick.read_value(micros(1)), 9);
        assert_eq!(tick.read_value(micros(9)), 1);
        assert!(!tick.advance(micros(9)));
        assert!(tick.advance(micros(10)));
        assert!(!tick.advance(micros(10)));
        assert_eq!(tick.read_value(micros(10)), 0);
        assert_eq!(tick.read_value(micros(11)), 9);
        assert_eq!(tick.next_event(), Some(micros(20)));
        assert_eq!(tick.read_csr(), 0x0001_0007);
        assert_eq!(tick.read_csr(), 7, "COUNTFLAG is cleared by reading");
        assert!(tick.advance(micros(20)));
    }

    #[test]
    fn the_external_clock_is_an_eighth() {
        let mut tick = SysTick::new(8_000_000, 0);
        tick.write_reload(9, Time(0));
        tick.write_csr(3, Time(0));
        assert_eq!(tick.next_event(), Some(Time(10_000_000)));
        tick.set_clock(16_000_000, Time(0));
        assert_eq!(tick.next_event(), Some(Time(5_000_000)));
    }

    /// A timer for one time, as Klipper sets it: LOAD = n, VAL = 0, LOAD = 0, three stores in a row. The
    /// cleared counter has loaded n before the last of them (ARMv7-M B3.3.1: with the next clock).
    #[test]
    fn a_cleared_counter_has_loaded_before_the_next_store() {
        let mut tick = SysTick::new(1_000_000, 0);
        tick.write_csr(7, Time(0));
        for once in 0..3 {
            let now = once * 100_000_000;
            tick.write_reload(9, Time(now));
            tick.write_value(Time(now));
            tick.write_reload(0, Time(now));
            let due = tick.next_event().unwrap().0 - now;
            assert!((9_000_000..=10_000_000).contains(&due), "{due} ps");
            assert!(tick.advance(Time(now + due)) && tick.next_event().is_none(), "once");
        }
        // With an eighth of the clock the stores may all be before the next clock of the counter.
        let mut tick = SysTick::new(8_000_000, 0);
        tick.write_csr(3, Time(0));
        tick.write_reload(9, Time(0));
        tick.write_value(Time(0));
        tick.write_reload(0, Time(0));
        assert_eq!(tick.next_event(), None);
    }

    #[test]
    fn a_reload_value_of_zero_stops_it() {
        let mut tick = SysTick::new(1_000_000, 0);
        tick.write_reload(4, Time(0));
        tick.write_csr(7, Time(0));
        tick.write_reload(0, Time(3_000_000));
        assert_eq!(tick.read_value(Time(3_000_000)), 2);
        assert!(tick.advance(Time(5_000_000)));
        assert!(!tick.advance(Time(500_000_000)));
        assert_eq!(tick.next_event(), None);
    }
}
