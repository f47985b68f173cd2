//! How a failed update leaves a device, for people and programs.

use std::fmt;

use canopen::program::ProgramState;
use serde::ser::SerializeStruct as _;
use serde::{Serialize, Serializer};

use crate::device::DeviceType;

/// What a procedure that failed leaves in the device.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DeviceState {
    /// Nothing was changed.
    Untouched,
    /// The bootloader was called; the old program is whole.
    Called,
    /// The erasure was begun: there is no program, or an incomplete one, as far as is known.
    Erased,
    /// The new program is in, in a dialect that has no release for autostart.
    Written,
    /// The new program is in and right, but not released for autostart.
    Unreleased,
    /// The new program is in and released for autostart.
    Released,
}

impl DeviceState {
    /// Its name for programs, which stays.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Untouched => "untouched",
            Self::Called => "called",
            Self::Erased => "erased",
            Self::Written => "written",
            Self::Unreleased => "unreleased",
            Self::Released => "released",
        }
    }
}

impl Serialize for DeviceState {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name())
    }
}

impl fmt::Display for DeviceState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Untouched => "nothing was changed in it",
            Self::Called => "it was called back to the bootloader, and its program is as it was",
            Self::Erased => "there is no complete program in it",
            Self::Written => "the new program is in it: it starts after a reset",
            Self::Unreleased => {
                "the new program is in it, not released for autostart: after a reset the bootloader waits for the next attempt"
            }
            Self::Released => "the new program is in it and released for autostart: it starts after a reset",
        })
    }
}

/// How an update that failed leaves the device. `Display` has words for people.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Left {
    /// What is in the device: as it told, otherwise as it was last known.
    pub state: DeviceState,
    /// What the device told when it was asked afterwards.
    pub look: Look,
}

/// What came of asking the device how it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Look {
    /// It was not asked: nothing had been done to it, or there is no way to it any more.
    NotAsked,
    /// It does not answer.
    Silent,
    /// It told this.
    Seen(Seen),
}

/// What a device told.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Seen {
    /// 1000h.
    pub running: DeviceType,
    /// 1F51h of the program, if there is such an object.
    pub control: Option<u32>,
    /// 1F56h of the program, if there is such an object.
    pub crc: Option<u32>,
}

impl Seen {
    /// Whether the device says that it has no program.
    pub(super) fn empty(&self) -> bool {
        self.control == Some(ProgramState::Absent as u32) || self.crc == Some(0)
    }
}

/// `state`, and as `seen` what the device told, if it did.
impl Serialize for Left {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let seen = match &self.look {
            Look::Seen(seen) => Some(seen),
            Look::NotAsked | Look::Silent => None,
        };
        let mut fields = serializer.serialize_struct("Left", 2)?;
        fields.serialize_field("state", &self.state)?;
        fields.serialize_field("seen", &seen)?;
        fields.end()
    }
}

impl Serialize for Seen {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut fields = serializer.serialize_struct("Seen", 4)?;
        fields.serialize_field("device_type", &self.running.0)?;
        fields.serialize_field("bootloader", &self.running.is_bootloader())?;
        fields.serialize_field("control", &self.control)?;
        fields.serialize_field("crc", &self.crc)?;
        fields.end()
    }
}

impl fmt::Display for Left {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.look {
            Look::NotAsked | Look::Silent if self.state == DeviceState::Untouched => self.state.fmt(f),
            Look::NotAsked => write!(f, "it cannot be asked any more; last known: {}", self.state),
            Look::Silent => write!(f, "it does not answer; last known: {}", self.state),
            Look::Seen(seen) => {
                let what = if seen.running.is_bootloader() { "bootloader" } else { "application" };
                write!(f, "its {what} is running; {}", self.state)?;
                match seen.crc {
                    Some(crc) if !seen.empty() && self.state != DeviceState::Erased => {
                        write!(f, " (CRC {crc:08X}h)")
                    }
                    _ => Ok(()),
                }
            }
        }
    }
}
