//! Reads, checks and writes block files. [`shared_abi::block_file`] defines the format.

use std::fmt;

use crc::{Crc, Table, CRC_16_XMODEM, CRC_32_ISO_HDLC};
use shared_abi::block_file::{
    Control, Header, Last, CRC_SIZE, HEADER_SIZE, LAST_SIZE, LAST_SIZE_2008, LAST_SIZE_AT_2008_OFFSETS,
    NUMBER_CONTROL, NUMBER_LAST,
};
pub use shared_abi::block_file::{Identity, FRAMING, MAX_BLOCK_SIZE};

use super::fault::{Cause, Place, ReadError};
use super::image::{Image, Pieces};
use super::range::AddressRange;

/// The CRC of blocks and programs: polynomial EDB88320h reflected (manual L-1112d_10, chapter 3.1).
pub const CRC: Crc<u32, Table<16>> = Crc::<u32, Table<16>>::new(&CRC_32_ISO_HDLC);

/// The CRC of a bootloader that was built for it: polynomial 1021h, start value 0, as in SDO block
/// transfer (manual L-1112d_10, table 8, `--crc16`).
const CRC16: Crc<u16, Table<16>> = Crc::<u16, Table<16>>::new(&CRC_16_XMODEM);

/// The CRC that protects the blocks and the program. The file does not name it: host and bootloader
/// must agree.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Checksum {
    /// [`CRC`].
    #[default]
    Crc32,
    /// The 16-bit CRC with polynomial 1021h, stored in 32 bits.
    Crc16,
}

impl Checksum {
    /// The other one of the two.
    #[must_use]
    pub const fn other(self) -> Self {
        match self {
            Self::Crc32 => Self::Crc16,
            Self::Crc16 => Self::Crc32,
        }
    }

    /// The CRC over all parts in sequence.
    fn of<'a>(self, parts: impl Iterator<Item = &'a [u8]>) -> u32 {
        match self {
            Self::Crc32 => {
                let mut digest = CRC.digest();
                parts.for_each(|part| digest.update(part));
                digest.finalize()
            }
            Self::Crc16 => {
                let mut digest = CRC16.digest();
                parts.for_each(|part| digest.update(part));
                digest.finalize().into()
            }
        }
    }
}

impl fmt::Display for Checksum {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Crc32 => "CRC-32",
            Self::Crc16 => "CRC-16",
        })
    }
}

/// The most data bytes that a block can have.
pub const MAX_DATA: usize = MAX_BLOCK_SIZE - FRAMING;

/// The most bytes from a program's start to its last byte. The flash of any microcontroller is
/// smaller; a larger file holds data for two memories.
pub const MAX_PROGRAM_SIZE: u32 = 64 * 1024 * 1024;

/// The form of the last block.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LastBlock {
    /// Size and CRC of the program: the manual of 2015.
    #[default]
    Of2015,
    /// 32 reserved bytes before them: the manual of 2008.
    Of2008,
}

/// One block, the data of one SDO download.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Block {
    /// 0, 1…N or FFFFFFFFh.
    pub number: u32,
    /// The address for the data.
    pub flash_address: u32,
    /// The data: control data, a part of the program, or its size and CRC.
    pub data: Vec<u8>,
}

impl Block {
    /// The bytes of the block with header and CRC-32.
    #[must_use]
    pub fn emit(&self) -> Vec<u8> {
        self.emit_with(Checksum::Crc32)
    }

    /// The bytes of the block with header and CRC.
    #[must_use]
    pub fn emit_with(&self, checksum: Checksum) -> Vec<u8> {
        let header = Header {
            number: self.number,
            flash_address: self.flash_address,
            size: match (self.number, self.data.len()) {
                // The size field of the manual of 2008 does not include the reserved bytes.
                (NUMBER_LAST, LAST_SIZE_2008 | LAST_SIZE_AT_2008_OFFSETS) => LAST_SIZE as u32,
                // A block is never larger than `MAX_DATA`.
                (_, size) => size as u32,
            },
        };
        let mut bytes = Vec::with_capacity(FRAMING + self.data.len());
        bytes.extend_from_slice(&header.emit());
        bytes.extend_from_slice(&self.data);
        let crc = checksum.of([bytes.as_slice()].into_iter());
        bytes.extend_from_slice(&crc.to_le_bytes());
        bytes
    }
}

