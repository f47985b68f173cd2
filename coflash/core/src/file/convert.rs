//! Makes a program for a device of the contents of a firmware file.

use shared_abi::block_file::{Last, ProgramVersion};

use super::block_file::{control_size, BlockFile, FRAMING, MAX_BLOCK_SIZE};
use super::checksum::Checksum;
use super::fault::{Cause, Place, ReadError};
use super::image::{Image, Piece, Pieces};
use super::judge;
use super::label::label_of;
use super::note::Note;
use super::program::{Cut, LastBlock, Program, Release, Target, MAX_PROGRAM_SIZE};
use super::range::AddressRange;
use super::read::Firmware;
use super::sealed::SealedFile;

/// The manual's default for `--block-size`: 1024 bytes, including framing.
pub const DEFAULT_BLOCK_SIZE: usize = 0x400;

/// Flash is programmed in words: a block begins at a word, and no word lies in two blocks.
const WORD: u32 = 4;

/// The region of a program, and the treatment of data outside it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Region {
    /// Unknown: the program starts at the first byte of the file (rounded down to a word).
    #[default]
    Unknown,
    /// The flash of a program on a known board: data outside it are an error.
    Strict(AddressRange),
    /// The region between `--start-address` and `--end-address` (manual, table 8): data outside it
    /// are left out.
    Cut(AddressRange),
    /// `--end-address` alone: the program starts at the first byte, and data beyond the end are
    /// left out.
    CutBehind(u32),
}

/// The value that fills gaps inside a block: a 32-bit pattern, aligned to the words of the flash.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GapFill([u8; 4]);

impl GapFill {
    /// The erased state of the flash.
    pub const ERASED: Self = Self([0xFF; 4]);

    /// The value in the manual's form: up to FFh it is a byte (manual of 2008), above that 32 bits
    /// (manual of 2015).
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

/// The target and the release of a program, which block 0 has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Label {
    /// The contents of the image's label, if it has one; otherwise nothing.
    OfImage {
        /// Seconds since 1970-01-01 UTC; 0 for the one in the label, if it has one.
        date: u64,
    },
    /// No identity.
    None,
    /// Vendor-ID and product code, compared with 1018h by the bootloader.
    Device {
        /// Vendor-ID, as in 1018h/1.
        vendor_id: u32,
        /// Product code, as in 1018h/2.
        product_code: u32,
    },
    /// Vendor-ID and product code, with version and date.
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
    /// Target and release of a program that starts at `start`.
    fn of(self, image: &Image, start: u32) -> (Option<Target>, Option<Release>) {
        let release = |version, date| Some(Release { version: ProgramVersion(version), date });
        match self {
            Self::None => (None, None),
            Self::Device { vendor_id, product_code } => (Some(Target { vendor_id, product_code }), None),
            Self::Release { vendor_id, product_code, version, date } => {
                (Some(Target { vendor_id, product_code }), release(version, date))
            }
            Self::OfImage { date } => label_of(image, start).map_or((None, None), |label| {
                let target = Target { vendor_id: label.vendor_id, product_code: label.product_code };
                (Some(target), release(label.version, if date == 0 { label.date.into() } else { date }))
            }),
        }
    }
}

options! {
    /// The options of a conversion. The default is the manual's.
    #[derive(Clone, Copy, Debug, PartialEq, Eq)]
    pub struct Options {
        /// The region of the program.
        pub region: Region = Region::default(),
        /// The size of the largest block, including framing; it must fit into the bootloader's
        /// buffer.
        pub block_size: usize = DEFAULT_BLOCK_SIZE,
        /// The value that fills gaps inside a block.
        pub gap_fill: GapFill = GapFill::default(),
        /// The contents of block 0.
        pub label: Label = Label::default(),
        /// The offset that is added to every address, after [`Region::Cut`] and before
        /// [`Region::Strict`]; 2³² − n subtracts n.
        pub adjust_start: u32 = 0,
        /// The CRC of blocks and program: the one that the bootloader was built for.
        pub checksum: Checksum = Checksum::default(),
        /// The longest gap inside a block, in bytes (manual L-1112e_5, `FT_BLOCK_MAX_GAP`): a
        /// longer gap starts a new block. `None`: the room in the block is the only limit.
        pub max_gap: Option<u32> = None,
        /// The form of the last block.
        pub last_block: LastBlock = LastBlock::default(),
    }
}

