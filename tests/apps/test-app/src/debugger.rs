//! The debugger interface, 1025h, with breakpoints: **everybody on the bus reads and writes this
//! device's memory, and stops its program**.

use core::sync::atomic::{AtomicU32, Ordering};

use bsp::{monitor, pac};

pub use bsp::debugger::{Debugger, ENTRIES};
pub use bsp::monitor::release_program;

/// Tasks of this priority and above cannot be stopped. Tasks of priority 1 and `idle` can. The
/// tasks that serve the bus have higher priorities.
const PRIORITY: u8 = 2;

/// Makes the interface to this chip's memory. From now on breakpoints stop the program.
pub fn start() -> Debugger {
    // The priority as the core counts it: 0 is the most urgent, and only the upper four bits exist.
    monitor::arm((16 - PRIORITY) << 4, pac::Interrupt::CAN1_TX as u16);
    Debugger::new()
}

/// The number of calls of [`example`].
#[unsafe(no_mangle)]
static DEBUGGER_EXAMPLE_CALLS: AtomicU32 = AtomicU32::new(0);

/// A function for a breakpoint, called every half second, and a variable to watch.
#[unsafe(export_name = "debugger_example")]
#[inline(never)]
pub extern "C" fn example() {
    // Load and store apart: an exclusive access never succeeds when it is stepped through.
    let calls = DEBUGGER_EXAMPLE_CALLS.load(Ordering::Relaxed);
    DEBUGGER_EXAMPLE_CALLS.store(calls.wrapping_add(1), Ordering::Relaxed);
}
