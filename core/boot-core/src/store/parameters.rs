//! Where it is stored: values under keys.

use shared_abi::geometry::Region;
use shared_abi::journal::{Key, ProgramRecord, Value};
use shared_abi::label::{self, Label};
use shared_abi::ram_image::SERVICES_VERSION;

use crate::flash::{Flash, FlashFault, Next};

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

    /// The record of a program; `None` if there is no program.
    fn program<F: Flash>(&self, flash: &F, number: u8) -> Option<ProgramRecord> {
        ProgramRecord::from_value(self.get(flash, Key::program(number))?)
    }

    /// The creation date of a program in seconds since 1970-01-01 UTC: the one that came with it
    /// ([`Key::date`]), or the one in its label; 0 if neither is known.
    fn date<F: Flash>(&self, flash: &F, number: u8, region: Region, record: &ProgramRecord) -> u32 {
        match self.get(flash, Key::date(number)) {
            Some([date, crc, ..]) if crc == record.crc => return date,
            _ if record.size < label::OFFSET + label::SIZE as u32 => return 0,
            _ => {}
        }
        let mut bytes = [0; label::SIZE];
        flash.read(region.base + label::OFFSET, &mut bytes);
        Label::parse(&bytes).map_or(0, |label| label.date)
    }

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
