//! The nameplate: the identity of a device in the one-time programmable (OTP) bytes of its chip, where
//! the production line of an OEM writes it. The device then identifies itself as the OEM's product and
//! not as what its board file says.
//!
//! A nameplate fills a block of the OTP bytes. The last good one counts, so that another block corrects
//! a mistake. Bootloader and applications only read them.

use crate::check_word;
use crate::geometry::OTP;

/// Identifies a nameplate ("CBNP" read as little-endian bytes).
pub const MAGIC: u32 = u32::from_le_bytes(*b"CBNP");
/// The blocks of the OTP bytes (RM0090 section 3.8, table 19).
pub const BLOCKS: usize = OTP.size as usize / size_of::<Nameplate>();

/// The words of a block.
pub type Words = [u32; 8];

/// A nameplate in flash: 32 bytes, little-endian.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Nameplate {
    /// [`MAGIC`].
    pub magic: u32,
    /// Vendor-ID of the device (1018h/1).
    pub vendor_id: u32,
    /// Product code of the device (1018h/2).
    pub product_code: u32,
    /// Revision number of the device (1018h/3).
    pub revision: u32,
    /// Serial number of the device (1018h/4); 0 for the fold of the chip's unique identifier.
    pub serial_number: u32,
    /// 0; later nameplates may define these words.
    pub reserved: [u32; 2],
    /// [`check_word`] of the seven words before.
    pub check: u32,
}

impl Nameplate {
    /// The nameplate of a device.
    #[must_use]
    pub const fn new(vendor_id: u32, product_code: u32, revision: u32, serial_number: u32) -> Self {
        let check = check_word(&[MAGIC, vendor_id, product_code, revision, serial_number, 0, 0]);
        Self { magic: MAGIC, vendor_id, product_code, revision, serial_number, reserved: [0; 2], check }
    }

    /// Its words, as they are programmed.
    #[must_use]
    pub const fn words(&self) -> Words {
        let [a, b] = self.reserved;
        let Self { magic, vendor_id, product_code, revision, serial_number, check, .. } = *self;
        [magic, vendor_id, product_code, revision, serial_number, a, b, check]
    }

    /// The nameplate in this block; `None` if it is blank or damaged.
    #[must_use]
    pub fn parse(words: &Words) -> Option<Self> {
        let [magic, vendor_id, product_code, revision, serial_number, a, b, check] = *words;
        let plate = Self { magic, vendor_id, product_code, revision, serial_number, reserved: [a, b], check };
        (magic == MAGIC && check == check_word(&words[..7])).then_some(plate)
    }

    /// The nameplate of the device: that in the last block with a good one.
    ///
    /// # Safety
    /// `otp` must be the address of [`BLOCKS`] blocks that can be read, [`OTP`] on the chip.
    #[must_use]
    pub unsafe fn read(otp: *const Words) -> Option<Self> {
        // SAFETY: the caller guarantees the blocks; any bits are valid words.
        (0..BLOCKS).rev().find_map(|block| Self::parse(&unsafe { otp.add(block).read_volatile() }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_last_good_one_counts() {
        let mut otp = [[u32::MAX; 8]; 16];
        // SAFETY: 16 blocks.
        let read = |otp: &[Words; 16]| unsafe { Nameplate::read(otp.as_ptr()) };
        assert_eq!(read(&otp), None);
        let plate = |product_code| Nameplate::new(1, product_code, 0, 0);
        otp[0] = plate(0).words();
        assert_eq!(read(&otp), Some(plate(0)));
        // With a gap before it, and in the last block.
        for block in [3, 15] {
            otp[block] = plate(block as u32).words();
            assert_eq!(read(&otp), Some(plate(block as u32)));
        }
        otp[15][7] = 0;
        assert_eq!(read(&otp), Some(plate(3)));
    }
}
