//! Reads and writes block files, and cuts programs in blocks. [`shared_abi::block_file`] defines the format.

use std::borrow::Cow;

use shared_abi::block_file::{
    Control, Header, Identity, Last, ProgramVersion, CRC_SIZE, HEADER_SIZE, LAST_SIZE, LAST_SIZE_2008,
    LAST_SIZE_AT_2008_OFFSETS, NUMBER_CONTROL, NUMBER_LAST,
};
pub use shared_abi::block_file::{FRAMING, MAX_BLOCK_SIZE};

use super::checksum::Checksum;
use super::fault::{Cause, Place, ReadError};
use super::image::Pieces;
use super::program::{chunks, starts_at, Cut, End, LastBlock, Program, Release, Target};

/// The most data bytes that a block can have.
pub const MAX_DATA: usize = MAX_BLOCK_SIZE - FRAMING;

/// One block, the data of one SDO download.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Block<'p> {
    /// 0, 1…N or FFFFFFFFh.
    pub number: u32,
    /// The address for the data.
    pub flash_address: u32,
    /// The data: control data, a part of the program, or its size and CRC.
    pub data: Cow<'p, [u8]>,
}

impl Block<'_> {
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

    /// Whether it has a part of the program.
    fn is_program(&self) -> bool {
        !matches!(self.number, NUMBER_CONTROL | NUMBER_LAST)
    }
}

/// A program, or a sealed image, cut in blocks. Their data are borrowed from it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BlockFile<'p> {
    blocks: Vec<Block<'p>>,
    /// The bytes without a gap between them, of which the blocks are parts.
    runs: Vec<(u32, &'p [u8])>,
    start: u32,
    last: Last,
    checksum: Checksum,
}

impl<'p> BlockFile<'p> {
    /// Cuts a program: one that was read from a block file in its own blocks, byte for byte.
    #[must_use]
    pub fn of(program: &'p Program) -> Self {
        let (control, last) = match &program.cut {
            Cut::Even { last_block, .. } => {
                let reserved = match last_block {
                    LastBlock::Of2015 => 0,
                    LastBlock::Of2008 => LAST_SIZE_2008 - LAST_SIZE,
                };
                let control = control_of(program.size(), program.target, program.release);
                (own(control), own([&vec![0; reserved][..], &program.last.emit()].concat()))
            }
            Cut::AsRead { control, last, .. } => (read_end(control), read_end(last)),
        };
        let blocks = numbered(control, program.parts(), last);
        let runs = program.image.runs().collect();
        Self { blocks, runs, start: program.start, last: program.last, checksum: program.checksum }
    }

    /// Cuts a sealed image in blocks of `payload` data bytes, which carry it from the address `start` on.
    pub(super) fn of_sealed(
        bytes: &'p [u8],
        start: u32,
        payload: usize,
        target: Target,
        release: Release,
    ) -> Self {
        let checksum = Checksum::Crc32;
        let size = bytes.len() as u32;
        let last = Last { program_size: size, program_crc: checksum.of([bytes].into_iter()) };
        let control = own(control_of(size, Some(target), Some(release)));
        let parts = chunks(start, bytes, payload).collect();
        let blocks = numbered(control, parts, own(last.emit().to_vec()));
        Self { blocks, runs: vec![(start, bytes)], start, last, checksum }
    }

