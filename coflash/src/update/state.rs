//! What an update leaves behind.

use std::fmt;

use serde::{Serialize, Serializer};

/// In what state an update leaves the device, as far as it got.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DeviceState {
    /// Nothing was changed.
    Untouched,
    /// The bootloader was called; the old program is whole.
    Called,
    /// The erasure was begun: there is no program, or an incomplete one.
    Erased,
    /// The new program is in, in a dialect without signatures.
    Written,
    /// The new program is in and right, but not signed.
    Unsigned,
    /// The new program is in and signed.
    Signed,
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
            Self::Unsigned => "unsigned",
            Self::Signed => "signed",
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
            Self::Called => {
                "it may be in the bootloader; its old program is whole and starts again after a reset"
            }
            Self::Erased => {
                "it has no complete program and stays in the bootloader, ready for the next attempt"
            }
            Self::Written => "the new program is in it: it starts after a reset",
            Self::Unsigned => {
                "the new program is in it but not signed: after a reset the bootloader waits for the next attempt"
            }
            Self::Signed => "the new program is in it and signed: it starts after a reset",
        })
    }
}