impl Options {
    /// The address of a raw binary, if the region gives it: the file begins at the start of the region. The
    /// conversion adjusts it like any other address.
    #[must_use]
    pub fn raw_address(&self) -> Option<u32> {
        match self.region {
            Region::Unknown | Region::CutBehind(_) => None,
            Region::Strict(range) => Some(range.first.wrapping_sub(self.adjust_start)),
            Region::Cut(range) => Some(range.first),
        }
    }
}

/// Why a conversion failed.
#[derive(Debug, thiserror::Error)]
pub enum ConvertError {
    /// The file does not fit into the region.
    #[error(transparent)]
    File(#[from] ReadError),
    /// Data lie outside the region, and their contents name the kind of the image.
    #[error("{}: {}", .0, .0.advice())]
    Judged(judge::Fault),
    /// The block size is invalid.
    #[error(
        "a block size of {given} is impossible: it counts the 16 bytes of framing and must be {min} to {max}"
    )]
    BlockSize {
        /// The requested size.
        given: usize,
        /// The lowest size for this conversion.
        min: usize,
        /// The highest size that the manual allows.
        max: usize,
    },
    /// The program's start is not a word address.
    #[error("a program cannot start at {0:#010x}: flash is programmed in words of 4 bytes")]
    Start(u32),
    /// A region that ends before it starts.
    #[error("the address range {0} ends before it starts")]
    Range(AddressRange),
    /// Adding the offset moves addresses out of the address space.
    #[error("adding {0:#010x} to the addresses moves the program beyond the end of the address space")]
    Adjust(u32),
    /// The contents of a block file cannot be changed.
    #[error("a block file cannot be changed: {0} needs the original firmware")]
    Blocks(&'static str),
}

/// The result of a conversion.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Converted {
    /// The program.
    pub program: Program,
    /// Bytes of the input that [`Region::Cut`] left out.
    pub left_out: u64,
    /// What is odd about the input.
    pub notes: Vec<Note>,
}

/// Makes a program of the memory contents in a file.
///
/// Its blocks show what is filled: a block starts at the first byte that is not yet in a block, rounded
/// down to a word. Gaps inside a block are filled; gaps between blocks stay erased flash. The same input
/// gives the same program.
///
/// # Errors
/// See [`ConvertError`].
pub fn convert(image: Image, options: &Options) -> Result<Converted, ConvertError> {
    let (image, start, left_out) = place(image, options)?;
    let (target, release) = options.label.of(&image, start);
    let payload = payload(options.block_size, target, release)?;
    check_extent(start, image.span().last)?;
    let (image, notes) = filled(image, payload, options);
    let (span, checksum) = (image.span(), options.checksum);
    let program_size = span.last - start + 1;
    let program_crc = checksum.of_flash(start, program_size, image.runs());
    let last = Last { program_size, program_crc };
    let cut = Cut::Even { payload, last_block: options.last_block };
    let program = Program { image, start, last, checksum, target, release, cut };
    Ok(Converted { program, left_out, notes })
}

/// Makes a program of any firmware file: an image is [converted](convert); that of a block file is
/// checked against a strict region and used unchanged.
///
/// # Errors
/// See [`ConvertError`].
pub fn program_of(firmware: Firmware, options: &Options) -> Result<Converted, ConvertError> {
    match firmware {
        Firmware::Image(image) => convert(image, options),
        Firmware::Blocks(_) if options.adjust_start != 0 => {
            Err(ConvertError::Blocks("another start address"))
        }
        Firmware::Blocks(program) => {
            match options.region {
                Region::Unknown => {}
                Region::Strict(region) | Region::Cut(region) => program.check_region(region)?,
                Region::CutBehind(last) => {
                    program.check_region(AddressRange { first: program.start(), last })?;
                }
            }
            Ok(Converted { program, left_out: 0, notes: Vec::new() })
        }
    }
}

/// Makes the blocks that carry a sealed image, of at most `block_size` bytes with framing, to a
/// device with a program that starts at `start`. The blocks hold the image's bytes in order from
/// this address on; block 0 holds the identity from its manifest.
/// # Errors
/// [`ConvertError::BlockSize`], [`ConvertError::Start`], and [`ConvertError::File`] if the image
/// exceeds the address space.
pub fn blocks_of_sealed(
    file: &SealedFile,
    start: u32,
    block_size: usize,
) -> Result<BlockFile<'_>, ConvertError> {
    let (head, target, bytes) = (file.head(), file.target(), file.bytes());
    let release = Release { version: ProgramVersion(head.version()), date: head.created() };
    let Some(last) = u32::try_from(bytes.len() - 1).ok().and_then(|last| start.checked_add(last)) else {
        let cause = Cause::AddressOverflow { address: start, what: "the address space" };
        return Err(Place::File.fault(cause).into());
    };
    let payload = payload(block_size, Some(target), Some(release))?;
    check_extent(start, last)?;
    Ok(BlockFile::of_sealed(bytes, start, payload, target, release))
}

