//! Frames on their way into the queue of an adapter.
//!
//! An adapter answers each frame: `z`, `Z` or CR if it has taken it, BEL if it has not: its queue is full, or
//! its bus is closed, as after a restart. What it refused is sent again first. So that few are refused, the
//! tool estimates how full the queue is, from the time that a frame takes on the bus. Firmwares that answer
//! nothing (CANable) get frames at the pace of the bus.

use std::time::{Duration, Instant};

use canopen::Frame;

use super::opening::{Answer, Heard, REST};
use super::queue::{Answers, Refusal, LATE_ANSWER};
use super::{is_of_protocol, parse_frame, text_of, Line, Message, Slcan, ANSWER, MOST_EARLY};
use crate::adapter::AdapterError;
use crate::health::Health;

/// After such pauses in all, the bus may be closed: it is opened again; and the adapter accepts no more frames.
const CLOSED: Duration = Duration::from_millis(100);
const STUCK: Duration = Duration::from_secs(1);

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
        // One that acknowledges nothing may say anything: it has restarted if its bus is silent from then on.
        let (patience, restarted) = match self.sending.answers {
            Answers::Never => (LATE_ANSWER, Answer::None),
            Answers::Unknown | Answers::Each => (REST, Answer::Done),
        };
        if self.sending.is_suspect && now >= self.heard + patience {
            self.sending.is_suspect = false;
            self.sending.losses.restarts += u32::from(self.reopen()? == restarted);
        }
        match self.sending.refusal {
            Some(refusal) if is_due(self) => self.repeat(refusal),
            _ => Ok(()),
        }
    }

    /// Sends the first of the refused frames again.
    fn repeat(&mut self, mut refusal: Refusal) -> Result<(), AdapterError> {
        refusal.paused += refusal.pause;
        if refusal.reopened.is_none() && refusal.paused >= CLOSED {
            refusal.reopened = Some(self.reopen()? == Answer::Done);
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
