//! The CRCs of block file, programs and journal.
//!
//! They are computed bit by bit without a table: about 40 cycles for each byte, and 100 bytes of
//! flash. A chip with a CRC unit uses it for long ranges, see
//! [`Flash::crc32`](crate::flash::Flash::crc32).

use crc::{Crc, NoTable, CRC_16_XMODEM, CRC_32_ISO_HDLC};

static CRC32: Crc<u32, NoTable> = Crc::<u32, NoTable>::new(&CRC_32_ISO_HDLC);
static CRC16: Crc<u16, NoTable> = Crc::<u16, NoTable>::new(&CRC_16_XMODEM);

/// The CRC of the blocks and programs of a product (SYS TEC manual L-1112d_10, `BLCOP_USE_CRC16`).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum CrcKind {
    /// CRC-32/ISO-HDLC.
    #[default]
    Crc32,
    /// The CRC of SDO block transfer (polynomial 1021h, start value 0), in the lower half of a
    /// word.
    Crc16,
}

impl CrcKind {
    /// The CRC of earlier bytes followed by `bytes`; `crc` is the CRC of the earlier bytes, 0 if
    /// there are none.
    #[must_use]
    pub fn resume(self, crc: u32, bytes: &[u8]) -> u32 {
        match self {
            Self::Crc32 => resume(crc, bytes),
            Self::Crc16 => {
                let mut digest = CRC16.digest_with_initial(crc as u16);
                digest.update(bytes);
                digest.finalize().into()
            }
        }
    }
}

/// The CRC-32 of these bytes.
#[must_use]
pub const fn crc32(bytes: &[u8]) -> u32 {
    CRC32.checksum(bytes)
}

/// The CRC-32 of earlier bytes followed by `bytes`; `crc` is the CRC of the earlier bytes, 0 if
/// there are none.
#[must_use]
pub fn resume(crc: u32, bytes: &[u8]) -> u32 {
    // The crate expects the start value unreflected and before the final inversion.
    let mut digest = CRC32.digest_with_initial((!crc).reverse_bits());
    digest.update(bytes);
    digest.finalize()
}
