//! What the RAM part of the bootloader asks of the resident part: everything non-volatile stands
//! there, once.
//!
//! The services run from flash. They may be called **while no flash operation runs**; each call
//! comes back with an answer, or with the operation that the RAM part is to start and to poll. What
//! the store remembers between two calls lies in RAM, in a [`StoreState`] of the caller.
//!
//! A change of anything here raises `SERVICES_VERSION`; the boot stage does not start a RAM image
//! of another version.

use boot_core::flash::{FlashFault, Operation};
use boot_core::store::{Key, Value};
use shared_abi::callgate::TABLE_SIZE;
use shared_abi::geometry::Sector;

/// Offset of the services from the callgate's table: behind the boot stage and what is done about a
/// fault (`resident/main.rs`).
#[allow(dead_code, reason = "the resident part lays them there by its header")]
pub const OFFSET: u32 = TABLE_SIZE + 8;

/// The services.
#[repr(C)]
pub struct Services {
    /// `SERVICES_VERSION`.
    pub version: u32,
    /// Bytes of this table.
    pub size: u32,
    /// Finds what is stored.
    pub open: unsafe extern "C" fn(*mut StoreState),
    /// The value of a key; whether there is one.
    pub get: unsafe extern "C" fn(*const StoreState, Key, *mut Value) -> bool,
    /// Begins to store a value.
    pub store: unsafe extern "C" fn(*mut StoreState, Key, *const Value),
    /// Goes on with it, told how the operation before ended ([`outcome_code`]).
    pub next: unsafe extern "C" fn(*mut StoreState, u32, *mut Operation) -> StoreStep,
    /// CRC-32 over a region of the flash, behind data whose CRC is the first argument.
    pub crc32: extern "C" fn(u32, u32, u32) -> u32,
    /// Whether a region of the flash is erased.
    pub is_blank: extern "C" fn(u32, u32) -> bool,
    /// The sector that holds an address; whether there is one.
    pub sector_at: unsafe extern "C" fn(u32, *mut Sector) -> bool,
}

/// What the store does next.
#[allow(dead_code, reason = "each of the two programs uses some of it")]
#[derive(Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum StoreStep {
    /// The operation is to be started.
    Start = 0,
    /// There is more to compute.
    Again = 1,
    /// The value is stored.
    Done = 2,
    /// It could not be stored; the old one is still there.
    Failed = 3,
}

/// Room for what the store remembers. The resident part knows what it means.
#[repr(C, align(8))]
pub struct StoreState(pub [u32; STORE_STATE_WORDS]);

/// Words of [`StoreState`]: enough for the journal. A store of a product's own that needs more
/// raises it.
pub const STORE_STATE_WORDS: usize = 32;

// What crosses the border, byte for byte the same in both programs.
const _: () = {
    use core::mem::{offset_of, size_of};
    assert!(size_of::<Services>() == if size_of::<usize>() == 4 { 36 } else { 64 });
    assert!(offset_of!(Services, open) == 8);
    assert!(size_of::<StoreState>() == 4 * STORE_STATE_WORDS);
    assert!(size_of::<Sector>() == 12 && size_of::<Operation>() == 16);
    assert!(size_of::<Key>() == 2);
    assert!(size_of::<Value>() == 16 && size_of::<StoreStep>() == 4);
};

/// How an operation ended, as [`Services::next`] is told it: 0 well, else 1 more than the fault.
#[allow(dead_code, reason = "each of the two programs uses some of it")]
pub const fn outcome_code(outcome: Result<(), FlashFault>) -> u32 {
    match outcome {
        Ok(()) => 0,
        Err(fault) => 1 + fault as u32,
    }
}

/// See [`outcome_code`].
#[allow(dead_code, reason = "each of the two programs uses some of it")]
pub const fn outcome_of(code: u32) -> Result<(), FlashFault> {
    match code {
        0 => Ok(()),
        code if code == outcome_code(Err(FlashFault::Protected)) => Err(FlashFault::Protected),
        code if code == outcome_code(Err(FlashFault::Verify)) => Err(FlashFault::Verify),
        _ => Err(FlashFault::Failed),
    }
}
