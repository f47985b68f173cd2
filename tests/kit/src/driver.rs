//! The demonstration that proves a flash driver: it erases a sector, programs it, reads it back, and
//! looks at everything else that the core relies on (`boot_core::flash::Flash`). The first thing that is
//! wrong ends it, with its name and place. SYS TEC's manual asks for the same of a driver (L-1112d_10,
//! 4.2).
//!
//! It takes a driver with nothing running, and gives it back so. It changes the sector alone.

use std::fmt;
use std::task::Poll;

use boot_core::flash::{crc32_by_software, Flash, FlashFault, Operation};
use shared_abi::geometry::{Region, Sector};

/// What a driver does wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// `sector_at` gives something else than the sector for an address in it.
    Map {
        /// The address.
        address: u32,
        /// What it gives.
        found: Option<Sector>,
    },
    /// It refused an operation.
    Refused(Operation, FlashFault),
    /// An operation ended with this fault.
    Failed(Operation, FlashFault),
    /// An operation is not over after this many polls.
    NeverEnds(Operation, u32),
    /// It began an operation at a place that is not in the flash.
    TakesForeign(Operation),
    /// An address outside the flash does not read FFh.
    ReadsForeign(u32, u8),
    /// A byte of the erased sector is not FFh.
    NotErased(u32, u8),
    /// A word reads another value than it must have.
    Reads {
        /// Its address.
        address: u32,
        /// What it must be.
        must: u32,
        /// What it is.
        is: u32,
    },
    /// A byte of the neighbourhood has changed.
    Disturbed {
        /// Its address.
        address: u32,
        /// What it was.
        was: u8,
        /// What it is.
        is: u8,
    },
    /// Its own CRC of a region is another than that of the bytes that it reads.
    Crc(Region),
    /// Its own blank check says something else than the bytes that it reads.
    Blank(Region),
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Map { address, found } => {
                write!(f, "sector_at({address:08X}h) gives {found:?}, and the address is in the sector")
            }
            Self::Refused(operation, fault) => write!(f, "it refused {operation:X?}: {fault:?}"),
            Self::Failed(operation, fault) => write!(f, "{operation:X?} ended with {fault:?}"),
            Self::NeverEnds(operation, polls) => {
                write!(
                    f,
                    "{operation:X?} is not over after {polls} polls: the driver needs a bound of its own"
                )
            }
            Self::TakesForeign(operation) => write!(f, "it began {operation:X?} outside the flash"),
            Self::ReadsForeign(address, byte) => {
                write!(f, "{address:08X}h is outside the flash and reads {byte:02X}h, not FFh")
            }
            Self::NotErased(address, byte) => {
                write!(f, "{address:08X}h reads {byte:02X}h after the erase of its sector, not FFh")
            }
            Self::Reads { address, must, is } => {
                write!(f, "{address:08X}h reads {is:08X}h and must read {must:08X}h")
            }
            Self::Disturbed { address, was, is } => {
                write!(f, "{address:08X}h, outside the sector, has changed from {was:02X}h to {is:02X}h")
            }
            Self::Crc(region) => write!(f, "crc32 of {region:X?} is not that of its bytes"),
            Self::Blank(region) => write!(f, "is_blank of {region:X?} does not say what its bytes say"),
        }
    }
}

/// Where a driver is demonstrated.
#[derive(Clone, Copy, Debug)]
pub struct Place {
    /// The sector, whose content is lost.
    pub sector: Sector,
    /// A region that must not change: the rest of the flash, or what is around the sector.
    pub around: Region,
    /// An address that is in no flash, a multiple of 4.
    pub foreign: u32,
    /// The most polls of an operation.
    pub polls: u32,
}