    /// The same program in blocks of up to `size` bytes, framing included: blocks without a gap
    /// between them are joined. Block 0 and the last block stay as they are.
    #[must_use]
    pub(crate) fn joined(&self, size: usize) -> Self {
        let most = size.min(MAX_BLOCK_SIZE).saturating_sub(FRAMING);
        let mut blocks: Vec<Block<'p>> = Vec::new();
        for block in &self.blocks {
            let join = |last: &Block<'p>| {
                let end = last.flash_address.checked_add(last.data.len() as u32);
                let len = last.data.len() + block.data.len();
                let follows = last.is_program() && block.is_program() && end == Some(block.flash_address);
                if follows && len <= most {
                    self.bytes(last.flash_address, len)
                } else {
                    None
                }
            };
            if let Some(data) = blocks.last().and_then(join) {
                // There is one: it was joined.
                blocks.last_mut().into_iter().for_each(|last| last.data = Cow::Borrowed(data));
            } else {
                let number = match block.number {
                    NUMBER_LAST => NUMBER_LAST,
                    _ => blocks.len() as u32,
                };
                blocks.push(Block { number, ..block.clone() });
            }
        }
        Self { blocks, runs: self.runs.clone(), ..*self }
    }

    /// The bytes from an address on, which lie in one run.
    fn bytes(&self, address: u32, len: usize) -> Option<&'p [u8]> {
        self.runs.iter().find_map(|(start, data)| {
            let at = address.checked_sub(*start)? as usize;
            data.get(at..at.checked_add(len)?)
        })
    }

    /// All blocks in the order of their downloads: control, program, last.
    #[must_use]
    pub fn blocks(&self) -> &[Block<'p>] {
        &self.blocks
    }

    /// The blocks with the program: 1…N.
    #[must_use]
    pub fn program_blocks(&self) -> &[Block<'p>] {
        let end = self.blocks.len().saturating_sub(1).max(1);
        &self.blocks[1..end]
    }

    /// The contents of block 0; `None` if it has a length that the manual does not define, because its data
    /// are the product's own.
    #[must_use]
    pub fn control(&self) -> Option<Control> {
        Control::parse(&self.blocks[0].data)
    }

    /// The bytes of one of its blocks for a device that checks with this CRC: the block's own one, and
    /// in the last block that of the program.
    #[must_use]
    pub fn emit_block(&self, block: &Block<'_>, checksum: Checksum) -> Vec<u8> {
        if block.number != NUMBER_LAST {
            return block.emit_with(checksum);
        }
        let size = self.last.program_size;
        let program_crc = match checksum == self.checksum {
            true => self.last.program_crc,
            false => checksum.of_flash(self.start, size, self.runs.iter().copied()),
        };
        let mut data = block.data.to_vec();
        let at = data.len().saturating_sub(LAST_SIZE);
        data.splice(at.., Last { program_crc, ..self.last }.emit());
        Block { data: data.into(), ..*block }.emit_with(checksum)
    }

    /// The CRC of the blocks and the program.
    #[must_use]
    pub fn checksum(&self) -> Checksum {
        self.checksum
    }

    /// The first address of the program's region.
    #[must_use]
    pub fn start(&self) -> u32 {
        self.start
    }

    /// Size of the program in bytes, from the start of its region.
    #[must_use]
    pub fn size(&self) -> u32 {
        self.last.program_size
    }

    /// The bytes of the file.
    #[must_use]
    pub fn emit(&self) -> Vec<u8> {
        self.blocks.iter().flat_map(|block| block.emit_with(self.checksum)).collect()
    }
}

/// The block file of a program.
#[must_use]
pub fn emit(program: &Program) -> Vec<u8> {
    BlockFile::of(program).emit()
}

/// The data of block 0.
fn control_of(app_size: u32, target: Option<Target>, release: Option<Release>) -> Vec<u8> {
    let control = match target {
        None => Control::Plain,
        Some(Target { vendor_id, product_code }) => {
            let identity = Identity { app_size, vendor_id, product_code };
            match release {
                None => Control::Identity(identity),
                Some(Release { version, date }) => Control::Dated { identity, version: version.0, date },
            }
        }
    };
    let (bytes, len) = control.emit();
    bytes[..len].to_vec()
}

/// The size of block 0 with framing, of a program for this device.
pub(super) fn control_size(target: Option<Target>, release: Option<Release>) -> usize {
    control_of(0, target, release).len() + FRAMING
}

/// Flash address and data of block 0 or of the last block.
type Edge<'p> = (u32, Cow<'p, [u8]>);

/// One that coflash makes. The older manual (L-1112e_5) requires the flash address 0, the newer one
/// allows any value.
fn own<'p>(data: Vec<u8>) -> Edge<'p> {
    (0, Cow::Owned(data))
}

/// One that was read.
fn read_end(end: &End) -> Edge<'_> {
    (end.flash_address, Cow::Borrowed(&end.data))
}

