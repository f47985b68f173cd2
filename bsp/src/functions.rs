//! What a board does: the functions of its file.

#[cfg(doc)]
use crate::facts::Functions;
use crate::facts::FACTS;
#[cfg(target_arch = "arm")]
use cortex_m::peripheral::{syst::SystClkSource, SYST};

/// Whether the board has [`Functions::each_10_ms`].
pub const HAS_EACH_10_MS: bool = FACTS.functions.each_10_ms.is_some();

/// Calls [`Functions::init`], if the board has it; so do the other two.
#[inline(always)]
pub fn after_reset() {
    if let Some(init) = FACTS.functions.init {
        init();
    }
}

/// See [`Functions::each_10_ms`].
#[inline(always)]
pub fn each_10_ms() {
    if let Some(each_10_ms) = FACTS.functions.each_10_ms {
        each_10_ms();
    }
}

/// See [`Functions::before_leaving`].
#[inline(always)]
pub fn before_leaving() {
    if let Some(before_leaving) = FACTS.functions.before_leaving {
        before_leaving();
    }
}

/// Begins to count 10 ms after 10 ms with the system timer, for [`poll`]. The core runs at `core` Hz.
///
/// # Safety
/// Nothing else uses the timer until [`end`].
#[cfg(target_arch = "arm")]
pub unsafe fn begin(core: u32) {
    if HAS_EACH_10_MS {
        // SAFETY: the caller guarantees it.
        let mut timer = unsafe { systick() };
        timer.clear_current();
        timer.set_clock_source(SystClkSource::Core);
        timer.set_reload(core / 100 - 1);
        timer.enable_counter();
    }
}

/// Calls [`Functions::each_10_ms`] if 10 ms have passed.
///
/// # Safety
/// Only between [`begin`] and [`end`].
#[cfg(target_arch = "arm")]
pub unsafe fn poll() {
    // SAFETY: the caller guarantees it.
    if HAS_EACH_10_MS && unsafe { systick() }.has_wrapped() {
        each_10_ms();
    }
}

/// Leaves the timer off, as after a reset.
///
/// # Safety
/// As for [`poll`].
#[cfg(target_arch = "arm")]
pub unsafe fn end() {
    if HAS_EACH_10_MS {
        // SAFETY: the caller guarantees it; the value after a reset (PM0214 section 4.5.1).
        unsafe { systick().csr.write(0) };
    }
}

/// # Safety
/// Nothing else uses the timer.
#[cfg(target_arch = "arm")]
unsafe fn systick() -> SYST {
    // SAFETY: the caller guarantees it.
    unsafe { cortex_m::Peripherals::steal() }.SYST
}