/// Demonstrates a driver.
///
/// # Errors
/// The first fault.
pub fn demonstrate<F: Flash>(flash: &mut F, place: &Place) -> Result<(), Fault> {
    let Place { sector, around, foreign, polls } = *place;
    let Region { base, size } = sector.region;
    let end = sector.region.end();
    let before = bytes(flash, around);
    // The map.
    for address in [base, base + 1, base + size / 2, end - 1] {
        let found = flash.sector_at(address);
        if found != Some(sector) {
            return Err(Fault::Map { address, found });
        }
    }
    // What is not there reads as erased, and takes nothing.
    let outside = bytes(flash, Region::new(foreign, 4));
    if let Some(byte) = outside.into_iter().find(|byte| *byte != u8::MAX) {
        return Err(Fault::ReadsForeign(foreign, byte));
    }
    let nowhere = Operation::Program { address: foreign, word: 0 };
    if flash.start(nowhere).is_ok() && wait(flash, nowhere, polls).is_ok() {
        return Err(Fault::TakesForeign(nowhere));
    }
    // The erase of a sector in an unknown state.
    erase(flash, sector, polls)?;
    // Words at both ends and in the middle, in another order than that of their addresses.
    let words = [(base + size / 2) & !3, end - 4, base, base + 4].map(|address| (address, pattern(address)));
    for (address, word) in words {
        program(flash, address, word, polls)?;
        expect(flash, address, word)?;
    }
    for (address, word) in words {
        expect(flash, address, word)?;
    }
    // A read that begins and ends within words.
    let mut across = [0; 6];
    flash.read(base + 1, &mut across);
    let both = [pattern(base).to_le_bytes(), pattern(base + 4).to_le_bytes()].concat();
    if across[..] != both[1..7] {
        let is = u32::from_le_bytes([across[0], across[1], across[2], across[3]]);
        let must = u32::from_le_bytes([both[1], both[2], both[3], both[4]]);
        return Err(Fault::Reads { address: base + 1, must, is });
    }
    // The same word once more, as after a download that was cut off; then bits that go from 1 to 0.
    program(flash, base, pattern(base), polls)?;
    expect(flash, base, pattern(base))?;
    program(flash, base, 0, polls)?;
    expect(flash, base, 0)?;
    // What the driver computes by itself is what it reads.
    if flash.crc32(0, sector.region) != crc32_by_software(flash, 0, sector.region) {
        return Err(Fault::Crc(sector.region));
    }
    if flash.is_blank(sector.region) {
        return Err(Fault::Blank(sector.region));
    }
    erase(flash, sector, polls)?;
    if !flash.is_blank(sector.region) {
        return Err(Fault::Blank(sector.region));
    }
    let after = bytes(flash, around);
    let changed = (around.base..).zip(before.into_iter().zip(after)).find(|(_, (was, is))| was != is);
    changed.map_or(Ok(()), |(address, (was, is))| Err(Fault::Disturbed { address, was, is }))
}

/// A word with as many zeros as ones, another one at each address.
fn pattern(address: u32) -> u32 {
    address.rotate_left(16) ^ 0x5A3C_C3A5 ^ !address & 0xFFFF
}

fn bytes<F: Flash>(flash: &F, region: Region) -> Vec<u8> {
    let mut bytes = vec![0; region.size as usize];
    flash.read(region.base, &mut bytes);
    bytes
}

fn erase<F: Flash>(flash: &mut F, sector: Sector, polls: u32) -> Result<(), Fault> {
    carry_out(flash, Operation::Erase(sector), polls)?;
    let read = bytes(flash, sector.region);
    let left = (sector.region.base..).zip(read).find(|(_, byte)| *byte != u8::MAX);
    left.map_or(Ok(()), |(address, byte)| Err(Fault::NotErased(address, byte)))
}

fn program<F: Flash>(flash: &mut F, address: u32, word: u32, polls: u32) -> Result<(), Fault> {
    carry_out(flash, Operation::Program { address, word }, polls)
}

fn expect<F: Flash>(flash: &F, address: u32, must: u32) -> Result<(), Fault> {
    match flash.read_word(address) {
        is if is == must => Ok(()),
        is => Err(Fault::Reads { address, must, is }),
    }
}

fn carry_out<F: Flash>(flash: &mut F, operation: Operation, polls: u32) -> Result<(), Fault> {
    flash.start(operation).map_err(|fault| Fault::Refused(operation, fault))?;
    wait(flash, operation, polls)
}

fn wait<F: Flash>(flash: &mut F, operation: Operation, polls: u32) -> Result<(), Fault> {
    for _ in 0..polls {
        if let Poll::Ready(ended) = flash.poll() {
            return ended.map_err(|fault| Fault::Failed(operation, fault));
        }
    }
    Err(Fault::NeverEnds(operation, polls))
}
