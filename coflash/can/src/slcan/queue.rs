//! How full the queue of an adapter is, as far as its answers say.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use canopen::Frame;

use crate::health::Losses;

/// How long the answer to a frame is waited for, and that of an adapter which answers commands too late for
/// their order.
pub(super) const LATE_ANSWER: Duration = Duration::from_secs(1);
/// The most frames without an answer (converters from USB hold back answers for 16 ms), and how many of them
/// are sent at once.
const MOST_UNDER_WAY: usize = 32;
const AT_ONCE: usize = 2;
/// How long an answer is waited for before more frames are sent.
const LEAD: Duration = Duration::from_micros(250);
/// The shortest pause before a refused frame is sent again.
const PAUSE: Duration = Duration::from_micros(200);
/// The bits of a frame with an identifier of 11 bits and 8 bytes, without stuff bits (ISO 11898-1).
const FRAME_BITS: u64 = 111;
/// The frames that a queue without answers is taken to have; a shorter one than this gets one at a time.
const UNKNOWN_QUEUE: u32 = 8;
const SHORT_QUEUE: u32 = 4;

/// Whether the adapter answers frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Answers {
    Unknown,
    Each,
    Never,
}

/// The frames that an adapter refuses.
#[derive(Clone, Copy, Debug)]
pub(super) struct Refusal {
    /// The sum of the pauses, the next one, and when it is over.
    pub(super) paused: Duration,
    pub(super) pause: Duration,
    next: Instant,
    /// Whether the adapter has acknowledged `O`, once the bus was opened again.
    pub(super) reopened: Option<bool>,
}

#[derive(Debug)]
pub(super) struct Sending {
    pub(super) answers: Answers,
    /// Frames without an answer, and since when one is waited for.
    pub(super) under_way: VecDeque<Frame>,
    waits: Instant,
    pub(super) refused: VecDeque<Frame>,
    pub(super) refusal: Option<Refusal>,
    /// How many frames the queue has, once it was full.
    capacity: Option<u32>,
    /// The frames that it has taken since the queue was empty, or since it was full, and since when.
    took: u32,
    since: Instant,
    was_full: bool,
    /// How long a frame takes on the bus: at least, and as estimated; 0 if the bit rate is unknown.
    shortest: Duration,
    frame_time: Duration,
    /// When the queue is empty, as estimated.
    empty: Instant,
    pub(super) losses: Losses,
    /// It has sent words, and no frame since then: it may have restarted.
    pub(super) is_suspect: bool,
}

impl Sending {
    pub(super) fn new(now: Instant) -> Self {
        Self {
            answers: Answers::Unknown,
            under_way: VecDeque::new(),
            waits: now,
            refused: VecDeque::new(),
            refusal: None,
            capacity: None,
            took: 0,
            since: now,
            was_full: false,
            shortest: Duration::ZERO,
            frame_time: Duration::ZERO,
            empty: now,
            losses: Losses::default(),
            is_suspect: false,
        }
    }

    /// The bus is open at this bit rate; `answers` says whether the adapter has acknowledged a command.
    pub(super) fn opened(&mut self, bit_rate: Option<u32>, answers: bool) {
        self.shortest = bit_rate.map_or(Duration::ZERO, |rate| Duration::from_secs(FRAME_BITS) / rate.max(1));
        self.frame_time = self.shortest;
        self.answers = Answers::Unknown;
        if !answers {
            self.set_silent();
        }
    }

    fn set_silent(&mut self) {
        (self.answers, self.capacity) = (Answers::Never, Some(UNKNOWN_QUEUE));
    }

    /// When something is to be done about what was sent, at the latest.
    pub(super) fn due(&self) -> Option<Instant> {
        match self.refusal {
            _ if !self.under_way.is_empty() => Some(self.waits + LATE_ANSWER),
            Some(refusal) if !self.refused.is_empty() => Some(refusal.next),
            _ => None,
        }
    }

