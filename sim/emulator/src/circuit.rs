//! What a board has at the pins of the chip beside crystal and transceiver: a watchdog chip, and a latch that holds
//! the supply.

use crate::time::{Span, Time};

/// A pin: its port, `'A'` and on, and its number.
pub type Pin = (char, u8);

/// The circuit; by default there is none.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Circuit {
    /// A watchdog chip: it pulls NRST when the level that the program drives at this pin has not changed for this
    /// time. It counts from the power-on, and anew from each reset by NRST; other resets do not change it.
    pub watchdog: Option<(Pin, Span)>,
    /// A latch: the power goes off when the program has not driven this pin high for this time, from the power-on on.
    pub latch: Option<(Pin, Span)>,
}

/// The circuit at work.
#[derive(Debug, Default)]
pub(crate) struct Wired {
    circuit: Circuit,
    /// The level that the program drove last at the watchdog's pin.
    level: Option<bool>,
    changed_at: Time,
    longest: Span,
    /// Since when the latch is not held.
    released_at: Option<Time>,
}

impl Wired {
    pub fn new(circuit: Circuit) -> Self {
        Self { circuit, ..Self::default() }
    }

    pub fn power_on(&mut self, now: Time) {
        *self = Self {
            longest: self.longest,
            changed_at: now,
            released_at: Some(now),
            ..Self::new(self.circuit)
        };
    }

    /// A reset by NRST.
    pub fn pin_reset(&mut self, now: Time) {
        self.changed_at = now;
    }

    /// The levels that the program drives may have changed.
    pub fn look(&mut self, now: Time, driven: impl Fn(Pin) -> Option<bool>) {
        if let Some(level) = self.circuit.watchdog.and_then(|(pin, _)| driven(pin)) {
            if self.level.replace(level).is_some_and(|before| before != level) {
                self.longest = self.longest.max(now - self.changed_at);
                self.changed_at = now;
            }
        }
        let is_held = self.circuit.latch.is_none_or(|(pin, _)| driven(pin) == Some(true));
        self.released_at = if is_held { None } else { self.released_at.or(Some(now)) };
    }

    fn bites_at(&self) -> Option<Time> {
        self.circuit.watchdog.map(|(_, span)| self.changed_at + span)
    }

    fn lets_go_at(&self) -> Option<Time> {
        Some(self.released_at? + self.circuit.latch?.1)
    }

    /// The watchdog pulls NRST.
    pub fn bites(&self, now: Time) -> bool {
        self.bites_at().is_some_and(|at| at <= now)
    }

    /// The latch switches the power off.
    pub fn lets_go(&self, now: Time) -> bool {
        self.lets_go_at().is_some_and(|at| at <= now)
    }

    pub fn next_event(&self) -> Option<Time> {
        self.bites_at().into_iter().chain(self.lets_go_at()).min()
    }

    /// The longest time between two changes of the level at the watchdog's pin.
    pub fn longest(&self) -> Span {
        self.longest
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: fn(u64) -> Time = |ms| Time(0) + Span::from_millis(ms);

    #[test]
    fn the_watchdog_wants_a_change_and_the_latch_a_high_level() {
        let (watchdog, latch) = (('E', 2), ('E', 3));
        let times = Circuit {
            watchdog: Some((watchdog, Span::from_millis(150))),
            latch: Some((latch, Span::from_millis(1))),
        };
        let mut wired = Wired::new(times);
        wired.power_on(MS(0));
        assert!(!wired.lets_go(Time(0)) && wired.lets_go(MS(1)), "nobody holds it");
        let mut look = |ms, level, held| {
            let driven = |pin| if pin == watchdog { level } else { held };
            wired.look(MS(ms), driven);
            (wired.bites_at(), wired.lets_go_at())
        };
        assert_eq!(look(0, Some(false), Some(true)), (Some(MS(150)), None), "the first level is no change");
        assert_eq!(look(100, Some(true), Some(true)), (Some(MS(250)), None));
        // A reset: the pins are inputs.
        assert_eq!(look(120, None, None), (Some(MS(250)), Some(MS(121))));
        assert_eq!(look(121, Some(true), Some(true)), (Some(MS(250)), None), "the same level");
        assert_eq!(look(130, Some(false), Some(false)), (Some(MS(280)), Some(MS(131))));
        assert!(!wired.bites(MS(279)) && wired.bites(MS(280)));
        wired.pin_reset(MS(280));
        assert!(!wired.bites(MS(429)) && wired.bites(MS(430)));
        assert_eq!(wired.longest(), Span::from_millis(100));
    }
}
