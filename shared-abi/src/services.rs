//! The services of the resident part for the RAM image: only the resident part has the code for
//! non-volatile data.
//!
//! The table follows the callgate's at its fixed address. Everything in it is an integer, or a
//! pointer to integers, so no side can give the other a value that its types do not know. An entry is
//! never changed or removed, nor what it gives: a new kind of operation needs a new entry. A RAM
//! image needs at least a version ([`Header::services`](crate::ram_image::Header::services)); the
//! resident part does not start an image that needs more.
//!
//! The services run from flash. They may be called only **while no flash operation runs**. Each
//! call returns an answer, or the operation that the RAM image must start and poll. The store keeps
//! its state between two calls in RAM, in a [`StoreState`] of the caller.

use crate::callgate::TABLE_SIZE;

/// Offset of the table from the callgate's.
pub const OFFSET: u32 = TABLE_SIZE;

/// The services.
#[repr(C)]
pub struct Services {
    /// [`SERVICES_VERSION`](crate::ram_image::SERVICES_VERSION) of the resident part.
    pub version: u32,
    /// Bytes of this table.
    pub size: u32,
    /// Finds the stored values.
    pub open: unsafe extern "C" fn(*mut StoreState),
    /// Reads the value of a key; returns 1 if there is one, otherwise 0.
    pub get: unsafe extern "C" fn(*const StoreState, u32, *mut [u32; 4]) -> u32,
    /// Begins to store a value under a key. A key that the resident part does not know is as good as
    /// any other.
    pub store: unsafe extern "C" fn(*mut StoreState, u32, *const [u32; 4]),
    /// Continues to store the value. The second argument is the result of the previous operation, a
    /// number of [`OperationResult`]. Returns a number of a [`Step`].
    pub next: unsafe extern "C" fn(*mut StoreState, u32, *mut FlashOperation) -> u32,
    /// CRC-32 of a region of the flash (address, size); it continues the CRC in the first argument.
    pub crc32: extern "C" fn(u32, u32, u32) -> u32,
    /// Returns 1 if a region of the flash (address, size) is erased, otherwise 0.
    pub is_blank: extern "C" fn(u32, u32) -> u32,
    /// Finds the sector that contains an address: its number, its address, its size. Returns 1 if
    /// there is one, otherwise 0.
    pub sector_at: unsafe extern "C" fn(u32, *mut [u32; 3]) -> u32,
    /// What the resident part decides by.
    pub facts: &'static Facts,
    /// Since version 2: begins to remove what is not current any more, if at least so many places are used.
    /// Returns 1 if it begins, otherwise 0; [`next`](Self::next) carries it out. A value may be
    /// [stored](Self::store) meanwhile: `next` then goes on with both.
    pub compact: unsafe extern "C" fn(*mut StoreState, u32) -> u32,
}

/// Choices of the product that the resident part decides by, and that a RAM image has to share. The
/// record only grows at its end. An image is for resident parts with one record: its header has the
/// CRC-32/ISO-HDLC of all its bytes ([`Header::facts`](crate::ram_image::Header::facts)). Nothing of the
/// single device is in it, neither serial number nor nameplate.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Facts {
    /// The board, as in [`Header::board`](crate::ram_image::Header::board).
    pub board: u32,
    /// Bytes of this record.
    pub size: u16,
    /// The programs that start by themselves, the first one in bits 0 to 7, the second one in bits 8 to 15;
    /// 0 for none, FFh if a function of the product says it.
    pub autostart: u16,
    /// Bits of the CRC of programs: 32 or 16.
    pub crc_bits: u16,
    /// The lowest node-ID with which a program starts, and in bits 8 to 15 the highest one.
    pub node_ids: u16,
    /// The bit rates that the device can be set to, a bit for each index of CiA 305 table 1; bit 9:
    /// the device may find it out.
    pub bit_rates: u16,
    /// The lower half of [`Abilities`](crate::abilities::Abilities); the upper one is 0.
    pub abilities: u16,
    /// The bases of the COB-IDs of SDO requests, and of answers, which programs get with the handoff.
    pub sdo_request_base: u16,
    /// See [`sdo_request_base`](Self::sdo_request_base).
    pub sdo_response_base: u16,
}

