//! The RAM image: the part of the bootloader that runs from RAM, as it is in flash.
//!
//! It is a [`Header`] and directly after it the image, from its vector table on. The resident part
//! checks it, copies it to the RAM, and enters it as it enters a program: by the two words at its
//! start. It knows no other address of the image, so any RAM image runs on any resident part that
//! has the services it needs.

use core::fmt;

use crate::abilities::Abilities;
use crate::geometry::{Region, CORE_VECTORS_SIZE};
use crate::layout::LEAST_STACK;
use crate::vectors::VectorTable;
use crate::warm_start::Damage;

/// Identifies a RAM image, format 2 ("CBI2" read as little-endian bytes).
pub const MAGIC: u32 = u32::from_le_bytes(*b"CBI2");

/// Version of the services that the resident part has ([`crate::services`]). It grows with each entry
/// that is added to their table.
pub const SERVICES_VERSION: u32 = 2;

/// What a device has for a RAM image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Host {
    /// The identity of its board, as in [`Header::board`].
    pub board: u32,
    /// The [`SERVICES_VERSION`] of its resident part.
    pub services: u32,
    /// The abilities of its resident part.
    pub features: Abilities,
    /// The CRC-32/ISO-HDLC of the [facts](crate::services::Facts) of its resident part.
    pub facts: u32,
}

/// The header before the image: 64 bytes, little-endian. `cargo build` writes everything but the
/// CRC, which `cargo xtask build` writes.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Header {
    /// [`MAGIC`].
    pub magic: u32,
    /// CRC-32/ISO-HDLC of the words after this one and of the image. 0 means that nobody has
    /// computed it (an image for the bench), and it is not checked.
    pub crc: u32,
    /// Size of this header in bytes in the lower half, number of the format (0) in the upper one.
    pub length: u32,
    /// Bytes of the image.
    pub size: u32,
    /// The address in RAM for which the image is linked.
    pub ram_base: u32,
    /// The end of the RAM that the image uses.
    pub ram_end: u32,
    /// The image needs at least this [`SERVICES_VERSION`].
    pub services: u32,
    /// The image needs these abilities.
    pub features: Abilities,
    /// The board: the CRC-32/ISO-HDLC of its layout as TOML ([`crate::layout::toml`]).
    pub board: u32,
    /// Vendor-ID, as in 1018h/1.
    pub vendor: u32,
    /// Product code, as in 1018h/2.
    pub product: u32,
    /// The hardware revisions on which the image runs, a bit each; 0 for all.
    pub revisions: u32,
    /// Version, as in 1018h/3: major in the upper half, minor in the lower.
    pub version: u32,
    /// Security counter.
    pub counter: u32,
    /// The facts of the resident part for which the image was built: as [`Host::facts`].
    pub facts: u32,
    /// 0; later images may define this word. What a resident part must not ignore is an ability.
    pub reserved: u32,
}

impl Header {
    /// The header in these bytes of an image.
    #[must_use]
    pub const fn of_bytes(bytes: &[u8; Self::SIZE as usize]) -> Self {
        let mut words = [0; Self::SIZE as usize / 4];
        let mut n = 0;
        while n < words.len() {
            let at = 4 * n;
            words[n] = u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]]);
            n += 1;
        }
        Self::of_words(words)
    }

    /// The header in these words.
    #[must_use]
    pub const fn of_words(words: [u32; Self::SIZE as usize / 4]) -> Self {
        let [magic, crc, length, size, ram_base, ram_end, services, features, board, rest @ ..] = words;
        let [vendor, product, revisions, version, counter, facts, reserved] = rest;
        Self {
            magic,
            crc,
            length,
            size,
            ram_base,
            ram_end,
            services,
            features: Abilities(features),
            board,
            vendor,
            product,
            revisions,
            version,
            counter,
            facts,
            reserved,
        }
    }

    /// The bytes of header and image.
    #[must_use]
    pub const fn total(&self) -> u32 {
        Self::SIZE.saturating_add(self.size)
    }

    /// Its size in bytes.
    pub const SIZE: u32 = size_of::<Self>() as u32;
    /// The offset of the CRC.
    pub const CRC: u32 = core::mem::offset_of!(Self, crc) as u32;
    /// Offset of the abilities that the image needs.
    pub const FEATURES: u32 = core::mem::offset_of!(Self, features) as u32;
    /// Offset of the facts of the resident part.
    pub const FACTS: u32 = core::mem::offset_of!(Self, facts) as u32;
    /// The offset of the first byte that the CRC covers.
    pub const CRC_FROM: u32 = Self::CRC + 4;

    /// Checks a header: `flash` bytes follow it in the region of the RAM image, `ram` is the RAM of
    /// the images.
    ///
    /// # Errors
    /// [`Damage::Header`], [`Damage::Board`], [`Damage::Services`] or [`Damage::Facts`].
    pub const fn check(&self, flash: u32, ram: Region, host: Host) -> Result<(), Damage> {
        if self.magic != MAGIC || self.length != Self::SIZE {
            return Err(Damage::Header);
        }
        if self.board != host.board {
            return Err(Damage::Board);
        }
        let fits = self.size >= CORE_VECTORS_SIZE
            && self.size.is_multiple_of(4)
            && self.size <= flash
            && self.size <= ram.size - LEAST_STACK
            && self.ram_base == ram.base
            && self.ram_end <= ram.end()
            && self.ram_end > ram.base
            && self.ram_end - ram.base >= self.size;
        if !fits {
            return Err(Damage::Header);
        }
        if self.services > host.services
            || !host.features.with(Abilities::RENEWAL, true).has(self.features)
            || host.features.has(Abilities::SEALED) && !self.features.has(Abilities::SEALED)
        {
            return Err(Damage::Services);
        }
        if self.facts != host.facts {
            return Err(Damage::Facts);
        }
        Ok(())
    }

    /// Checks the two words at the start of the image.
    ///
    /// # Errors
    /// [`Damage::Vectors`].
    pub const fn entry(&self, words: [u32; 2]) -> Result<VectorTable, Damage> {
        let image = Region::new(self.ram_base, self.size);
        let ram = Region::new(self.ram_base, self.ram_end - self.ram_base);
        match VectorTable::of_ram_image(words, image, ram) {
            Some(vectors) => Ok(vectors),
            None => Err(Damage::Vectors),
        }
    }
}

