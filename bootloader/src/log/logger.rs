//! The output of `defmt`: it writes one frame at a time to the ring that a debug probe reads.

use core::cell::UnsafeCell;

use cortex_m::{interrupt, register::primask};
use defmt::Encoder;

use super::rtt::Message;

#[defmt::global_logger]
struct Logger;

struct State {
    encoder: Encoder,
    message: Option<Message>,
    /// Whether interrupts were on when the frame began.
    interrupts: bool,
}

struct Guarded(UnsafeCell<State>);

// SAFETY: it is used only between `acquire` and `release`, with interrupts off, on a chip with one
// core.
unsafe impl Sync for Guarded {}

static STATE: Guarded =
    Guarded(UnsafeCell::new(State { encoder: Encoder::new(), message: None, interrupts: false }));

/// Gives a function access to the state.
///
/// # Safety
/// Interrupts are off, and stay off.
unsafe fn with<T>(act: impl FnOnce(&mut State) -> T) -> T {
    // SAFETY: the caller guarantees that interrupts are off, so no other code uses the state.
    act(unsafe { &mut *STATE.0.get() })
}

// SAFETY: between `acquire` and `release` interrupts are off, so only one frame is written at a
// time. None of the values that `defmt` formats here has a formatter that logs.
unsafe impl defmt::Logger for Logger {
    fn acquire() {
        let interrupts = primask::read().is_active();
        interrupt::disable();
        // SAFETY: interrupts are off.
        unsafe {
            with(|state| {
                let mut message = Message::begin();
                state.encoder.start_frame(|bytes| message.put(bytes.iter().copied()));
                state.message = Some(message);
                state.interrupts = interrupts;
            });
        }
    }

    unsafe fn flush() {
        // There is nothing to flush: the probe reads the ring at its own speed.
    }

    unsafe fn release() {
        // SAFETY: `acquire` has switched the interrupts off.
        let interrupts = unsafe {
            with(|state| {
                if let Some(mut message) = state.message.take() {
                    state.encoder.end_frame(|bytes| message.put(bytes.iter().copied()));
                    message.end();
                }
                state.interrupts
            })
        };
        if interrupts {
            // SAFETY: they were on before `acquire`.
            unsafe { interrupt::enable() };
        }
    }

    unsafe fn write(bytes: &[u8]) {
        // SAFETY: `acquire` has switched the interrupts off.
        unsafe {
            with(|state| {
                if let Some(message) = &mut state.message {
                    state.encoder.write(bytes, |bytes| message.put(bytes.iter().copied()));
                }
            });
        }
    }
}
