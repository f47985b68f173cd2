//! Everything that outlives a power-off: what is stored, under which key, and how.
//!
//! | module | what it holds |
//! |---|---|
//! | [`journal`] | the power-fail-safe journal over two flash regions |
//! | [`record`] | what is known of a program |
//! | [`node`] | node-ID and bit rate |
//!
//! Who stores does not touch the flash: it tells the next operation, and its caller carries it out.
//! So the code of the store can stand in the resident part while the flash operations are started
//! and polled from RAM.

pub mod journal;
pub mod node;
pub mod record;

pub use journal::Journal;
pub use node::NodeParameters;
pub use record::ProgramRecord;

use crate::flash::{Flash, FlashFault, Next};

/// What a stored value is about.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Key {
    /// The record of a program (1 to 254), see [`ProgramRecord`].
    Program(u8),
    /// How often in a row the application ended without being asked to.
    CrashCount,
    /// Node-ID and bit rate, see [`NodeParameters`].
    Node,
    /// Of a program (1 to 254) the lowest security counter and the lowest epoch that the device
    /// takes, and the counter of what is installed. It outlives the program's record.
    #[cfg(feature = "sealed")]
    Counter(u8),
    /// An event (0 to 7), see `seal::access`.
    #[cfg(feature = "sealed")]
    Event(u8),
    /// How often rights were granted, and whether one of them has opened the device for good.
    #[cfg(feature = "sealed")]
    Grants,
}

impl Key {
    /// The word that stands for the key. FFFFFFFFh (erased flash) stands for none.
    #[must_use]
    pub const fn tag(self) -> u32 {
        match self {
            Self::Program(number) => 0x0001_0000 | number as u32,
            Self::CrashCount => 0x0002_0000,
            Self::Node => 0x0003_0000,
            #[cfg(feature = "sealed")]
            Self::Counter(number) => 0x0004_0000 | number as u32,
            #[cfg(feature = "sealed")]
            Self::Event(place) => 0x0005_0000 | place as u32,
            #[cfg(feature = "sealed")]
            Self::Grants => 0x0006_0000,
        }
    }
}

/// The words of a value; what they mean is the key's.
pub type Value = [u32; 4];

/// Why a value could not be stored. 1F57h says NVDATA.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StoreError {
    /// The flash refused or failed.
    Flash(FlashFault),
    /// No slot took the record: the region is worn out.
    WornOut,
    /// The journal is of a newer format. It belongs to a newer bootloader, and nothing is changed;
    /// to go on with this one, erase the two parameter sectors with a debugger.
    NewerFormat,
    /// A store outside the flash failed.
    Device,
}

/// Where parameters are kept: the [`Journal`] in flash, or what a board has for them (an EEPROM),
/// which may leave the flash that it is handed alone.
///
/// An implementation owes this: after a power cut at any moment [`get`](Self::get) gives the value
/// from before the store or the new one, of every key; and every store comes to an end, a store
/// that is full or worn out with an error.
pub trait Parameters {
    /// The value of a key, `None` where it was never stored.
    fn get<F: Flash>(&self, flash: &F, key: Key) -> Option<Value>;

    /// Begins to store a value, one at a time; [`next`](Self::next) carries it through.
    fn store(&mut self, key: Key, value: Value);

    /// The next operation of the store, told the outcome of the one before (`Ok` at first). On an
    /// error the old value is still there.
    fn next<F: Flash>(&mut self, flash: &F, outcome: Result<(), FlashFault>) -> Next<StoreError>;
}
