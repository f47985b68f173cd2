//! The faults of a firmware file, with their places in the file.

use std::fmt;

use shared_abi::block_file::{FRAMING, MAX_BLOCK_SIZE};

use super::area::{Area, FLASH};
use super::foreign::Foreign;
use super::range::AddressRange;
use crate::advice::Advice;

/// A place in a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Place {
    /// The file as a whole.
    File,
    /// A line of a text file; the first is 1.
    Line(usize),
    /// A byte of a binary file; the first is 0.
    Offset(usize),
}

impl Place {
    /// The fault `cause` at this place.
    #[must_use]
    pub fn fault(self, cause: Cause) -> ReadError {
        ReadError { place: self, cause }
    }
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::File => f.write_str("the file"),
            Self::Line(line) => write!(f, "line {line}"),
            Self::Offset(offset) => write!(f, "offset {offset:#x}"),
        }
    }
}

/// Why bytes are not usable firmware, and where.
#[derive(Debug, thiserror::Error)]
#[error("{place}: {cause}")]
pub struct ReadError {
    /// Where the fault is.
    pub place: Place,
    /// The kind of the fault.
    #[source]
    pub cause: Cause,
}

impl ReadError {
    /// The same error with the file's name.
    #[must_use]
    pub fn of(self, file: impl fmt::Display) -> FileError {
        FileError { file: file.to_string(), error: self }
    }
}

/// Why a file is not usable firmware: `file, place: cause`.
#[derive(Debug)]
pub struct FileError {
    /// Name of the file, as the user gave it.
    pub file: String,
    /// The fault.
    pub error: ReadError,
}

impl fmt::Display for FileError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.error.place {
            Place::File => write!(f, "{}: {}", self.file, self.error.cause),
            place => write!(f, "{}, {place}: {}", self.file, self.error.cause),
        }
    }
}

// By hand: `Display` has the text of the cause, so the source is that of the cause, two fields down.
impl std::error::Error for FileError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        std::error::Error::source(&self.error.cause)
    }
}

/// An encoding of text that no firmware file has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Encoding {
    /// Its name.
    pub name: &'static str,
    /// The text begins with a byte order mark.
    pub is_marked: bool,
}

impl fmt::Display for Encoding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let what = if self.is_marked { "begins with a byte order mark of" } else { "is a text in" };
        write!(f, "{what} {}", self.name)
    }
}

