//! Readers of firmware files: from bytes to [`Image`] or [`BlockFile`]. Only [`load`] uses the file
//! system, and no reader needs a device.

use std::fmt;
use std::path::Path;

use super::block_file::BlockFile;
use super::fault::{Cause, FileError, Place, ReadError};
use super::image::Image;
use super::sealed::{blocks, Sealed};
use super::{elf, ihex, limit, raw, srec};

/// The formats of a firmware file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// Intel HEX.
    IntelHex,
    /// Motorola S-record.
    SRecord,
    /// ELF executable, 32 bit, little-endian, Arm.
    Elf,
    /// Block file, ready for 1F50h.
    BlockFile,
    /// Sealed image: sent to the device unchanged; only the device's keys decrypt it.
    Sealed,
    /// The bytes of the flash alone; the address must be given.
    Raw,
}

impl Format {
    /// Detects the format from the first bytes. A raw file has no distinctive bytes and is never
    /// detected.
    #[must_use]
    pub fn detect(bytes: &[u8]) -> Option<Self> {
        let text = bytes.trim_ascii_start();
        match bytes {
            [0x7F, b'E', b'L', b'F', ..] => Some(Self::Elf),
            _ if Sealed::looks_like(bytes) => Some(Self::Sealed),
            _ if BlockFile::looks_like(bytes) => Some(Self::BlockFile),
            _ if text.starts_with(b":") => Some(Self::IntelHex),
            _ if text.first() == Some(&b'S') && text.get(1).is_some_and(u8::is_ascii_digit) => {
                Some(Self::SRecord)
            }
            _ => None,
        }
    }
}

impl fmt::Display for Format {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::IntelHex => "Intel HEX",
            Self::SRecord => "Motorola S-record",
            Self::Elf => "ELF",
            Self::BlockFile => "block file",
            Self::Sealed => "sealed image",
            Self::Raw => "raw binary",
        })
    }
}

/// The contents of a firmware file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Firmware {
    /// Memory contents that must still be [converted](super::convert::convert).
    Image(Image),
    /// Blocks for the device; every CRC was checked.
    Blocks(BlockFile),
}

/// Reads a firmware file that is already in memory.
///
/// `format` replaces the detection by the first bytes. `raw_address` is the address of a
/// [`Format::Raw`] file.
///
/// # Errors
/// The first fault, with its place.
pub fn read(bytes: &[u8], format: Option<Format>, raw_address: Option<u32>) -> Result<Firmware, ReadError> {
    read_telling(bytes, format, raw_address).map(|(firmware, _)| firmware)
}

/// Reads a firmware file from disk, like [`read`].
///
/// # Errors
/// The first fault, with file and place.
pub fn load(path: &Path, format: Option<Format>, raw_address: Option<u32>) -> Result<Firmware, FileError> {
    load_telling(path, format, raw_address).map(|(firmware, _)| firmware)
}

/// Reads a firmware file from disk; also returns its format.
///
/// # Errors
/// The first fault, with file and place.
pub fn load_telling(
    path: &Path,
    format: Option<Format>,
    raw_address: Option<u32>,
) -> Result<(Firmware, Format), FileError> {
    limit::read(path)
        .map_err(|cause| Place::File.fault(cause))
        .and_then(|bytes| read_telling(&bytes, format, raw_address))
        .map_err(|error| error.of(path.display()))
}

fn read_telling(
    bytes: &[u8],
    format: Option<Format>,
    raw_address: Option<u32>,
) -> Result<(Firmware, Format), ReadError> {
    if bytes.is_empty() {
        return Err(Place::File.fault(Cause::Empty));
    }
    let format = format.or_else(|| Format::detect(bytes)).ok_or(Place::File.fault(Cause::NotFirmware))?;
    let firmware = match format {
        Format::IntelHex => ihex::read(bytes).map(Firmware::Image),
        Format::SRecord => srec::read(bytes).map(Firmware::Image),
        Format::Elf => elf::read(bytes).map(Firmware::Image),
        Format::Raw => raw::read(bytes, raw_address).map(Firmware::Image),
        Format::BlockFile if !blocks::looks_like(bytes) => BlockFile::parse(bytes).map(Firmware::Blocks),
        // The contents of the blocks are not a program for the flash.
        Format::BlockFile | Format::Sealed => Err(Place::File.fault(Cause::Sealed)),
    };
    Ok((firmware?, format))
}
