//! Storing for boot stage and callgate, which nothing else is kept waiting by.

use boot_core::flash::run;
use boot_core::store::{Key, Parameters as _, StoreError, Value};

use crate::caches::Caches;
use crate::flash::ResidentFlash;
use crate::product::Parameters;

/// Stores a value and waits for it.
#[inline(never)]
pub fn store(
    parameters: &mut Parameters,
    flash: &mut ResidentFlash,
    key: Key,
    value: Value,
) -> Result<(), StoreError> {
    // They would show words as they were before they were programmed.
    // SAFETY: whoever has the flash has its caches.
    let _caches = unsafe { Caches::off() };
    parameters.store(key, value);
    run(flash, |flash, outcome| parameters.next(flash, outcome))
}

/// Resets in a row by which an application ended without being asked to.
pub fn crash_count(parameters: &Parameters, flash: &ResidentFlash) -> u32 {
    parameters.get(flash, Key::CrashCount).map_or(0, |[count, ..]| count)
}
