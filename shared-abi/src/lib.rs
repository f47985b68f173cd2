//! What the bootloader, the application, the host tool and the emulator must agree on.
//!
//! | module | what it fixes |
//! |---|---|
//! | [`geometry`] | the silicon: flash sectors, RAM, number of interrupts |
//! | [`layout`] | **the numbers** of each board: who owns which address |
//! | [`memory_map`] | which addresses of a chip may be touched blindly |
//! | [`warm_start`] | the last RAM cell: what the application asks of the bootloader across a reset |
//! | [`handoff`] | what the bootloader tells the application about how it came up |
//! | [`label`] | what a program image says of itself: whom it is for |
//! | [`vectors`] | the proof that a vector table may be jumped to, and the jump |
//! | [`callgate`] | the bootloader's services for the application, at a fixed address |
//! | [`ram_image`] | the part of the bootloader that runs from RAM, as it lies in flash |
//! | `reentry` | the way back from an application into its bootloader (on the target) |
//! | `reset` | registers after a reset, for those who leave the chip so (on the target) |
//! | [`block_file`] | the container that object 1F50h takes |
//!
//! Everything that crosses a border between two images is `repr(C)`, little-endian and versioned.
//! This crate has no dependencies, so that a C or foreign application can be held against it
//! easily.
#![no_std]

pub mod block_file;
pub mod callgate;
pub mod geometry;
pub mod handoff;
pub mod label;
pub mod layout;
pub mod memory_map;
pub mod ram_image;
#[cfg(target_arch = "arm")]
pub mod reentry;
#[cfg(target_arch = "arm")]
pub mod reset;
pub mod vectors;
pub mod warm_start;

/// The password of a lift device (6005h), which arms the way into the bootloader in the application
/// and opens 1F50h in the bootloader: choose your own.
pub const LIFT_PASSWORD: &[u8] = b"coboot";

/// The check word that guards a record in RAM: a rotating fold over its other words.
///
/// It tells a record from the noise of an unpowered RAM; it is no protection against an attacker
/// who can write RAM. All-zero and all-one records never check (the seed sees to that), and the
/// fold is simple enough to be written again in C in three lines.
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

/// Where the fold of [`check_word`] begins.
pub const CHECK_SEED: u32 = 0xC0B0_07A5;
/// By how many bits it is rotated to the left before each word.
pub const CHECK_ROTATION: u32 = 5;
/// What it is multiplied with after each word.
pub const CHECK_FACTOR: u32 = 0x9E37_79B1;

/// The example on the crate's page compiles and runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
