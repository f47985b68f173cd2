//! The independent watchdog (RM0090 section 21), fed when every task has checked in (SYS TEC manual L-1112d_10, 3.4.8).
//!
//! A reset is what stops it: the bootloader leaves by one, so that a program starts without it unless `boot.rs` says
//! otherwise.

use core::sync::atomic::{AtomicBool, Ordering};

use bsp::pac;

/// How long a task may be missing, in ms. The longest that any is kept from running is a few of them: a block of 16 KiB being
/// judged.
const TIMEOUT_MS: u16 = 1000;

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

/// The watchdog, running.
pub struct Watchdog(pac::IWDG);

impl Watchdog {
    /// Takes it and starts it.
    pub fn new(registers: pac::IWDG) -> Self {
        Self::start(&registers, TIMEOUT_MS);
        Self(registers)
    }

    /// Starts it: a reset follows unless it is fed every `ms` milliseconds, 2 to 8000, as the LSI counts them (± 50 %).
    pub fn start(registers: &pac::IWDG, ms: u16) {
        // SAFETY: the keys of section 21.4.1.
        let key = |key: u16| registers.kr().write(|w| unsafe { w.bits(key) });
        key(0xCCCC);
        key(0x5555);
        // SAFETY: LSI / 64, 2 ms a count (section 21.4.2).
        registers.pr().write(|w| unsafe { w.bits(4) });
        // SAFETY: a reload value of 12 bits.
        registers.rlr().write(|w| unsafe { w.bits(ms / 2) });
    }

    /// Feeds it if all tasks have checked in since they last did. To be called by the task that drives the others.
    pub fn feed(&mut self) {
        if CHECKED_IN.iter().all(|task| task.load(Ordering::Relaxed)) {
            for task in &CHECKED_IN {
                task.store(false, Ordering::Relaxed);
            }
            // SAFETY: the key that reloads the counter.
            self.0.kr().write(|w| unsafe { w.bits(0xAAAA) });
        }
    }
}
