//! The block file: the format of the data for object 1F50h (SYS TEC manual L-1112d_10, chapter 3
//! figure 2 and chapter 5.1).
//!
//! A file is a sequence of blocks: number 0 (control), 1…N (program data, ascending), FFFFFFFFh
//! (size and CRC of the program). Each block is one SDO download:
//!
//! ```text
//! u32 number | u32 flash address | u32 size | size bytes | u32 CRC over all of the block before it
//! ```
//!
//! All words are little-endian. The CRC is CRC-32/ISO-HDLC (polynomial EDB88320h reflected); the
//! manual gives its start value once as 0 and once as FFFFFFFFh, which is one function called in
//! two ways. The users of this module compute the CRC, so this crate has no code for it.

use core::fmt;

/// The size of the header before a block's data in bytes.
pub const HEADER_SIZE: usize = 12;
/// The size of the CRC after a block's data in bytes.
pub const CRC_SIZE: usize = 4;
/// The bytes of a block that are not data; `--block-size` includes them.
pub const FRAMING: usize = HEADER_SIZE + CRC_SIZE;
/// The largest block that the manual allows, including framing (table 1: "container of up to 16384
/// bytes").
pub const MAX_BLOCK_SIZE: usize = 16384;

/// The number of the control block.
pub const NUMBER_CONTROL: u32 = 0;
/// The number of the last block.
pub const NUMBER_LAST: u32 = u32::MAX;

/// The twelve bytes before a block's data.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Header {
    /// 0, 1…N or FFFFFFFFh.
    pub number: u32,
    /// The flash address of the data; 0 in the control block, without meaning in the last one.
    pub flash_address: u32,
    /// The number of data bytes.
    pub size: u32,
}

impl Header {
    /// Parses a header.
    #[must_use]
    pub fn parse(bytes: &[u8; HEADER_SIZE]) -> Self {
        let [number, flash_address, size] = words(bytes);
        Self { number, flash_address, size }
    }

    /// The bytes of the header.
    #[must_use]
    pub fn emit(&self) -> [u8; HEADER_SIZE] {
        let mut bytes = [0; HEADER_SIZE];
        put_words(&mut bytes, &[self.number, self.flash_address, self.size]);
        bytes
    }
}

/// The data of block 0: the target of the program. Each variant has its own length.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Control {
    /// 8 bytes, all reserved.
    Plain,
    /// 12 bytes: size of the program (0 if unknown) and its target.
    Identity(Identity),
    /// 24 bytes: `Identity` with version and date.
    Dated {
        /// The target of the program.
        identity: Identity,
        /// Version: major in bits 0–7, minor in bits 8–15, release in bits 16–31 (figure 13).
        version: u32,
        /// Creation date, seconds since 1970-01-01 UTC.
        date: u64,
    },
}

/// The target of a program.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Identity {
    /// Size of the program in bytes, 0 if unknown.
    pub app_size: u32,
    /// Vendor-ID, as in 1018h/1.
    pub vendor_id: u32,
    /// Product code, as in 1018h/2.
    pub product_code: u32,
}

/// The number in which a program and a device differ.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Difference {
    /// The vendor-ID, 1018h/1.
    VendorId,
    /// The product code, 1018h/2.
    ProductCode,
}

/// Whether a program for this vendor-ID and product code is for the device with these. 0 in the program
/// is any. A device with 0 and 0 has no identity, and takes any program.
///
/// # Errors
/// The first difference.
pub const fn fits(program: (u32, u32), device: (u32, u32)) -> Result<(), Difference> {
    if device.0 == 0 && device.1 == 0 {
        return Ok(());
    }
    if program.0 != 0 && program.0 != device.0 {
        return Err(Difference::VendorId);
    }
    if program.1 != 0 && program.1 != device.1 {
        return Err(Difference::ProductCode);
    }
    Ok(())
}

/// The largest data of block 0.
pub const CONTROL_MAX: usize = 24;

impl Control {
    /// Parses the data of block 0; `None` for a length that the manual does not define.
    #[must_use]
    pub fn parse(data: &[u8]) -> Option<Self> {
        let identity =
            |[app_size, vendor_id, product_code]: [u32; 3]| Identity { app_size, vendor_id, product_code };
        match data.len() {
            8 => Some(Self::Plain),
            12 => Some(Self::Identity(identity(words(data)))),
            24 => {
                let [a, b, c, version, low, high] = words(data);
                let date = u64::from(low) | u64::from(high) << 32;
                Some(Self::Dated { identity: identity([a, b, c]), version, date })
            }
            _ => None,
        }
    }

