//! The events of an update, with one set of names for people, programs and pages.
//!
//! Each event has a text for people (`Display`) and a form for programs ([`Event::line`]): one
//! object with the node, the kind of the event as `event`, its data under stable names, and the
//! text as `text`.

use std::fmt;

use canopen::NodeId;
use serde::{Serialize, Serializer};

pub use super::device_after::{DeviceAfterUpdate, DeviceState};
pub use super::phase::{Note, Phase, Warning};
pub use super::report::Report;
pub use super::retry::{RepeatReason, Retry};
use crate::advice::{Advice, OfProgram};
use crate::device::{DeviceType, Error};
use crate::json;

/// An event of an update. `Display` has the text for people.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(tag = "event", rename_all = "snake_case")]
#[non_exhaustive]
pub enum Event {
    /// Step 2: the device type of what runs on the device.
    Found(DeviceType),
    /// The update has entered this phase.
    Phase(Phase),
    /// Steps 6 to 9: the progress of the transfer.
    Progress {
        /// Bytes that have arrived in the device.
        done: usize,
        /// Total number of bytes.
        total: usize,
    },
    /// A block or the whole program is sent again.
    Retry(Retry),
    /// Useful information about the device.
    Note(Note),
    /// A problem that may make the update fail.
    Warning(Warning),
    /// The end, successful or not. No event follows it.
    Done(Box<Done>),
}

/// How an update ended. After a failure, `Display` describes the state of the device.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct Done {
    /// The state of the device.
    #[serde(flatten)]
    pub left: DeviceAfterUpdate,
    /// The results of a successful update.
    pub report: Option<Report>,
    /// The error of a failed update.
    pub error: Option<Problem>,
}

impl Done {
    /// The end of an update with this result, and this state of the device.
    pub(super) fn new(left: DeviceAfterUpdate, result: &Result<Report, Error>) -> Self {
        match result {
            Ok(report) => Self { left, report: Some(*report), error: None },
            Err(error) => Self { left, report: None, error: Some(Problem::of(error)) },
        }
    }
}

/// An [`Error`] in the form for events.
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
    /// What the device has answered, for reports: [`Error::answers`].
    #[serde(skip)]
    pub answers: Vec<String>,
}

impl Problem {
    /// The data of this error.
    #[must_use]
    pub fn of(error: &Error) -> Self {
        Self {
            number: error.number(),
            what: error.to_string(),
            advice: error.advice().to_string(),
            answers: error.answers(),
        }
    }
}

/// An event in the form of one line for programs.
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
    /// The event for programs, with its node and its text.
    #[must_use]
    pub fn line(&self, node: NodeId) -> Line<'_> {
        Line { node, event: self, text: self }
    }

    /// The advice at the end of its text, if there is any.
    #[must_use]
    pub fn advice(&self) -> Option<Advice> {
        match self {
            Self::Phase(Phase::NotReleased { program }) => {
                Some(Advice::ReleaseIt { program: OfProgram(*program) })
            }
            Self::Done(done) if done.report.is_none() => done.left.advice(),
            _ => None,
        }
    }

    /// The state of the device, if this event is the end of a failed update.
    #[must_use]
    pub fn left(&self) -> Option<DeviceAfterUpdate> {
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