/// All blocks with their numbers.
fn numbered<'p>(control: Edge<'p>, parts: Vec<(u32, &'p [u8])>, last: Edge<'p>) -> Vec<Block<'p>> {
    let block = |number, (flash_address, data)| Block { number, flash_address, data };
    let mut all = vec![block(NUMBER_CONTROL, control)];
    all.extend(
        (1..).zip(parts).map(|(number, (address, data))| block(number, (address, Cow::Borrowed(data)))),
    );
    all.push(block(NUMBER_LAST, last));
    all
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

/// Reads a file and checks every number, size and CRC in it. The first block shows which CRC the file
/// uses. The program's blocks go out byte for byte as they are here.
///
/// # Errors
/// The first fault, with its offset.
pub fn read(bytes: &[u8]) -> Result<Program, ReadError> {
    let mut checksum = Checksum::Crc32;
    if parse_block(bytes, Checksum::Crc16, Place::Offset(0)).is_ok() {
        checksum = Checksum::Crc16;
    }
    let mut control = None;
    let mut pieces = Pieces::default();
    let mut sizes = Vec::new();
    let mut before: Option<u32> = None;
    let (mut offset, mut expected) = (0, 0);
    let (last, end) = loop {
        let place = Place::Offset(offset);
        let (block, len) = parse_block(&bytes[offset..], checksum, place)?;
        let is_last = block.number == NUMBER_LAST && expected > 0;
        if block.number != expected && !is_last {
            return Err(place.fault(Cause::BlockNumber { found: block.number, expected }));
        }
        offset += len;
        expected += 1;
        let Block { number, flash_address, data } = block;
        if is_last {
            let last = Last::parse(&data).ok_or_else(|| place.fault(Cause::LastSize(data.len())))?;
            break (last, End { flash_address, data: data.into_owned() });
        }
        if number == NUMBER_CONTROL {
            control = Some(End { flash_address, data: data.into_owned() });
        } else {
            before = Some(check_order(before, flash_address, data.len(), place)?);
            sizes.push(data.len());
            pieces.extend(flash_address, &data, place);
        }
        if offset == bytes.len() {
            return Err(Place::File.fault(Cause::NoEnd("its last block (number FFFFFFFFh)")));
        }
    };
    if offset != bytes.len() {
        let words =
            "there are more bytes after the last block: the file is damaged, or consists of several files";
        return Err(Place::Offset(offset).fault(Cause::Malformed(words)));
    }
    let Some(control) = control.filter(|_| !sizes.is_empty()) else {
        return Err(Place::File.fault(Cause::NoData));
    };
    let image = pieces.in_order();
    // The file does not contain the start of its program. It is the first byte, or the address
    // that lies the program's size before the end of the last byte.
    let span = image.span();
    let by_end = (u64::from(span.last) + 1).checked_sub(last.program_size.into());
    let mut starts = [Some(span.first), by_end.and_then(|start| u32::try_from(start).ok())].into_iter();
    let Some(start) =
        starts.find_map(|start| start.filter(|start| starts_at(&image, *start, last, checksum)))
    else {
        let Last { program_size: size, program_crc: crc } = last;
        return Err(Place::Offset(offset - FRAMING - 8).fault(Cause::ProgramCrc { size, crc }));
    };
    // Of another length, it has a meaning for the check of the product alone.
    let (target, release) = match Control::parse(&control.data) {
        None | Some(Control::Plain) => (None, None),
        Some(Control::Identity(identity)) => (Some(target_of(identity)), None),
        Some(Control::Dated { identity, version, date }) => {
            (Some(target_of(identity)), Some(Release { version: ProgramVersion(version), date }))
        }
    };
    let cut = Cut::AsRead { control, sizes, last: end };
    Ok(Program { image, start, last, checksum, target, release, cut })
}

fn target_of(Identity { vendor_id, product_code, .. }: Identity) -> Target {
    Target { vendor_id, product_code }
}

