//! The CRCs of blocks and programs.

use std::fmt;

use crc::{Crc, Table, CRC_16_XMODEM, CRC_32_ISO_HDLC};

/// The CRC of blocks and programs: polynomial EDB88320h reflected (manual L-1112d_10, chapter 3.1).
pub const CRC: Crc<u32, Table<16>> = Crc::<u32, Table<16>>::new(&CRC_32_ISO_HDLC);

/// The CRC of a bootloader that was built for it: polynomial 1021h, start value 0, as in SDO block
/// transfer (manual L-1112d_10, table 8, `--crc16`).
const CRC16: Crc<u16, Table<16>> = Crc::<u16, Table<16>>::new(&CRC_16_XMODEM);

/// The CRCs of data that end with a CRC-32 of their own, whatever the data are: after the CRC itself (zlib,
/// `srec_cat -crc32-l-e`), after its complement (the suffix of DFU 1.1), and 0, to which tools adjust a word.
const SELF_CHECKED: [u32; 3] = [0x2144_DF1C, 0xFFFF_FFFF, 0];

/// Whether a CRC is that of each program with a CRC-32 of its own at its end.
pub(crate) fn is_of_self_checked(crc: u32) -> bool {
    SELF_CHECKED.contains(&crc)
}

/// Where the last CRC-32 ends that data have of themselves, if they have one at a multiple of 4 or at their end.
/// The [`CRC`] from there on is the same for all data of this length that have one there.
///
/// The CRC of the data may have the start value 0 (IAR `ielftool`), too: what that adds depends on the length alone.
pub(super) fn own_crc(bytes: &[u8]) -> Option<usize> {
    let mut digests = [CRC.digest(), CRC.digest_with_initial(0)];
    let (mut end, mut last) = (0, None);
    for part in bytes.chunks(4) {
        end += part.len();
        digests.iter_mut().for_each(|digest| digest.update(part));
        if digests.iter().any(|digest| is_of_self_checked(digest.clone().finalize())) {
            last = Some(end);
        }
    }
    // Over zeros, the start value 0 stays; the CRC of an erased word is FFFFFFFFh.
    last.filter(|end| !bytes[..*end].iter().all(|byte| matches!(byte, 0 | 0xFF)))
}

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

#[cfg(test)]
mod tests {
    use super::*;

    /// The value for zlib is the "residue" of CRC-32/ISO-HDLC in the catalogue of Greg Cook, complemented.
    #[test]
    fn a_crc_of_the_data_themselves_is_found() {
        assert_eq!(SELF_CHECKED[0], !0xDEBB_20E3);
        let data: Vec<u8> = (0..400_u32).map(|at| (at * 7 + at / 256) as u8).collect();
        let from_0 = |data: &[u8]| {
            let mut digest = CRC.digest_with_initial(0);
            digest.update(data);
            digest.finalize()
        };
        let of = CRC.checksum(&data);
        for own in [of, !of, from_0(&data), !from_0(&data)] {
            let with = [&data[..], &own.to_le_bytes()].concat();
            assert_eq!(own_crc(&with), Some(404), "{own:08X}");
            assert_eq!(own_crc(&[&with[..], &data].concat()), Some(404), "{own:08X}");
            assert_eq!(own_crc(&[&data[..], &own.to_be_bytes()].concat()), None, "{own:08X}");
        }
        for none in [&data[..], &[0; 40], &[0xFF; 4], &[]] {
            assert_eq!(own_crc(none), None, "{none:X?}");
        }
    }
}
