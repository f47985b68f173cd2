//! Conversion: from the memory contents of a program to the block file that a bootloader takes.

use std::borrow::Cow;

use shared_abi::block_file::{Control, Identity};

use super::block_file::{BlockFile, Checksum, LastBlock, FRAMING, MAX_BLOCK_SIZE, MAX_PROGRAM_SIZE};
use super::fault::{Cause, Place, ReadError};
use super::image::Image;
use super::label::label_of;
use super::range::AddressRange;
use super::raw;
use super::read::Firmware;
use super::sealed::SealedFile;

/// The manual's `--block-size`: 1024 bytes, framing included.
pub const DEFAULT_BLOCK_SIZE: usize = 0x400;

/// Flash is programmed by words: no block starts inside one, and no word lies in two blocks.
const WORD: u32 = 4;

/// Where a program may lie, and what becomes of data that lies elsewhere.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Region {
    /// Nobody knows: the program starts at the first byte of the file (rounded down to a word).
    #[default]
    Unknown,
    /// The flash of a program on a known board: data outside is an error.
    Strict(AddressRange),
    /// What `--start-address` and `--end-address` cut out (manual, table 8): data outside is left
    /// out.
    Cut(AddressRange),
    /// The same with `--end-address` alone: the program starts at the first byte.
    CutBehind(u32),
}

/// What gaps inside a block are filled with: a 32-bit pattern, as the flash's words would show it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GapFill([u8; 4]);

impl GapFill {
    /// The erased state of the flash.
    pub const ERASED: Self = Self([0xFF; 4]);

    /// The manual's value: up to FFh it is a byte (as in the manual of 2008), above it 32 bits (as
    /// in that of 2015).
    #[must_use]
    pub fn new(value: u32) -> Self {
        match u8::try_from(value) {
            Ok(byte) => Self([byte; 4]),
            Err(_) => Self(value.to_le_bytes()),
        }
    }

    fn at(self, address: u32) -> u8 {
        self.0[(address % WORD) as usize]
    }
}

impl Default for GapFill {
    fn default() -> Self {
        Self::ERASED
    }
}

/// For whom the program is and which one it is: what goes into block 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Label {
    /// What the image's own label tells, if it has one, and otherwise nothing.
    OfImage {
        /// Seconds since 1970-01-01 UTC, 0 where it is not told: a label has no date.
        date: u64,
    },
    /// Nothing is told.
    None,
    /// Vendor-ID and product code, compared with 1018h by the bootloader.
    Device {
        /// Vendor-ID, as in 1018h/1.
        vendor_id: u32,
        /// Product code, as in 1018h/2.
        product_code: u32,
    },
    /// The same, with version and date.
    Release {
        /// Vendor-ID, as in 1018h/1.
        vendor_id: u32,
        /// Product code, as in 1018h/2.
        product_code: u32,
        /// Major in bits 0–7, minor in bits 8–15, release in bits 16–31 (manual, figure 13).
        version: u32,
        /// Seconds since 1970-01-01 UTC.
        date: u64,
    },
}

impl Default for Label {
    fn default() -> Self {
        Self::OfImage { date: 0 }
    }
}

impl Label {
    /// What is to be told of a program that starts at `start`.
    fn resolved(self, image: &Image, start: u32) -> Self {
        let Self::OfImage { date } = self else { return self };
        label_of(image, start).map_or(Self::None, |label| Self::Release {
            vendor_id: label.vendor_id,
            product_code: label.product_code,
            version: label.version,
            date,
        })
    }

    fn control(self, app_size: u32) -> Control {
        match self {
            Self::OfImage { .. } | Self::None => Control::Plain,
            Self::Device { vendor_id, product_code } => {
                Control::Identity(Identity { app_size, vendor_id, product_code })
            }
            Self::Release { vendor_id, product_code, version, date } => {
                let identity = Identity { app_size, vendor_id, product_code };
                Control::Dated { identity, version, date }
            }
        }
    }

    /// Bytes of block 0 with framing.
    fn block_size(self) -> usize {
        self.control(0).emit().1 + FRAMING
    }
}