    /// The data of block 0; returns the bytes and the number of valid bytes.
    #[must_use]
    pub fn emit(&self) -> ([u8; CONTROL_MAX], usize) {
        let mut bytes = [0; CONTROL_MAX];
        let put_identity = |bytes: &mut [u8], id: &Identity| {
            put_words(bytes, &[id.app_size, id.vendor_id, id.product_code]);
        };
        let len = match self {
            Self::Plain => 8,
            Self::Identity(identity) => {
                put_identity(&mut bytes, identity);
                12
            }
            Self::Dated { identity, version, date } => {
                put_identity(&mut bytes, identity);
                put_words(&mut bytes[12..], &[*version, *date as u32, (*date >> 32) as u32]);
                24
            }
        };
        (bytes, len)
    }
}

/// The data of the last block.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Last {
    /// Size of the program in bytes, from its region's start.
    pub program_size: u32,
    /// CRC of these bytes as they will lie in flash; gaps read FFh.
    pub program_crc: u32,
}

/// The size of [`Last`] in bytes.
pub const LAST_SIZE: usize = 8;
/// The size in the manual of 2008 (L-1112e_5, 5.1), with 32 reserved bytes at the beginning. The
/// size in the block's header stays [`LAST_SIZE`].
pub const LAST_SIZE_2008: usize = 32 + LAST_SIZE;
/// The same if size, CRC and block CRC are at the offsets that this manual prints (28h, 2Ch and 30h): they
/// leave 28 bytes for the field that its table calls 32 bytes long. Nobody here has a file of that tool, so
/// both are taken.
pub const LAST_SIZE_AT_2008_OFFSETS: usize = 0x30 - HEADER_SIZE;

impl Last {
    /// Parses the data of the last block, with or without reserved bytes at the beginning; `None`
    /// for a wrong length.
    #[must_use]
    pub fn parse(data: &[u8]) -> Option<Self> {
        if !matches!(data.len(), LAST_SIZE | LAST_SIZE_2008 | LAST_SIZE_AT_2008_OFFSETS) {
            return None;
        }
        let data: &[u8; LAST_SIZE] = data.last_chunk()?;
        let [program_size, program_crc] = words(data);
        Some(Self { program_size, program_crc })
    }

    /// The data of the last block.
    #[must_use]
    pub fn emit(&self) -> [u8; LAST_SIZE] {
        let mut bytes = [0; LAST_SIZE];
        put_words(&mut bytes, &[self.program_size, self.program_crc]);
        bytes
    }
}

/// The first `N` little-endian words; missing bytes read 0.
fn words<const N: usize>(bytes: &[u8]) -> [u32; N] {
    let mut words = [0; N];
    for (word, chunk) in words.iter_mut().zip(bytes.chunks_exact(4)) {
        *word = u32::from_le_bytes([chunk[0], chunk[1], chunk[2], chunk[3]]);
    }
    words
}

fn put_words(bytes: &mut [u8], words: &[u32]) {
    for (chunk, word) in bytes.chunks_exact_mut(4).zip(words) {
        chunk.copy_from_slice(&word.to_le_bytes());
    }
}

/// The version of a program in control blocks and labels: major in bits 0-7, minor in bits 8-15,
/// release in bits 16-31 (SYS TEC manual L-1112d_10, figure 13). `Display` writes it like the
/// manual: `V1.10r100`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ProgramVersion(pub u32);

impl ProgramVersion {
    /// Whether this version was before another one: major, minor and release count in this order.
    #[must_use]
    pub const fn is_before(self, other: Self) -> bool {
        let [major, minor, ..] = self.0.to_le_bytes();
        let [other_major, other_minor, ..] = other.0.to_le_bytes();
        let (one, two) = (u16::from_be_bytes([major, minor]), u16::from_be_bytes([other_major, other_minor]));
        one < two || one == two && self.0 >> 16 < other.0 >> 16
    }
}

impl fmt::Display for ProgramVersion {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [major, minor, ..] = self.0.to_le_bytes();
        write!(f, "V{major}.{minor}r{}", self.0 >> 16)
    }
}

