//! A password check that slows down guessing: each wrong password makes the next wait longer.

use crate::abort::AbortCode;
use crate::time::Instant;

/// How long the lock accepts no password after the first wrong one, in milliseconds. The time
/// doubles with each further wrong password.
pub const FIRST_DELAY_MS: u32 = 500;
/// The number of wrong passwords after which the wait no longer grows.
const MOST_FAILURES: u32 = 6;
/// The longest wait, in milliseconds: half a minute.
pub const LONGEST_DELAY_MS: u32 = FIRST_DELAY_MS << MOST_FAILURES;

/// A lock with its password, and the state of the attempts.
#[derive(Clone, Copy, Debug)]
pub struct Lock {
    password: &'static [u8],
    /// Wrong passwords since the last right one.
    failures: u32,
    /// The time of the last wrong one, for as long as the longest wait.
    failed_at: Option<Instant>,
}

impl Lock {
    /// A lock with this password.
    #[must_use]
    pub const fn new(password: &'static [u8]) -> Self {
        Self { password, failures: 0, failed_at: None }
    }

    /// Wrong passwords since the last right one.
    #[must_use]
    pub const fn failures(&self) -> u32 {
        self.failures
    }

    /// Whether the lock accepts no password at present. Call it at least every three weeks, because
    /// instants wrap. A device that is about to restart waits until this is over: a restart would
    /// end the wait.
    #[must_use]
    pub fn is_waiting(&mut self, now: Instant) -> bool {
        let delay = FIRST_DELAY_MS << self.failures.saturating_sub(1).min(MOST_FAILURES);
        self.remembers(now) && self.failed_at.is_some_and(|at| !now.has_reached(at + delay))
    }

    /// Whether a restart now would forget a wrong attempt too early: the next wait would be the first
    /// one again. It ends with the longest wait after the last wrong attempt, so that restarts allow
    /// few attempts more: 18 in two minutes in place of 9. Call it as often as
    /// [`is_waiting`](Self::is_waiting).
    #[must_use]
    pub fn remembers(&mut self, now: Instant) -> bool {
        // Removed when the time is over, because instants wrap.
        self.failed_at = self.failed_at.filter(|at| !now.has_reached(*at + LONGEST_DELAY_MS));
        self.failed_at.is_some()
    }

    /// Tries a password.
    ///
    /// # Errors
    /// [`AbortCode::INVALID_VALUE`] for a wrong password; [`AbortCode::DEVICE_STATE`] for any
    /// password during a wait.
    pub fn open(&mut self, given: &[u8], now: Instant) -> Result<(), AbortCode> {
        if self.is_waiting(now) {
            return Err(AbortCode::DEVICE_STATE);
        }
        // All bytes are compared, so that the time does not depend on the first different byte.
        let differs = given.iter().zip(self.password).fold(0, |sum, (a, b)| sum | (a ^ b));
        if differs == 0 && given.len() == self.password.len() {
            self.succeed();
            return Ok(());
        }
        self.fail(now);
        Err(AbortCode::INVALID_VALUE)
    }

    /// An attempt of another kind has failed: the next wait is longer.
    pub fn fail(&mut self, now: Instant) {
        self.failed_at = Some(now);
        self.failures = self.failures.saturating_add(1);
    }

    /// An attempt of another kind was successful: the wait ends, and the next one is the first one
    /// again.
    pub fn succeed(&mut self) {
        self.failures = 0;
        self.failed_at = None;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WRONG: Result<(), AbortCode> = Err(AbortCode(0x0609_0030));
    const TOO_EARLY: Result<(), AbortCode> = Err(AbortCode(0x0800_0022));

    #[test]
    fn the_right_password_opens_and_others_do_not() {
        let mut now = 0;
        // Two wrong letters whose differences are the same do not cancel each other.
        for given in [&b""[..], b"INI", b"INIT!", b"INIU", b"JNIT", b"NIIT", b"JOIT", b"JOJU"] {
            let mut lock = Lock::new(b"INIT");
            now += 100_000;
            assert_eq!(lock.open(given, Instant::from_millis(now)), WRONG, "{given:?}");
            assert_eq!(lock.failures(), 1);
        }
        assert_eq!(Lock::new(b"INIT").open(b"INIT", Instant::from_millis(0)), Ok(()));
    }

    /// A success of another kind: the next wait is the first one again.
    #[test]
    fn a_success_makes_the_next_wait_short() {
        let mut lock = Lock::new(b"INIT");
        let mut now = Instant::from_millis(0);
        for _ in 0..4 {
            lock.fail(now);
            now = now + 60_000;
        }
        lock.succeed();
        assert_eq!(lock.failures(), 0);
        lock.fail(now);
        assert!(lock.is_waiting(now + 499) && !lock.is_waiting(now + 500));
    }

    /// A restart forgets the attempts, so it has to wait for the longest wait after the last one.
    #[test]
    fn a_wrong_one_is_remembered_for_half_a_minute() {
        let mut lock = Lock::new(b"INIT");
        let mut now = Instant::from_millis(0);
        assert!(!lock.remembers(now));
        for _ in 0..9 {
            lock.fail(now);
            assert!(lock.remembers(now + 31_999));
            let mut later = lock;
            assert!(!later.remembers(now + 32_000) && !later.is_waiting(now + 32_000));
            now = now + 31_999;
        }
        lock.succeed();
        assert!(!lock.remembers(now) && !lock.is_waiting(now));
    }

    /// Half a second, one, two … half a minute; during the wait even the right password is refused.
    #[test]
    fn wrong_ones_are_slowed_down() {
        let mut lock = Lock::new(b"INIT");
        let mut now = Instant::from_millis(5);
        for delay in [500, 1000, 2000, 4000, 8000, 16_000, 32_000, 32_000, 32_000] {
            assert_eq!(lock.open(b"", now), WRONG);
            assert!(lock.is_waiting(now + (delay - 1)));
            assert_eq!(lock.open(b"INIT", now + (delay - 1)), TOO_EARLY);
            now = now + delay;
            assert!(!lock.is_waiting(now));
        }
        assert_eq!(lock.failures(), 9);
        assert_eq!(lock.open(b"INIT", now), Ok(()));
        assert_eq!(lock.open(b"", now), WRONG, "and counting begins anew");
        assert!(!lock.is_waiting(now + 500));
    }
}