/// A complete block file with correct numbers, sizes and CRCs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BlockFile {
    blocks: Vec<Block>,
    /// `None` for data of the product's own.
    control: Option<Control>,
    last: Last,
    checksum: Checksum,
}

impl BlockFile {
    /// Makes a file from the blocks of a program with a region that starts at `start`.
    ///
    /// `blocks` are pairs of address and data in the order of addresses, none before `start`; each
    /// has at most [`MAX_DATA`] bytes. `control` makes block 0 after the program's size is known.
    pub(crate) fn new(
        start: u32,
        blocks: Vec<(u32, Vec<u8>)>,
        control: impl FnOnce(u32) -> Control,
        checksum: Checksum,
        last_block: LastBlock,
    ) -> Self {
        let program_size = blocks.last().map_or(0, |(address, data)| address - start + data.len() as u32);
        let program_crc =
            program_crc(checksum, start, program_size, blocks.iter().map(|(a, d)| (*a, d.as_slice())));
        let control = control(program_size);
        // Flash address 0: the older manual (L-1112e_5) requires it, the newer one allows any
        // value.
        let last = Last { program_size, program_crc };
        let (bytes, len) = control.emit();
        let block = |number, flash_address, data| Block { number, flash_address, data };
        let mut all = vec![block(NUMBER_CONTROL, 0, bytes[..len].to_vec())];
        all.extend((1..).zip(blocks).map(|(number, (address, data))| block(number, address, data)));
        let reserved = match last_block {
            LastBlock::Of2015 => 0,
            LastBlock::Of2008 => LAST_SIZE_2008 - LAST_SIZE,
        };
        all.push(block(NUMBER_LAST, 0, [&vec![0; reserved][..], &last.emit()].concat()));
        Self { blocks: all, control: Some(control), last, checksum }
    }

    /// The same program in blocks of up to `size` bytes, framing included: blocks without a gap
    /// between them are joined. Block 0 and the last block stay as they are.
    #[must_use]
    pub(crate) fn joined(&self, size: usize) -> Self {
        let most = size.min(MAX_BLOCK_SIZE).saturating_sub(FRAMING);
        let mut blocks: Vec<Block> = Vec::new();
        for block in &self.blocks {
            let is_program = |block: &Block| !matches!(block.number, NUMBER_CONTROL | NUMBER_LAST);
            let follows = |last: &&mut Block| {
                let end = last.flash_address.checked_add(last.data.len() as u32);
                let fits = last.data.len() + block.data.len() <= most;
                is_program(last) && is_program(block) && fits && end == Some(block.flash_address)
            };
            if let Some(last) = blocks.last_mut().filter(follows) {
                last.data.extend_from_slice(&block.data);
            } else {
                let number = match block.number {
                    NUMBER_LAST => NUMBER_LAST,
                    _ => blocks.len() as u32,
                };
                blocks.push(Block { number, ..block.clone() });
            }
        }
        Self { blocks, ..self.clone() }
    }

    /// Whether bytes begin like a block file: block 0 at address 0, with one of the manual's lengths, or with
    /// another one and block 1 after it.
    #[must_use]
    pub fn looks_like(bytes: &[u8]) -> bool {
        let Some(header) = bytes.first_chunk() else { return false };
        let Header { number, flash_address, size } = Header::parse(header);
        let next = bytes.get((size as usize).saturating_add(FRAMING)..).and_then(|rest| rest.first_chunk());
        let is_followed = next.is_some_and(|number| u32::from_le_bytes(*number) == 1);
        number == NUMBER_CONTROL && flash_address == 0 && (matches!(size, 8 | 12 | 24) || is_followed)
    }

