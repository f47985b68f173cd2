//! Repetitions of blocks and programs, and their reasons.

use std::fmt;

use canopen::AbortCode;
use serde::ser::SerializeStruct as _;
use serde::{Serialize, Serializer};

/// A block or the whole program is sent again.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct Retry {
    /// The block's number; `None` for the whole program.
    pub block: Option<u32>,
    /// The number of this repetition, counted from 1.
    pub repeat: u32,
    /// The number of permitted repetitions.
    pub of: u32,
    /// The reason.
    #[serde(flatten)]
    pub why: RepeatReason,
}

impl Retry {
    /// Repetition number `repeat` of at most `of` for a block.
    #[must_use]
    pub const fn block(block: u32, repeat: u32, of: u32, why: RepeatReason) -> Self {
        Self { block: Some(block), repeat, of, why }
    }

    /// Repetition number `repeat` of at most `of` for the whole program.
    #[must_use]
    pub const fn program(repeat: u32, of: u32, why: RepeatReason) -> Self {
        Self { block: None, repeat, of, why }
    }
}

impl fmt::Display for Retry {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { repeat, of, why, .. } = self;
        match self.block {
            Some(block) => write!(f, "sending block {block} again, {repeat} of {of}: {why}"),
            None => write!(f, "sending the program again, {repeat} of {of}: {why}"),
        }
    }
}

/// The reason for a repetition.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RepeatReason {
    /// The bootloader found a wrong CRC.
    Crc,
    /// The bootloader was busy with another command.
    Busy,
    /// The device aborted the transfer with a code that means lost frames.
    Broken(AbortCode),
    /// The transfer got no answer.
    NoAnswer,
}

impl fmt::Display for RepeatReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Crc => f.write_str("the CRC of the received data is wrong"),
            Self::Busy => f.write_str("the bootloader was busy"),
            Self::Broken(code) => write!(f, "the transfer failed: {code}"),
            Self::NoAnswer => f.write_str("no answer"),
        }
    }
}

impl RepeatReason {
    /// Its stable name for programs.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Crc => "crc",
            Self::Busy => "busy",
            Self::Broken(_) => "broken",
            Self::NoAnswer => "no_answer",
        }
    }
}

impl Serialize for RepeatReason {
    /// `reason`, and the abort code if there is one.
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let abort = match self {
            Self::Broken(code) => Some(code.0),
            Self::Crc | Self::Busy | Self::NoAnswer => None,
        };
        let mut fields = serializer.serialize_struct("RepeatReason", 2)?;
        fields.serialize_field("reason", self.name())?;
        fields.serialize_field("abort", &abort)?;
        fields.end()
    }
}
