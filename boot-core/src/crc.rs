//! CRC-32/ISO-HDLC: the one function of block file, 1F56h and journal.
//!
//! Without the feature `crc-table` it goes bit by bit, some 40 cycles a byte; with it, it takes a table of 1 KiB and some 10
//! cycles. A chip with a CRC unit does long ranges by that, see [`Flash::crc32`](crate::flash::Flash::crc32).

use crc::{Crc, CRC_32_ISO_HDLC};

#[cfg(not(feature = "crc-table"))]
type Means = crc::NoTable;
#[cfg(feature = "crc-table")]
type Means = crc::Table<1>;

static CRC32: Crc<u32, Means> = Crc::<u32, Means>::new(&CRC_32_ISO_HDLC);

/// The CRC of these bytes.
#[must_use]
pub fn crc32(bytes: &[u8]) -> u32 {
    resume(0, bytes)
}

/// The CRC of these bytes behind others whose CRC is `crc`; 0 for none.
#[must_use]
pub fn resume(crc: u32, bytes: &[u8]) -> u32 {
    // The start value is told unreflected, and before the final inversion.
    let mut digest = CRC32.digest_with_initial((!crc).reverse_bits());
    digest.update(bytes);
    digest.finalize()
}