    /// Parses a file and checks every number, size and CRC in it. The first block shows which CRC
    /// the file uses.
    ///
    /// # Errors
    /// The first fault, with its offset.
    pub fn parse(bytes: &[u8]) -> Result<Self, ReadError> {
        let mut blocks: Vec<Block> = Vec::new();
        let mut offset = 0;
        let mut checksum = Checksum::Crc32;
        if parse_block(bytes, Checksum::Crc16, Place::Offset(0)).is_ok() {
            checksum = Checksum::Crc16;
        }
        let last = loop {
            let place = Place::Offset(offset);
            let (block, len) = parse_block(&bytes[offset..], checksum, place)?;
            let expected = blocks.len() as u32;
            let is_last = block.number == NUMBER_LAST && expected > 0;
            if block.number != expected && !is_last {
                return Err(place.fault(Cause::BlockNumber { found: block.number, expected }));
            }
            offset += len;
            let data_len = block.data.len();
            let last = is_last.then(|| Last::parse(&block.data));
            check_order(blocks.last(), &block, place)?;
            blocks.push(block);
            match last {
                Some(Some(last)) => break last,
                Some(None) => return Err(place.fault(Cause::LastSize(data_len))),
                None if offset == bytes.len() => {
                    return Err(Place::File.fault(Cause::NoEnd("its last block (number FFFFFFFFh)")))
                }
                None => {}
            }
        };
        if offset != bytes.len() {
            let words = "there are more bytes after the last block: the file is damaged, or consists of several files";
            return Err(Place::Offset(offset).fault(Cause::Malformed(words)));
        }
        // Of another length, it has a meaning for the check of the product alone.
        let control = Control::parse(&blocks[0].data);
        let file = Self { blocks, control, last, checksum };
        if file.program_blocks().is_empty() {
            return Err(Place::File.fault(Cause::NoData));
        }
        // The file does not contain the start of its program. It is the first byte, or the address
        // that lies the program's size before the end of the last byte.
        let span = file.span();
        let by_end = (u64::from(span.last) + 1).checked_sub(last.program_size.into());
        let fits = |start| file.starts_at(start);
        if fits(span.first) || by_end.and_then(|start| u32::try_from(start).ok()).is_some_and(fits) {
            return Ok(file);
        }
        Err(Place::Offset(offset - FRAMING - 8).fault(file.program_fault()))
    }

    /// Checks the file against the region for its program: every block must lie inside, and size
    /// and CRC must be right when counted from the start of the region, as the device counts them.
    ///
    /// # Errors
    /// [`Cause::Outside`], [`Cause::Elsewhere`] or [`Cause::OtherPlace`].
    pub fn check_region(&self, region: AddressRange) -> Result<(), ReadError> {
        let mut offset = self.blocks[0].data.len() + FRAMING;
        for block in self.program_blocks() {
            let data = AddressRange { first: block.flash_address, last: last_address(block) };
            if !region.contains(&data) {
                return Err(Place::Offset(offset).fault(Cause::outside(data, region)));
            }
            offset += block.data.len() + FRAMING;
        }
        if self.starts_at(region.first) {
            Ok(())
        } else {
            let (linked, start) = (self.program_start(), region.first);
            Err(Place::File.fault(Cause::OtherPlace { linked, start }))
        }
    }

    /// Whether size and CRC in the last block match the blocks, counted from `start`.
    fn starts_at(&self, start: u32) -> bool {
        let span = self.span();
        let Last { program_size, program_crc: crc } = self.last;
        // The CRC would not cover blocks beyond the size.
        let covered = start <= span.first
            && program_size <= MAX_PROGRAM_SIZE
            && u64::from(start) + u64::from(program_size) > u64::from(span.last);
        let blocks = self.program_blocks().iter().map(|block| (block.flash_address, block.data.as_slice()));
        covered && program_crc(self.checksum, start, program_size, blocks) == crc
    }

    fn program_fault(&self) -> Cause {
        Cause::ProgramCrc { size: self.last.program_size, crc: self.last.program_crc }
    }

    /// All blocks in the order of their downloads: control, program, last.
    #[must_use]
    pub fn blocks(&self) -> &[Block] {
        &self.blocks
    }

    /// The blocks with the program: 1…N.
    #[must_use]
    pub fn program_blocks(&self) -> &[Block] {
        let end = self.blocks.len().saturating_sub(1).max(1);
        &self.blocks[1..end]
    }

    /// The range from the program's first byte in a block to its last one.
    #[must_use]
    pub fn span(&self) -> AddressRange {
        let blocks = self.program_blocks();
        AddressRange {
            first: blocks.first().map_or(0, |block| block.flash_address),
            last: blocks.last().map_or(0, last_address),
        }
    }