/// Checks the place of a program: from `start` to its last byte.
fn check_extent(start: u32, last: u32) -> Result<(), ConvertError> {
    if !start.is_multiple_of(WORD) {
        return Err(ConvertError::Start(start));
    }
    if last - start >= MAX_PROGRAM_SIZE {
        return Err(Place::File.fault(Cause::TooSparse { first: start, last }).into());
    }
    Ok(())
}

/// The data bytes of the largest block, a multiple of a word.
fn payload(given: usize, target: Option<Target>, release: Option<Release>) -> Result<usize, ConvertError> {
    // The last block has 8 data bytes, block 0 at least as many.
    let (min, max) = (control_size(target, release), MAX_BLOCK_SIZE);
    if !(min..=max).contains(&given) {
        return Err(ConvertError::BlockSize { given, min, max });
    }
    let data = given - FRAMING;
    Ok(data - data % WORD as usize)
}

/// The part of the image that belongs to the program, the program's start address, and the number
/// of bytes outside it.
fn place(image: Image, options: &Options) -> Result<(Image, u32, u64), ConvertError> {
    let offset = options.adjust_start;
    let adjusted = |image: Image| match offset {
        0 => Ok(image),
        _ => image.moved(offset).ok_or(ConvertError::Adjust(offset)),
    };
    let inside = |range| image.part(range).ok_or(Place::File.fault(Cause::NothingInside(range)));
    let left_out = |part: &Image| image.byte_count() - part.byte_count();
    let start = |image: &Image| image.span().first & !(WORD - 1);
    match options.region {
        Region::Unknown => {
            let image = adjusted(image)?;
            image.check_areas()?;
            let start = start(&image);
            Ok((image, start, 0))
        }
        Region::CutBehind(last) => {
            let part = inside(AddressRange { first: 0, last })?;
            let left_out = left_out(&part);
            let part = adjusted(part)?;
            let start = start(&part);
            Ok((part, start, left_out))
        }
        Region::Strict(range) => {
            check_range(range)?;
            let image = adjusted(image)?;
            image.check_inside(range).map_err(|error| match error.cause {
                Cause::Outside { .. } => judge::named_image(&image, image.span().first)
                    .map_or(ConvertError::File(error), ConvertError::Judged),
                _ => error.into(),
            })?;
            Ok((image, range.first, 0))
        }
        Region::Cut(range) => {
            check_range(range)?;
            let part = inside(range)?;
            let left_out = left_out(&part);
            let start = range.first.wrapping_add(offset);
            let part = adjusted(part)?;
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

/// The image as it lies in flash, in whole words and with the gaps inside its blocks filled; and what is
/// odd about its file. The bytes of a piece that fills no gap are moved, not copied.
fn filled(image: Image, payload: usize, options: &Options) -> (Image, Vec<Note>) {
    let (pieces, notes) = image.into_pieces();
    let mut runs: Vec<Piece> = Vec::new();
    // The address of the last block, which is a multiple of `payload` after the start of its run.
    let mut block = 0;
    for mut piece in pieces {
        let address = u64::from(piece.address);
        let reaches = |run: &Piece| {
            let end = u64::from(run.address) + run.data.len() as u64;
            // A word that a block has begun belongs to it: no word lies in two blocks.
            let same_word = address < end.next_multiple_of(WORD.into());
            let near = options.max_gap.is_none_or(|most| address - end <= most.into());
            address == end || address < block + payload as u64 && (near || same_word)
        };
        let gap = |from| (from..piece.address).map(|address| options.gap_fill.at(address));
        if let Some(run) = runs.last_mut().filter(|run| reaches(run)) {
            // It ends before the address of another piece.
            let end = run.address + run.data.len() as u32;
            run.data.extend(gap(end));
            run.data.append(&mut piece.data);
        } else {
            let first = piece.address & !(WORD - 1);
            if first < piece.address {
                piece.data.splice(..0, gap(first));
            }
            block = first.into();
            runs.push(Piece { address: first, ..piece });
        }
        if let Some(run) = runs.last() {
            let end = u64::from(run.address) + run.data.len() as u64;
            block += (end - 1 - block) / payload as u64 * payload as u64;
        }
    }
    let mut all = Pieces::default();
    runs.into_iter().for_each(|run| all.add(run.address, run.data, run.place));
    (all.in_order(), notes)
}
