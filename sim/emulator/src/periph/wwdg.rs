//! Window watchdog (RM0090 section 22).
//!
//! The prescaler starts anew with each write; on the chip it is never reset, so that the first count may be
//! shorter.

use crate::clock::{picos_of, ticks_in};
use crate::peripheral::{unmodelled, Peripheral, Unmodelled};
use crate::time::{Span, Time};

/// Interrupt line (RM0090 table 61).
const LINE: u16 = 0;

const CR_T: u32 = 0x7F;
/// T6: the counter resets the chip when it goes out.
const CR_T6: u32 = 1 << 6;
const CR_WDGA: u32 = 1 << 7;
const CFR_W: u32 = 0x7F;
const CFR_EWI: u32 = 1 << 9;
const SR_EWIF: u32 = 1 << 0;
/// The counter's clock is PCLK1 divided by this and by the prescaler.
const DIVIDER: u64 = 4096;

/// The watchdog. Once activated only a reset stops it.
#[derive(Clone, Debug)]
pub struct Wwdg {
    /// PCLK1, or 0 without a clock.
    clock_hz: u32,
    is_active: bool,
    /// The counter at a time. It counts in any case.
    counter: (u32, Time),
    cfr: u32,
    early_wakeup: bool,
    /// The counter has got to 40h since it was written.
    was_early: bool,
    expired: bool,
}

impl Default for Wwdg {
    fn default() -> Self {
        Self {
            clock_hz: 0,
            is_active: false,
            counter: (CR_T, Time(0)),
            cfr: CFR_W,
            early_wakeup: false,
            was_early: false,
            expired: false,
        }
    }
}

impl Wwdg {
    /// PCLK1 in Hz from `now` on; 0 while the watchdog has none.
    pub fn set_clock(&mut self, hz: u32, now: Time) {
        if hz != self.clock_hz {
            self.restart_prescaler(now);
            self.clock_hz = hz;
        }
    }

    /// Whether it has run out, or was refreshed outside its window; the machine resets the chip then.
    #[must_use]
    pub fn has_expired(&self) -> bool {
        self.expired
    }

    /// PCLK1 cycles of a count: 4096, by WDGTB once to eight times.
    fn cycles(&self) -> u64 {
        DIVIDER << (self.cfr >> 7 & 3)
    }

    fn after(&self, counts: u32) -> Option<Time> {
        let (_, at) = self.counter;
        (self.clock_hz > 0)
            .then(|| at + Span(picos_of(u64::from(counts) * self.cycles(), self.clock_hz.into())))
    }

    /// When the counter gets to 40h, and when T6 goes out.
    fn milestones(&self) -> Option<(Time, Time)> {
        let (value, _) = self.counter;
        let left = value.checked_sub(CR_T6).filter(|_| self.is_active)?;
        Some((self.after(left)?, self.after(left + 1)?))
    }

    /// The counter now: seven bits.
    fn value(&self, now: Time) -> u32 {
        let (value, at) = self.counter;
        let counts = ticks_in((now - at).0, self.clock_hz.into()) / self.cycles();
        // Less than 128.
        (value + 128 - (counts % 128) as u32) & CR_T
    }

    fn settle(&mut self, now: Time) {
        if let Some((early, late)) = self.milestones() {
            self.early_wakeup |= now >= early && !self.was_early;
            self.was_early |= now >= early;
            self.expired |= now >= late;
        }
    }

    /// From here on it counts at another rate.
    fn restart_prescaler(&mut self, now: Time) {
        self.settle(now);
        self.counter = (self.value(now), now);
    }
}