    /// When the next frame may be sent; `None` while that depends on an answer.
    pub(super) fn room(&self) -> Option<Instant> {
        let under_way = self.under_way.len();
        let is_blind = self.capacity.is_some() && self.frame_time.is_zero() && under_way > 0;
        if under_way >= MOST_UNDER_WAY || !self.refused.is_empty() || is_blind {
            return None;
        }
        let Some(capacity) = self.capacity else {
            return Some(if under_way < AT_ONCE { self.waits } else { self.waits + LEAD });
        };
        // A part of the queue stays free, for what the estimate does not know: more of it while others are
        // under way, which a refused frame would come after.
        let free = if under_way > 0 { capacity.div_ceil(2) } else { capacity / 4 };
        let before = self.frame_time * (capacity - free).saturating_sub(1);
        let queued = self.empty.checked_sub(before).unwrap_or(self.waits);
        let is_short = capacity < SHORT_QUEUE && under_way > 0;
        Some(if is_short { queued.max(self.waits + LEAD.max(self.frame_time)) } else { queued })
    }

    /// A frame is sent now.
    pub(super) fn sends(&mut self, frame: Frame, now: Instant) {
        if self.empty <= now && self.under_way.is_empty() {
            (self.took, self.was_full) = (0, false);
        }
        self.empty = self.empty.max(now) + self.frame_time;
        if self.answers != Answers::Never {
            self.waits = if self.under_way.is_empty() { now } else { self.waits };
            self.under_way.push_back(frame);
        }
    }

    /// The adapter has taken a frame, if one is under way.
    pub(super) fn taken(&mut self, now: Instant) {
        self.waits = now;
        if self.under_way.pop_front().is_none() {
            return;
        }
        self.answers = Answers::Each;
        if self.took == 0 && !self.was_full {
            self.since = now;
        }
        self.took += 1;
        // What has slowed the bus down may be over.
        self.frame_time -= (self.frame_time - self.shortest) / 256;
        if let Some(refusal) = self.refusal.take() {
            self.losses.restarts += u32::from(refusal.reopened == Some(true));
            self.pause(now);
        }
    }

    /// The adapter has refused a frame: its queue is full.
    pub(super) fn refuses(&mut self, now: Instant) {
        self.losses.refused = self.losses.refused.saturating_add(1);
        self.waits = now;
        let Some(frame) = self.under_way.pop_front() else { return };
        self.answers = Answers::Each;
        self.refused.push_back(frame);
        let elapsed = now - self.since;
        let filled = if self.was_full { 0 } else { self.capacity.unwrap_or(self.took) };
        if let Some(sent @ 1..) = self.took.checked_sub(filled) {
            // Those of others, and stuff bits, take time, too.
            let measured = (elapsed / sent).clamp(self.shortest, 4 * self.shortest);
            self.frame_time = measured.min(self.frame_time + self.frame_time / 16);
        }
        if !self.was_full {
            let sent = (elapsed.as_nanos() / self.shortest.as_nanos().max(1)) as u32;
            self.capacity = self.capacity.max(Some(self.took.saturating_sub(sent).max(1)));
        }
        (self.took, self.since, self.was_full) = (0, now, true);
        self.empty = now + self.frame_time * self.capacity.unwrap_or_default();
        self.pause(now);
    }

    /// What was refused is sent again when there is room for one frame, and after longer and longer pauses.
    fn pause(&mut self, now: Instant) {
        if !self.refused.is_empty() {
            let none = Duration::ZERO;
            let first = Refusal { paused: none, pause: none, next: now, reopened: None };
            let refusal = self.refusal.get_or_insert(first);
            refusal.pause = PAUSE.max(self.frame_time).max(refusal.paused / 2);
            refusal.next = now + refusal.pause;
        }
    }

    /// What was sent is not answered any more.
    pub(super) fn give_up(&mut self) {
        match self.answers {
            Answers::Unknown => self.set_silent(),
            _ => self.losses.lost = self.losses.lost.saturating_add(self.under_way.len() as u32),
        }
        self.under_way.clear();
    }
}
