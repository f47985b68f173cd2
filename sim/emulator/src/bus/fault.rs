//! Injected faults: the errors that a test causes on the bus, and the frames that they affect.

use crate::frame::{Frame, Id};
use crate::time::Span;

/// The effect of a fault on a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FaultAction {
    /// The frame is acknowledged, and no receiver gets it: a gateway or a receive queue lost it.
    Drop,
    /// The receivers see a CRC error: error frame, counters, and the controller repeats the frame.
    Disturb,
    /// The receivers get other bits in one data byte, with a CRC that matches. Only an end-to-end
    /// check finds this fault.
    Alter {
        /// Which data byte, from 0. A frame without it passes unchanged.
        byte: usize,
        /// The bits to flip.
        mask: u8,
    },
    /// The frame is acknowledged, held back, and sent again after this time as a frame of its own,
    /// as a store-and-forward gateway does.
    Delay(Span),
    /// The frame gets through, and is sent once more right after it.
    Duplicate,
}

/// The frames that a fault is for. A field that is left open matches every frame.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct FrameMatch {
    /// The identifier.
    pub id: Option<Id>,
    /// The first data bytes.
    pub data: Vec<u8>,
    /// The sender, as its place among the nodes of the bus.
    pub from: Option<usize>,
}

impl FrameMatch {
    /// Frames with this identifier.
    #[must_use]
    pub fn id(id: Id) -> Self {
        Self { id: Some(id), ..Self::default() }
    }

    fn matches(&self, frame: &Frame, from: usize) -> bool {
        self.id.is_none_or(|id| id == frame.id())
            && frame.data().starts_with(&self.data)
            && self.from.is_none_or(|node| node == from)
    }
}

/// Which of the matching frames the fault hits. Every attempt counts, so a frame that the
/// controller repeats counts again.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum When {
    /// All.
    Always,
    /// The n-th alone, from 1.
    Nth(u64),
    /// Every n-th; 0 hits none.
    EveryNth(u64),
    /// The n-th and all after it, from 1.
    FromNth(u64),
    /// One in so many on average, in an order that the seed fixes; 0 hits none.
    OneIn {
        /// One in how many.
        frames: u32,
        /// The same seed hits the same frames.
        seed: u64,
    },
}

/// A rule: which frames it is for, how often it hits, and its effect.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Fault {
    /// Which frames.
    pub frames: FrameMatch,
    /// Which of them.
    pub when: When,
    /// What happens.
    pub action: FaultAction,
}

/// The rules in force, each with its count.
#[derive(Clone, Debug, Default)]
pub(super) struct Faults {
    rules: Vec<Rule>,
}

#[derive(Clone, Debug)]
struct Rule {
    fault: Fault,
    seen: u64,
    hits: u64,
    random: u64,
}

impl Faults {
    pub(super) fn add(&mut self, fault: Fault) -> usize {
        let random = match fault.when {
            When::OneIn { seed, .. } => seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1,
            _ => 0,
        };
        self.rules.push(Rule { fault, seen: 0, hits: 0, random });
        self.rules.len() - 1
    }

    pub(super) fn clear(&mut self) {
        self.rules.clear();
    }

    pub(super) fn hits(&self, rule: usize) -> u64 {
        self.rules.get(rule).map_or(0, |rule| rule.hits)
    }

    /// The effect on this frame: that of the first rule that hits it. All rules count the frame.
    pub(super) fn decide(&mut self, frame: &Frame, from: usize) -> Option<FaultAction> {
        let mut action = None;
        for rule in &mut self.rules {
            if rule.fault.frames.matches(frame, from) && rule.next() && action.is_none() {
                rule.hits += 1;
                action = Some(rule.fault.action);
            }
        }
        action
    }
}

impl Rule {
    fn next(&mut self) -> bool {
        self.seen += 1;
        match self.fault.when {
            When::Always => true,
            When::Nth(n) => self.seen == n,
            When::EveryNth(n) => n != 0 && self.seen.is_multiple_of(n),
            When::FromNth(n) => self.seen >= n,
            When::OneIn { frames, .. } => {
                // xorshift64
                self.random ^= self.random << 13;
                self.random ^= self.random >> 7;
                self.random ^= self.random << 17;
                frames != 0 && (self.random >> 32).is_multiple_of(u64::from(frames))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn hits(when: When) -> Vec<u64> {
        let mut faults = Faults::default();
        faults.add(Fault { frames: FrameMatch::default(), when, action: FaultAction::Drop });
        let frame = Frame::standard(1, &[]).unwrap();
        (1..=12).filter(|_| faults.decide(&frame, 0).is_some()).collect()
    }

    #[test]
    fn which_frames() {
        assert_eq!(hits(When::Always).len(), 12);
        assert_eq!(hits(When::Nth(3)), [3]);
        assert_eq!(hits(When::EveryNth(5)), [5, 10]);
        assert!(hits(When::EveryNth(0)).is_empty());
        assert_eq!(hits(When::FromNth(10)), [10, 11, 12]);
        assert!(hits(When::OneIn { frames: 0, seed: 1 }).is_empty());
        assert_eq!(hits(When::OneIn { frames: 1, seed: 1 }).len(), 12);
        assert_eq!(hits(When::OneIn { frames: 3, seed: 7 }), hits(When::OneIn { frames: 3, seed: 7 }));
    }

    #[test]
    fn one_in_ten_is_about_one_in_ten() {
        let mut faults = Faults::default();
        let when = When::OneIn { frames: 10, seed: 42 };
        let rule = faults.add(Fault { frames: FrameMatch::default(), when, action: FaultAction::Drop });
        let frame = Frame::standard(1, &[]).unwrap();
        for _ in 0..10_000 {
            faults.decide(&frame, 0);
        }
        // The standard deviation is 30.
        assert!((800..1200).contains(&faults.hits(rule)), "{}", faults.hits(rule));
    }

    #[test]
    fn matching() {
        let frame = Frame::standard(0x581, &[0x60, 1, 2]).unwrap();
        let by = |id: Option<u16>, data: &[u8], from| {
            let id = id.and_then(embedded_can::StandardId::new).map(Id::Standard);
            FrameMatch { id, data: data.to_vec(), from }.matches(&frame, 4)
        };
        assert!(by(None, &[], None));
        assert!(by(Some(0x581), &[0x60, 1], Some(4)));
        assert!(!by(Some(0x582), &[], None));
        assert!(!by(None, &[0x61], None));
        assert!(!by(None, &[0x60, 1, 2, 3], None));
        assert!(!by(None, &[], Some(3)));
    }
}
