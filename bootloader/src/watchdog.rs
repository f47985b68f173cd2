//! The independent watchdog (RM0090 section 21). It is fed when every task has checked in (SYS TEC
//! manual L-1112d_10, 3.4.8).
//!
//! Only a reset stops the watchdog. The bootloader starts a program through a reset, so the program
//! starts without the watchdog unless the product says otherwise.

use core::sync::atomic::{AtomicBool, Ordering};

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

/// The watchdog; it runs if the product has one.
pub struct Watchdog(pac::IWDG);

impl Watchdog {
    /// Takes the watchdog, and starts it if the product has one.
    pub fn new(registers: pac::IWDG) -> Self {
        if let Some(ms) = PRODUCT.watchdog.bootloader_ms {
            watchdog::start(&registers, ms);
        }
        Self(registers)
    }

    /// Feeds the watchdog if all tasks have checked in since it was last fed. The task that drives
    /// the others calls it.
    pub fn feed(&mut self) {
        if CHECKED_IN.iter().all(|task| task.load(Ordering::Relaxed)) {
            for task in &CHECKED_IN {
                task.store(false, Ordering::Relaxed);
            }
            watchdog::feed(&self.0);
            feeds::fed();
        }
    }
}
