//! The record of a program.

use super::parameters::{Key, Parameters, Value};
use shared_abi::geometry::Region;
use shared_abi::label::{self, Label};

use crate::flash::Flash;
use crate::resume::Partial;

/// The stored record of a program that was downloaded completely with a correct CRC.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ProgramRecord {
    /// Size in bytes, from the start of its region.
    pub size: u32,
    /// CRC of these bytes.
    pub crc: u32,
    /// Whether it is released for autostart (1F51h = 83h, SET_SIGNATURE).
    pub signed: bool,
    /// Whether the program has proved that it can return to the bootloader: it was confirmed, or it
    /// has returned the device to the bootloader once. It then starts without a rescue window.
    pub confirmed: bool,
    /// The version in its control block, 0 if unknown.
    pub version: u32,
    /// Whether work on the program was started but not finished since all of its flash was last
    /// erased: a sector that reads as erased may be only partly erased.
    pub half_erased: bool,
    /// The kind of sealed image; `None` for a program that was not sealed.
    pub seal: Option<Seal>,
    /// A client with the right to do so has withdrawn the release of the sealed program (84h). It is
    /// not released then, whatever `signed` is when the record is stored: nobody without this right
    /// releases it again, no master and no program.
    pub withdrawn: bool,
}

/// What a sealed program may do to the flash.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Seal {
    /// Nothing: the flash is locked until the next reset before the program starts.
    Locked,
    /// It writes to flash itself; its manifest says so.
    WritesFlash,
}

/// The words for the two flags: released or not, confirmed or not. They are magic numbers, so that
/// a few wrong bits never turn one into another.
const SIGNED: u32 = u32::from_le_bytes(*b"APP1");
const CONFIRMED: u32 = u32::from_le_bytes(*b"RUN0");
const SIGNED_CONFIRMED: u32 = u32::from_le_bytes(*b"RUN1");

/// The flag of [`half_erased`](ProgramRecord::half_erased) in the first word of the stored form,
/// above the size.
const HALF_ERASED: u32 = 1 << 31;
/// The flags of the two kinds of [`Seal`], in the same word.
const SEALED: u32 = 1 << 30;
const WRITES_FLASH: u32 = 1 << 29;
/// The flag of [`withdrawn`](ProgramRecord::withdrawn), in the same word.
const WITHDRAWN: u32 = 1 << 28;
/// The mask of the size in the first word.
const SIZE: u32 = !(HALF_ERASED | SEALED | WRITES_FLASH | WITHDRAWN);

impl ProgramRecord {
    /// The stored form of "no program", with the download that is going on.
    #[must_use]
    pub const fn none(half_erased: bool, partial: Partial) -> Value {
        let [id, end] = partial.words();
        [if half_erased { HALF_ERASED } else { 0 }, id, end, 0]
    }

    /// The download of a program that was cut off, from the stored form.
    #[must_use]
    pub const fn partial_of([first, id, end, _]: Value) -> Partial {
        if first & SIZE == 0 {
            Partial::of_words([id, end])
        } else {
            Partial::NONE
        }
    }

    /// [`half_erased`](Self::half_erased), also if there is no program.
    pub fn load_half_erased<F: Flash>(parameters: &impl Parameters, flash: &F, number: u8) -> bool {
        parameters.get(flash, Key::program(number)).is_some_and(|[first, ..]| first & HALF_ERASED != 0)
    }

    /// Whether it was installed as a sealed image.
    #[must_use]
    pub const fn is_sealed(&self) -> bool {
        self.seal.is_some()
    }

    /// Loads the record from the store; `None` if there is no program.
    pub fn load<F: Flash>(parameters: &impl Parameters, flash: &F, number: u8) -> Option<Self> {
        Self::from_value(parameters.get(flash, Key::program(number))?)
    }

    /// The creation date of the program in seconds since 1970-01-01 UTC: the one that came with it
    /// ([`Key::date`]), or the one in its label; 0 if neither is known.
    pub fn date<F: Flash>(&self, parameters: &impl Parameters, flash: &F, number: u8, region: Region) -> u32 {
        match parameters.get(flash, Key::date(number)) {
            Some([date, crc, ..]) if crc == self.crc => return date,
            _ if self.size < label::OFFSET + label::SIZE as u32 => return 0,
            _ => {}
        }
        let mut bytes = [0; label::SIZE];
        flash.read(region.base + label::OFFSET, &mut bytes);
        Label::parse(&bytes).map_or(0, |label| label.date)
    }

    /// Decodes the stored form; `None` for [`none`](Self::none).
    #[must_use]
    pub const fn from_value([first, crc, flags, version]: Value) -> Option<Self> {
        let half_erased = first & HALF_ERASED != 0;
        let size = first & SIZE;
        if size == 0 {
            return None;
        }
        let withdrawn = first & WITHDRAWN != 0;
        let signed = (flags == SIGNED || flags == SIGNED_CONFIRMED) && !withdrawn;
        let confirmed = flags == CONFIRMED || flags == SIGNED_CONFIRMED;
        Some(Self {
            size,
            crc,
            signed,
            confirmed,
            version,
            half_erased,
            seal: match first & (SEALED | WRITES_FLASH) {
                SEALED => Some(Seal::Locked),
                0 | WRITES_FLASH => None,
                _ => Some(Seal::WritesFlash),
            },
            withdrawn,
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
        let seal = match self.seal {
            None => 0,
            Some(Seal::Locked) => SEALED,
            Some(Seal::WritesFlash) => SEALED | WRITES_FLASH,
        } | if self.withdrawn { WITHDRAWN } else { 0 };
        [self.size | Self::none(self.half_erased, Partial::NONE)[0] | seal, self.crc, flags, self.version]
    }
}