/// How to convert. The default is the manual's.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Options {
    /// Where the program may lie.
    pub region: Region,
    /// Bytes of the largest block, framing included; the bootloader's buffer must hold it.
    pub block_size: usize,
    /// What gaps inside a block are filled with.
    pub gap_fill: GapFill,
    /// What goes into block 0.
    pub label: Label,
    /// What is added to every address, after [`Region::Cut`] and before [`Region::Strict`]; 2³² − n
    /// takes n away.
    pub adjust_start: u32,
    /// With what the blocks and the program are checked: what the bootloader was built for.
    pub checksum: Checksum,
    /// The most bytes in a row that a block may have without data of the program between two that
    /// have (manual L-1112e_5, `FT_BLOCK_MAX_GAP`): a longer gap starts a new block. `None`: as many
    /// as the block has room for.
    pub max_gap: Option<u32>,
    /// The form of the last block.
    pub last_block: LastBlock,
}

impl Options {
    setters! {
        region: Region,
        block_size: usize,
        gap_fill: GapFill,
        label: Label,
        adjust_start: u32,
        checksum: Checksum,
        max_gap: Option<u32>,
        last_block: LastBlock,
    }
}

impl Default for Options {
    fn default() -> Self {
        Self {
            region: Region::default(),
            block_size: DEFAULT_BLOCK_SIZE,
            gap_fill: GapFill::default(),
            label: Label::default(),
            adjust_start: 0,
            checksum: Checksum::default(),
            max_gap: None,
            last_block: LastBlock::default(),
        }
    }
}

/// Why nothing was converted.
#[derive(Debug, thiserror::Error)]
pub enum ConvertError {
    /// The file and the region do not fit each other.
    #[error(transparent)]
    File(#[from] ReadError),
    /// The block size is no good.
    #[error(
        "a block size of {given} is impossible: it counts the 16 bytes of framing and must be {min} to {max}"
    )]
    BlockSize {
        /// What was asked for.
        given: usize,
        /// The least that this conversion needs.
        min: usize,
        /// The most that the manual allows.
        max: usize,
    },
    /// The program's start is no word address.
    #[error("a program cannot start at {0:#010x}: flash is programmed by words of 4 bytes")]
    Start(u32),
    /// A region that ends before it starts.
    #[error("the address range {0} ends before it starts")]
    Range(AddressRange),
    /// Addresses that leave the address space when they are adjusted.
    #[error("adding {0:#010x} to the addresses moves the program over the end of the address space")]
    Adjust(u32),
    /// Blocks cannot be changed any more.
    #[error("a block file is taken as it is: {0} needs the firmware that it was made of")]
    Blocks(&'static str),
}

/// A conversion's result.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Converted {
    /// The blocks.
    pub file: BlockFile,
    /// Bytes of the input that [`Region::Cut`] left out.
    pub left_out: u64,
}

/// Makes blocks out of a program.
///
/// Blocks start at the first byte that is not yet in a block, rounded down to a word; gaps inside a
/// block are filled, gaps between blocks are left to the erased flash. The same input gives the
/// same blocks.
///
/// # Errors
/// See [`ConvertError`].
pub fn convert(image: &Image, options: &Options) -> Result<Converted, ConvertError> {
    let (image, start, left_out) = place(image, options)?;
    let label = options.label.resolved(&image, start);
    let payload = payload(options.block_size, label)?;
    if !start.is_multiple_of(WORD) {
        return Err(ConvertError::Start(start));
    }
    let last = image.span().last;
    if last - start >= MAX_PROGRAM_SIZE {
        return Err(Place::File.fault(Cause::TooSparse { first: start, last }).into());
    }
    let blocks = blocks(&image, payload, options);
    let control = |app_size| label.control(app_size);
    let file = BlockFile::new(start, blocks, control, options.checksum, options.last_block);
    Ok(Converted { file, left_out })
}

/// Blocks of whatever a file holds: an image is [converted](convert), blocks are checked against a
/// strict region and taken as they are.
///
/// # Errors
/// See [`ConvertError`].
pub fn blocks_of(firmware: Firmware, options: &Options) -> Result<Converted, ConvertError> {
    match firmware {
        Firmware::Image(image) => convert(&image, options),
        Firmware::Blocks(_) if options.adjust_start != 0 => {
            Err(ConvertError::Blocks("another start address"))
        }
        Firmware::Blocks(file) => {
            match options.region {
                Region::Unknown => {}
                Region::Strict(region) | Region::Cut(region) => file.check_region(region)?,
                Region::CutBehind(last) => {
                    file.check_region(AddressRange { first: file.program_start(), last })?;
                }
            }
            Ok(Converted { file, left_out: 0 })
        }
    }
}