/// The faults of a firmware file. The messages give advice if it is not obvious.
#[derive(Debug, thiserror::Error)]
pub enum Cause {
    /// The file cannot be read.
    #[error("cannot be read: {0}")]
    Io(#[source] std::io::Error),
    /// A device, pipe or the like, with an unknown or infinite size.
    #[error("is {0} and not a file: give a file, or save the data to one first")]
    NoRegularFile(&'static str),
    /// A file larger than any firmware.
    #[error("has {size} bytes, and a firmware file has at most {most}: check that it is the right file, or strip the symbols of the ELF file")]
    TooLarge {
        /// Size of the file, or a lower limit of it.
        size: u64,
        /// The most bytes that are read.
        most: u64,
    },
    /// Load segments that together are larger than any program.
    #[error(
        "its load segments have more than {most} bytes together: the file is damaged, or it is not firmware"
    )]
    SegmentsTooLarge {
        /// The most bytes of all segments.
        most: u32,
    },
    /// The file has no bytes.
    #[error("is empty")]
    Empty,
    /// A file in none of the known formats.
    #[error(
        "is not a firmware file (neither Intel HEX, S-record, ELF nor block file; {})",
        Advice::RawNeedsAddress
    )]
    NotFirmware,
    /// A file of another kind, which its first or last bytes name.
    #[error("is not a firmware file but {}: {}", .0.what, .0.advice)]
    Foreign(Foreign),
    /// A file whose first bytes are not those of the format that the user named.
    #[error("is no {named} file{}", .found.map_or(String::new(), |found| format!(", but {found}")))]
    NotNamedFormat {
        /// The format that the user named.
        named: &'static str,
        /// The format that the first bytes show.
        found: Option<&'static str>,
    },
    /// A text in another encoding than ASCII.
    #[error("{0}: an editor or a shell has stored it anew, and its format is plain ASCII: take the file as it was built, or store it as ASCII (PowerShell: Out-File -Encoding ascii)")]
    Encoding(Encoding),
    /// A sealed image in a place that needs the program itself.
    #[error("is a sealed image and cannot be converted: {}", Advice::SealedStays)]
    Sealed,
    /// A raw file without an address.
    #[error("a raw binary does not contain its address: {}", Advice::GiveAddress)]
    NoAddress,
    /// A record or structure ends too early.
    #[error(
        "{what} is cut off: it must have {needed} bytes and has {found}; the file is truncated or damaged"
    )]
    CutOff {
        /// The part that ends too early.
        what: &'static str,
        /// Announced size in bytes.
        needed: usize,
        /// Actual size in bytes.
        found: usize,
    },
    /// A record is longer than announced.
    #[error("the record has {found} bytes but announces {needed}")]
    TooLong {
        /// Announced size in bytes.
        needed: usize,
        /// Actual size in bytes.
        found: usize,
    },
    /// The end record is missing.
    #[error("the file ends without {0}: it is truncated")]
    NoEnd(&'static str),
    /// There is text after the end record.
    #[error("there is more text after the end record")]
    AfterEnd,
    /// A violation of the format.
    #[error("{0}")]
    Malformed(&'static str),
    /// A character that is not a hexadecimal digit.
    #[error("character {column} is not a hexadecimal digit")]
    BadDigit {
        /// Its column; the first is 1.
        column: usize,
    },
    /// A record type that the format does not define.
    #[error("unknown record type {0}")]
    UnknownRecord(String),
    /// A wrong checksum of a record.
    #[error("checksum is {found:02X} and must be {needed:02X}: the line is damaged")]
    Checksum {
        /// The record's checksum.
        found: u8,
        /// The checksum of the record's other bytes.
        needed: u8,
    },
    /// A wrong record count.
    #[error(
        "the file has {counted} data records and its count record has {says}: lines are missing or doubled"
    )]
    Count {
        /// The number in the count record, modulo its width.
        says: u32,
        /// The number of records found.
        counted: usize,
    },
    /// Data beyond the end of the range that their addresses can express.
    #[error("the data from {address:#010x} on exceeds the end of {what}")]
    AddressOverflow {
        /// First address of the data.
        address: u32,
        /// The range that is exceeded.
        what: &'static str,
    },
    /// Two parts of the file give data for one address.
    #[error("the data at {address:#010x} overlaps that of {with}")]
    Overlap {
        /// The first address with two data.
        address: u32,
        /// The place of the other data.
        with: Place,
    },
    /// Data outside the program's region.
    #[error("the data at {first:#010x}..={last:#010x} lies outside {region}: link the program for this region, or choose another board or program")]
    Outside {
        /// First address of the data.
        first: u32,
        /// Last address of the data.
        last: u32,
        /// The region of the program.
        region: AddressRange,
    },
    /// A program for another place of the same region: size and CRC count from its start.
    #[error("the program begins at {linked:#010x}, and the region at {start:#010x}: link the program for that address, or choose another board or program")]
    OtherPlace {
        /// The start of the program in the file.
        linked: u32,
        /// The start of the region.
        start: u32,
    },
    /// Data in an area that is not the main flash.
    #[error("the data at {range} lies in {area}, not in the flash of a program: {}", .area.advice())]
    Elsewhere {
        /// First and last address of the data.
        range: AddressRange,
        /// The area of the first address.
        area: Area,
    },
    /// A well-formed file without data.
    #[error("holds no data")]
    NoData,
    /// A well-formed file without data in the region.
    #[error("holds no data inside {0}")]
    NothingInside(AddressRange),
    /// The distance between the first and the last byte is too large for one program.
    #[error(
        "the data spans {first:#010x}..={last:#010x}, too much for one program: {}",
        Advice::SelectRange
    )]
    TooSparse {
        /// First address of the program.
        first: u32,
        /// Last address of the data.
        last: u32,
    },
    /// An ELF file that cannot run on the device.
    #[error("{0}")]
    WrongElf(&'static str),
    /// Program headers of another size than those of a 32-bit ELF file.
    #[error(
        "its program headers have {0} bytes, and those of a 32-bit ELF file have 32: the file is damaged"
    )]
    ProgramHeaderSize(u16),
    /// An ELF file for another machine.
    #[error("is an ELF file for {} and not for Arm (40)", machine(*.0))]
    WrongMachine(u16),
    /// A wrong CRC of a block.
    #[error("CRC of block {number} is {found:#010x} and must be {needed:#010x}: the file is damaged")]
    BlockCrc {
        /// Number of the block.
        number: u32,
        /// The block's CRC.
        found: u32,
        /// The CRC of the block's other bytes.
        needed: u32,
    },
    /// A block in the wrong place.
    #[error("block {found} follows where block {expected} must: the file is damaged")]
    BlockNumber {
        /// The number in its header.
        found: u32,
        /// The expected number.
        expected: u32,
    },
    /// A block larger than any bootloader's buffer.
    #[error("block {number} has {size} data bytes, at most {max} are allowed", max = MAX_BLOCK_SIZE - FRAMING)]
    BlockSize {
        /// Number of the block.
        number: u32,
        /// The size of its data in bytes.
        size: u32,
    },
    /// The last block has a wrong length.
    #[error("the last block has {0} data bytes and must have 8")]
    LastSize(usize),
    /// Size or CRC in the last block do not match the blocks before it.
    #[error(
        "the last block gives {size} bytes with CRC {crc:#010x}, which does not match the blocks before it"
    )]
    ProgramCrc {
        /// The program size in the block.
        size: u32,
        /// The program CRC in the block.
        crc: u32,
    },
}

