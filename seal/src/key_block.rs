//! The key block: what makes a device a sealed one.
//!
//! It is the last 256 bytes of the bootloader's flash region, written in production together with
//! the bootloader (`coflash provision`), and never changed in the field. It is read where it lies
//! and never copied to RAM as a whole.
//!
//! | offset | bytes | |
//! |---|---|---|
//! | 0 | 4 | `CBKB` |
//! | 4 | 4 | flags: bit 0 for tests |
//! | 8 | 4 | the lowest security counter of every program |
//! | 12 | 4 | the lowest epoch |
//! | 16 | 2 × 36 | roots: id, public key; unused ones are 0 |
//! | 88 | 3 × 36 | key-encryption keys: id, key; unused ones are 0 |
//! | 196 | 56 | 0 |
//! | 252 | 4 | CRC-32 of all before |

/// Bytes of a key block.
pub const SIZE: usize = 256;
/// Its first word.
pub const MAGIC: [u8; 4] = *b"CBKB";
/// Where the flags stand.
pub const FLAGS: usize = 4;
/// Where the lowest security counter stands.
pub const COUNTER: usize = 8;
/// Where the lowest epoch stands.
pub const EPOCH: usize = 12;
/// Where the roots stand.
pub const ROOTS: usize = 16;
/// How many there are.
pub const ROOT_COUNT: usize = 2;
/// Where the key-encryption keys stand.
pub const KEKS: usize = ROOTS + ROOT_COUNT * KEY;
/// How many there are.
pub const KEK_COUNT: usize = 3;
/// Bytes of a key with its id in front of it.
pub const KEY: usize = 36;
/// Where the CRC stands.
pub const CHECK: usize = SIZE - 4;
/// In the flags: the device takes programs that are signed with a test key.
pub const FOR_TESTS: u32 = 1;

use crate::wire::word;

/// Where the key with this id stands, id included, among the roots (`ROOTS`, `ROOT_COUNT`) or the
/// key-encryption keys (`KEKS`, `KEK_COUNT`). The id 0 is that of none.
#[must_use]
pub fn find(block: &[u8], keys: usize, count: usize, id: u32) -> Option<usize> {
    let mut places = (keys..).step_by(KEY).take(count);
    places.find(|at| id != 0 && word(block, *at) == id)
}
