//! The CRCs of blocks and programs.

use std::fmt;

use crc::{Crc, Table, CRC_16_XMODEM, CRC_32_ISO_HDLC};

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
    pub(super) fn of<'a>(self, parts: impl Iterator<Item = &'a [u8]>) -> u32 {
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

    /// The CRC of the first `size` bytes from `start` as they will lie in flash: erased bytes read FFh.
    ///
    /// The parts, address and data, lie between `start` and `start + size`, in the order of addresses.
    pub(super) fn of_flash<'a>(
        self,
        start: u32,
        size: u32,
        parts: impl Iterator<Item = (u32, &'a [u8])>,
    ) -> u32 {
        const ERASED: [u8; 4096] = [0xFF; 4096];
        let end = u64::from(start) + u64::from(size);
        let parts = parts.map(|(address, data)| (u64::from(address), data)).chain([(end, [].as_slice())]);
        let mut at = u64::from(start);
        self.of(parts.flat_map(move |(address, data)| {
            let gap = address.saturating_sub(at) as usize;
            at = at.max(address) + data.len() as u64;
            let full = std::iter::repeat_n(ERASED.as_slice(), gap / ERASED.len());
            full.chain([&ERASED[..gap % ERASED.len()], data])
        }))
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
