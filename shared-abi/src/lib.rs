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
//! | [`journal`] | the slots of the journal, its keys, and the record of a program |
//! | [`renewal`] | a new RAM image: staged, on trial, confirmed, installed |
//! | `reentry` | the return from an application to its bootloader (on the target) |
//! | `reset` | register values after a reset, for code that restores them (on the target) |
//! | [`block_file`] | the format of the data for object 1F50h |
//!
//! This crate has no dependencies, so that an application in C or with a foreign tool chain can
//! easily be compared with it.
//!
//! # Records that stay for ever
//!
//! The resident part of a device never changes: it meets the applications and RAM images of the next
//! ten years, and they meet it. `tests/abi` has a golden copy of all that they exchange.
//!
//! - A record has integers alone, little-endian, `repr(C)`, without gaps.
//! - A number (of a request, a key, an ability, a reason) keeps its meaning; none is used twice.
//! - **A record grows at its end**: by fields, if it says its size; otherwise by its reserved words
//!   and bits, first to last. **Reserved is written 0 and ignored when read**: 0 in a later field means
//!   "as before". A version counts the additions, and a reader takes every later one.
//! - What an older reader must not ignore is an ability that the header of a RAM image needs; or the
//!   record gets another magic, and is none to that reader.
//! - Zeros, ones, and a record with a wrong check word are no record.
//!
//! | record | from → to | bytes | grows by | smaller, larger | what its reader does not know |
//! |---|---|---|---|---|---|
//! | [`warm_start`] | application, RAM image → resident part | 16 | requests | – | no request: a crash |
//! | [`handoff`] | resident part → application | 48 | flags, 1 word | none | a flag is ignored, a cause is *unknown* |
//! | [`boot_report`] | resident part → RAM image | 48 | 4 words | none | a reason is shown, an origin is *home*, an end *none* |
//! | [`callgate`] | resident part → application | 16: the services follow | selectors | none, read | a selector: status −1; a status is a failure |
//! | its arguments | application ↔ resident part | each its own | – | – | a flag is ignored |
//! | [`services`] | resident part → RAM image | its `size` | entries | refused, read | a step or a result is *failed* |
//! | [`Facts`](services::Facts) | resident part → build, tools, RAM image | ≥ 20 | fields | none, read | an [ability](abilities::Abilities) is ignored |
//! | [`ram_image`] | build → resident part, RAM image | 64 | 1 word | refused | an [ability](abilities::Abilities) is refused |
//! | [`nameplate`] | production → resident part, application | 32 | 2 words | – | – |
//! | [`label`] | application → bootloader, tools | 32 | 2 words | – | – |
//! | [`journal`] | resident part, RAM image, production → the two parts | 28 each | keys | – | a key is kept; a release or a state is none |
//! | key block (`seal::key_block`) | production → bootloader | 256 | flags, 56 bytes | – | a flag is ignored |
//!
//! The header of an image has the CRC of the facts that it is for: one more ability, or field, makes
//! other facts. **Kept** for files that an application stores, to be installed later: request 15 with
//! the number of the program, [`INSTALL`](abilities::Abilities::INSTALL), which the application finds
//! in the facts, and the keys 0008xxxxh (the installation) and 0009xxxxh (the kept file). To a
//! resident part without the ability request 15 is none, and counts as a crash: nobody sends it there.
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
pub mod journal;
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
