//! The STM32F407G-DISC1 with a watchdog chip at PD14, which resets by NRST, and a latch at PD13 that holds its power.

use crate::{Facts, Functions, Pin};

#[path = "stm32f407g_disc1.rs"]
#[allow(dead_code, reason = "its facts are not used here")]
mod same;

pub use same::*;

/// Each change of the level restarts the time of the watchdog chip.
const WATCHDOG: Pin = ('D', 14);
/// High as long as the board is on.
const HOLD: Pin = ('D', 13);
/// High when a program has the board.
const READY: Pin = ('D', 15);

/// The facts of this board.
pub const FACTS: Facts = Facts {
    functions: Functions {
        init: Some(|| {
            crate::drive(HOLD, true);
            crate::drive(WATCHDOG, false);
            crate::drive(READY, false);
        }),
        each_10_ms: Some(|| crate::toggle(WATCHDOG)),
        before_leaving: Some(|| crate::drive(READY, true)),
    },
    ..same::FACTS
};
