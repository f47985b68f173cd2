//! Turns of the conversations that send many frames in a row.
//!
//! The segments of several transfers at once would fill the adapter's queue, and the bus without a
//! pause: nodes could not send what has a lower priority than requests, such as a boot-up, for as
//! long as that lasts, and the segments of one transfer would have pauses that its device takes for
//! losses. So one conversation at a time sends a burst. The next one waits for the answer to it, and
//! for a moment in which the bus is free. Single requests are sent at once.

use std::collections::VecDeque;
use std::time::Duration;

use canopen::Frame;

/// If a burst gets no answer for this time, the next conversation has its turn.
const UNANSWERED: Duration = Duration::from_millis(250);

/// How long the bus is left alone between two turns. A frame can begin when the bus has been idle
/// for 3 bits, which are 150 us at 20 kbit/s.
const PAUSE: Duration = Duration::from_micros(300);

/// Whose turn it is, and the frames of those that wait for theirs.
#[derive(Default)]
pub(super) struct Turns {
    turn: Option<Turn>,
    /// When the last turn ended.
    ended: Duration,
    held: VecDeque<(usize, Vec<Frame>)>,
}

struct Turn {
    port: usize,
    /// When its burst was complete; `None` while it sends.
    waits_since: Option<Duration>,
}

impl Turns {
    /// Whether frames of this conversation wait for its turn.
    pub(super) fn hold(&self, port: usize) -> bool {
        self.held.iter().any(|(held, _)| *held == port)
    }

    /// Takes what a conversation sends before it waits, until `until`; returns what is sent now.
    pub(super) fn take(
        &mut self,
        port: usize,
        frames: Vec<Frame>,
        until: Duration,
        now: Duration,
    ) -> Vec<Frame> {
        if let Some((_, held)) = self.held.iter_mut().find(|(held, _)| *held == port) {
            held.extend(frames);
            return Vec::new();
        }
        let is_burst = frames.len() > 1;
        match &mut self.turn {
            Some(turn) if turn.port == port => turn.waits_since = (until > now).then_some(now),
            turn if is_burst && (turn.is_some() || !self.held.is_empty()) => {
                self.held.push_back((port, frames));
                return Vec::new();
            }
            None if is_burst => {
                self.turn = Some(Turn { port, waits_since: (until > now).then_some(now) });
            }
            _ => {}
        }
        frames
    }

    /// A conversation has got an answer, or waits no longer.
    pub(super) fn woken(&mut self, port: usize, now: Duration) {
        if self.turn.as_ref().is_some_and(|turn| turn.port == port && turn.waits_since.is_some()) {
            self.turn = None;
            self.ended = now;
        }
    }

    /// A conversation has ended.
    pub(super) fn gone(&mut self, port: usize) {
        self.held.retain(|(held, _)| *held != port);
        if self.turn.as_ref().is_some_and(|turn| turn.port == port) {
            self.turn = None;
        }
    }

    /// When the next conversation has its turn at the latest, if one waits for it.
    pub(super) fn deadline(&self) -> Option<Duration> {
        if self.held.is_empty() {
            return None;
        }
        match &self.turn {
            Some(turn) => turn.waits_since.map(|since| since + UNANSWERED),
            None => Some(self.ended + PAUSE),
        }
    }

    /// Passes the turn on if it is time; returns the frames of the next conversation.
    pub(super) fn pass_on(&mut self, now: Duration) -> Vec<Frame> {
        if self.deadline().is_none_or(|deadline| now < deadline) {
            return Vec::new();
        }
        let Some((port, frames)) = self.held.pop_front() else { return Vec::new() };
        self.turn = Some(Turn { port, waits_since: None });
        frames
    }
}
