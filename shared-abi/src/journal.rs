//! What is non-volatile, as it is in flash: the slots of the journal, the keys of its values, and the record of
//! a program.
//!
//! The resident part keeps the journal (`boot_core::store`), and a production line writes the first records with
//! the first program (`coflash seal factory`).

use crate::geometry::Region;

/// A slot of the journal: a tag, the four words of a value, the CRC-32/ISO-HDLC of these five, and the mark.
pub type Slot = [u32; 7];
/// Bytes of a slot. Slot 0 of a region is its header.
pub const SLOT_SIZE: u32 = size_of::<Slot>() as u32;
/// The place of the mark in a slot; in front of it are the words that a reader needs.
pub const MARK_WORD: usize = 6;
/// The mark: it is programmed after the words before it were read back.
pub const MARK: u32 = 0;

/// Identifies a region's header ("CBNV" read as little-endian bytes).
pub const HEADER_MAGIC: u32 = u32::from_le_bytes(*b"CBNV");
/// Version of the journal's format: the meaning of the keys' values. A journal of an older version
/// is read, and converted to this one when the next value is stored. A journal of a newer version
/// belongs to a newer bootloader and is not changed.
pub const FORMAT: u32 = 1;

/// The words of a value; their meaning depends on the key.
pub type Value = [u32; 4];

/// A record with this tag, a key, and value. `crc32` computes a CRC-32/ISO-HDLC.
pub fn slot(tag: u32, [a, b, c, d]: Value, crc32: impl FnOnce(&[u8]) -> u32) -> Slot {
    let mut bytes = [0; 20];
    for (place, word) in bytes.chunks_exact_mut(4).zip([tag, a, b, c, d]) {
        place.copy_from_slice(&word.to_le_bytes());
    }
    [tag, a, b, c, d, crc32(&bytes), MARK]
}

/// The value of a region's header, whose tag is [`HEADER_MAGIC`]: of two valid ones, that with the later sequence
/// number counts.
#[must_use]
pub const fn header(sequence: u32) -> Value {
    [sequence, !sequence, FORMAT, u32::MAX]
}

/// The value of [`Key::NODE`]: a node-ID, 255 for none (CiA 305), and a bit rate, an index of CiA 305 table 1.
#[must_use]
pub const fn node(id: u8, bit_rate: u8) -> Value {
    [id as u32, bit_rate as u32, 0, 0]
}

/// The first record of a region.
#[must_use]
pub const fn first_slot(region: &Region) -> u32 {
    region.base + SLOT_SIZE
}

/// The key of a stored value: a word, in flash and between the parts of the bootloader. A part that
/// does not know a key keeps its value. FFFFFFFFh (erased flash) is no key; 0008xxxxh and 0009xxxxh are
/// kept ([`crate`]).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(transparent)]
pub struct Key(pub u32);

impl Key {
    /// The number of consecutive times that the application ended without a request.
    pub const CRASH_COUNT: Self = Self(0x0002_0000);
    /// Node-ID and bit rate, see [`node`].
    pub const NODE: Self = Self(0x0003_0000);
    /// The number of grants of rights, and whether one of them has opened the device permanently.
    pub const GRANTS: Self = Self(0x0006_0000);

    /// The record of a program (1 to 254), see [`ProgramRecord`]; 255 is that of the bootloader's RAM
    /// image (`boot_core::store::RenewalRecord`).
    #[must_use]
    pub const fn program(number: u8) -> Self {
        Self(0x0001_0000 | number as u32)
    }

    /// Of a program (1 to 254, 255 for the bootloader): the lowest security counter and the lowest epoch
    /// that the device accepts, and the counter of the installed program. This value survives the program's record.
    #[must_use]
    pub const fn counter(number: u8) -> Self {
        Self(0x0004_0000 | number as u32)
    }

    /// The creation date of a program (1 to 254), in seconds since 1970-01-01 UTC, and the CRC of the program to
    /// which it belongs.
    #[must_use]
    pub const fn date(number: u8) -> Self {
        Self(0x0007_0000 | number as u32)
    }

    /// An event (0 to 7), see `seal::access`.
    #[must_use]
    pub const fn event(place: u8) -> Self {
        Self(0x0005_0000 | place as u32)
    }
}

