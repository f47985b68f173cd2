//! Frames on their way into the queue of an adapter, in their order.
//!
//! An adapter answers each frame: `z`, `Z` or CR if it has taken it, BEL if it has not: its queue is full, or
//! its bus is closed, as after a restart. A refused frame is sent again, before any other one. So that few
//! are refused, the tool estimates how full the queue is, from the time that a frame takes on the bus.
//! Firmwares that acknowledge nothing (CANable) get frames without a limit.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use canopen::Frame;

use super::opening::{Answer, Heard, LATE_ANSWER, REST};
use super::{parse_frame, text_of, Line, Message, Slcan, ANSWER, MOST_EARLY};
use crate::adapter::AdapterError;
use crate::health::{Health, Losses};
use crate::tcp::PATIENCE;

/// The most frames without an answer. Converters from USB hold back answers for 16 ms.
const MOST_UNDER_WAY: usize = 32;
/// How long the answer to a frame is waited for before the next one is sent.
const LEAD: Duration = Duration::from_micros(250);
/// The pause before a refused frame is sent again. It doubles with each refusal …
const PAUSE: Duration = Duration::from_micros(200);
/// … up to this one.
const LONGEST_PAUSE: Duration = Duration::from_millis(4);
/// An adapter that has refused a frame for so long may have closed its bus: it is opened again.
const CLOSED: Duration = Duration::from_millis(100);
/// An adapter that goes on to refuse a frame for so long, and so often, accepts no more frames.
const STUCK: Duration = Duration::from_secs(1);
const MOST_REFUSALS: u32 = 10;
/// How often the bus is opened again at most for an adapter that sends words.
const PROBE_PERIOD: Duration = Duration::from_secs(1);
/// The bits of a frame with an identifier of 11 bits and 8 bytes, without stuff bits (ISO 11898-1).
const FRAME_BITS: u32 = 111;

/// Whether the adapter answers frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Answers {
    Unknown,
    Each,
    Never,
}

/// A frame that the adapter refuses.
#[derive(Clone, Copy, Debug)]
struct Refusal {
    since: Instant,
    count: u32,
    /// When it is sent again.
    next: Instant,
    pause: Duration,
    /// The answer to `O`, once the bus was opened again.
    reopened: Option<Answer>,
}

impl Refusal {
    const fn new(since: Instant, next: Instant) -> Self {
        Self { since, count: 0, next, pause: PAUSE, reopened: None }
    }
}

#[derive(Debug)]
pub(super) struct Sending {
    answers: Answers,
    /// Frames without an answer, in their order.
    under_way: VecDeque<Frame>,
    /// When the last frame was sent, and since when an answer is waited for.
    sent: Instant,
    waits: Instant,
    /// Frames that were refused, in their order.
    refused: VecDeque<Frame>,
    refusal: Option<Refusal>,
    /// How many frames the queue has; `None` as long as it has refused none.
    capacity: Option<u32>,
    /// How long a frame takes on the bus: the shortest time, and the estimate; 0 if the bit rate is unknown.
    shortest: Duration,
    frame_time: Duration,
    /// When the queue is empty, as estimated.
    empty: Instant,
    pub(super) losses: Losses,
    /// It has sent words, and no frame since then: it may have restarted.
    is_suspect: bool,
    /// When it was last opened again for its words.
    probed: Option<Instant>,
}

impl Sending {
    pub(super) fn new(now: Instant) -> Self {
        Self {
            answers: Answers::Unknown,
            under_way: VecDeque::new(),
            sent: now,
            waits: now,
            refused: VecDeque::new(),
            refusal: None,
            capacity: None,
            shortest: Duration::ZERO,
            frame_time: Duration::ZERO,
            empty: now,
            losses: Losses::default(),
            is_suspect: false,
            probed: None,
        }
    }

