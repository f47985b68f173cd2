//! The RAM image: the part of the bootloader that runs from RAM, as it lies in flash.
//!
//! A [`Header`], and right behind it the stored bytes. The linker lays both down with the bytes as
//! they are ([`Method::Raw`], without a CRC); `cargo xtask build` packs them and computes the CRC.
//! The boot stage checks the image before it unpacks it, and tells what is wrong by a
//! [`Damage`] in the warm-start cell.

/// Tells a RAM image, format version 1 ("CBI1" read as little-endian bytes).
pub const MAGIC: u32 = u32::from_le_bytes(*b"CBI1");

/// Version of what the resident part and the RAM part of the bootloader tell each other in RAM and
/// by calls. A change of that raises it.
pub const SERVICES_VERSION: u32 = 3;

/// Bytes of RAM behind the bootloader's variables that are left for its stack, at least. The boot
/// stage, which unpacks the image, is at home there.
pub const LEAST_STACK: u32 = 4096;

/// What stands in front of the stored bytes.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Header {
    /// [`MAGIC`].
    pub magic: u32,
    /// CRC-32/ISO-HDLC over the bootloader's flash in front of the header, the rest of the header
    /// behind this word, and the stored bytes. 0 for not checked, with [`Method::Raw`] alone.
    pub crc: u32,
    /// [`SERVICES_VERSION`].
    pub services: u32,
    /// The number of a [`Method`].
    pub method: u32,
    /// Bytes in flash behind the header.
    pub stored: u32,
    /// Bytes in RAM, from the start of the image's RAM on.
    pub unpacked: u32,
}

/// How the bytes are stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum Method {
    /// As they are in RAM.
    Raw = 0,
    /// As a ZX0 stream, format version 2 (Einar Saukas), with three changes. Offsets count half-words.
    /// Their lower part has eight bits, and the length behind it all of its own. A copy that comes
    /// from in front of the output comes from the end of the bootloader's flash in front of the
    /// header, and ends there at the latest.
    ///
    /// It unpacks to the image with absolute calls: in each pair of half-words 11110… 11111… (`BL`)
    /// the 22 bits that are left of both are the distance in half-words, to which half the address of
    /// the second half-word was added.
    Zx0 = 1,
}

/// Why the RAM image cannot run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Damage {
    /// The header is none, or tells of an unknown method or of a size that cannot be.
    Header = 1,
    /// The image is for another [`SERVICES_VERSION`].
    Services = 2,
    /// The CRC is another.
    Crc = 3,
    /// The stream does not unpack to the size that the header tells.
    Stream = 4,
}

impl Damage {
    /// The damage of this number.
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
    /// Bytes of it in flash.
    pub const SIZE: u32 = size_of::<Self>() as u32;
    /// Offset of the first byte of the header that the CRC runs over.
    pub const CRC_FROM: u32 = 8;

    /// Judges a header: `flash` bytes are behind it in the bootloader's region, and `ram` bytes are
    /// there to unpack to.
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

    /// Whether the CRC has to be right.
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

    /// Only what the linker laid down goes without.
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
