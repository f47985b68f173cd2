//! Frames on their way into the queue of an adapter.
//!
//! An adapter answers each frame: `z`, `Z` or CR if it has taken it, BEL if it has not: its queue is full, or
//! its bus is closed, as after a restart. What it refused is sent again first. So that few are refused, the
//! tool estimates how full the queue is, from the time that a frame takes on the bus. Firmwares that answer
//! nothing (CANable) get frames at the pace of the bus.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use canopen::Frame;

use super::opening::{Answer, Heard, LATE_ANSWER, REST};
use super::{is_of_protocol, parse_frame, text_of, Line, Message, Slcan, ANSWER, MOST_EARLY};
use crate::adapter::AdapterError;
use crate::health::{Health, Losses};

/// The most frames without an answer (converters from USB hold back answers for 16 ms), and how many of them
/// are sent at once.
const MOST_UNDER_WAY: usize = 32;
const AT_ONCE: usize = 2;
/// How long an answer is waited for before more frames are sent.
const LEAD: Duration = Duration::from_micros(250);
/// The pauses before a refused frame is sent again: each is twice as long as the last one.
const PAUSES: [Duration; 2] = [Duration::from_micros(200), Duration::from_millis(4)];
/// After such pauses in all, the bus may be closed: it is opened again; and the adapter accepts no more frames.
const CLOSED: Duration = Duration::from_millis(100);
const STUCK: Duration = Duration::from_secs(1);
/// The bits of a frame with an identifier of 11 bits and 8 bytes, without stuff bits (ISO 11898-1).
const FRAME_BITS: u64 = 111;
/// The frames that a queue without answers is taken to have; a shorter one than this gets one at a time.
const UNKNOWN_QUEUE: u32 = 8;
const SHORT_QUEUE: u32 = 4;

/// Whether the adapter answers frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Answers {
    Unknown,
    Each,
    Never,
}

/// The frames that an adapter refuses.
#[derive(Clone, Copy, Debug)]
struct Refusal {
    /// The sum of the pauses, the next one, and when it is over.
    paused: Duration,
    pause: Duration,
    next: Instant,
    /// The answer to `O`, once the bus was opened again.
    reopened: Option<Answer>,
}

#[derive(Debug)]
pub(super) struct Sending {
    answers: Answers,
    /// Frames without an answer, and since when one is waited for.
    under_way: VecDeque<Frame>,
    waits: Instant,
    refused: VecDeque<Frame>,
    refusal: Option<Refusal>,
    /// How many frames the queue has, once it was full.
    capacity: Option<u32>,
    /// How long a frame takes on the bus: at least, and as estimated; 0 if the bit rate is unknown.
    shortest: Duration,
    frame_time: Duration,
    /// When the queue is empty, as estimated.
    empty: Instant,
    pub(super) losses: Losses,
    /// It has sent words, and no frame since then: it may have restarted.
    is_suspect: bool,
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
    fn room(&self) -> Option<Instant> {
        let under_way = self.under_way.len();
        let is_blind = self.capacity.is_some() && self.frame_time.is_zero() && under_way > 0;
        if under_way >= MOST_UNDER_WAY || !self.refused.is_empty() || is_blind {
            return None;
        }
        let Some(capacity) = self.capacity else {
            return Some(if under_way < AT_ONCE { self.waits } else { self.waits + LEAD });
        };
        // A quarter of a longer queue stays free, for what the estimate does not know.
        let before = self.frame_time * (capacity - capacity / 4 - 1);
        let queued = self.empty.checked_sub(before).unwrap_or(self.waits);
        let is_short = capacity < SHORT_QUEUE && under_way > 0;
        Some(if is_short { queued.max(self.waits + LEAD.max(self.frame_time)) } else { queued })
    }

    /// A frame is sent now.
    fn sends(&mut self, frame: Frame, now: Instant) {
        self.empty = self.empty.max(now) + self.frame_time;
        if self.answers != Answers::Never {
            self.waits = if self.under_way.is_empty() { now } else { self.waits };
            self.under_way.push_back(frame);
        }
    }

    /// The adapter has taken a frame, if one is under way.
    fn taken(&mut self, now: Instant) {
        self.waits = now;
        if self.under_way.pop_front().is_none() {
            return;
        }
        self.answers = Answers::Each;
        // What has slowed the bus down may be over.
        self.frame_time -= (self.frame_time - self.shortest) / 256;
        if let Some(refusal) = self.refusal.take() {
            self.losses.restarts += u32::from(refusal.reopened == Some(Answer::Done));
            self.is_full(now);
        }
    }

    /// The adapter has refused a frame.
    fn refuses(&mut self, now: Instant) {
        self.losses.refused = self.losses.refused.saturating_add(1);
        self.waits = now;
        let Some(frame) = self.under_way.pop_front() else { return };
        self.answers = Answers::Each;
        self.refused.push_back(frame);
        if self.refusal.is_none() && self.capacity.is_some() {
            // The frames of others, and stuff bits, take time, too.
            self.frame_time = (self.frame_time + self.frame_time / 8).min(4 * self.shortest);
        }
        let left = self.empty.saturating_duration_since(now).as_nanos();
        let queued = (left / self.frame_time.as_nanos().max(1)) as u32;
        let queued = queued.saturating_sub(1 + self.under_way.len() as u32).max(1);
        self.capacity = self.capacity.max(Some(queued));
        self.is_full(now);
    }

