//! A sealed image in a block file, for masters that only support block files. Blocks 1 to N carry
//! the image piece by piece, like a program, from the program's first address on. Block 0 holds the
//! identity from the manifest, and the last block holds size and CRC of the sealed image.
//!
//! [`blocks_of_sealed`](crate::file::convert::blocks_of_sealed) makes such a file.

use shared_abi::block_file::{Header, HEADER_SIZE};

use super::open::Sealed;
use crate::file::block_file::{self, BlockFile, FRAMING};
use crate::file::checksum::Checksum;
use crate::file::fault::{Cause, Place, ReadError};
use crate::file::program::Program;

/// This many bytes at the beginning of a file show whether it is a sealed image, in blocks or not:
/// block 0 has at most 24 bytes of data.
pub const FRONT: usize = FRAMING + 24 + HEADER_SIZE + 4;

/// A sealed image, and the blocks that carried it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Carried {
    /// The sealed image, or the bytes in its place.
    pub image: Vec<u8>,
    /// The block file that carried it, if one did; its "program" is the image.
    pub blocks: Option<Program>,
}

/// Whether a file begins as a sealed image, or as a block file that carries one. The first
/// [`FRONT`] bytes are enough.
#[must_use]
pub fn looks_like(bytes: &[u8]) -> bool {
    Sealed::looks_like(bytes) || carries(bytes)
}

/// Whether the bytes begin as a block file with a sealed image in its first data block.
fn carries(bytes: &[u8]) -> bool {
    let Some(header) = bytes.first_chunk().filter(|_| block_file::looks_like(bytes)) else { return false };
    let data = FRAMING + Header::parse(header).size as usize + HEADER_SIZE;
    bytes.get(data..).is_some_and(Sealed::looks_like)
}

/// Extracts a sealed image from its file: from the blocks of a block file, after a check of all
/// numbers, sizes, addresses and CRCs, or otherwise the whole file unchanged.
///
/// # Errors
/// The first fault in the blocks, with its offset. This function does not check whether the result
/// is a sealed image.
pub fn carried(bytes: Vec<u8>) -> Result<Carried, ReadError> {
    if !carries(&bytes) {
        return Ok(Carried { image: bytes, blocks: None });
    }
    let program = block_file::read(&bytes)?;
    if program.checksum() != Checksum::Crc32 {
        let words = "its blocks have a CRC-16, and a sealed device accepts only blocks with CRC-32: seal \
                     the program again with --blocks";
        return Err(Place::File.fault(Cause::Malformed(words)));
    }
    let file = BlockFile::of(&program);
    let mut offset = FRAMING + file.blocks()[0].data.len();
    let first = program.span().first;
    let mut size = 0;
    for block in file.program_blocks() {
        if u64::from(block.flash_address) != u64::from(first) + size {
            let words = "there is a gap before this block, and a sealed image has no gaps: a block is \
                         missing";
            return Err(Place::Offset(offset).fault(Cause::Malformed(words)));
        }
        size += block.data.len() as u64;
        offset += FRAMING + block.data.len();
    }
    // The region of a program may begin before its first block, or end with erased flash; that of a
    // sealed image must not.
    if program.start() != first || u64::from(program.size()) != size {
        let (size, crc) = (program.size(), program.crc());
        return Err(Place::Offset(offset).fault(Cause::ProgramCrc { size, crc }));
    }
    let image = program.flash_image().into_owned();
    Ok(Carried { image, blocks: Some(program) })
}