/// The stored record of a program that was downloaded completely with a correct CRC.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ProgramRecord {
    /// Size in bytes, from the start of its region.
    pub size: u32,
    /// CRC of these bytes.
    pub crc: u32,
    /// Whether it is released for autostart (1F51h = 83h, SET_SIGNATURE).
    pub signed: bool,
    /// Whether the program has proved that it can return to the bootloader: it was confirmed, or it
    /// has returned the device to the bootloader once. It then starts without a rescue window.
    pub confirmed: bool,
    /// The version in its control block, 0 if unknown.
    pub version: u32,
    /// Whether work on the program was started but not finished since all of its flash was last
    /// erased: a sector that reads as erased may be only partly erased.
    pub half_erased: bool,
    /// The kind of sealed image; `None` for a program that was not sealed.
    pub seal: Option<Seal>,
    /// A client with the right to do so has withdrawn the release of the sealed program (84h). It is
    /// not released then, whatever `signed` is when the record is stored: nobody without this right
    /// releases it again, no master and no program.
    pub withdrawn: bool,
}

/// What a sealed program may do to the flash.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Seal {
    /// Nothing: the flash is locked until the next reset before the program starts.
    Locked,
    /// It writes to flash itself; its manifest says so.
    WritesFlash,
}

/// The words for the two flags: released or not, confirmed or not. They are magic numbers, so that
/// a few wrong bits never turn one into another.
const SIGNED: u32 = u32::from_le_bytes(*b"APP1");
const CONFIRMED: u32 = u32::from_le_bytes(*b"RUN0");
const SIGNED_CONFIRMED: u32 = u32::from_le_bytes(*b"RUN1");

/// The flag of [`half_erased`](ProgramRecord::half_erased) in the first word of the stored form,
/// above the size.
const HALF_ERASED: u32 = 1 << 31;
/// The flags of the two kinds of [`Seal`], in the same word.
const SEALED: u32 = 1 << 30;
const WRITES_FLASH: u32 = 1 << 29;
/// The flag of [`withdrawn`](ProgramRecord::withdrawn), in the same word.
const WITHDRAWN: u32 = 1 << 28;
/// The mask of the size in the first word.
const SIZE: u32 = !(HALF_ERASED | SEALED | WRITES_FLASH | WITHDRAWN);

impl ProgramRecord {
    /// The record of a program that is released, and is neither sealed nor confirmed.
    #[must_use]
    pub const fn released(size: u32, crc: u32) -> Self {
        Self {
            size,
            crc,
            signed: true,
            confirmed: false,
            version: 0,
            half_erased: false,
            seal: None,
            withdrawn: false,
        }
    }

    /// The stored form of "no program", with the two words of the download that is going on.
    #[must_use]
    pub const fn none(half_erased: bool, [id, end]: [u32; 2]) -> Value {
        [if half_erased { HALF_ERASED } else { 0 }, id, end, 0]
    }

    /// The two words of a download that was cut off, from the stored form; 0 for none.
    #[must_use]
    pub const fn partial_of([first, id, end, _]: Value) -> [u32; 2] {
        if first & SIZE == 0 {
            [id, end]
        } else {
            [0; 2]
        }
    }

    /// [`half_erased`](Self::half_erased) from the stored form, also if there is no program.
    #[must_use]
    pub const fn is_half_erased([first, ..]: Value) -> bool {
        first & HALF_ERASED != 0
    }

    /// Whether it was installed as a sealed image.
    #[must_use]
    pub const fn is_sealed(&self) -> bool {
        self.seal.is_some()
    }

    /// Decodes the stored form; `None` for [`none`](Self::none).
    #[must_use]
    pub const fn from_value([first, crc, flags, version]: Value) -> Option<Self> {
        let half_erased = first & HALF_ERASED != 0;
        let size = first & SIZE;
        if size == 0 {
            return None;
        }
        let withdrawn = first & WITHDRAWN != 0;
        let signed = (flags == SIGNED || flags == SIGNED_CONFIRMED) && !withdrawn;
        let confirmed = flags == CONFIRMED || flags == SIGNED_CONFIRMED;
        Some(Self {
            size,
            crc,
            signed,
            confirmed,
            version,
            half_erased,
            seal: match first & (SEALED | WRITES_FLASH) {
                SEALED => Some(Seal::Locked),
                0 | WRITES_FLASH => None,
                _ => Some(Seal::WritesFlash),
            },
            withdrawn,
        })
    }

    /// The stored form.
    #[must_use]
    pub const fn value(&self) -> Value {
        let flags = match (self.signed, self.confirmed) {
            (false, false) => 0,
            (true, false) => SIGNED,
            (false, true) => CONFIRMED,
            (true, true) => SIGNED_CONFIRMED,
        };
        let seal = match self.seal {
            None => 0,
            Some(Seal::Locked) => SEALED,
            Some(Seal::WritesFlash) => SEALED | WRITES_FLASH,
        } | if self.withdrawn { WITHDRAWN } else { 0 };
        [self.size | Self::none(self.half_erased, [0; 2])[0] | seal, self.crc, flags, self.version]
    }
}
