//! Storing for the boot stage and the callgate: both wait until the value is stored.

use boot_core::flash::run;
use boot_core::store::{Key, Parameters as _, StoreError, Value};

use crate::caches::Caches;
use crate::flash::ResidentFlash;
use product::Parameters;

/// Stores a value and waits for it.
pub fn store(
    parameters: &mut Parameters,
    flash: &mut ResidentFlash,
    key: Key,
    value: Value,
) -> Result<(), StoreError> {
    // A word is read back to see what the cells have become; the data cache would return what was written
    // (RM0090 section 3.6.4).
    // SAFETY: the owner of the flash also owns its caches.
    let _caches = unsafe { Caches::off() };
    parameters.store(key, value);
    run(flash, |flash, outcome| parameters.next(flash, outcome))
}