    /// The contents of block 0; `None` if it has a length that the manual does not define, because its data
    /// are the product's own.
    #[must_use]
    pub fn control(&self) -> Option<Control> {
        self.control
    }

    /// The values of 1F56h of a device with this program: its CRC by the checksum of the file, and by
    /// the other one, which the device may use for a program that it got without blocks.
    #[must_use]
    pub fn program_crcs(&self) -> [u32; 2] {
        [self.checksum, self.checksum.other()].map(|checksum| self.program_crc_with(checksum))
    }

    fn program_crc_with(&self, checksum: Checksum) -> u32 {
        if checksum == self.checksum {
            return self.last.program_crc;
        }
        checksum.of([self.flash_image().as_slice()].into_iter())
    }

    /// The bytes of one of its blocks for a device that checks with this CRC: the block's own one, and
    /// in the last block that of the program.
    #[must_use]
    pub fn emit_block(&self, block: &Block, checksum: Checksum) -> Vec<u8> {
        if block.number != NUMBER_LAST {
            return block.emit_with(checksum);
        }
        let last = Last { program_crc: self.program_crc_with(checksum), ..self.last };
        let mut block = block.clone();
        let at = block.data.len().saturating_sub(LAST_SIZE);
        block.data.splice(at.., last.emit());
        block.emit_with(checksum)
    }

    /// The CRC of the blocks and the program.
    #[must_use]
    pub fn checksum(&self) -> Checksum {
        self.checksum
    }

    /// The memory contents in the blocks.
    #[must_use]
    pub fn image(&self) -> Image {
        let mut pieces = Pieces::default();
        let mut offset = 0;
        for block in &self.blocks {
            if !matches!(block.number, NUMBER_CONTROL | NUMBER_LAST) {
                pieces.add(block.flash_address, block.data.clone(), Place::Offset(offset));
            }
            offset += FRAMING + block.data.len();
        }
        pieces.in_order()
    }

    /// The start of the program: the first address of its region, as far as the file shows it.
    #[must_use]
    pub fn program_start(&self) -> u32 {
        let span = self.span();
        if self.starts_at(span.first) {
            return span.first;
        }
        span.last.wrapping_add(1).wrapping_sub(self.last.program_size)
    }

    /// The contents of the flash after the download, from the program's start to its last byte.
    #[must_use]
    pub fn flash_image(&self) -> Vec<u8> {
        let start = self.program_start();
        // `parse` and `convert` bound the size by `MAX_PROGRAM_SIZE`.
        let mut flash = vec![0xFF; self.last.program_size as usize];
        for block in self.program_blocks() {
            let at = block.flash_address.wrapping_sub(start) as usize;
            if let Some(place) = flash.get_mut(at..at + block.data.len()) {
                place.copy_from_slice(&block.data);
            }
        }
        flash
    }

    /// Size of the program in bytes, from the start of its region.
    #[must_use]
    pub fn program_size(&self) -> u32 {
        self.last.program_size
    }

    /// CRC of the program: the value of 1F56h after the download.
    #[must_use]
    pub fn program_crc(&self) -> u32 {
        self.last.program_crc
    }

    /// The bytes of the file.
    #[must_use]
    pub fn emit(&self) -> Vec<u8> {
        self.blocks.iter().flat_map(|block| block.emit_with(self.checksum)).collect()
    }
}

fn last_address(block: &Block) -> u32 {
    block.flash_address.saturating_add((block.data.len() as u32).saturating_sub(1))
}

