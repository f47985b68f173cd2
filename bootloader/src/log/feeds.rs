//! The longest time between two feeds of the watchdog (SYS TEC manual L-1112d_10, 3.4.8), measured with
//! the system timer. The cycle counter of the DWT would do for a core that never sleeps: in Sleep mode its clock, HCLK,
//! is off (RM0090 section 38.16.1).

use core::sync::atomic::{AtomicU32, Ordering};

use bsp::clock::HSI;
use cortex_m::peripheral::syst::SystClkSource;
use cortex_m::peripheral::SYST;
use rtic_monotonics::systick::SystickBackend;
use rtic_monotonics::TimerQueueBackend;

use super::ON;

/// The largest reload value of the timer (ARMv7-M B3.3.4): a second of HSI, longer than all that is waited for.
const FULL: u32 = 0xFF_FFFF;

/// The time of the last feed, in us of the monotonic.
static FED: AtomicU32 = AtomicU32::new(0);
static LONGEST: AtomicU32 = AtomicU32::new(0);
/// The longest call of the board's function, in us.
static SLOWEST: AtomicU32 = AtomicU32::new(0);

/// Starts the clocks, from HSI: the watchdog runs, and the monotonic does not yet. A crystal that does not
/// start takes longest.
pub fn during_clock_start<T>(timer: &mut SYST, start: impl FnOnce() -> T) -> T {
    if !ON {
        return start();
    }
    timer.set_clock_source(SystClkSource::Core);
    timer.set_reload(FULL);
    timer.clear_current();
    timer.enable_counter();
    let result = start();
    let us = (FULL - SYST::get_current()) / (HSI / 1_000_000);
    timer.disable_counter();
    // Before the monotonic's 0.
    FED.store(0_u32.wrapping_sub(us), Ordering::Relaxed);
    result
}

/// The watchdog was fed.
pub fn fed() {
    if ON {
        let now = now();
        let passed = now.wrapping_sub(FED.swap(now, Ordering::Relaxed));
        LONGEST.fetch_max(passed, Ordering::Relaxed);
    }
}

/// Calls the board's function, which all tasks of its priority wait for.
pub fn during_board(each_10_ms: impl FnOnce()) {
    if !ON {
        return each_10_ms();
    }
    let from = now();
    each_10_ms();
    SLOWEST.fetch_max(now().wrapping_sub(from), Ordering::Relaxed);
}

/// Its longest call so far, in us.
pub fn slowest() -> u32 {
    SLOWEST.load(Ordering::Relaxed)
}

/// The longest time so far, in us.
pub fn longest() -> u32 {
    LONGEST.load(Ordering::Relaxed)
}

/// Time in us: the milliseconds of the monotonic, and the count of its timer, which runs down once in each.
fn now() -> u32 {
    loop {
        let ms = SystickBackend::now();
        let left = SYST::get_current() / ((SYST::get_reload() + 1) / 1000);
        if SystickBackend::now() == ms {
            return ms.wrapping_mul(1000).wrapping_add(999 - left);
        }
    }
}
