//! Board support: everything that differs between two boards of one firmware.
//!
//! Each board has one file in `boards/`; the variable `COBOOT_BOARD` selects it at build time. Its
//! memory map is in `shared-abi/src/layout/boards/`. To port coboot, create both files with `cargo
//! xtask new-board`. All boards share the rest of the crate.
//!
//! On the host the crate has the values of a board, without the drivers (`host.rs`).
//!
//! | file | what it does |
//! |---|---|
//! | `boards/` | the facts of each board |
//! | `facts.rs` | what a board says about itself, and what follows from it; the rules are in shared-abi |
//! | [`functions`] | what a board does |
//! | `identity.rs` | who the device is: 1008h to 100Ah, 1018h, and the chip's unique identifier |
//! | [`clock`] | the source of the clocks |
//! | `pll.rs` | the clock tree in the registers of the chip, and the regulator |
//! | `drivers.rs` | the set-up that is the same for every board: clocks, pins, entry strap |
//! | [`can`] | bxCAN: bit timing, filters, send, receive, errors |
//! | [`can_driver`] | what bootloader and application want of a CAN controller |
//! | `can_modes.rs` | bxCAN's operating modes, register by register |
//! | `can_controllers.rs` | the use of CAN2 in place of CAN1 |
//! | [`uart`] | a UART without waiting |
//! | [`ring`], [`slcan`], `virtual_can.rs` | CAN over the UART, in the SLCAN protocol (feature `virtual-can`) |
//! | `port.rs` | the port for frames: the CAN controller, or the UART |
//! | [`line`](mod@line) | what a CANopen slave wants of its port |
//! | `watchdog.rs` | the independent watchdog |
//! | [`voltage`] | what follows from the supply: how wide the flash is programmed, and when it is left alone |
//! | [`supply`] | the voltage detector |
//! | `rom.rs` | the loader in the ROM of the chip |
//! | `low_power.rs` | the wake-up from Standby, the clocks of the sleep mode |
//! | `debugger.rs`, `memory.rs` | the debugger interface, 1025h, to the chip's memory (feature `debugger`) |
//! | `monitor.rs` | stops the program at a breakpoint while the bus goes on (feature `monitor`) |
#![cfg_attr(not(test), no_std)]

pub mod can;
#[cfg(target_arch = "arm")]
pub mod can_controllers;
pub mod can_driver;
mod can_modes;
pub mod clock;
#[cfg(target_arch = "arm")]
#[cfg_attr(not(feature = "debugger"), path = "no_debugger.rs")]
pub mod debugger;
#[cfg(target_arch = "arm")]
mod drivers;
#[cfg(not(target_arch = "arm"))]
mod host;
mod identity;
pub mod line;
#[cfg(target_arch = "arm")]
pub mod low_power;
#[cfg(all(target_arch = "arm", feature = "debugger"))]
mod memory;
#[cfg(all(target_arch = "arm", feature = "monitor"))]
pub mod monitor;
#[cfg(target_arch = "arm")]
mod pll;
mod port;
#[cfg(any(feature = "uart", not(target_arch = "arm")))]
pub mod ring;
#[cfg(target_arch = "arm")]
pub mod rom;
#[cfg(any(feature = "virtual-can", not(target_arch = "arm")))]
pub mod slcan;
#[cfg(target_arch = "arm")]
pub mod supply;
#[macro_use]
pub mod uart;
// The facts use the macro of the UART.
mod facts;
pub mod functions;
#[cfg(all(target_arch = "arm", feature = "virtual-can"))]
pub mod virtual_can;
pub mod voltage;
#[cfg(target_arch = "arm")]
pub mod watchdog;

#[cfg(target_arch = "arm")]
pub use drivers::{clocks, drive, entry_strap, init, inputs, toggle, Board, Led};
pub use facts::*;
#[cfg(not(target_arch = "arm"))]
pub use host::{cycles, drive, inputs, toggle};
pub use identity::{nameplate, serial_number, unique_id, Identity};
#[cfg(target_arch = "arm")]
pub use pll::slow_down;
#[cfg(target_arch = "arm")]
pub use port::CanPort;
#[cfg(target_arch = "arm")]
pub use stm32f4xx_hal as hal;
#[cfg(target_arch = "arm")]
pub use stm32f4xx_hal::pac;

/// SysTick with an empty counter. After a reset the counter holds anything (ARMv7-M B3.3.5): the first period
/// could last a tenth of a second.
#[cfg(target_arch = "arm")]
#[must_use]
pub fn cleared_systick(mut systick: cortex_m::peripheral::SYST) -> cortex_m::peripheral::SYST {
    systick.clear_current();
    systick
}

/// Waits `ms` milliseconds with the system timer, while the core runs at `core` Hz. Afterwards the timer is off, as
/// after a reset.
#[cfg(target_arch = "arm")]
pub fn pause(core: u32, ms: u32) {
    // SAFETY: only the boot stage runs, which uses the timer for nothing else.
    let mut timer = cleared_systick(unsafe { cortex_m::Peripherals::steal() }.SYST);
    timer.set_clock_source(cortex_m::peripheral::syst::SystClkSource::Core);
    timer.set_reload(core / 1000 - 1);
    timer.enable_counter();
    for passed in 0..ms {
        if functions::HAS_EACH_10_MS && passed.is_multiple_of(10) {
            functions::each_10_ms();
        }
        while !timer.has_wrapped() {
            // A fraction of a millisecond: the timer need not be asked more often.
            cortex_m::asm::delay(1000);
        }
    }
    // SAFETY: the value after a reset (PM0214 section 4.5.1).
    unsafe { timer.csr.write(0) };
}

/// The count of the system timer, which runs with the clock of the core.
#[cfg(target_arch = "arm")]
#[must_use]
pub fn cycles() -> u32 {
    cortex_m::peripheral::SYST::get_current()
}
