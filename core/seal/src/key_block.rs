//! The key block, which makes a device a sealed device.
//!
//! It occupies the last 256 bytes of the bootloader's flash region. Production writes it together
//! with the bootloader (`coflash seal provision`), and it never changes in the field. The code reads it
//! in place and never copies all of it to RAM.
//!
//! | offset | bytes | |
//! |---|---|---|
//! | 0 | 4 | `CBKB` |
//! | 4 | 4 | flags: bit 0 for tests |
//! | 8 | 4 | the lowest security counter of every program |
//! | 12 | 4 | the lowest epoch |
//! | 16 | 2 × 36 | roots: id, public key; unused ones are 0 |
//! | 88 | 3 × 36 | key-encryption keys: id, key; unused ones are 0 |
//! | 196 | 56 | reserved: 0, and ignored when read |
//! | 252 | 4 | CRC-32 of all before |

/// Bytes of a key block.
pub const SIZE: usize = 256;
/// Its first word.
pub const MAGIC: [u8; 4] = *b"CBKB";
/// The offset of the flags.
pub const FLAGS: usize = 4;
/// The offset of the lowest security counter.
pub const COUNTER: usize = 8;
/// The offset of the lowest epoch.
pub const EPOCH: usize = 12;
/// The offset of the roots.
pub const ROOTS: usize = 16;
/// The number of roots.
pub const ROOT_COUNT: usize = 2;
/// The offset of the key-encryption keys.
pub const KEKS: usize = ROOTS + ROOT_COUNT * KEY;
/// The number of key-encryption keys.
pub const KEK_COUNT: usize = 3;
/// The size of a key with its id before it.
pub const KEY: usize = 36;
/// The offset of the CRC.
pub const CHECK: usize = SIZE - 4;
/// In the flags: the device accepts programs signed with a test key.
pub const FOR_TESTS: u32 = 1;

use crate::wire::word;

/// The offset of the key with this id, including its id, among the roots (`ROOTS`, `ROOT_COUNT`) or
/// the key-encryption keys (`KEKS`, `KEK_COUNT`). The id 0 means "no key".
#[must_use]
pub fn find(block: &[u8], keys: usize, count: usize, id: u32) -> Option<usize> {
    let mut places = (keys..).step_by(KEY).take(count);
    places.find(|at| id != 0 && word(block, *at) == id)
}
