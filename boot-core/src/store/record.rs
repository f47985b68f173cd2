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
    /// How it came where it came as a sealed image; `None` where it did not.
    #[cfg(feature = "sealed")]
    pub seal: Option<Seal>,
}

/// What a sealed program may do to the flash.
#[cfg(feature = "sealed")]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Seal {
    /// Nothing: the flash is locked in front of it until the next reset.
    Locked,
    /// It writes the flash itself, and its manifest says so.
    WritesFlash,
}

/// The words of the two flags: signed or not, confirmed or not. Magic numbers, so that few wrong
/// bits never make one of another.
const SIGNED: u32 = u32::from_le_bytes(*b"APP1");
const CONFIRMED: u32 = u32::from_le_bytes(*b"RUN0");
const SIGNED_CONFIRMED: u32 = u32::from_le_bytes(*b"RUN1");

/// In the first word of the stored form, above the size: [`half_erased`](ProgramRecord::half_erased).
const HALF_ERASED: u32 = 1 << 31;
/// There, too: the two kinds of [`Seal`].
#[cfg(feature = "sealed")]
const SEALED: u32 = 1 << 30;
#[cfg(feature = "sealed")]
const WRITES_FLASH: u32 = 1 << 29;
/// Where the size stands in the first word.
#[cfg(feature = "sealed")]
const SIZE: u32 = !(HALF_ERASED | SEALED | WRITES_FLASH);
#[cfg(not(feature = "sealed"))]
const SIZE: u32 = !HALF_ERASED;

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

    /// Whether it came as a sealed image.
    #[must_use]
    pub const fn is_sealed(&self) -> bool {
        #[cfg(feature = "sealed")]
        return self.seal.is_some();
        #[cfg(not(feature = "sealed"))]
        false
    }

    /// From the store; `None` where there is no program.
    pub fn load<F: Flash>(parameters: &impl Parameters, flash: &F, number: u8) -> Option<Self> {
        Self::from_value(parameters.get(flash, Key::Program(number))?)
    }

    /// From its stored form; `None` for [`none`](Self::none).
    #[must_use]
    pub const fn from_value([first, crc, flags, version]: Value) -> Option<Self> {
        let half_erased = first & HALF_ERASED != 0;
        let size = first & SIZE;
        if size == 0 {
            return None;
        }
        let signed = flags == SIGNED || flags == SIGNED_CONFIRMED;
        let confirmed = flags == CONFIRMED || flags == SIGNED_CONFIRMED;
        Some(Self {
            size,
            crc,
            signed,
            confirmed,
            version,
            half_erased,
            #[cfg(feature = "sealed")]
            seal: match first & (SEALED | WRITES_FLASH) {
                SEALED => Some(Seal::Locked),
                0 | WRITES_FLASH => None,
                _ => Some(Seal::WritesFlash),
            },
        })
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
        #[cfg(not(feature = "sealed"))]
        let seal = 0;
        #[cfg(feature = "sealed")]
        let seal = match self.seal {
            None => 0,
            Some(Seal::Locked) => SEALED,
            Some(Seal::WritesFlash) => SEALED | WRITES_FLASH,
        };
        [self.size | Self::none(self.half_erased)[0] | seal, self.crc, flags, self.version]
    }
}