impl Cause {
    /// The advice at the end of its text that depends on where the user gives files.
    #[must_use]
    pub fn advice(&self) -> Option<Advice> {
        Some(match self {
            Self::NotFirmware => Advice::RawNeedsAddress,
            Self::Sealed => Advice::SealedStays,
            Self::NoAddress => Advice::GiveAddress,
            Self::TooSparse { .. } => Advice::SelectRange,
            Self::Foreign(foreign) => foreign.advice.clone(),
            Self::Elsewhere { area, .. } => area.advice(),
            _ => return None,
        })
    }

    /// The fault of data that lie outside a program's region.
    pub(crate) fn outside(data: AddressRange, region: AddressRange) -> Self {
        let first_outside = if region.has(data.first) { region.last.saturating_add(1) } else { data.first };
        // A region that is not in the flash is not that of an STM32F4.
        match Area::outside(first_outside).filter(|_| FLASH.has(region.first)) {
            Some(area) => Self::Elsewhere { range: data, area },
            None => Self::Outside { first: data.first, last: data.last, region },
        }
    }

    /// The stable error number: the manual's number (L-1112e_5, table 5) if there is one, otherwise
    /// the operating system's.
    #[must_use]
    pub fn number(&self) -> u32 {
        match self {
            Self::Io(error) => error.raw_os_error().and_then(|code| u32::try_from(code).ok()).unwrap_or(5),
            Self::Outside { .. }
            | Self::Elsewhere { .. }
            | Self::OtherPlace { .. }
            | Self::TooSparse { .. }
            | Self::SegmentsTooLarge { .. } => 0x6000_0015,
            Self::Checksum { .. } | Self::BlockCrc { .. } | Self::ProgramCrc { .. } => 0x6000_0020,
            Self::Empty
            | Self::NoRegularFile(_)
            | Self::TooLarge { .. }
            | Self::NotFirmware
            | Self::Foreign(_)
            | Self::NotNamedFormat { .. }
            | Self::Encoding(_)
            | Self::Sealed
            | Self::NoAddress
            | Self::WrongElf(_)
            | Self::WrongMachine(_)
            | Self::NoData => 0x6000_0021,
            Self::CutOff { .. }
            | Self::TooLong { .. }
            | Self::NoEnd(_)
            | Self::AfterEnd
            | Self::Malformed(_)
            | Self::BadDigit { .. }
            | Self::UnknownRecord(_)
            | Self::Count { .. }
            | Self::AddressOverflow { .. }
            | Self::ProgramHeaderSize(_)
            | Self::BlockNumber { .. }
            | Self::BlockSize { .. }
            | Self::LastSize(_) => 0x6000_0022,
            Self::Overlap { .. } => 0x6000_0023,
            Self::NothingInside(_) => 0x6000_0024,
        }
    }
}

/// A machine of the ELF header (e_machine; the gABI's list), in words.
fn machine(number: u16) -> String {
    let name = match number {
        3 | 62 => "x86, as for a test on the computer",
        94 => "Xtensa",
        183 => "64-bit Arm",
        243 => "RISC-V",
        _ => return format!("machine {number}"),
    };
    format!("machine {number} ({name})")
}
