//! The services of the resident part for the RAM part of the bootloader: only the resident part has
//! the code for non-volatile data.
//!
//! The services run from flash. They may be called only **while no flash operation runs**. Each
//! call returns an answer, or the operation that the RAM part must start and poll. The store keeps
//! its state between two calls in RAM, in a [`StoreState`] of the caller.
//!
//! Each change in this file must raise `SERVICES_VERSION`; the boot stage does not start a RAM
//! image of another version.

use boot_core::flash::{FlashFault, Operation};
use boot_core::store::{Key, Value};
use shared_abi::callgate::TABLE_SIZE;
use shared_abi::geometry::Sector;

/// Offset of the services from the callgate's table, which they follow (`resident/main.rs`).
#[allow(dead_code, reason = "the resident part lays them there by its header")]
pub const OFFSET: u32 = TABLE_SIZE;

/// The services.
#[repr(C)]
pub struct Services {
    /// `SERVICES_VERSION`.
    pub version: u32,
    /// Bytes of this table.
    pub size: u32,
    /// Finds the stored values.
    pub open: unsafe extern "C" fn(*mut StoreState),
    /// Reads the value of a key; returns whether there is one.
    pub get: unsafe extern "C" fn(*const StoreState, Key, *mut Value) -> bool,
    /// Begins to store a value.
    pub store: unsafe extern "C" fn(*mut StoreState, Key, *const Value),
    /// Continues to store the value; the second argument is the result of the previous operation
    /// ([`outcome_code`]).
    pub next: unsafe extern "C" fn(*mut StoreState, u32, *mut Operation) -> StoreStep,
    /// CRC-32 of a region of the flash; it continues the CRC in the first argument.
    pub crc32: extern "C" fn(u32, u32, u32) -> u32,
    /// Whether a region of the flash is erased.
    pub is_blank: extern "C" fn(u32, u32) -> bool,
    /// Finds the sector that contains an address; returns whether there is one.
    pub sector_at: unsafe extern "C" fn(u32, *mut Sector) -> bool,
}

/// The next step of the store.
#[allow(dead_code, reason = "each of the two programs uses some of it")]
#[derive(Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum StoreStep {
    /// The operation must be started.
    Start = 0,
    /// There is more to compute: call again.
    Again = 1,
    /// The value is stored.
    Done = 2,
    /// The value could not be stored; the old one is still stored.
    Failed = 3,
}

/// Memory for the state of the store. Only the resident part knows its contents.
#[repr(C, align(8))]
pub struct StoreState(pub [u32; STORE_STATE_WORDS]);

/// Words of [`StoreState`]: enough for the journal. A product must raise it if its own store needs
/// more.
pub const STORE_STATE_WORDS: usize = 32;

// The types at the interface have the same layout in both programs, byte for byte.
const _: () = {
    use core::mem::{offset_of, size_of};
    assert!(size_of::<Services>() == if size_of::<usize>() == 4 { 36 } else { 64 });
    assert!(offset_of!(Services, open) == 8);
    assert!(size_of::<StoreState>() == 4 * STORE_STATE_WORDS);
    assert!(size_of::<Sector>() == 12 && size_of::<Operation>() == 16);
    assert!(size_of::<Key>() == 2);
    assert!(size_of::<Value>() == 16 && size_of::<StoreStep>() == 4);
};

/// The result of an operation as the argument of [`Services::next`]: 0 for success, otherwise the
/// fault's number plus 1.
#[allow(dead_code, reason = "each of the two programs uses some of it")]
pub const fn outcome_code(outcome: Result<(), FlashFault>) -> u32 {
    match outcome {
        Ok(()) => 0,
        Err(fault) => 1 + fault as u32,
    }
}

/// The inverse of [`outcome_code`].
#[allow(dead_code, reason = "each of the two programs uses some of it")]
pub const fn outcome_of(code: u32) -> Result<(), FlashFault> {
    match code {
        0 => Ok(()),
        code if code == outcome_code(Err(FlashFault::Protected)) => Err(FlashFault::Protected),
        code if code == outcome_code(Err(FlashFault::Verify)) => Err(FlashFault::Verify),
        _ => Err(FlashFault::Failed),
    }
}
