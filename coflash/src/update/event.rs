//! What happens during an update, for whoever watches it: one vocabulary for people, programs and
//! pages.
//!
//! Each event has words for people (`Display`), and a form for programs ([`Event::line`]): one
//! object with the node, the kind of the event as `event`, what belongs to it under names that
//! stay, and the words as `text`.

use std::fmt;

use canopen::NodeId;
use serde::{Serialize, Serializer};

pub use super::left::{DeviceState, Left};
pub use super::phase::{Note, Phase, Warning};
pub use super::report::Report;
pub use super::retry::{RepeatReason, Retry};
use crate::device::{DeviceType, Error};
use crate::json;

/// What happens during an update. `Display` has words for people.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(tag = "event", rename_all = "snake_case")]
#[non_exhaustive]
pub enum Event {
    /// Step 2: this is running on the device.
    Found(DeviceType),
    /// The update has come to here.
    Phase(Phase),
    /// Steps 6 to 9: so far the transfer has come.
    Progress {
        /// Bytes that are in the device.
        done: usize,
        /// Bytes in all.
        total: usize,
    },
    /// A block, or the whole program, is sent again.
    Retry(Retry),
    /// Something about the device that is good to know.
    Note(Note),
    /// Something that may go wrong because of it.
    Warning(Warning),
    /// The end, good or bad. Nothing comes behind it.
    Done(Box<Done>),
}

/// How an update ended. `Display` says, of one that failed, how it leaves the device.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct Done {
    /// How the device is left.
    #[serde(flatten)]
    pub left: Left,
    /// What was done, if all of it was.
    pub report: Option<Report>,
    /// What went wrong otherwise.
    pub error: Option<Problem>,
}

impl Done {
    /// The end of an update that has come to this result, and leaves the device like this.
    pub(super) fn new(left: Left, result: &Result<Report, Error>) -> Self {
        match result {
            Ok(report) => Self { left, report: Some(*report), error: None },
            Err(error) => Self { left, report: None, error: Some(Problem::of(error)) },
        }
    }
}

/// An [`Error`] that is told on.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct Problem {
    /// [`Error::number`].
    #[serde(serialize_with = "json::hex")]
    pub number: u32,
    /// What happened, in words.
    pub what: String,
    /// What to do next.
    pub advice: String,
}

impl Problem {
    /// What this error says of itself.
    #[must_use]
    pub fn of(error: &Error) -> Self {
        Self { number: error.number(), what: error.to_string(), advice: error.advice() }
    }
}

/// An event as one line for programs has it.
#[derive(Debug, Serialize)]
pub struct Line<'e> {
    #[serde(serialize_with = "json::node")]
    node: NodeId,
    #[serde(flatten)]
    event: &'e Event,
    #[serde(serialize_with = "words")]
    text: &'e Event,
}

fn words<S: Serializer>(event: &&Event, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(event)
}

impl Event {
    /// The event for programs: with the node that it is about, and with its words.
    #[must_use]
    pub fn line(&self, node: NodeId) -> Line<'_> {
        Line { node, event: self, text: self }
    }

    /// How a failed update leaves the device, if this is the end of one.
    #[must_use]
    pub fn left(&self) -> Option<Left> {
        match self {
            Self::Done(done) if done.error.is_some() => Some(done.left),
            _ => None,
        }
    }
}

impl From<Phase> for Event {
    fn from(phase: Phase) -> Self {
        Self::Phase(phase)
    }
}

impl From<Note> for Event {
    fn from(note: Note) -> Self {
        Self::Note(note)
    }
}

impl From<Warning> for Event {
    fn from(warning: Warning) -> Self {
        Self::Warning(warning)
    }
}

impl fmt::Display for Event {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Found(running) => write!(f, "found {running}"),
            Self::Phase(phase) => phase.fmt(f),
            Self::Progress { done, total } => write!(f, "{done} of {total} bytes"),
            Self::Retry(retry) => retry.fmt(f),
            Self::Note(note) => note.fmt(f),
            Self::Warning(warning) => warning.fmt(f),
            Self::Done(done) => done.fmt(f),
        }
    }
}

impl fmt::Display for Done {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.report {
            Some(report) => report.fmt(f),
            None => write!(f, "the device: {}", self.left),
        }
    }
}
