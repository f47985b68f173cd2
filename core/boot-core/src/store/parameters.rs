//! What is stored: values under keys.

use shared_abi::ram_image::SERVICES_VERSION;

use crate::flash::{Flash, FlashFault, Next};

/// The key of a stored value: a word, in flash and between the parts of the bootloader. A part that
/// does not know a key keeps its value. FFFFFFFFh (erased flash) is no key; 0008xxxxh and 0009xxxxh are
/// kept (`shared_abi`).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(transparent)]
pub struct Key(pub u32);

impl Key {
    /// The number of consecutive times that the application ended without a request.
    pub const CRASH_COUNT: Self = Self(0x0002_0000);
    /// Node-ID and bit rate, see [`NodeParameters`](super::NodeParameters).
    pub const NODE: Self = Self(0x0003_0000);
    /// The number of grants of rights, and whether one of them has opened the device permanently.
    pub const GRANTS: Self = Self(0x0006_0000);

    /// The record of a program (1 to 254), see [`ProgramRecord`](super::ProgramRecord); 255 is that of
    /// the bootloader's RAM image, see [`RenewalRecord`](super::RenewalRecord).
    #[must_use]
    pub const fn program(number: u8) -> Self {
        Self(0x0001_0000 | number as u32)
    }

    /// Of a program (1 to 254, 255 for the bootloader): the lowest security counter and the lowest epoch
    /// that the device accepts, and the counter of the installed program. This value survives the program's record.
    #[must_use]
    pub const fn counter(number: u8) -> Self {
        Self(0x0004_0000 | number as u32)
    }

    /// The creation date of a program (1 to 254), and the CRC of the program to which it belongs, see
    /// [`ProgramRecord::date`](super::ProgramRecord::date).
    #[must_use]
    pub const fn date(number: u8) -> Self {
        Self(0x0007_0000 | number as u32)
    }

    /// An event (0 to 7), see `seal::access`.
    #[must_use]
    pub const fn event(place: u8) -> Self {
        Self(0x0005_0000 | place as u32)
    }
}

/// The words of a value; their meaning depends on the key.
pub type Value = [u32; 4];

/// Why a value could not be stored. 1F57h then shows NVDATA.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StoreError {
    /// The flash refused or failed.
    Flash(FlashFault),
    /// No slot accepted the record: the region is worn out.
    WornOut,
    /// The journal has a newer format. It belongs to a newer bootloader and is not changed. To use
    /// this bootloader, erase the two parameter sectors with a debugger.
    NewerFormat,
    /// A store outside the flash failed.
    Device,
}

/// A place for parameters: the [`Journal`](super::Journal) in flash, or a part of the board (an EEPROM), which may
/// ignore the flash.
///
/// An implementation must guarantee three properties: after a power cut at any time,
/// [`get`](Self::get) returns for every key the value before the store or the new one; every store
/// ends, with an error if the memory is full or worn out; and to store a value that is stored
/// already writes nothing. Callers rely on the last one: they store whenever a value must be
/// certain, also if it reads so already.
pub trait Parameters {
    /// The version of the services of the resident part, which owns the store. The flash must be idle.
    fn services(&self) -> u32 {
        SERVICES_VERSION
    }

    /// The CRC-32 of the facts of the resident part, as in the header of an image for it. The flash must be idle.
    fn facts(&self) -> u32 {
        0
    }

    /// The value of a key, `None` if it was never stored.
    fn get<F: Flash>(&self, flash: &F, key: Key) -> Option<Value>;

    /// Starts to store one value; [`next`](Self::next) carries it out. After a success the value is
    /// certain, also if a power cut had left it between 0 and 1. During a compaction it follows after it.
    fn store(&mut self, key: Key, value: Value);

    /// Whether so few places are free that it must be compacted before a program starts: the program and the
    /// boot stage may only add values. A store that is never compacted is never nearly full.
    fn is_nearly_full(&self) -> bool {
        false
    }

    /// Starts to remove what is not current any more, if at least `used` places are used;
    /// [`next`](Self::next) carries it out. Returns whether there is something to carry out.
    fn compact(&mut self, used: u32) -> bool {
        let _ = used;
        false
    }

    /// The next operation of the store. `outcome` is the result of the previous one (`Ok` at
    /// first). After an error the old value still exists.
    fn next<F: Flash>(&mut self, flash: &F, outcome: Result<(), FlashFault>) -> Next<StoreError>;
}