/// Parses one block at the front of `bytes`; also returns its length.
fn parse_block(bytes: &[u8], checksum: Checksum, place: Place) -> Result<(Block, usize), ReadError> {
    let cut_off = |what, needed| place.fault(Cause::CutOff { what, needed, found: bytes.len() });
    let header = bytes.first_chunk().ok_or_else(|| cut_off("the header of a block", HEADER_SIZE))?;
    let Header { number, flash_address, size } = Header::parse(header);
    if size as usize > MAX_DATA {
        return Err(place.fault(Cause::BlockSize { number, size }));
    }
    let mut crc_at = HEADER_SIZE + size as usize;
    // The size field of the manual of 2008 does not include the reserved bytes. The last block ends
    // with the file.
    if number == NUMBER_LAST && size as usize == LAST_SIZE {
        let of_2008 = [LAST_SIZE_2008, LAST_SIZE_AT_2008_OFFSETS].map(|size| HEADER_SIZE + size);
        crc_at = of_2008.into_iter().find(|at| bytes.len() == at + CRC_SIZE).unwrap_or(crc_at);
    }
    let crc = bytes.get(crc_at..).and_then(|rest| rest.first_chunk::<CRC_SIZE>());
    let crc = crc.ok_or_else(|| cut_off("a block", crc_at + CRC_SIZE))?;
    let (found, needed) = (u32::from_le_bytes(*crc), checksum.of([&bytes[..crc_at]].into_iter()));
    if found != needed {
        return Err(place.fault(Cause::BlockCrc { number, found, needed }));
    }
    let data = bytes[HEADER_SIZE..crc_at].to_vec();
    Ok((Block { number, flash_address, data }, crc_at + CRC_SIZE))
}

/// Checks that a program block has data, ends inside the address space and lies after the block
/// before it.
fn check_order(before: Option<&Block>, block: &Block, place: Place) -> Result<(), ReadError> {
    if matches!(block.number, NUMBER_CONTROL | NUMBER_LAST) {
        return Ok(());
    }
    let address = block.flash_address;
    if block.data.is_empty() {
        return Err(place.fault(Cause::Malformed("the block has no data")));
    }
    if u64::from(address) + block.data.len() as u64 > 1 << 32 {
        return Err(place.fault(Cause::AddressOverflow { address, what: "the address space" }));
    }
    match before {
        Some(before) if before.number != NUMBER_CONTROL && address <= last_address(before) => {
            Err(place.fault(Cause::Malformed("the block does not lie after the one before it")))
        }
        _ => Ok(()),
    }
}

/// CRC of the first `size` bytes from `start` as they will lie in flash: erased bytes read FFh.
///
/// The blocks lie between `start` and `start + size`, in the order of addresses.
fn program_crc<'a>(
    checksum: Checksum,
    start: u32,
    size: u32,
    blocks: impl Iterator<Item = (u32, &'a [u8])>,
) -> u32 {
    const ERASED: [u8; 4096] = [0xFF; 4096];
    let end = u64::from(start) + u64::from(size);
    let blocks = blocks.map(|(address, data)| (u64::from(address), data)).chain([(end, [].as_slice())]);
    let mut at = u64::from(start);
    checksum.of(blocks.flat_map(move |(address, data)| {
        let gap = address.saturating_sub(at) as usize;
        at = at.max(address) + data.len() as u64;
        let full = std::iter::repeat_n(ERASED.as_slice(), gap / ERASED.len());
        full.chain([&ERASED[..gap % ERASED.len()], data])
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::file::convert::{blocks_of, Options};
    use crate::file::read::Firmware;

    /// 300 bytes, a gap, and 100 more.
    fn file() -> BlockFile {
        let mut pieces = Pieces::default();
        pieces.add(0x1000, (0..300_u32).map(|i| i as u8).collect(), Place::File);
        pieces.add(0x2000, vec![7; 100], Place::File);
        let image = Firmware::Image(pieces.in_order());
        blocks_of(image, &Options::default().block_size(64).max_gap(Some(0))).expect("it fits").file
    }

    #[test]
    fn joined_blocks_are_the_same_program() {
        let file = file();
        for (size, sizes) in [
            (0, vec![48; 6].into_iter().chain([12, 48, 48, 4]).collect::<Vec<_>>()),
            (128, vec![96, 96, 108, 100]),
            (usize::MAX, vec![300, 100]),
        ] {
            let joined = file.joined(size);
            let found: Vec<usize> = joined.program_blocks().iter().map(|block| block.data.len()).collect();
            assert_eq!(found, sizes, "{size}");
            // The numbers and CRCs are right, by the reader's judgement.
            assert_eq!(BlockFile::parse(&joined.emit()).expect("a block file"), joined);
            assert_eq!(joined.flash_image(), file.flash_image());
            assert_eq!(
                (joined.blocks.first(), joined.blocks.last()),
                (file.blocks.first(), file.blocks.last())
            );
        }
    }
}
