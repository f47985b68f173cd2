//! What the attacker finds.

use std::fmt;

/// A broken rule, with details.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Broken {
    /// No answer in time, or one that nobody asked for.
    Answer(String),
    /// Node parameters that no master stored.
    Parameters(String),
    /// A program that nobody asked to change.
    Program(String),
    /// A record that is not true.
    Record(String),
    /// A reset that nobody asked for.
    Reset(String),
    /// The watchdog was fed late.
    Watchdog(String),
    /// Another one.
    Other(String),
}

impl fmt::Display for Broken {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (rule, what) = match self {
            Self::Answer(what) => ("answers", what),
            Self::Parameters(what) => ("node parameters stay", what),
            Self::Program(what) => ("programs stay", what),
            Self::Record(what) => ("records are true", what),
            Self::Reset(what) => ("no reset unasked", what),
            Self::Watchdog(what) => ("the watchdog is fed", what),
            Self::Other(what) => ("device", what),
        };
        write!(f, "{rule}: {what}")
    }
}
