//! The independent watchdog (RM0090 section 21). It is fed when every task has checked in (SYS TEC
//! manual L-1112d_10, 3.4.8).
//!
//! Only a reset stops the watchdog. The bootloader starts a program through a reset, so the program
//! starts without the watchdog unless the product says otherwise.

use core::sync::atomic::{AtomicBool, Ordering};

use bsp::functions::{self, HAS_EACH_10_MS};
use bsp::{pac, watchdog};

use crate::log::feeds;
use product::PRODUCT;

/// The tasks that must check in.
#[derive(Clone, Copy)]
pub enum Task {
    /// The protocol: it checks in every millisecond or two.
    Protocol,
    /// The work on the flash, in `idle`.
    Flash,
}

static CHECKED_IN: [AtomicBool; 2] = [const { AtomicBool::new(false) }; 2];

/// Records that a task is alive.
pub fn check_in(task: Task) {
    CHECKED_IN[task as usize].store(true, Ordering::Relaxed);
}

/// The watchdog; it runs if the product has one. And the board's function, if it has one.
pub struct Watchdog {
    registers: pac::IWDG,
    board: [Times; HAS_EACH_10_MS as usize],
}

/// Times for the board's function, in ms.
struct Times {
    /// All tasks had checked in.
    proved: u32,
    /// The function was called.
    called: u32,
}

impl Watchdog {
    /// How long the board's function is called after a proof that all tasks work, in ms: longer than any of them
    /// takes, and short enough for an external watchdog.
    const PROVES_MS: u32 = 50;
    /// The period of the board's function, in ms, less that of the task which calls it.
    const PERIOD_MS: u32 = 10 - 2;

    /// Takes the watchdog, and starts it if the product has one.
    pub fn new(registers: pac::IWDG) -> Self {
        if let Some(ms) = PRODUCT.watchdog.bootloader_ms {
            watchdog::start(&registers, ms);
        }
        Self { registers, board: [const { Times { proved: 0, called: 0 } }; _] }
    }

    /// Feeds the watchdog if all tasks have checked in since it was last fed, and calls the board's function. The
    /// task that drives the others calls it; `now` is the time in ms.
    pub fn feed(&mut self, now: impl FnOnce() -> u32) {
        let is_proved = CHECKED_IN.iter().all(|task| task.load(Ordering::Relaxed));
        if is_proved {
            for task in &CHECKED_IN {
                task.store(false, Ordering::Relaxed);
            }
            watchdog::feed(&self.registers);
            feeds::fed();
        }
        let Some(board) = self.board.first_mut() else { return };
        let now = now();
        if is_proved {
            board.proved = now;
        }
        let since = |time| now.wrapping_sub(time);
        if since(board.called) >= Self::PERIOD_MS && since(board.proved) < Self::PROVES_MS {
            board.called = now;
            feeds::during_board(functions::each_10_ms);
        }
    }
}
