//! The services for the RAM part of the bootloader: all access to non-volatile data.

use boot_core::flash::{Flash, Next, Operation};
use boot_core::store::{Key, Parameters as _, Value};
use shared_abi::geometry::{Region, Sector};
use shared_abi::ram_image::SERVICES_VERSION;

use crate::flash::ResidentFlash;
use crate::product::{self, Parameters};
use crate::services::{outcome_of, Services, StoreState, StoreStep};

pub const SERVICES: Services = Services {
    version: SERVICES_VERSION,
    size: size_of::<Services>() as u32,
    open,
    get,
    store,
    next,
    crc32,
    is_blank,
    sector_at,
};

const _: () = assert!(
    size_of::<Parameters>() <= size_of::<StoreState>()
        && align_of::<Parameters>() <= align_of::<StoreState>(),
    "product: the parameters need more than services.rs has room for: raise STORE_STATE_WORDS"
);

/// The flash, for one call. The boot stage has left the clock of the CRC unit on.
fn flash() -> ResidentFlash {
    // SAFETY: the RAM part, which owns the chip, calls one service at a time from one priority,
    // while no operation runs. It does not use the controller or the CRC unit during the call.
    unsafe { ResidentFlash::steal(true) }
}

/// # Safety
/// `state` must be writable, and nothing else may use it.
unsafe extern "C" fn open(state: *mut StoreState) {
    // SAFETY: the caller guarantees it; size and alignment are asserted above.
    unsafe { state.cast::<Parameters>().write(product::parameters(&flash())) };
}

/// # Safety
/// `state` must come from [`open`]; `value` must be writable.
unsafe extern "C" fn get(state: *const StoreState, key: Key, value: *mut Value) -> bool {
    // SAFETY: the caller guarantees both.
    unsafe {
        let Some(found) = (*state.cast::<Parameters>()).get(&flash(), key) else { return false };
        value.write(found);
    }
    true
}

/// # Safety
/// `state` must come from [`open`]; `value` must be readable.
unsafe extern "C" fn store(state: *mut StoreState, key: Key, value: *const Value) {
    // SAFETY: the caller guarantees both.
    unsafe { (*state.cast::<Parameters>()).store(key, *value) };
}

/// # Safety
/// `state` must come from [`open`]; `operation` must be writable.
unsafe extern "C" fn next(state: *mut StoreState, outcome: u32, operation: *mut Operation) -> StoreStep {
    // SAFETY: the caller guarantees both.
    unsafe {
        match (*state.cast::<Parameters>()).next(&flash(), outcome_of(outcome)) {
            Next::Start(start) => {
                operation.write(start);
                StoreStep::Start
            }
            Next::Again => StoreStep::Again,
            Next::Done(Ok(())) => StoreStep::Done,
            Next::Done(Err(_)) => StoreStep::Failed,
        }
    }
}

extern "C" fn crc32(crc: u32, base: u32, size: u32) -> u32 {
    flash().crc32(crc, Region::new(base, size))
}

extern "C" fn is_blank(base: u32, size: u32) -> bool {
    flash().is_blank(Region::new(base, size))
}

/// # Safety
/// `sector` must be writable.
unsafe extern "C" fn sector_at(address: u32, sector: *mut Sector) -> bool {
    let Some(found) = flash().sector_at(address) else { return false };
    // SAFETY: the caller guarantees it.
    unsafe { sector.write(found) };
    true
}
