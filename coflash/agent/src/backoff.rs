//! Pauses with jitter, so that many devices do not ask at the same moment.

use std::time::Duration;

/// A source of jitter: SplitMix64 (Steele, Lea, Flood 2014), the same course for the same seed.
#[derive(Clone, Debug)]
pub(super) struct Jitter(u64);

impl Jitter {
    pub(super) fn new(seed: u64) -> Self {
        Self(seed)
    }

    /// A number in 0..1.
    fn part(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ z >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ z >> 27).wrapping_mul(0x94D0_49BB_1331_11EB);
        // 53 bits fit into the number exactly.
        ((z ^ z >> 31) >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// A pause of this length or up to a tenth longer.
    pub(super) fn longer(&mut self, pause: Duration) -> Duration {
        pause + pause.mul_f64(self.part() / 10.0)
    }

    /// The pause after this many failures in a row: doubled with each, half of that to all of it.
    pub(super) fn after(&mut self, failures: u32, (first, most): (Duration, Duration)) -> Duration {
        let doubled = first.saturating_mul(1 << failures.saturating_sub(1).min(20)).min(most);
        doubled.mul_f64(0.5 + self.part() / 2.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pauses_grow_to_their_limit_and_differ() {
        let (first, most) = (Duration::from_secs(4), Duration::from_secs(60));
        let course = |seed| {
            let mut jitter = Jitter::new(seed);
            (1..=40).map(|failures| jitter.after(failures, (first, most))).collect::<Vec<_>>()
        };
        for (failures, pause) in course(1).into_iter().enumerate() {
            let full = Duration::from_secs(4 << failures.min(10)).min(most);
            assert!(pause >= full / 2 && pause <= full, "{failures}: {pause:?}");
        }
        assert_eq!(course(1), course(1));
        assert_ne!(course(1), course(2));
        let mut jitter = Jitter::new(0);
        let longer = jitter.longer(most);
        assert!(longer >= most && longer <= most + most / 10);
    }
}