/// The version of a RAM image, as 1018h/3 has it: major in the upper half, minor in the lower.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Version(pub u32);

impl fmt::Display for Version {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}.{}", self.0 >> 16, self.0 & 0xFFFF)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RAM: Region = Region::new(0x2000_0000, 0x1_FFC0);
    const BOARD: u32 = 0x1234_5678;
    const FACTS: u32 = 0x0FAC_7500;
    const HOST: Host =
        Host { board: BOARD, services: SERVICES_VERSION, features: Abilities::NONE, facts: FACTS };
    const SOUND: Header = Header {
        magic: MAGIC,
        crc: 0,
        length: 64,
        size: 0x4000,
        ram_base: 0x2000_0000,
        ram_end: 0x2001_FFC0,
        services: SERVICES_VERSION,
        features: Abilities::NONE,
        board: BOARD,
        vendor: 1,
        product: 2,
        revisions: 3,
        version: 4,
        counter: 5,
        facts: FACTS,
        reserved: 0,
    };

    #[test]
    fn a_header_is_judged() {
        let check = |header: Header| header.check(0x4000, RAM, HOST);
        assert_eq!(check(SOUND), Ok(()));
        assert_eq!(check(Header { services: 0, size: 64, ram_end: 0x2000_0040, ..SOUND }), Ok(()));
        for (header, damage) in [
            (Header { magic: u32::MAX, ..SOUND }, Damage::Header),
            (Header { magic: u32::from_le_bytes(*b"CBI1"), ..SOUND }, Damage::Header),
            (Header { size: 0, ..SOUND }, Damage::Header),
            (Header { size: 60, ..SOUND }, Damage::Header),
            (Header { size: 0x3FFE, ..SOUND }, Damage::Header),
            (Header { size: 0x4004, ..SOUND }, Damage::Header),
            (Header { size: !3, ..SOUND }, Damage::Header),
            (Header { ram_base: 0x2000_0200, ..SOUND }, Damage::Header),
            (Header { ram_base: 0x0801_0040, ..SOUND }, Damage::Header),
            (Header { ram_end: 0x2001_FFC4, ..SOUND }, Damage::Header),
            (Header { ram_end: 0x2000_0000, ..SOUND }, Damage::Header),
            (Header { ram_end: 0x2000_3FFC, ..SOUND }, Damage::Header),
            (Header { ram_end: 0, ..SOUND }, Damage::Header),
            (Header { board: !BOARD, ..SOUND }, Damage::Board),
            (Header { features: Abilities::NAMEPLATE, ..SOUND }, Damage::Services),
        ] {
            assert_eq!(check(header), Err(damage), "{header:?}");
        }
        let large = Header { size: RAM.size - LEAST_STACK + 4, ..SOUND };
        let sealed = Header { features: Abilities::SEALED, ..SOUND };
        let check =
            |header: Header| header.check(0x4000, RAM, Host { features: Abilities(1 << 5 | 1), ..HOST });
        assert_eq!((check(SOUND), check(sealed)), (Err(Damage::Services), Ok(())), "it may have more");
        assert_eq!(large.check(u32::MAX, RAM, HOST), Err(Damage::Header), "no room for the stack");
    }

    #[test]
    fn the_entry_is_inside_its_ram() {
        let entry =
            |sp, reset| SOUND.entry([sp, reset]).map(|vectors| (vectors.initial_sp(), vectors.reset()));
        assert_eq!(entry(0x2001_FFC0, 0x2000_0041), Ok((0x2001_FFC0, 0x2000_0041)));
        assert_eq!(entry(0x2000_0008, 0x2000_3FFF), Ok((0x2000_0008, 0x2000_3FFF)));
        for (sp, reset) in [
            (0x2001_FFC4, 0x2000_0041), // no multiple of 8
            (0x2001_FFC8, 0x2000_0041), // over the end
            (0x2000_0000, 0x2000_0041), // no room below
            (0xFFFF_FFFF, 0x2000_0041),
            (0x2001_FFC0, 0x2000_0040), // no Thumb bit
            (0x2001_FFC0, 0x2000_003F), // a vector
            (0x2001_FFC0, 0x2000_4001), // after its end
            (0x2001_FFC0, 0x0801_0081), // in flash
            (0x2001_FFC0, 0xFFFF_FFFF),
        ] {
            assert_eq!(entry(sp, reset), Err(Damage::Vectors), "{sp:08X} {reset:08X}");
        }
    }
}
