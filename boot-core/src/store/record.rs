//! What is known of a program.

use super::{Key, Parameters, Value};
use crate::flash::Flash;

/// What the store tells of a program that was downloaded completely and whose CRC was right then.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ProgramRecord {
    /// Bytes from the start of its region on.
    pub size: u32,
    /// CRC over them.
    pub crc: u32,
    /// Whether it is released for autostart (1F51h = 83h, SET_SIGNATURE).
    pub signed: bool,
    /// Whether it has proved that the bootloader can be reached from it: it was confirmed, or has
    /// brought the device back to the bootloader once. It then starts without a rescue window.
    pub confirmed: bool,
    /// The version that its control block told, 0 for none.
    pub version: u32,
    /// Since all of the program's flash was last erased, work on it was begun that did not come to its
    /// end: a sector that reads as erased may be so badly.
    pub half_erased: bool,
}

/// The words of the two flags: signed or not, confirmed or not. Magic numbers, so that few wrong
/// bits never make one of another.
const SIGNED: u32 = u32::from_le_bytes(*b"APP1");
const CONFIRMED: u32 = u32::from_le_bytes(*b"RUN0");
const SIGNED_CONFIRMED: u32 = u32::from_le_bytes(*b"RUN1");

/// In the first word of the stored form, above the size: [`half_erased`](ProgramRecord::half_erased).
const HALF_ERASED: u32 = 1 << 31;

impl ProgramRecord {
    /// The stored form of "no program".
    #[must_use]
    pub const fn none(half_erased: bool) -> Value {
        [if half_erased { HALF_ERASED } else { 0 }, 0, 0, 0]
    }

    /// [`half_erased`](Self::half_erased), whether or not there is a program.
    pub fn load_half_erased<F: Flash>(parameters: &impl Parameters, flash: &F, number: u8) -> bool {
        parameters.get(flash, Key::Program(number)).is_some_and(|[first, ..]| first & HALF_ERASED != 0)
    }

    /// From the store; `None` where there is no program.
    pub fn load<F: Flash>(parameters: &impl Parameters, flash: &F, number: u8) -> Option<Self> {
        Self::from_value(parameters.get(flash, Key::Program(number))?)
    }

    /// From its stored form; `None` for [`none`](Self::none).
    #[must_use]
    pub const fn from_value([first, crc, flags, version]: Value) -> Option<Self> {
        let half_erased = first & HALF_ERASED != 0;
        let size = first & !HALF_ERASED;
        if size == 0 {
            return None;
        }
        let signed = flags == SIGNED || flags == SIGNED_CONFIRMED;
        let confirmed = flags == CONFIRMED || flags == SIGNED_CONFIRMED;
        Some(Self { size, crc, signed, confirmed, version, half_erased })
    }

    /// The stored form.
    #[must_use]
    pub const fn value(&self) -> Value {
        let flags = match (self.signed, self.confirmed) {
            (false, false) => 0,
            (true, false) => SIGNED,
            (false, true) => CONFIRMED,
            (true, true) => SIGNED_CONFIRMED,
        };
        [self.size | Self::none(self.half_erased)[0], self.crc, flags, self.version]
    }
}