    /// The bus is open at this bit rate; `answers` says whether the adapter has acknowledged a command.
    pub(super) fn opened(&mut self, bit_rate: Option<u32>, answers: bool) {
        let bits = Duration::from_secs(FRAME_BITS.into());
        self.shortest = bit_rate.map_or(Duration::ZERO, |rate| bits / rate.max(1));
        self.frame_time = self.shortest;
        self.answers = if answers { Answers::Unknown } else { Answers::Never };
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
        let is_full = self.under_way.len() >= MOST_UNDER_WAY || !self.refused.is_empty();
        let pace = match self.capacity {
            _ if is_full => return None,
            _ if self.answers == Answers::Never => return Some(self.sent),
            None => self.sent,
            Some(_) if self.frame_time.is_zero() && !self.under_way.is_empty() => return None,
            Some(capacity) => {
                let before = self.frame_time * capacity.saturating_sub(1);
                self.empty.checked_sub(before).unwrap_or(self.sent)
            }
        };
        match self.capacity {
            _ if self.under_way.is_empty() => Some(pace),
            None => Some(pace.max(self.sent + LEAD)),
            Some(_) => Some(pace.max(self.sent + LEAD.max(self.frame_time))),
        }
    }

    /// A frame is sent now.
    fn sends(&mut self, frame: Frame, now: Instant) {
        self.empty = self.empty.max(now) + self.frame_time;
        self.sent = now;
        if self.answers != Answers::Never {
            if self.under_way.is_empty() {
                self.waits = now;
            }
            self.under_way.push_back(frame);
        }
    }

    /// The adapter has taken a frame, or acknowledged a command of before. An empty line may also be the
    /// begin of words.
    pub(super) fn taken(&mut self, is_certain: bool, now: Instant) {
        self.waits = now;
        if self.under_way.pop_front().is_none() && !(is_certain && self.answers == Answers::Never) {
            return;
        }
        self.answers = Answers::Each;
        // What has slowed the bus down may be over.
        self.frame_time -= (self.frame_time - self.shortest) / 256;
        let Some(refusal) = self.refusal.take() else { return };
        self.is_full(now);
        self.losses.restarts += u32::from(refusal.reopened == Some(Answer::Done));
        self.refusal = (!self.refused.is_empty()).then(|| Refusal::new(now, now));
    }

    /// The adapter has refused a frame.
    pub(super) fn refuses(&mut self, now: Instant) {
        self.losses.refused = self.losses.refused.saturating_add(1);
        self.waits = now;
        let Some(frame) = self.under_way.pop_front() else { return };
        self.answers = Answers::Each;
        self.refused.push_back(frame);
        match &mut self.refusal {
            Some(refusal) => {
                refusal.count += 1;
                refusal.next = now + refusal.pause;
            }
            None => {
                self.refusal = Some(Refusal::new(now, now + PAUSE));
                if self.capacity.is_some() {
                    // The frames of others, and stuff bits, take time, too.
                    self.frame_time = (self.frame_time + self.frame_time / 16).min(4 * self.shortest);
                } else {
                    let left = self.empty.saturating_duration_since(now).as_nanos();
                    let queued = (left / self.frame_time.as_nanos().max(1)) as u32;
                    self.capacity = Some(queued.saturating_sub(1 + self.under_way.len() as u32).max(1));
                }
            }
        }
        self.is_full(now);
    }

    /// The queue is full at this time.
    fn is_full(&mut self, now: Instant) {
        self.empty = now + self.frame_time * self.capacity.unwrap_or_default();
    }

