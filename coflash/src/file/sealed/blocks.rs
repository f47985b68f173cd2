//! A sealed image in a block file: blocks 1 to N carry it piece by piece, as they carry a program,
//! from the program's first address on; block 0 tells what the manifest tells, and the last block
//! has size and CRC of the sealed image. For masters that know block files and nothing else.
//!
//! [`blocks_of_sealed`](crate::file::convert::blocks_of_sealed) makes such a file.

use shared_abi::block_file::{Header, HEADER_SIZE};

use super::open::Sealed;
use crate::file::block_file::{BlockFile, Checksum, FRAMING};
use crate::file::fault::{Cause, Place, ReadError};

/// So many of a file's first bytes tell whether it is a sealed image, in blocks or not: block 0 has
/// 24 bytes of data at most.
pub const FRONT: usize = FRAMING + 24 + HEADER_SIZE + 4;

/// A sealed image, and the blocks that it came in.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Carried {
    /// The sealed image, or what was taken for one.
    pub image: Vec<u8>,
    /// The block file that carried it, if one did.
    pub blocks: Option<BlockFile>,
}

/// Whether a file begins as a sealed image, or as a block file that carries one. [`FRONT`] bytes are
/// enough.
#[must_use]
pub fn looks_like(bytes: &[u8]) -> bool {
    Sealed::looks_like(bytes) || carries(bytes)
}

/// Whether it begins as a block file whose first block with data begins as a sealed image.
fn carries(bytes: &[u8]) -> bool {
    let Some(header) = bytes.first_chunk().filter(|_| BlockFile::looks_like(bytes)) else { return false };
    let data = FRAMING + Header::parse(header).size as usize + HEADER_SIZE;
    bytes.get(data..).is_some_and(Sealed::looks_like)
}

/// Takes a sealed image out of its file: out of the blocks of a block file, after all of their
/// numbers, sizes, addresses and CRCs were checked, or else all of the file as it is.
///
/// # Errors
/// The first fault in the blocks, with its offset. Whether the image is one is not asked here.
pub fn carried(bytes: Vec<u8>) -> Result<Carried, ReadError> {
    if !carries(&bytes) {
        return Ok(Carried { image: bytes, blocks: None });
    }
    let file = BlockFile::parse(&bytes)?;
    if file.checksum() != Checksum::Crc32 {
        let words = "its blocks have a CRC-16, and a sealed device takes blocks with CRC-32 alone: seal \
                     the program again with --blocks";
        return Err(Place::File.fault(Cause::Malformed(words)));
    }
    let mut image = Vec::new();
    let mut offset = FRAMING + file.blocks()[0].data.len();
    let first = file.span().first;
    for block in file.program_blocks() {
        if u64::from(block.flash_address) != u64::from(first) + image.len() as u64 {
            let words = "there is a gap in front of this block, and a sealed image has none: a block is \
                         missing";
            return Err(Place::Offset(offset).fault(Cause::Malformed(words)));
        }
        image.extend_from_slice(&block.data);
        offset += FRAMING + block.data.len();
    }
    // A program may begin in front of its first block, or have erased flash at its end.
    if file.program_start() != first || file.program_size() as usize != image.len() {
        let (size, crc) = (file.program_size(), file.program_crc());
        return Err(Place::Offset(offset).fault(Cause::ProgramCrc { size, crc }));
    }
    Ok(Carried { image, blocks: Some(file) })
}
