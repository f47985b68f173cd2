//! The label in a program image: vendor-ID, product code, version and date at a fixed place after the
//! vector table. It lets the bootloader refuse an image for another device before it changes the
//! installed program.
//!
//! The control block of a block file contains the same data; the label serves raw images and Intel
//! HEX, which have no control block.

use crate::check_word;

/// Identifies a label, layout version 1 ("CBL1" read as little-endian bytes).
pub const MAGIC: u32 = u32::from_le_bytes(*b"CBL1");
/// Its offset from the start of the program: the last 32 bytes of the first 512, after the vectors
/// of every STM32F4.
pub const OFFSET: u32 = 0x1E0;
/// The size of a label in bytes.
pub const SIZE: usize = 32;

/// The label in flash: 32 bytes, little-endian.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Label {
    /// [`MAGIC`].
    pub magic: u32,
    /// Vendor-ID of the devices for which the program is (1018h/1).
    pub vendor_id: u32,
    /// Product code of the devices for which the program is (1018h/2).
    pub product_code: u32,
    /// Version of the program, chosen by its manufacturer.
    pub version: u32,
    /// The creation date, seconds since 1970-01-01 UTC; 0 if unknown.
    pub date: u32,
    /// 0; later labels may define these words.
    pub reserved: [u32; 2],
    /// [`check_word`] of the seven words before.
    pub check: u32,
}

impl Label {
    /// The label of a program without a date.
    #[must_use]
    pub const fn new(vendor_id: u32, product_code: u32, version: u32) -> Self {
        Self::dated(vendor_id, product_code, version, 0)
    }

    /// The label of a program with its creation date, in seconds since 1970-01-01 UTC.
    #[must_use]
    pub const fn dated(vendor_id: u32, product_code: u32, version: u32, date: u32) -> Self {
        let check = check_word(&[MAGIC, vendor_id, product_code, version, date, 0, 0]);
        Self { magic: MAGIC, vendor_id, product_code, version, date, reserved: [0; 2], check }
    }

    /// The bytes of the label.
    #[must_use]
    pub fn emit(&self) -> [u8; SIZE] {
        let Self { magic, vendor_id, product_code, version, date, reserved: [a, b], check } = *self;
        let words = [magic, vendor_id, product_code, version, date, a, b, check];
        let mut bytes = [0; SIZE];
        for (place, word) in bytes.chunks_exact_mut(4).zip(words) {
            place.copy_from_slice(&word.to_le_bytes());
        }
        bytes
    }

    /// The label in these bytes; `None` if it is missing or damaged.
    #[must_use]
    pub fn parse(bytes: &[u8; SIZE]) -> Option<Self> {
        let words: [u32; SIZE / 4] = core::array::from_fn(|i| {
            let at = 4 * i;
            u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
        });
        let [magic, vendor_id, product_code, version, date, a, b, check] = words;
        let label = Self { magic, vendor_id, product_code, version, date, reserved: [a, b], check };
        (magic == MAGIC && check == check_word(&words[..7])).then_some(label)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::CHIPS;

    #[test]
    fn it_lies_behind_the_vectors_of_every_chip() {
        for chip in CHIPS {
            assert!(chip.vector_table_size() <= OFFSET, "{}", chip.chip);
        }
    }
}
