//! Heartbeat producer (CiA 301 section 7.2.8.3.2).

use crate::time::Instant;

/// The heartbeat of a node: when the next one is due.
#[derive(Clone, Copy, Debug)]
pub struct Heartbeat {
    period_ms: u16,
    last: Instant,
}

impl Heartbeat {
    /// A producer whose first heartbeat is due one period after `now`. The period is the value of
    /// 1017h: milliseconds, 0 is off.
    #[must_use]
    pub const fn new(period_ms: u16, now: Instant) -> Self {
        Self { period_ms, last: now }
    }

    /// The period in milliseconds.
    #[must_use]
    pub const fn period_ms(&self) -> u16 {
        self.period_ms
    }

    /// Sets the period; the next heartbeat comes one new period after `now`. The old value again
    /// changes nothing.
    pub fn set_period(&mut self, period_ms: u16, now: Instant) {
        if self.period_ms != period_ms {
            *self = Self::new(period_ms, now);
        }
    }

    /// The time of the next heartbeat; `None` if the heartbeat is off.
    #[must_use]
    pub fn deadline(&self) -> Option<Instant> {
        (self.period_ms != 0).then(|| self.last + u32::from(self.period_ms))
    }

    /// Returns whether a heartbeat is due, and counts it as sent.
    ///
    /// The period runs from due time to due time, so a late call does not shift later heartbeats.
    /// If the call is at least a whole period late, the missed heartbeats are not sent.
    pub fn take_due(&mut self, now: Instant) -> bool {
        let Some(due) = self.deadline().filter(|due| now.has_reached(*due)) else { return false };
        let late = now.since(due) >= u32::from(self.period_ms);
        self.last = if late { now } else { due };
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(millis: u32) -> Instant {
        Instant::from_millis(millis)
    }

    #[test]
    fn the_period_does_not_drift_and_lost_ones_stay_lost() {
        let mut heartbeat = Heartbeat::new(100, at(1000));
        assert!(!heartbeat.take_due(at(1099)));
        assert!(heartbeat.take_due(at(1130)));
        assert!(!heartbeat.take_due(at(1199)));
        assert!(heartbeat.take_due(at(1200)));
        assert!(heartbeat.take_due(at(1550)));
        assert!(!heartbeat.take_due(at(1550)));
        assert_eq!(heartbeat.deadline(), Some(at(1650)));
    }

    #[test]
    fn zero_is_off_and_a_new_period_starts_anew() {
        let mut heartbeat = Heartbeat::new(0, at(0));
        assert_eq!(heartbeat.deadline(), None);
        assert!(!heartbeat.take_due(at(1 << 30)));
        heartbeat.set_period(10, at(5));
        assert!(!heartbeat.take_due(at(14)));
        heartbeat.set_period(10, at(14));
        assert!(heartbeat.take_due(at(15)));
    }

    #[test]
    fn goes_on_across_the_wrap() {
        let mut heartbeat = Heartbeat::new(100, at(u32::MAX - 49));
        assert!(!heartbeat.take_due(at(49)));
        assert!(heartbeat.take_due(at(50)));
    }
}
