//! Numbers of several words, the lowest word first.

use crate::wire::word;

/// Words from little-endian bytes; zeros if there are too few bytes.
pub fn words(bytes: &[u8], words: &mut [u32]) {
    for (at, value) in words.iter_mut().enumerate() {
        *value = word(bytes, at * 4);
    }
}

/// Adds factor * number to up to eight words; returns the carry.
#[inline(never)]
pub fn add_product(sum: &mut [u32], factor: u32, number: &[u32; 8]) -> u32 {
    let mut carry = 0;
    for (sum, word) in sum.iter_mut().zip(number) {
        let wide = u64::from(factor) * u64::from(*word) + u64::from(*sum) + u64::from(carry);
        *sum = wide as u32;
        carry = (wide >> 32) as u32;
    }
    carry
}