impl Facts {
    /// Its size in bytes.
    pub const SIZE: u16 = size_of::<Self>() as u16;

    /// The bytes of the record in those of a resident part for the chip, as many as it says: `base` is the
    /// address of the resident part, `table` that of its services. `None` if this is no resident part.
    #[must_use]
    pub const fn record(bytes: &[u8], base: u32, table: u32) -> Option<&[u8]> {
        /// The offset of the pointer to the facts: two words and seven pointers of four bytes.
        const FACTS: u32 = 9 * 4;
        let Some(at) = word(bytes, table.wrapping_sub(base).wrapping_add(FACTS)) else { return None };
        let at = at.wrapping_sub(base);
        let Some(size) = word(bytes, at.wrapping_add(4)) else { return None };
        let Some((_, rest)) = bytes.split_at_checked(at as usize) else { return None };
        match rest.split_at_checked(size as u16 as usize) {
            Some((record, _)) if record.len() >= Self::SIZE as usize => Some(record),
            _ => None,
        }
    }

    /// Reads the facts in a [record](Self::record), and the version of the services before it.
    #[must_use]
    pub const fn of_resident(bytes: &[u8], base: u32, table: u32) -> Option<(u32, Self)> {
        let Some(version) = word(bytes, table.wrapping_sub(base)) else { return None };
        let Some(record) = Self::record(bytes, base, table) else { return None };
        let (Some(board), Some(first), Some(second), Some(third), Some(fourth)) =
            (word(record, 0), word(record, 4), word(record, 8), word(record, 12), word(record, 16))
        else {
            return None;
        };
        let facts = Self {
            board,
            size: first as u16,
            autostart: (first >> 16) as u16,
            crc_bits: second as u16,
            node_ids: (second >> 16) as u16,
            bit_rates: third as u16,
            abilities: (third >> 16) as u16,
            sdo_request_base: fourth as u16,
            sdo_response_base: (fourth >> 16) as u16,
        };
        Some((version, facts))
    }
}

/// The word at an offset in the bytes of a resident part, if it is inside.
#[must_use]
pub const fn word(bytes: &[u8], offset: u32) -> Option<u32> {
    let Some((_, rest)) = bytes.split_at_checked(offset as usize) else { return None };
    match rest.first_chunk() {
        Some(word) => Some(u32::from_le_bytes(*word)),
        None => None,
    }
}

/// An operation of the flash in four words: [`ERASE`], and number, address and size of a sector; or
/// [`PROGRAM`], an address, the word, 0.
pub type FlashOperation = [u32; 4];

/// The first word of a [`FlashOperation`] that erases a sector.
pub const ERASE: u32 = 1;
/// The first word of a [`FlashOperation`] that programs a word.
pub const PROGRAM: u32 = 2;

/// The result of an operation of the flash.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum OperationResult {
    /// It is done.
    Done = 0,
    /// The place is write-protected by option bytes.
    Protected = 1,
    /// The operation was refused or failed.
    Failed = 2,
    /// The word read back differs from the programmed one.
    NotVerified = 3,
}

impl OperationResult {
    /// The result with this number; any other number is [`Failed`](Self::Failed).
    #[must_use]
    pub const fn from_number(number: u32) -> Self {
        match number {
            0 => Self::Done,
            1 => Self::Protected,
            3 => Self::NotVerified,
            _ => Self::Failed,
        }
    }
}

/// The next step of the store.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum Step {
    /// The operation must be started.
    Start = 0,
    /// There is more to compute: call again.
    Again = 1,
    /// The value is stored.
    Done = 2,
    /// The value could not be stored; the old one is still stored.
    Failed = 3,
}

impl Step {
    /// The step with this number; any other number is [`Failed`](Self::Failed).
    #[must_use]
    pub const fn from_number(number: u32) -> Self {
        match number {
            0 => Self::Start,
            1 => Self::Again,
            2 => Self::Done,
            _ => Self::Failed,
        }
    }
}

/// Memory for the state of the store. Only the resident part knows its contents.
#[repr(C, align(8))]
pub struct StoreState(pub [u32; STORE_STATE_WORDS]);

/// Words of [`StoreState`]: enough for the journal. It never changes: a store of a product's own that
/// needs more keeps it elsewhere.
pub const STORE_STATE_WORDS: usize = 32;