    /// What was sent is not answered any more.
    fn give_up(&mut self) {
        match self.answers {
            Answers::Unknown => self.answers = Answers::Never,
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
            let now = self.line.now();
            let room = self.sending.room();
            if room.is_some_and(|room| room <= now) {
                return self.write(*frame);
            }
            let until = [room, self.sending.due()].into_iter().flatten().min().unwrap_or(now);
            if let Some(message) = self.message(until)? {
                self.keep(&message);
            }
            self.go_on()?;
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
        let text = match message {
            Message::Refused => {
                self.sending.refuses(now);
                return None;
            }
            Message::Text(text) => text.as_slice(),
        };
        if let b"" | b"z" | b"Z" = text {
            self.sending.taken(!text.is_empty(), now);
            return None;
        }
        // An echo of characters has no end of its own.
        let echo = text.strip_suffix(b"z").or(text.strip_suffix(b"Z")).filter(|_| self.echoes);
        if let Some(frame) = echo.and_then(parse_frame) {
            self.sent.takes(&frame);
            self.sending.taken(true, now);
            return None;
        }
        let frame = parse_frame(text);
        if frame.is_some() {
            self.sending.is_suspect = false;
        } else if !super::is_of_protocol(text) {
            self.strange = self.strange.saturating_add(1);
            self.sending.is_suspect = true;
        }
        frame.filter(|frame| !self.sent.takes(frame))
    }

    /// Takes a message while the tool waits for another one.
    pub(super) fn keep(&mut self, message: &Message) {
        if let Some(frame) = self.hear(message).filter(|_| self.early.len() < MOST_EARLY) {
            self.early.push_back(frame);
        }
    }

    /// Does what is due about the frames that were sent.
    pub(super) fn go_on(&mut self) -> Result<(), AdapterError> {
        let is_overdue = |slcan: &Self, now| slcan.sending.due().is_some_and(|due| due <= now);
        let now = self.line.now();
        if !self.sending.under_way.is_empty() {
            // The answers may have come while nobody read them: the computer may have slept.
            for _ in 0..MOST_EARLY {
                if !is_overdue(self, now) {
                    break;
                }
                match self.message(now + REST)? {
                    Some(message) => self.keep(&message),
                    None => self.sending.give_up(),
                }
            }
            return Ok(());
        }
        let is_probed = self.sending.probed.is_some_and(|at| now < at + PROBE_PERIOD);
        if self.sending.is_suspect && now >= self.heard + REST && !is_probed {
            self.sending.probed = Some(now);
            self.sending.is_suspect = false;
            let answer = self.reopen()?;
            let is_silent = answer == Answer::None && self.sending.answers == Answers::Never;
            self.sending.losses.restarts += u32::from(answer == Answer::Done || is_silent);
        }
        match self.sending.refusal {
            Some(refusal) if is_overdue(self, now) => self.repeat(refusal),
            _ => Ok(()),
        }
    }

    /// Sends the first of the refused frames again.
    fn repeat(&mut self, mut refusal: Refusal) -> Result<(), AdapterError> {
        let refused_for = self.line.now().saturating_duration_since(refusal.since);
        if refusal.reopened.is_none() && refused_for >= CLOSED {
            refusal.reopened = Some(self.reopen()?);
            (refusal.since, refusal.count) = (self.line.now(), 0);
        } else if refusal.reopened.is_some() && refused_for >= STUCK && refusal.count >= MOST_REFUSALS {
            let health = Health { losses: self.sending.losses, ..Health::default() };
            return Err(AdapterError::Stuck { adapter: self.name.clone(), health });
        }
        refusal.pause = LONGEST_PAUSE.min(2 * refusal.pause);
        self.sending.refusal = Some(refusal);
        match self.sending.refused.pop_front() {
            Some(frame) => self.write(frame),
            None => Ok(()),
        }
    }

    /// Opens the bus again, as it was opened: an adapter whose bus is open refuses that. Returns the answer to
    /// `O`.
    fn reopen(&mut self) -> Result<Answer, AdapterError> {
        if let Some(rate) = self.rate.clone() {
            self.ask(&rate, ANSWER, &mut Heard::default())?;
        }
        let reply = self.ask("O", ANSWER, &mut Heard::default())?;
        Ok(if reply.words.is_empty() { reply.answer } else { Answer::None })
    }

    /// Waits until what was sent is answered, or given up.
    pub(super) fn settle(&mut self) -> Result<(), AdapterError> {
        while let Some(due) = self.sending.due() {
            if let Some(message) = self.message(due)? {
                self.keep(&message);
            }
            self.go_on()?;
        }
        Ok(())
    }

    /// Writes text without waiting until the line has sent it.
    pub(super) fn write_text(&mut self, text: &str) -> Result<(), AdapterError> {
        // The time of a serial port is that of reads and writes.
        let done = self.line.set_timeout(PATIENCE).and_then(|()| self.line.write_all(text.as_bytes()));
        done.map_err(|error| self.lost(error))
    }
}
