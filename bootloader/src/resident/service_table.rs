//! The services for the RAM image of the bootloader: all access to non-volatile data.

use boot_core::flash::{Flash, FlashFault, Next, Operation};
use boot_core::store::{Key, Parameters as _, Value};
use shared_abi::geometry::Region;
use shared_abi::ram_image::SERVICES_VERSION;
use shared_abi::services::{FlashOperation, OperationResult, Services, Step, StoreState, ERASE, PROGRAM};

use crate::flash::{CrcUnit, ResidentFlash};
use product::{self, Parameters};

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
    facts: &product::FACTS,
    compact,
};

const _: () = assert!(
    size_of::<Parameters>() <= size_of::<StoreState>()
        && align_of::<Parameters>() <= align_of::<StoreState>(),
    "product: the parameters need more than the services have room for"
);

/// The flash, for one call. The boot stage has left the clock of the CRC unit on.
fn flash() -> ResidentFlash {
    // SAFETY: the RAM image, which owns the chip, calls one service at a time from one priority,
    // while no operation runs. It does not use the controller or the CRC unit during the call.
    unsafe { ResidentFlash::steal(CrcUnit::Own) }
}

/// # Safety
/// `state` must be writable, and nothing else may use it.
unsafe extern "C" fn open(state: *mut StoreState) {
    // SAFETY: the caller guarantees it; size and alignment are asserted above.
    unsafe { state.cast::<Parameters>().write(product::parameters(&flash())) };
}

/// # Safety
/// `state` must come from [`open`]; `value` must be writable.
unsafe extern "C" fn get(state: *const StoreState, key: u32, value: *mut Value) -> u32 {
    // SAFETY: the caller guarantees both.
    unsafe {
        let Some(found) = (*state.cast::<Parameters>()).get(&flash(), Key(key)) else { return 0 };
        value.write(found);
    }
    1
}

/// # Safety
/// `state` must come from [`open`]; `value` must be readable.
unsafe extern "C" fn store(state: *mut StoreState, key: u32, value: *const Value) {
    // SAFETY: the caller guarantees both.
    unsafe { (*state.cast::<Parameters>()).store(Key(key), *value) };
}

/// # Safety
/// `state` must come from [`open`]; `operation` must be writable.
unsafe extern "C" fn next(state: *mut StoreState, result: u32, operation: *mut FlashOperation) -> u32 {
    let outcome = match OperationResult::from_number(result) {
        OperationResult::Done => Ok(()),
        OperationResult::Protected => Err(FlashFault::Protected),
        OperationResult::Failed => Err(FlashFault::Failed),
        OperationResult::NotVerified => Err(FlashFault::Verify),
    };
    // SAFETY: the caller guarantees both.
    let step = unsafe {
        match (*state.cast::<Parameters>()).next(&flash(), outcome) {
            Next::Start(start) => {
                operation.write(match start {
                    Operation::Erase(sector) => {
                        [ERASE, sector.number.into(), sector.region.base, sector.region.size]
                    }
                    Operation::Program { address, word } => [PROGRAM, address, word, 0],
                });
                Step::Start
            }
            Next::Again => Step::Again,
            Next::Done(Ok(())) => Step::Done,
            Next::Done(Err(_)) => Step::Failed,
        }
    };
    step as u32
}

/// # Safety
/// `state` must come from [`open`].
unsafe extern "C" fn compact(state: *mut StoreState, used: u32) -> u32 {
    // SAFETY: the caller guarantees it.
    unsafe { (*state.cast::<Parameters>()).compact(used).into() }
}

extern "C" fn crc32(crc: u32, base: u32, size: u32) -> u32 {
    flash().crc32(crc, Region::new(base, size))
}

extern "C" fn is_blank(base: u32, size: u32) -> u32 {
    flash().is_blank(Region::new(base, size)).into()
}

/// # Safety
/// `sector` must be writable.
unsafe extern "C" fn sector_at(address: u32, sector: *mut [u32; 3]) -> u32 {
    let Some(found) = flash().sector_at(address) else { return 0 };
    // SAFETY: the caller guarantees it.
    unsafe { sector.write([found.number.into(), found.region.base, found.region.size]) };
    1
}