    /// The queue is full at this time; what was refused is sent again after a pause.
    fn is_full(&mut self, now: Instant) {
        self.empty = now + self.frame_time * self.capacity.unwrap_or_default();
        let [pause, _] = PAUSES;
        let first = Refusal { paused: Duration::ZERO, pause, next: now, reopened: None };
        if !self.refused.is_empty() {
            let refusal = self.refusal.get_or_insert(first);
            refusal.next = now + refusal.pause;
        }
    }

    /// What was sent is not answered any more.
    fn give_up(&mut self) {
        match self.answers {
            Answers::Unknown => self.set_silent(),
            _ => self.losses.lost = self.losses.lost.saturating_add(self.under_way.len() as u32),
        }
        self.under_way.clear();
    }
}

impl<L: Line> Slcan<L> {
    /// Sends a frame as soon as the adapter may have room for it.
    pub(super) fn hand_over(&mut self, frame: &Frame) -> Result<(), AdapterError> {
        self.go_on()?;
        loop {
            let (now, room) = (self.line.now(), self.sending.room());
            if room.is_some_and(|room| room <= now) {
                return self.write(*frame);
            }
            let until = [room, self.sending.due()].into_iter().flatten().min().unwrap_or(now);
            self.keep_until(until)?;
        }
    }

    fn write(&mut self, frame: Frame) -> Result<(), AdapterError> {
        if self.echoes {
            self.sent.sent(&frame);
        }
        self.sending.sends(frame, self.line.now());
        match self.sending.answers {
            Answers::Each => self.write_text(&text_of(&frame)),
            // Nothing else says when the line has taken it.
            Answers::Unknown | Answers::Never => self.send_text(&text_of(&frame)),
        }
    }

    /// Takes a message of an adapter whose bus is open; returns another node's frame.
    pub(super) fn hear(&mut self, message: &Message) -> Option<Frame> {
        let now = self.line.now();
        let Message::Text(text) = message else {
            self.sending.refuses(now);
            return None;
        };
        // An echo of characters has no end of its own.
        let end = text.strip_suffix(b"z").or(text.strip_suffix(b"Z"));
        let echo = end.filter(|_| self.echoes).and_then(parse_frame).filter(|echo| self.sent.takes(echo));
        if text.is_empty() || end == Some(b"") || echo.is_some() {
            self.sending.taken(now);
            return None;
        }
        let frame = parse_frame(text);
        if frame.is_none() && !is_of_protocol(text) {
            self.strange = self.strange.saturating_add(1);
            self.sending.is_suspect = true;
        }
        self.sending.is_suspect &= frame.is_none();
        frame.filter(|frame| !self.sent.takes(frame))
    }

    /// Takes a message while the tool waits for another one, and does what is due.
    fn keep_until(&mut self, until: Instant) -> Result<(), AdapterError> {
        if let Some(message) = self.message(until)? {
            self.keep(&message);
        }
        self.go_on()
    }

    fn keep(&mut self, message: &Message) {
        if let Some(frame) = self.hear(message).filter(|_| self.early.len() < MOST_EARLY) {
            self.early.push_back(frame);
        }
    }

    /// Waits until what was sent is answered, or given up.
    pub(super) fn settle(&mut self) -> Result<(), AdapterError> {
        while let Some(due) = self.sending.due() {
            self.keep_until(due)?;
        }
        Ok(())
    }

    /// Does what is due about the frames that were sent.
    pub(super) fn go_on(&mut self) -> Result<(), AdapterError> {
        let now = self.line.now();
        let is_due = |slcan: &Self| slcan.sending.due().is_some_and(|due| due <= now);
        if !self.sending.under_way.is_empty() {
            // The answers may have come while nobody read them: the computer may have slept.
            while is_due(self) && !self.sending.under_way.is_empty() {
                match self.message(now + REST)? {
                    Some(message) => self.keep(&message),
                    None => self.sending.give_up(),
                }
            }
            return Ok(());
        }
        if self.sending.is_suspect && now >= self.heard + REST {
            self.sending.is_suspect = false;
            let is_silent = self.sending.answers == Answers::Never;
            let answer = self.reopen()?;
            let has_restarted = answer == Answer::Done || is_silent && answer == Answer::None;
            self.sending.losses.restarts += u32::from(has_restarted);
        }
        match self.sending.refusal {
            Some(refusal) if is_due(self) => self.repeat(refusal),
            _ => Ok(()),
        }
    }

    /// Sends the first of the refused frames again.
    fn repeat(&mut self, mut refusal: Refusal) -> Result<(), AdapterError> {
        refusal.paused += refusal.pause;
        refusal.pause = PAUSES[1].min(2 * refusal.pause);
        if refusal.reopened.is_none() && refusal.paused >= CLOSED {
            refusal.reopened = Some(self.reopen()?);
        } else if refusal.paused >= STUCK {
            let health = Health { losses: self.sending.losses, ..Health::default() };
            return Err(AdapterError::Stuck { adapter: self.name.clone(), health });
        }
        self.sending.refusal = Some(refusal);
        self.sending.refused.pop_front().map_or(Ok(()), |frame| self.write(frame))
    }

    /// Opens the bus again, which an adapter with an open bus refuses. Returns the answer to `O`.
    fn reopen(&mut self) -> Result<Answer, AdapterError> {
        if let Some(rate) = self.rate.clone() {
            self.ask(&rate, ANSWER, &mut Heard::default())?;
        }
        let reply = self.ask("O", ANSWER, &mut Heard::default())?;
        Ok(if reply.words.is_empty() { reply.answer } else { Answer::None })
    }
}
