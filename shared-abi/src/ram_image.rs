//! The RAM image: the part of the bootloader that runs from RAM, in the form stored in flash.
//!
//! It consists of a [`Header`] and directly after it the stored bytes. The linker writes both with
//! the bytes uncompressed ([`Method::Raw`], without a CRC); `cargo xtask build` compresses them and
//! computes the CRC. The boot stage checks the image before it decompresses it, and reports an
//! error by a [`Damage`] in the warm-start cell.

/// Identifies a RAM image, format version 1 ("CBI1" read as little-endian bytes).
pub const MAGIC: u32 = u32::from_le_bytes(*b"CBI1");

/// Version of the interface between the resident part and the RAM part of the bootloader, in RAM
/// and by calls. A change of the interface increases it.
pub const SERVICES_VERSION: u32 = 3;

/// The least number of bytes of RAM after the bootloader's variables that remain for its stack. The
/// boot stage, which decompresses the image, uses this RAM, too.
pub const LEAST_STACK: u32 = 4096;

/// The header before the stored bytes.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Header {
    /// [`MAGIC`].
    pub magic: u32,
    /// CRC-32/ISO-HDLC of the bootloader's flash before the header, the rest of the header after
    /// this word, and the stored bytes. 0 means unchecked, only with [`Method::Raw`].
    pub crc: u32,
    /// [`SERVICES_VERSION`].
    pub services: u32,
    /// The number of a [`Method`].
    pub method: u32,
    /// Bytes in flash after the header.
    pub stored: u32,
    /// Bytes in RAM, from the start of the image's RAM.
    pub unpacked: u32,
}

/// The method by which the bytes are stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum Method {
    /// Uncompressed, as in RAM.
    Raw = 0,
    /// As a ZX0 stream, format version 2 (Einar Saukas), with three changes. Offsets count
    /// half-words. Their lower part has eight bits, and the length after it has all its own bits. A
    /// copy from before the output reads from the end of the bootloader's flash before the header,
    /// and ends there at the latest.
    ///
    /// The stream decompresses to the image with absolute calls: in each pair of half-words 11110…
    /// 11111… (`BL`), the remaining 22 bits of both are the distance in half-words plus half the
    /// address of the second half-word.
    Zx0 = 1,
}

/// Why the RAM image cannot run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Damage {
    /// The header is missing, or contains an unknown method or an impossible size.
    Header = 1,
    /// The image is for another [`SERVICES_VERSION`].
    Services = 2,
    /// The CRC is wrong.
    Crc = 3,
    /// The stream does not decompress to the size in the header.
    Stream = 4,
}

impl Damage {
    /// The damage with this number.
    #[must_use]
    pub const fn from_number(number: u8) -> Option<Self> {
        Some(match number {
            1 => Self::Header,
            2 => Self::Services,
            3 => Self::Crc,
            4 => Self::Stream,
            _ => return None,
        })
    }
}

impl Header {
    /// Its size in flash in bytes.
    pub const SIZE: u32 = size_of::<Self>() as u32;
    /// The offset of the first byte of the header that the CRC covers.
    pub const CRC_FROM: u32 = 8;

    /// Checks a header: `flash` bytes follow it in the bootloader's region, and `ram` bytes are
    /// available for the decompressed image.
    ///
    /// # Errors
    /// [`Damage::Header`] or [`Damage::Services`].
    pub const fn check(&self, flash: u32, ram: u32) -> Result<Method, Damage> {
        if self.magic != MAGIC {
            return Err(Damage::Header);
        }
        if self.services != SERVICES_VERSION {
            return Err(Damage::Services);
        }
        if self.stored > flash || self.unpacked > ram {
            return Err(Damage::Header);
        }
        const RAW: u32 = Method::Raw as u32;
        const ZX0: u32 = Method::Zx0 as u32;
        match self.method {
            RAW if self.stored == self.unpacked => Ok(Method::Raw),
            ZX0 => Ok(Method::Zx0),
            _ => Err(Damage::Header),
        }
    }

    /// Whether the CRC must be checked.
    #[must_use]
    pub const fn has_crc(&self) -> bool {
        self.crc != 0 || self.method != Method::Raw as u32
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SOUND: Header = Header {
        magic: MAGIC,
        crc: 0x1234_5678,
        services: SERVICES_VERSION,
        method: 1,
        stored: 100,
        unpacked: 200,
    };

    #[test]
    fn a_header_is_judged() {
        assert_eq!(SOUND.check(100, 200), Ok(Method::Zx0));
        assert_eq!(Header { method: 0, unpacked: 100, ..SOUND }.check(100, 200), Ok(Method::Raw));
        for (header, damage) in [
            (Header { magic: u32::MAX, ..SOUND }, Damage::Header),
            (Header { services: SERVICES_VERSION + 1, ..SOUND }, Damage::Services),
            (Header { method: 0, ..SOUND }, Damage::Header),
            (Header { method: 2, ..SOUND }, Damage::Header),
            (Header { stored: 101, ..SOUND }, Damage::Header),
            (Header { stored: u32::MAX, ..SOUND }, Damage::Header),
            (Header { unpacked: 201, ..SOUND }, Damage::Header),
        ] {
            assert_eq!(header.check(100, 200), Err(damage), "{header:?}");
        }
    }

    /// Only the image from the linker has no CRC.
    #[test]
    fn a_packed_image_has_a_crc() {
        assert!(SOUND.has_crc());
        assert!(Header { crc: 0, ..SOUND }.has_crc());
        assert!(Header { method: 0, ..SOUND }.has_crc());
        assert!(!Header { crc: 0, method: 0, ..SOUND }.has_crc());
    }

    #[test]
    fn every_damage_has_a_number() {
        for damage in [Damage::Header, Damage::Services, Damage::Crc, Damage::Stream] {
            assert_eq!(Damage::from_number(damage as u8), Some(damage));
        }
        assert_eq!((Damage::from_number(0), Damage::from_number(5)), (None, None));
    }
}
