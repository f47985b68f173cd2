//! Time: milliseconds in 32 bits, which wrap after 49 days.

use core::ops::Add;

/// A point in time, in milliseconds from an origin that the caller has chosen.
///
/// It wraps. Two instants are compared by their difference, which is correct if they are less than
/// 2³¹ ms (24 days) apart; therefore there is no `Ord`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Instant(u32);

impl Instant {
    /// The instant at which a free-running millisecond counter reads `millis`.
    #[must_use]
    pub const fn from_millis(millis: u32) -> Self {
        Self(millis)
    }

    /// The counter's reading.
    #[must_use]
    pub const fn as_millis(self) -> u32 {
        self.0
    }

    /// Milliseconds from `earlier` to this instant.
    #[must_use]
    pub const fn since(self, earlier: Self) -> u32 {
        self.0.wrapping_sub(earlier.0)
    }

    /// Whether `deadline` has passed.
    #[must_use]
    pub const fn has_reached(self, deadline: Self) -> bool {
        self.since(deadline) < 1 << 31
    }

    /// The earlier of two instants.
    #[must_use]
    pub const fn earlier(self, other: Self) -> Self {
        if self.has_reached(other) {
            other
        } else {
            self
        }
    }
}

/// This many milliseconds later.
impl Add<u32> for Instant {
    type Output = Self;

    fn add(self, millis: u32) -> Self {
        Self(self.0.wrapping_add(millis))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_deadline_behind_the_wrap_is_still_ahead() {
        let now = Instant::from_millis(u32::MAX - 9);
        let deadline = now + 20;
        assert_eq!(deadline.as_millis(), 10);
        assert!(!now.has_reached(deadline));
        assert!(!(now + 19).has_reached(deadline));
        assert!((now + 20).has_reached(deadline));
        assert!((now + 21).has_reached(deadline));
        assert_eq!((now + 21).since(now), 21);
        assert_eq!(now.earlier(deadline), now);
        assert_eq!(deadline.earlier(now), now);
    }
}
