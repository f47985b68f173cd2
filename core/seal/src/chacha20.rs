//! ChaCha20 (RFC 8439, 2.4), optimised for size. It leaves nothing of the key on the stack.

use zeroize::Zeroize;

use crate::words::words;

/// Encrypts or decrypts: exclusive-or of `data` with the key stream that begins with block number
/// `counter`.
///
/// The same key, nonce and counter must not be used for two different data. The block number wraps
/// after 2^32 - 1.
pub fn apply(key: &[u8; 32], nonce: &[u8; 12], counter: u32, data: &mut [u8]) {
    let mut start = [0; 16];
    words(b"expand 32-byte k", &mut start[..4]);
    words(key, &mut start[4..12]);
    words(nonce, &mut start[13..]);
    start[12] = counter;
    let mut s = [0; 16];
    for part in data.chunks_mut(64) {
        s.copy_from_slice(&start);
        for round in 0..80 {
            quarter(&mut s, round);
        }
        for (at, byte) in part.iter_mut().enumerate() {
            let word = s[at / 4 % 16].wrapping_add(start[at / 4 % 16]);
            *byte ^= (word >> (at % 4 * 8)) as u8;
        }
        start[12] = start[12].wrapping_add(1);
    }
    start.zeroize();
    s.zeroize();
}

/// Quarter round `n` of 80: four down the columns, four down the diagonals, repeated.
fn quarter(s: &mut [u32; 16], n: usize) {
    // A diagonal goes one column to the right with each row.
    let slope = n / 4 % 2;
    let place = |row: usize| row * 4 + (n + row * slope) % 4;
    let [mut a, mut b, mut c, mut d] = [place(0), place(1), place(2), place(3)];
    // The rotations of the words to the left, in bits: 16, 12, 8, 7.
    let mut turns = 0x0708_0c10_u32;
    while turns != 0 {
        s[a % 16] = s[a % 16].wrapping_add(s[b % 16]);
        s[d % 16] = (s[d % 16] ^ s[a % 16]).rotate_left(turns);
        (a, b, c, d) = (c, d, a, b);
        turns >>= 8;
    }
}