/// Parses one block at the front of `bytes`; also returns its length.
fn parse_block(bytes: &[u8], checksum: Checksum, place: Place) -> Result<(Block<'_>, usize), ReadError> {
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
    let data = Cow::Borrowed(&bytes[HEADER_SIZE..crc_at]);
    Ok((Block { number, flash_address, data }, crc_at + CRC_SIZE))
}

/// Checks that a program block has data, ends inside the address space and lies after `before`, the last
/// address of the block before it. Returns its own last address.
fn check_order(before: Option<u32>, address: u32, len: usize, place: Place) -> Result<u32, ReadError> {
    if len == 0 {
        return Err(place.fault(Cause::Malformed("the block has no data")));
    }
    let last = u64::from(address) + len as u64 - 1;
    let last = u32::try_from(last)
        .map_err(|_| place.fault(Cause::AddressOverflow { address, what: "the address space" }))?;
    if before.is_some_and(|before| address <= before) {
        return Err(place.fault(Cause::Malformed("the block does not lie after the one before it")));
    }
    Ok(last)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::file::convert::{program_of, Options};
    use crate::file::read::Firmware;

    /// 300 bytes, a gap, and 100 more.
    fn program() -> Program {
        let mut pieces = Pieces::default();
        pieces.add(0x1000, (0..300_u32).map(|i| i as u8).collect(), Place::File);
        pieces.add(0x2000, vec![7; 100], Place::File);
        let image = Firmware::Image(pieces.in_order());
        program_of(image, &Options::default().block_size(64).max_gap(Some(0))).expect("it fits").program
    }

    #[test]
    fn joined_blocks_are_the_same_program() {
        let program = program();
        let file = BlockFile::of(&program);
        let again = read(&file.emit()).expect("a block file");
        for file in [&file, &BlockFile::of(&again)] {
            for (size, sizes) in [
                (0, vec![48; 6].into_iter().chain([12, 48, 48, 4]).collect::<Vec<_>>()),
                (128, vec![96, 96, 108, 100]),
                (usize::MAX, vec![300, 100]),
            ] {
                let joined = file.joined(size);
                let found: Vec<usize> =
                    joined.program_blocks().iter().map(|block| block.data.len()).collect();
                assert_eq!(found, sizes, "{size}");
                // The numbers and CRCs are right, by the reader's judgement.
                let read = read(&joined.emit()).expect("a block file");
                assert_eq!(BlockFile::of(&read), joined);
                assert_eq!(read.flash_image(), program.flash_image());
                assert_eq!(
                    (joined.blocks.first(), joined.blocks.last()),
                    (file.blocks.first(), file.blocks.last())
                );
            }
        }
    }

    /// The blocks of any program are parts of it, and so is the image of its flash if it has no gap.
    #[test]
    fn nothing_of_a_program_is_copied() {
        let is_part = |data: &Cow<'_, [u8]>| matches!(data, Cow::Borrowed(_));
        let program = program();
        let again = read(&emit(&program)).expect("a block file");
        for program in [program, again] {
            let file = BlockFile::of(&program);
            for file in [file.joined(usize::MAX), file] {
                assert!(file.program_blocks().iter().all(|block| is_part(&block.data)));
            }
            assert!(program.image().segments().all(|(_, data)| is_part(&data)));
            assert!(!is_part(&program.flash_image()), "it has a gap");
        }
        let image = crate::file::raw::read(&[0x5A; 300], Some(0x1000)).expect("a raw image");
        let program = program_of(Firmware::Image(image), &Options::default()).expect("it fits").program;
        assert!(is_part(&program.flash_image()));
    }

    /// What another tool wrote in the first and the last block goes out as it was: the newer manual
    /// allows any flash address there.
    #[test]
    fn the_addresses_of_the_first_and_the_last_block_stay() {
        let program = program();
        let mut blocks = BlockFile::of(&program).blocks;
        let end = blocks.len() - 1;
        (blocks[0].flash_address, blocks[end].flash_address) = (0x1234_5678, 0x9ABC_DEF0);
        let bytes: Vec<u8> = blocks.iter().flat_map(Block::emit).collect();
        assert_eq!(BlockFile::of(&read(&bytes).expect("a block file")).emit(), bytes);
    }
}
