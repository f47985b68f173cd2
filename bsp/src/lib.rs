//! Board support: everything that differs between two boards of one firmware.
//!
//! One file per board, chosen by the cargo feature `board-…`, beside its memory map in
//! `shared-abi/src/layout/`. To port coboot, copy a board file and go through it from top to bottom.
//! [`can`] holds what all boards share.
//!
//! On the host there are the values of a board, without the drivers.
#![no_std]

pub mod can;
pub mod clock;
#[cfg(target_arch = "arm")]
pub mod watchdog;

#[cfg(any(feature = "board-stm32f407g-disc1", feature = "board-stm32f407g-disc1-two"))]
#[path = "stm32f407g_disc1.rs"]
mod board;

#[cfg(not(any(feature = "board-stm32f407g-disc1", feature = "board-stm32f407g-disc1-two")))]
compile_error!("bsp: choose a board by one of the features `board-…`");

pub use board::*;

#[cfg(target_arch = "arm")]
pub use stm32f4xx_hal as hal;
#[cfg(target_arch = "arm")]
pub use stm32f4xx_hal::pac;

/// What the device says of itself in 1008h–100Ah and 1018h, for bootloader and application alike.
#[derive(Clone, Copy, Debug)]
pub struct Identity {
    /// 1018h/1, assigned by CiA; 0 where there is none.
    pub vendor_id: u32,
    /// 1018h/2.
    pub product_code: u32,
    /// 1018h/3: major in the upper half, minor in the lower.
    pub revision: u32,
    /// 1008h.
    pub device_name: &'static str,
    /// 1009h.
    pub hardware_version: &'static str,
}

/// Serial number of the device (1018h/4): a fold of the chip's 96-bit unique identifier (RM0090 section 39.1).
#[must_use]
pub fn serial_number() -> u32 {
    const UNIQUE_ID: *const [u32; 3] = 0x1FFF_7A10 as *const _;
    // SAFETY: the unique identifier is a read-only word-aligned part of every STM32F4.
    shared_abi::check_word(&unsafe { UNIQUE_ID.read_volatile() })
}
