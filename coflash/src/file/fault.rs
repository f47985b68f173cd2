//! What can be wrong with a firmware file, and where in it.

use std::fmt;

use shared_abi::block_file::{FRAMING, MAX_BLOCK_SIZE};

use super::range::AddressRange;

/// Where in a file something is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Place {
    /// No place in particular: the file as a whole.
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

/// Why bytes are no usable firmware, and where.
#[derive(Debug, thiserror::Error)]
#[error("{place}: {cause}")]
pub struct ReadError {
    /// Where the fault is.
    pub place: Place,
    /// What it is.
    #[source]
    pub cause: Cause,
}

impl ReadError {
    /// The same, with the file's name in front.
    #[must_use]
    pub fn of(self, file: impl fmt::Display) -> FileError {
        FileError { file: file.to_string(), error: self }
    }
}

/// Why a file is no usable firmware: `file, place: cause`.
#[derive(Debug)]
pub struct FileError {
    /// Name of the file, as the user gave it.
    pub file: String,
    /// What is wrong in it.
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

impl std::error::Error for FileError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        std::error::Error::source(&self.error.cause)
    }
}

/// What can be wrong with a firmware file. The words say what to do where it is not plain.
#[derive(Debug, thiserror::Error)]
pub enum Cause {
    /// The file cannot be read at all.
    #[error("cannot be read: {0}")]
    Io(#[source] std::io::Error),
    /// Something that has no end, or none that can be known.
    #[error("is {0} and no file: give a file, or save into one what comes from there")]
    NoRegularFile(&'static str),
    /// A file larger than any firmware.
    #[error("has {size} bytes, and no firmware file has more than {most}: it is another file, or an ELF file whose symbols must be stripped first")]
    TooLarge {
        /// Bytes that it has, or at least has.
        size: u64,
        /// The most that are read.
        most: u64,
    },
    /// Load segments that hold more together than any program.
    #[error("its load segments have more than {most} bytes together: the file is damaged, or no firmware")]
    SegmentsTooLarge {
        /// The most that they may have.
        most: u32,
    },
    /// No bytes.
    #[error("is empty")]
    Empty,
    /// None of the known formats.
    #[error("is no firmware file (neither Intel HEX, S-record, ELF nor block file; for a raw binary give -I binary and --start-address)")]
    NotFirmware,
    /// A sealed image where the program itself is needed.
    #[error("is a sealed image, which is taken as it is: `coflash flash` sends it, `coflash show` and `coflash verify` tell what it is")]
    Sealed,
    /// A raw file, and nobody said where it goes.
    #[error("a raw binary does not say where it belongs: give --start-address or --board")]
    NoAddress,
    /// The record or structure ends too early.
    #[error(
        "{what} is cut off: it must have {needed} bytes and has {found}; the file is truncated or damaged"
    )]
    CutOff {
        /// What ends too early.
        what: &'static str,
        /// Bytes that it announces.
        needed: usize,
        /// Bytes that are there.
        found: usize,
    },
    /// A record is longer than it says.
    #[error("the record has {found} bytes but announces {needed}")]
    TooLong {
        /// Bytes that it announces.
        needed: usize,
        /// Bytes that are there.
        found: usize,
    },
    /// The record that ends such a file is absent.
    #[error("the file ends without {0}: it is truncated")]
    NoEnd(&'static str),
    /// There is more behind the record that ends the file.
    #[error("there is more text behind the end record")]
    AfterEnd,
    /// Not what this format looks like.
    #[error("{0}")]
    Malformed(&'static str),
    /// A character that is no hexadecimal digit.
    #[error("character {column} is no hexadecimal digit")]
    BadDigit {
        /// Its column; the first is 1.
        column: usize,
    },
    /// A record type that the format does not know.
    #[error("unknown record type {0}")]
    UnknownRecord(String),
    /// A record's checksum does not match.
    #[error("checksum is {found:02X} and must be {needed:02X}: the line is damaged")]
    Checksum {
        /// What the record says.
        found: u8,
        /// What its other bytes add up to.
        needed: u8,
    },
    /// A record count does not match.
    #[error(
        "the file has {counted} data records and its count record says {says}: lines are missing or doubled"
    )]
    Count {
        /// What the count record says, modulo its width.
        says: u32,
        /// What was counted.
        counted: usize,
    },
    /// Data runs over the end of what its addresses can express.
    #[error("the data from {address:#010x} on runs over the end of {what}")]
    AddressOverflow {
        /// First address of the data.
        address: u32,
        /// What ends there.
        what: &'static str,
    },
    /// Two parts of the file say what belongs at one address.
    #[error("the data at {address:#010x} overlaps that of {with}")]
    Overlap {
        /// First address that is doubled.
        address: u32,
        /// The other one.
        with: Place,
    },
    /// Data where the program may not lie.
    #[error("the data at {first:#010x}..={last:#010x} lies outside {region}: link the program for this region, or choose another board or program")]
    Outside {
        /// First address of the data.
        first: u32,
        /// Its last.
        last: u32,
        /// Where the program may lie.
        region: AddressRange,
    },
    /// A well-formed file without data.
    #[error("holds no data")]
    NoData,
    /// A well-formed file without data in the region.
    #[error("holds no data inside {0}")]
    NothingInside(AddressRange),
    /// First and last byte are too far apart for one program.
    #[error("the data spans {first:#010x}..={last:#010x}, too much for one program: choose the part to take with --start-address and --end-address")]
    TooSparse {
        /// First address of the program.
        first: u32,
        /// Last address of the data.
        last: u32,
    },
    /// Not an ELF file that can run on the device.
    #[error("{0}")]
    WrongElf(&'static str),
    /// An ELF file for another machine.
    #[error("is an ELF file for machine {0} and not for Arm (40)")]
    WrongMachine(u16),
    /// A block's CRC does not match.
    #[error("CRC of block {number} is {found:#010x} and must be {needed:#010x}: the file is damaged")]
    BlockCrc {
        /// Number of the block.
        number: u32,
        /// What the block says.
        found: u32,
        /// What its other bytes give.
        needed: u32,
    },
    /// A block out of its place.
    #[error("block {found} follows where block {expected} must: the file is damaged")]
    BlockNumber {
        /// The number in its header.
        found: u32,
        /// The number that must be there.
        expected: u32,
    },
    /// A block larger than any bootloader takes.
    #[error("block {number} has {size} data bytes, at most {max} are allowed", max = MAX_BLOCK_SIZE - FRAMING)]
    BlockSize {
        /// Number of the block.
        number: u32,
        /// Its data bytes.
        size: u32,
    },
    /// Block 0 has a length that no bootloader knows.
    #[error("block 0 has {0} data bytes; 8, 12 and 24 are known")]
    ControlSize(usize),
    /// The last block is not what it must be.
    #[error("the last block has {0} data bytes and must have 8")]
    LastSize(usize),
    /// The last block's size or CRC does not fit the blocks before it.
    #[error(
        "the last block says {size} bytes with CRC {crc:#010x}, which does not fit the blocks before it"
    )]
    ProgramCrc {
        /// Program size it says.
        size: u32,
        /// Program CRC it says.
        crc: u32,
    },
}

impl Cause {
    /// The stable number: that of the manual's error table (L-1112e_5, table 5) where it has one,
    /// otherwise the operating system's.
    #[must_use]
    pub fn number(&self) -> u32 {
        match self {
            Self::Io(error) => error.raw_os_error().and_then(|code| u32::try_from(code).ok()).unwrap_or(5),
            Self::Outside { .. } | Self::TooSparse { .. } | Self::SegmentsTooLarge { .. } => 0x6000_0015,
            Self::Checksum { .. } | Self::BlockCrc { .. } | Self::ProgramCrc { .. } => 0x6000_0020,
            Self::Empty
            | Self::NoRegularFile(_)
            | Self::TooLarge { .. }
            | Self::NotFirmware
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
            | Self::BlockNumber { .. }
            | Self::BlockSize { .. }
            | Self::ControlSize(_)
            | Self::LastSize(_) => 0x6000_0022,
            Self::Overlap { .. } => 0x6000_0023,
            Self::NothingInside(_) => 0x6000_0024,
        }
    }
}
