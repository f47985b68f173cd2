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
pub const SERVICES_VERSION: u32 = 1;

/// Bytes of RAM behind the bootloader's variables that are left for its stack, at least. The boot
/// stage, which unpacks the image, is at home there.
pub const LEAST_STACK: u32 = 4096;

/// What stands in front of the stored bytes.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Header {
    /// [`MAGIC`].
    pub magic: u32,
    /// CRC-32/ISO-HDLC over everything behind this word: the rest of the header and the stored
    /// bytes. 0 for not checked, with [`Method::Raw`] alone.
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
    /// As a ZX0 stream, format version 2 (Einar Saukas).
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
    /// Offset of the first byte that the CRC runs over.
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

/// The stream is damaged.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Corrupt;

/// Unpacks a ZX0 stream into all of `to`, and takes all of `packed` for it.
///
/// Whatever the stream says, nothing outside `to` is written, and it ends: every step either takes
/// from the stream or writes.
///
/// # Errors
/// [`Corrupt`] for a stream that ends early or late, refers to what is in front of `to`, or unpacks
/// to another length.
pub fn unpack(packed: &[u8], to: &mut [u8]) -> Result<(), Corrupt> {
    /// In the place of the upper part of an offset: the end.
    const END: usize = 256;
    let mut stream = Stream { packed, taken: 0, bits: MARK };
    let (mut at, mut offset) = (0, 1);
    // What follows: literals, or else a copy, from another offset or from the last one.
    let (mut literals, mut another) = (true, false);
    loop {
        let mut length = 0;
        if another {
            let upper = stream.number(1);
            if upper == END {
                break;
            }
            let lower = stream.byte();
            offset = (upper << 7).wrapping_sub(usize::from(lower >> 1));
            stream.put_back(lower & 1);
            length = 1;
        }
        length = stream.number(0).wrapping_add(length);
        while length > 0 {
            let byte = if literals {
                stream.byte()
            } else {
                *to.get(usize::wrapping_sub(at, offset)).ok_or(Corrupt)?
            };
            *to.get_mut(at).ok_or(Corrupt)? = byte;
            at += 1;
            length -= 1;
        }
        another = stream.bit() != 0;
        literals = !another && !literals;
    }
    if stream.taken == packed.len() && at == to.len() {
        Ok(())
    } else {
        Err(Corrupt)
    }
}

/// What is left of a stream. Behind its end there are ones: every number is 1 then.
struct Stream<'a> {
    packed: &'a [u8],
    /// Bytes that were taken, or would have been.
    taken: usize,
    /// The bits that are left of the last byte of bits, from bit 31 on, and [`MARK`] behind them.
    bits: u32,
}

/// Behind the last bit.
const MARK: u32 = 1 << 31;

impl Stream<'_> {
    // Not inlined, nor are the others: that is smaller.
    #[inline(never)]
    fn byte(&mut self) -> u8 {
        let byte = self.packed.get(self.taken).copied().unwrap_or(u8::MAX);
        self.taken += 1;
        byte
    }

    #[inline(never)]
    fn bit(&mut self) -> u32 {
        if self.bits == MARK {
            self.bits = u32::from(self.byte()) << 24 | MARK >> 8;
        }
        let bit = self.bits >> 31;
        self.bits <<= 1;
        bit
    }

    /// A bit that is to be taken next.
    fn put_back(&mut self, bit: u8) {
        self.bits = u32::from(bit) << 31 | self.bits >> 1;
    }

    /// A number, at least 1: an interlaced Elias gamma code, with its data bits exclusive-ored with
    /// `inverted`. (One that is too large for an image may come out as any.)
    #[inline(never)]
    fn number(&mut self, inverted: u32) -> usize {
        let mut number = 1;
        while self.bit() == 0 {
            number = number << 1 | self.bit() ^ inverted;
        }
        number as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A stream of somebody else's, from the documentation of the crate `zx0decompress`.
    const PUBLISHED: [u8; 14] =
        [0x1F, 0x41, 0x42, 0x52, 0x41, 0x20, 0xF6, 0xAB, 0x43, 0x44, 0xF5, 0xF2, 0x55, 0x58];
    const TEXT: &[u8; 16] = b"ABRA ABRACADABRA";

    #[test]
    fn a_published_stream_unpacks() {
        let mut to = [0; 16];
        assert_eq!(unpack(&PUBLISHED, &mut to), Ok(()));
        assert_eq!(to, *TEXT);
    }

    #[test]
    fn a_stream_of_another_length_is_corrupt() {
        for len in 0..PUBLISHED.len() {
            assert_eq!(unpack(&PUBLISHED[..len], &mut [0; 16]), Err(Corrupt), "{len} bytes of it");
        }
        let mut longer = [0; PUBLISHED.len() + 1];
        longer[..PUBLISHED.len()].copy_from_slice(&PUBLISHED);
        assert_eq!(unpack(&longer, &mut [0; 16]), Err(Corrupt));
        for len in (0..16).chain(17..20) {
            assert_eq!(unpack(&PUBLISHED, &mut [0; 20][..len]), Err(Corrupt), "into {len} bytes");
        }
    }

    /// Nothing is read in front of the output: an offset beyond it is refused.
    #[test]
    fn an_offset_in_front_of_the_output_is_corrupt() {
        // 1: one literal; 1: a copy from another offset; 1: its upper part is 1. The lower part is
        // 126, which makes an offset of 2, with a 1 behind it: two bytes.
        let stream = [0b1110_0000, b'A', 126 << 1 | 1];
        assert_eq!(unpack(&stream, &mut [0; 3]), Err(Corrupt));
        // With an offset of 1 it gets further, and then ends too early.
        let stream = [0b1110_0000, b'A', 127 << 1 | 1];
        let mut to = [0; 3];
        assert_eq!(unpack(&stream, &mut to), Err(Corrupt));
        assert_eq!(to, *b"AAA");
    }

    /// Every byte of the published stream, every value: it ends, without a panic.
    #[test]
    fn damaged_streams_end() {
        let mut refused = 0;
        for at in 0..PUBLISHED.len() {
            for value in 0..=u8::MAX {
                let mut stream = PUBLISHED;
                stream[at] = value;
                refused += u32::from(unpack(&stream, &mut [0; 16]).is_err());
            }
        }
        // Literals may have any value; what is not one of them is what the length depends on.
        assert!(refused > 1000, "{refused}");
    }

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