impl Peripheral for Wwdg {
    fn name(&self) -> &'static str {
        "WWDG"
    }

    fn read(&mut self, offset: u32, now: Time) -> Result<u32, Unmodelled> {
        self.settle(now);
        match offset {
            0x00 => Ok(self.value(now) | if self.is_active { CR_WDGA } else { 0 }),
            0x04 => Ok(self.cfr),
            0x08 => Ok(u32::from(self.early_wakeup)),
            _ => unmodelled("the WWDG has no such register"),
        }
    }

    fn write(&mut self, offset: u32, value: u32, now: Time) -> Result<(), Unmodelled> {
        self.settle(now);
        match offset {
            0x00 => {
                // Above the window, a refresh resets the chip.
                let is_early = self.is_active && self.value(now) > self.cfr & CFR_W;
                self.is_active |= value & CR_WDGA != 0;
                self.counter = (value & CR_T, now);
                self.was_early = false;
                self.expired |= self.is_active && (is_early || value & CR_T6 == 0);
            }
            0x04 => {
                self.restart_prescaler(now);
                self.cfr = value & 0x3FF | self.cfr & CFR_EWI;
            }
            0x08 => self.early_wakeup &= value & SR_EWIF != 0,
            _ => return unmodelled("the WWDG has no such register"),
        }
        Ok(())
    }

    fn advance(&mut self, now: Time) {
        self.settle(now);
    }

    fn next_event(&self) -> Option<Time> {
        let (early, late) = self.milestones().filter(|_| !self.expired)?;
        Some(if self.was_early { late } else { early })
    }

    fn interrupts(&self, active: &mut Vec<u16>) {
        if self.early_wakeup && self.cfr & CFR_EWI != 0 {
            active.push(LINE);
        }
    }

    fn reset(&mut self) {
        *self = Self::default();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CR: u32 = 0x00;
    const CFR: u32 = 0x04;
    const SR: u32 = 0x08;

    /// At 30 MHz, as in the table of section 22.4.
    fn dog() -> Wwdg {
        let mut dog = Wwdg::default();
        dog.set_clock(30_000_000, Time(0));
        dog
    }

    /// RM0090 section 22.4: the shortest and the longest time at 30 MHz by WDGTB, in hundredths of a
    /// microsecond.
    #[test]
    fn it_runs_out_after_the_times_of_the_manual() {
        for (prescaler, shortest, longest) in
            [(0, 13_653, 873_813), (1, 27_306, 1_747_626), (2, 54_613, 3_495_253), (3, 109_226, 6_990_506)]
        {
            for (t, hundredths) in [(0x40, shortest), (0x7F, longest)] {
                let mut dog = dog();
                dog.write(CFR, prescaler << 7 | 0x7F, Time(0)).unwrap();
                dog.write(CR, 0x80 | t, Time(0)).unwrap();
                dog.advance(Time(hundredths * 10_000));
                assert!(!dog.has_expired(), "{prescaler}, {t:02X}h");
                dog.advance(Time((hundredths + 1) * 10_000));
                assert!(dog.has_expired(), "{prescaler}, {t:02X}h");
            }
        }
    }

    /// Sections 22.3 and 22.6.1: before it is activated it counts and does nothing; T6 written as 0 resets.
    #[test]
    fn nothing_happens_before_it_is_activated_and_nothing_stops_it_afterwards() {
        let mut dog = dog();
        assert_eq!((dog.read(CR, Time(0)), dog.read(CFR, Time(0))), (Ok(0x7F), Ok(0x7F)));
        let second = Time(1_000_000_000_000);
        dog.advance(second);
        assert!(!dog.has_expired());
        assert_eq!(dog.next_event(), None);
        dog.write(CR, 0x7F, second).unwrap();
        assert!(!dog.has_expired(), "without WDGA");
        dog.write(CR, 0xFF, second).unwrap();
        dog.write(CR, 0x7F, second).unwrap();
        assert_eq!(dog.read(CR, second), Ok(0xFF), "WDGA stays");
        dog.write(CR, 0x3F, second).unwrap();
        assert!(dog.has_expired());
    }

    /// Section 22.4: a refresh while the counter is above the window resets; in the window it does not.
    #[test]
    fn a_refresh_outside_its_window_is_a_reset() {
        // 7Fh down to 50h are 47 counts of 136.53 us: 6.417 ms.
        for (at_us, bites) in [(6_416, true), (6_418, false)] {
            let mut dog = dog();
            dog.write(CFR, 0x50, Time(0)).unwrap();
            dog.write(CR, 0xFF, Time(0)).unwrap();
            dog.write(CR, 0xFF, Time(at_us * 1_000_000)).unwrap();
            assert_eq!(dog.has_expired(), bites, "{at_us} us");
        }
    }

    /// Section 22.5: at 40h, a count before the reset; cleared by writing 0, and EWI only by a reset.
    #[test]
    fn the_early_wakeup_comes_a_count_before_the_reset() {
        let mut dog = dog();
        dog.write(CFR, 1 << 9 | 0x7F, Time(0)).unwrap();
        dog.write(CFR, 0x7F, Time(0)).unwrap();
        dog.write(CR, 0xFF, Time(0)).unwrap();
        // 63 counts are 8601.6 us.
        dog.advance(Time(8_601_599_999));
        assert_eq!((dog.active(), dog.next_event()), (vec![], Some(Time(8_601_600_000))));
        dog.advance(Time(8_601_600_000));
        assert_eq!((dog.active(), dog.read(SR, Time(8_601_600_000))), (vec![0], Ok(1)));
        dog.write(SR, 0, Time(8_601_600_000)).unwrap();
        assert_eq!(dog.read(SR, Time(8_700_000_000)), Ok(0), "an edge");
        dog.write(CR, 0xC1, Time(8_700_000_000)).unwrap();
        assert_eq!(dog.read(SR, Time(8_900_000_000)), Ok(1));
        assert!(!dog.has_expired());
    }

    #[test]
    fn without_its_clock_it_stands_still() {
        let mut dog = dog();
        dog.write(CR, 0xFF, Time(0)).unwrap();
        dog.set_clock(0, Time(0));
        dog.advance(Time(1_000_000_000_000));
        assert_eq!((dog.has_expired(), dog.next_event()), (false, None));
        dog.set_clock(30_000_000, Time(1_000_000_000_000));
        assert_eq!(dog.next_event(), Some(Time(1_008_601_600_000)));
    }
}
