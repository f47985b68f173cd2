//! The independent watchdog (RM0090 section 21), fed when every task has checked in (SYS TEC manual
//! L-1112d_10, 3.4.8).
//!
//! A reset is what stops it: the bootloader leaves by one, so that a program starts without it
//! unless `product.rs` says otherwise.

use core::sync::atomic::{AtomicBool, Ordering};

use bsp::{pac, watchdog};

use crate::product::PRODUCT;

/// Who has to check in.
#[derive(Clone, Copy)]
pub enum Task {
    /// The protocol: every millisecond or two.
    Protocol,
    /// The work on the flash, and with it `idle`.
    Flash,
}

static CHECKED_IN: [AtomicBool; 2] = [const { AtomicBool::new(false) }; 2];

/// A task is alive.
pub fn check_in(task: Task) {
    CHECKED_IN[task as usize].store(true, Ordering::Relaxed);
}

/// The watchdog, running if the product has one.
pub struct Watchdog(pac::IWDG);

impl Watchdog {
    /// Takes it and starts it.
    pub fn new(registers: pac::IWDG) -> Self {
        if let Some(ms) = PRODUCT.watchdog_ms {
            watchdog::start(&registers, ms);
        }
        Self(registers)
    }

    /// Feeds it if all tasks have checked in since they last did. To be called by the task that
    /// drives the others.
    pub fn feed(&mut self) {
        if CHECKED_IN.iter().all(|task| task.load(Ordering::Relaxed)) {
            for task in &CHECKED_IN {
                task.store(false, Ordering::Relaxed);
            }
            watchdog::feed(&self.0);
        }
    }
}
