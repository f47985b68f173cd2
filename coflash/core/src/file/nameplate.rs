//! The nameplate of a device as a file: what the programmer of a production line writes into the one-time programmable
//! (OTP) bytes of the chip.

use shared_abi::geometry::OTP;
use shared_abi::nameplate::{Nameplate, BLOCKS};

use super::fault::Place;
use super::image::{Image, Pieces};

/// The highest number of a block.
pub const LAST_BLOCK: u8 = BLOCKS as u8 - 1;

/// The nameplate in a block of the OTP bytes, and with `lock` the bytes that lock this block and those after it for good
/// (RM0090 section 3.8): nothing can change the nameplate then, or add one that counts in its place.
///
/// # Panics
/// If there is no such block.
#[must_use]
pub fn nameplate(plate: &Nameplate, block: u8, lock: bool) -> Image {
    assert!(block <= LAST_BLOCK, "the OTP bytes have no block {block}");
    let after = BLOCKS - usize::from(block);
    let block = u32::from(block);
    let bytes = plate.words().map(u32::to_le_bytes).concat();
    let mut pieces = Pieces::default();
    pieces.add(OTP.base + block * bytes.len() as u32, bytes, Place::File);
    if lock {
        pieces.add(OTP.end() + block, vec![0; after], Place::File);
    }
    pieces.in_order()
}
