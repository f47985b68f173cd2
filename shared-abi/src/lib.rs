//! The definitions on which bootloader, application, host tool and emulator must agree.
//!
//! | module | definition |
//! |---|---|
//! | [`geometry`] | the silicon: flash sectors, RAM, number of interrupts |
//! | [`layout`] | **the numbers** of each board: who owns which address |
//! | [`clock_tree`] | the clocks of a board, and their rules |
//! | [`wiring`] | the pins of a board, and their rules |
//! | [`memory_map`] | the addresses of a chip that may be read without side effects |
//! | [`warm_start`] | the last RAM cell: requests of the application to the bootloader across a
//! reset |
//! | [`handoff`] | information from the bootloader to the application about the start |
//! | [`label`] | the target, version and date in a program image |
//! | [`date`] | the creation date of a program |
//! | [`bxcan`] | a received frame, and how many data bytes it has |
//! | [`nameplate`] | the identity of the device in the one-time programmable bytes of its chip |
//! | [`vectors`] | the proof that a vector table may be jumped to, and the jump |
//! | [`callgate`] | the bootloader's services for the application, at a fixed address |
//! | [`ram_image`] | the part of the bootloader that runs from RAM, as it is in flash |
//! | [`boot_report`] | information from the resident part of the bootloader to its RAM image |
//! | [`services`] | the services of the resident part for the RAM image |
//! | [`renewal`] | a new RAM image: staged, on trial, confirmed, installed |
//! | `reentry` | the return from an application to its bootloader (on the target) |
//! | `reset` | register values after a reset, for code that restores them (on the target) |
//! | [`block_file`] | the format of the data for object 1F50h |
//!
//! Everything that two images exchange is `repr(C)`, little-endian and versioned. This crate has no
//! dependencies, so that an application in C or with a foreign tool chain can easily be compared
//! with it.
#![no_std]

pub mod abilities;
pub mod bit_timing;
pub mod block_file;
pub mod boot_report;
pub mod bxcan;
pub mod callgate;
pub mod clock_tree;
pub mod date;
pub mod geometry;
pub mod handoff;
pub mod label;
pub mod layout;
pub mod memory_map;
pub mod nameplate;
pub mod ram_image;
#[cfg(target_arch = "arm")]
pub mod reentry;
#[cfg(any(target_arch = "arm", test))]
mod registers;
pub mod renewal;
#[cfg(any(target_arch = "arm", test))]
pub mod reset;
pub mod services;
pub mod vectors;
pub mod warm_start;
pub mod wiring;

/// The password of a lift device (6005h), which permits the call to the bootloader in the
/// application and unlocks 1F50h in the bootloader: choose your own.
pub const LIFT_PASSWORD: &[u8] = b"coboot";

/// The check word that protects a record in RAM: a rotating fold over its other words.
///
/// It distinguishes a record from the noise in RAM after power-on. It does not protect against an
/// attacker who can write to RAM. Records of only zeros or only ones never pass (the seed ensures
/// this), and the fold is simple enough to be implemented in three lines of C.
#[must_use]
pub const fn check_word(words: &[u32]) -> u32 {
    let mut fold = CHECK_SEED;
    let mut i = 0;
    while i < words.len() {
        fold = fold.rotate_left(CHECK_ROTATION) ^ words[i];
        fold = fold.wrapping_mul(CHECK_FACTOR);
        i += 1;
    }
    !fold
}

/// The start value of the fold of [`check_word`].
pub const CHECK_SEED: u32 = 0xC0B0_07A5;
/// The number of bits by which it is rotated left before each word.
pub const CHECK_ROTATION: u32 = 5;
/// The factor by which it is multiplied after each word.
pub const CHECK_FACTOR: u32 = 0x9E37_79B1;

/// The example on the crate's page compiles and runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
