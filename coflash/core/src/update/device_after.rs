//! The state of a device after a failed update.

use std::fmt;

use canopen::program::ProgramState;
use serde::{Serialize, Serializer};

use crate::advice::{Advice, OfProgram};
use crate::device::DeviceType;

/// The contents of a device after a failed procedure.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum DeviceState {
    /// Nothing was changed.
    Untouched,
    /// This program was not changed; another one of the device was, in the same run.
    OtherChanged,
    /// An earlier attempt has begun, and nobody knows how far it came.
    Begun,
    /// The bootloader was called; the old program is intact.
    Called,
    /// The device has not acknowledged the erase, or has postponed it until the first good data, and has
    /// acknowledged none: the old program may be intact.
    Postponed,
    /// The erase was started: as far as is known, there is no program, or an incomplete one.
    Erased,
    /// The new program is complete, in a dialect without a release for autostart.
    Written,
    /// The new program is complete and correct, but not released for autostart.
    Unreleased,
    /// The new program is complete and released for autostart.
    Released,
    /// The new bootloader is installed, and the program is unchanged.
    Renewed,
}

impl DeviceState {
    /// Its stable name for programs.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Untouched => "untouched",
            Self::OtherChanged => "other_changed",
            Self::Begun => "begun",
            Self::Called => "called",
            Self::Postponed => "postponed",
            Self::Erased => "erased",
            Self::Written => "written",
            Self::Unreleased => "unreleased",
            Self::Released => "released",
            Self::Renewed => "renewed",
        }
    }
}

impl fmt::Display for DeviceState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Untouched => "it was not changed",
            Self::OtherChanged => "this program of it was not changed, and another one was",
            Self::Begun => "an earlier attempt has begun with it, and may have changed it",
            Self::Called => "it was called back to the bootloader, and its program is unchanged",
            Self::Postponed => "it was told to erase its program, and has acknowledged nothing of the new one: it may have the old one",
            Self::Erased => "it contains no complete program",
            Self::Written => "it contains the new program, which starts after a reset",
            Self::Unreleased => "it contains the new program, not released for autostart",
            Self::Released => "it contains the new program, released for autostart",
            Self::Renewed => "it has the new bootloader, and its program is unchanged",
        })
    }
}

/// The state of a device after a failed update. `Display` has the text for people.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct DeviceAfterUpdate {
    /// The device's contents: from its own answers if it answered, otherwise the last known state.
    pub state: DeviceState,
    /// The device's answer after the failure.
    #[serde(rename = "seen", serialize_with = "given")]
    pub answer: DeviceAnswer,
}

/// The result of asking the device for its state.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DeviceAnswer {
    /// It was not asked: it was not changed, or the connection is lost.
    NotAsked,
    /// It was not asked: this attempt has not changed it, and its state is from an earlier one.
    Unchanged,
    /// It does not answer.
    Silent,
    /// It has answered.
    Given(Answers),
}

/// The answers of a device.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct Answers {
    /// 1000h.
    #[serde(flatten)]
    pub running: DeviceType,
    /// The number of the program.
    #[serde(skip)]
    pub program: u8,
    /// 1F51h of the program, if the object exists.
    pub control: Option<u32>,
    /// 1F56h of the program, if the object exists.
    pub crc: Option<u32>,
}

impl DeviceAfterUpdate {
    /// The same of a device that was in this state before: if this attempt has not changed it, and it has not said
    /// more itself, it still is.
    #[must_use]
    pub fn after(self, before: DeviceState) -> Self {
        match (self.state, self.answer) {
            (DeviceState::Untouched, DeviceAnswer::NotAsked | DeviceAnswer::Silent) => {
                Self { state: before, answer: DeviceAnswer::Unchanged }
            }
            _ => self,
        }
    }

    /// The advice at the end of its text, if there is any.
    #[must_use]
    pub fn advice(&self) -> Option<Advice> {
        let DeviceAnswer::Given(answers) = self.answer else { return None };
        let waits = self.state == DeviceState::Called && answers.running.is_bootloader() && !answers.empty();
        waits.then_some(Advice::StartIt { program: OfProgram(answers.program) })
    }
}

impl Answers {
    /// Whether the device reports that it has no program.
    pub(super) fn empty(&self) -> bool {
        self.control == Some(ProgramState::Absent as u32) || self.crc == Some(0)
    }
}

/// The device's answers, if there are any.
fn given<S: Serializer>(answer: &DeviceAnswer, serializer: S) -> Result<S::Ok, S::Error> {
    let answers = match answer {
        DeviceAnswer::Given(answers) => Some(answers),
        DeviceAnswer::NotAsked | DeviceAnswer::Unchanged | DeviceAnswer::Silent => None,
    };
    answers.serialize(serializer)
}

impl fmt::Display for DeviceAfterUpdate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.answer {
            DeviceAnswer::NotAsked | DeviceAnswer::Unchanged | DeviceAnswer::Silent
                if matches!(self.state, DeviceState::Untouched | DeviceState::OtherChanged) =>
            {
                self.state.fmt(f)
            }
            DeviceAnswer::Unchanged => {
                write!(f, "this attempt has not changed it; known from before: {}", self.state)
            }
            DeviceAnswer::NotAsked => write!(f, "it cannot be asked any more; last known: {}", self.state),
            DeviceAnswer::Silent => write!(f, "it does not answer; last known: {}", self.state),
            DeviceAnswer::Given(answers) => {
                let what = if answers.running.is_bootloader() { "bootloader" } else { "application" };
                write!(f, "its {what} is running; {}", self.state)?;
                match answers.crc {
                    Some(crc) if !answers.empty() && self.state != DeviceState::Erased => {
                        write!(f, " (CRC {crc:08X}h)")?;
                    }
                    _ => {}
                }
                match self.advice() {
                    Some(advice) => write!(f, ": {advice}"),
                    None => Ok(()),
                }
            }
        }
    }
}