/// The blocks that carry a sealed image, of at most `block_size` bytes with framing, to a device whose
/// program starts at `start`: its bytes in order from there on, and block 0 with what it says.
///
/// # Errors
/// [`ConvertError::BlockSize`], [`ConvertError::Start`], and [`ConvertError::File`] for one that runs
/// over the end of the address space.
pub fn blocks_of_sealed(file: &SealedFile, start: u32, block_size: usize) -> Result<BlockFile, ConvertError> {
    let head = file.head();
    let label = Label::Release {
        vendor_id: head.vendor_id(),
        product_code: head.product_code(),
        version: head.version(),
        date: head.created(),
    };
    let bytes = raw::read(file.bytes(), Some(start))?;
    Ok(convert(&bytes, &Options::default().block_size(block_size).label(label))?.file)
}

/// Data bytes of the largest block: whole words.
fn payload(given: usize, label: Label) -> Result<usize, ConvertError> {
    // The last block has 8 data bytes, block 0 at least as many.
    let (min, max) = (label.block_size(), MAX_BLOCK_SIZE);
    if !(min..=max).contains(&given) {
        return Err(ConvertError::BlockSize { given, min, max });
    }
    let data = given - FRAMING;
    Ok(data - data % WORD as usize)
}

/// What of the image belongs to the program, where the program starts, and how many bytes do not
/// belong to it.
fn place<'i>(image: &'i Image, options: &Options) -> Result<(Cow<'i, Image>, u32, u64), ConvertError> {
    let offset = options.adjust_start;
    let adjusted = |image: Cow<'i, Image>| match offset {
        0 => Ok(image),
        _ => image.moved(offset).map(Cow::Owned).ok_or(ConvertError::Adjust(offset)),
    };
    let inside = |range| image.part(range).ok_or(Place::File.fault(Cause::NothingInside(range)));
    let left_out = |part: &Image| image.byte_count() - part.byte_count();
    let start = |image: &Image| image.span().first & !(WORD - 1);
    match options.region {
        Region::Unknown => {
            let image = adjusted(Cow::Borrowed(image))?;
            let start = start(&image);
            Ok((image, start, 0))
        }
        Region::CutBehind(last) => {
            let part = inside(AddressRange { first: 0, last })?;
            let left_out = left_out(&part);
            let part = adjusted(Cow::Owned(part))?;
            let start = start(&part);
            Ok((part, start, left_out))
        }
        Region::Strict(range) => {
            check_range(range)?;
            let image = adjusted(Cow::Borrowed(image))?;
            image.check_inside(range)?;
            Ok((image, range.first, 0))
        }
        Region::Cut(range) => {
            check_range(range)?;
            let part = inside(range)?;
            let left_out = left_out(&part);
            let start = range.first.wrapping_add(offset);
            let part = adjusted(Cow::Owned(part))?;
            if part.span().first < start {
                return Err(ConvertError::Adjust(offset));
            }
            Ok((part, start, left_out))
        }
    }
}

fn check_range(range: AddressRange) -> Result<(), ConvertError> {
    if range.first > range.last {
        return Err(ConvertError::Range(range));
    }
    Ok(())
}

/// Address and data of each block.
fn blocks(image: &Image, payload: usize, options: &Options) -> Vec<(u32, Vec<u8>)> {
    let mut blocks: Vec<(u32, Vec<u8>)> = Vec::new();
    for piece in image.pieces() {
        let (mut address, mut data) = (u64::from(piece.address), piece.data.as_slice());
        while !data.is_empty() {
            // The block under way, if its window reaches this far, or else a new one.
            let reaches = |(start, data): &(u32, Vec<u8>)| {
                let end = u64::from(*start) + data.len() as u64;
                // A word that the block has begun is the block's: no word lies in two.
                let same_word = address < end.next_multiple_of(WORD.into());
                let near = options.max_gap.is_none_or(|most| address - end <= most.into());
                address < u64::from(*start) + payload as u64 && (near || same_word)
            };
            if !blocks.last().is_some_and(reaches) {
                // `address` is that of a byte, so it fits.
                blocks.push((address as u32 & !(WORD - 1), Vec::with_capacity(payload)));
            }
            let Some((start, block)) = blocks.last_mut() else { break };
            let gap = *start + block.len() as u32..address as u32;
            block.extend(gap.map(|address| options.gap_fill.at(address)));
            let (fitting, rest) = data.split_at(data.len().min(payload - block.len()));
            block.extend_from_slice(fitting);
            address += fitting.len() as u64;
            data = rest;
        }
    }
    blocks
}