#[cfg(test)]
mod tests {
    extern crate std;

    use super::*;

    #[test]
    fn zero_is_any_in_a_program_and_both_zeros_are_in_a_device() {
        use Difference::{ProductCode, VendorId};
        for (program, device, expected) in [
            ((7, 8), (7, 8), Ok(())),
            ((0, 8), (7, 8), Ok(())),
            ((7, 0), (7, 8), Ok(())),
            ((0, 0), (7, 8), Ok(())),
            ((7, 8), (0, 0), Ok(())),
            ((6, 8), (7, 8), Err(VendorId)),
            ((7, 9), (7, 8), Err(ProductCode)),
            ((7, 8), (0, 8), Err(VendorId)),
            ((7, 8), (7, 0), Err(ProductCode)),
        ] {
            assert_eq!(fits(program, device), expected, "{program:?} {device:?}");
        }
    }

    #[test]
    fn the_major_number_counts_first_and_the_release_last() {
        let versions = [0x0064_0A01, 0x0065_0A01, 0x0000_0B01, 0xFFFF_0102, 0x0000_0203].map(ProgramVersion);
        for (at, one) in versions.iter().enumerate() {
            for (place, two) in versions.iter().enumerate() {
                assert_eq!(one.is_before(*two), at < place, "{one} {two}");
            }
        }
    }

    /// The offsets of the tables of chapter 5.1, filled with distinct bytes.
    #[test]
    fn fields_lie_where_the_manual_puts_them() {
        let header = [1, 0, 0, 0, 0x00, 0x00, 0x01, 0x08, 0x10, 0, 0, 0];
        let reported = Header { number: 1, flash_address: 0x0801_0000, size: 16 };
        assert_eq!(Header::parse(&header), reported);
        assert_eq!(reported.emit(), header);

        // Block 0 of the manual's example call: --vid 0 --pid 1234 --ver 0x00640A01 (V1.10r100).
        #[rustfmt::skip]
        let control = [
            0, 0, 0, 0,
            0, 0, 0, 0,
            0xD2, 0x04, 0, 0,
            0x01, 0x0A, 0x64, 0x00,
            0x80, 0x51, 0x01, 0, 0, 0, 0, 0,
        ];
        let reported = Control::Dated {
            identity: Identity { app_size: 0, vendor_id: 0, product_code: 1234 },
            version: 0x0064_0A01,
            date: 86400,
        };
        assert_eq!(Control::parse(&control), Some(reported));
        assert_eq!(reported.emit(), (control, 24));

        let last = [0x00, 0x10, 0, 0, 0x26, 0x39, 0xF4, 0xCB];
        let reported = Last { program_size: 4096, program_crc: 0xCBF4_3926 };
        assert_eq!(Last::parse(&last), Some(reported));
        assert_eq!(reported.emit(), last);
        // With the 32 reserved bytes of 2008 in front, and with other lengths.
        for (reserved, expected) in [(32, Some(reported)), (31, None), (33, None), (4, None), (248, None)] {
            let old = [&[0xA5; 248][..reserved], &last[..]].concat();
            assert_eq!(Last::parse(&old), expected, "{reserved}");
        }
    }

    /// A date after 2106-02-07 needs more than 32 bits; its low word comes first.
    #[test]
    fn a_date_has_64_bits() {
        let mut control = [0; 24];
        control[16..].copy_from_slice(&[0x04, 0x03, 0x02, 0x01, 0x08, 0x07, 0x06, 0x05]);
        let Some(reported @ Control::Dated { date, .. }) = Control::parse(&control) else { panic!() };
        assert_eq!(date, 0x0506_0708_0102_0304);
        assert_eq!(reported.emit(), (control, 24));
    }

    #[test]
    fn only_the_lengths_of_the_manual_are_control_data() {
        for len in 0..=32 {
            let known = matches!(len, 8 | 12 | 24);
            assert_eq!(Control::parse(&[0; 32][..len]).is_some(), known, "{len}");
        }
        assert_eq!(Last::parse(&[0; 7]), None);
        assert_eq!(Last::parse(&[0; 9]), None);
    }

    /// The manual's own example: 0x00640A01 is V1.10r100.
    #[test]
    fn a_version_reads_as_in_the_manual() {
        assert_eq!(std::format!("{}", ProgramVersion(0x0064_0A01)), "V1.10r100");
    }
}
