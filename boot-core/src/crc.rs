//! CRC-32/ISO-HDLC: the one function of block file, 1F56h and journal.
//!
//! Without the feature `crc-table` it goes bit by bit, some 40 cycles a byte; with it, it takes a
//! table of 1 KiB and some 10 cycles. A chip with a CRC unit does long ranges by that, see
//! [`Flash::crc32`](crate::flash::Flash::crc32).

#[cfg(feature = "crc-16")]
use crc::CRC_16_XMODEM;
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

/// The CRC of blocks and programs, behind data whose CRC is `crc` (0 for none): CRC-32, or with the
/// feature `crc-16` the one of SDO block transfer (polynomial 1021h, start 0), in the lower half of
/// the word.
#[must_use]
#[cfg(not(feature = "crc-16"))]
pub fn block(crc: u32, bytes: &[u8]) -> u32 {
    resume(crc, bytes)
}

/// The CRC of blocks and programs, behind data whose CRC is `crc` (0 for none): the one of SDO
/// block transfer (polynomial 1021h, start 0), in the lower half of the word.
#[must_use]
#[cfg(feature = "crc-16")]
pub fn block(crc: u32, bytes: &[u8]) -> u32 {
    static CRC16: Crc<u16, crc::NoTable> = Crc::<u16, crc::NoTable>::new(&CRC_16_XMODEM);
    let mut digest = CRC16.digest_with_initial(crc as u16);
    digest.update(bytes);
    digest.finalize().into()
}
