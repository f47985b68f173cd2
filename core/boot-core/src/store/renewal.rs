//! The record of a renewal of the bootloader (docs/renewal.md).

use shared_abi::journal::{Key, Value};
use shared_abi::renewal::{State, BOOTLOADER};

use super::parameters::Parameters;
use crate::flash::Flash;

/// The stored record of a complete RAM image in staging. It is removed before the flash of staging
/// changes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RenewalRecord {
    /// What is certain: not [`State::None`].
    pub state: State,
    /// Bytes of the image in staging, with its header.
    pub size: u32,
    /// The CRC in its header.
    pub crc: u32,
    /// The CRC in the header of the image at home when this one was staged.
    pub home: u32,
}

/// The first word of the stored form, for each state. As sizes of a program they are larger than any
/// flash; bit 31 is clear, which is `half_erased` in the record of a program.
const STAGED: u32 = u32::from_le_bytes(*b"STG1");
const CONFIRMED: u32 = u32::from_le_bytes(*b"CNF1");
const INSTALLED: u32 = u32::from_le_bytes(*b"INS1");

impl RenewalRecord {
    /// The stored form of "nothing is in staging".
    pub(crate) const NONE: Value = [0; 4];

    /// Loads the record from the store; `None` if nothing is in staging.
    pub fn load<F: Flash>(parameters: &impl Parameters, flash: &F) -> Option<Self> {
        Self::from_value(parameters.get(flash, Key::program(BOOTLOADER))?)
    }

    /// Decodes the stored form.
    #[must_use]
    pub const fn from_value([state, size, crc, home]: Value) -> Option<Self> {
        let state = match state {
            STAGED => State::Staged,
            CONFIRMED => State::Confirmed,
            INSTALLED => State::Installed,
            _ => return None,
        };
        Some(Self { state, size, crc, home })
    }

    /// The stored form.
    #[must_use]
    pub const fn value(&self) -> Value {
        let state = match self.state {
            State::None => 0,
            State::Staged => STAGED,
            State::Confirmed => CONFIRMED,
            State::Installed => INSTALLED,
        };
        [state, self.size, self.crc, self.home]
    }
}
