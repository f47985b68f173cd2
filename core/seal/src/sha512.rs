//! SHA-512, SHA-512/256 (FIPS 180-4) and HMAC-SHA-512 (RFC 2104), optimised for size.
//!
//! The current block is also the message schedule: sixteen words, one of which is replaced in each
//! round. A hash therefore needs 200 bytes of RAM for any message.

use core::sync::atomic::{AtomicU32, Ordering};

use crate::words::add_product;

/// The initial state of SHA-512 (FIPS 180-4, 5.3.5) and the constants of the rounds (4.2.3), the
/// lower half of each first: the first 64 bits of the fractional parts of the square roots of the
/// first eight primes and of the cube roots of the first eighty. In the image they would take 704
/// bytes, which cannot be compressed. They are therefore computed ([`prepare`]), which takes about
/// 30 ms at 168 MHz.
static CONSTANTS: [[AtomicU32; 2]; STATE + 80] = [const { [const { AtomicU32::new(0) }; 2] }; STATE + 80];

/// Words of the state.
const STATE: usize = 8;

/// All constants, computed if necessary.
fn constants() -> &'static [[AtomicU32; 2]; STATE + 80] {
    while !prepare() {}
    &CONSTANTS
}

/// Computes the next constant, in about 0.4 ms at 168 MHz; returns whether all are there. A device
/// calls it while it has no other work, so that no request waits for all of them.
pub fn prepare() -> bool {
    // The upper half of every constant is not zero. Two concurrent calls write the same value.
    let missing = |halves: &[AtomicU32; 2]| halves[1].load(Ordering::Acquire) == 0;
    let Some((n, constant)) = CONSTANTS.iter().enumerate().find(|(_, halves)| missing(halves)) else {
        return true;
    };
    let square = n < STATE;
    let is_prime = |number: &u32| (2..*number).all(|divisor| !number.is_multiple_of(divisor));
    let prime = (2..).filter(is_prime).nth(if square { n } else { n - STATE });
    let root = root(prime.unwrap_or(0), if square { 2 } else { 3 });
    constant[0].store(root as u32, Ordering::Release);
    constant[1].store((root >> 32) as u32, Ordering::Release);
    false
}

/// The first 64 bits of the fractional part of a square or cube root below 8, bit by bit: each bit
/// is tried, and cleared again if the power is not below the number. No root is an integer, so the
/// power never equals the number.
#[inline(never)]
fn root(number: u32, exponent: usize) -> u64 {
    // Times 2^64.
    let mut root = [0; 3];
    // Three bits are in front of the point.
    for bit in (0..3 + 64).rev() {
        root[bit / 32] ^= 1 << (bit % 32);
        // Its powers, each multiplied by 2^64 once more.
        let mut power = [1, 0, 0, 0, 0, 0, 0, 0];
        for _ in 0..exponent {
            let mut product = [0; 8 + 3];
            for (at, factor) in root.iter().enumerate() {
                add_product(&mut product[at..], *factor, &power);
            }
            power.copy_from_slice(&product[..8]);
        }
        if power[2 * exponent % 8] >= number {
            root[bit / 32] ^= 1 << (bit % 32);
        }
    }
    u64::from(root[1]) << 32 | u64::from(root[0])
}

#[inline(always)]
fn constant(halves: &[AtomicU32; 2]) -> u64 {
    let [low, high] = halves;
    u64::from(high.load(Ordering::Relaxed)) << 32 | u64::from(low.load(Ordering::Relaxed))
}

/// A hash that is being computed.
#[derive(Clone, Debug)]
pub struct Sha512 {
    state: [u64; STATE],
    block: [u64; 16],
    /// The number of bytes so far.
    length: u32,
}

impl Default for Sha512 {
    fn default() -> Self {
        Self::new()
    }
}

impl Sha512 {
    /// Space for a hash; [`new`](Self::new) starts one. All zeros, so that it takes no flash.
    pub const IDLE: Self = Self { state: [0; 8], block: [0; 16], length: 0 };

    /// SHA-512 of an empty message.
    #[must_use]
    pub fn new() -> Self {
        let mut state = [0; STATE];
        for (word, start) in state.iter_mut().zip(constants()) {
            *word = constant(start);
        }
        Self { state, block: [0; 16], length: 0 }
    }

    /// SHA-512/256 of an empty message. Its hash is the first 32 bytes of the result of
    /// [`finish`](Self::finish).
    #[must_use]
    pub fn new_256() -> Self {
        // FIPS 180-4, 5.3.6: the computation of the initial state of a truncated hash.
        let mut hash = Self::new();
        hash.state.iter_mut().for_each(|word| *word ^= 0xa5a5_a5a5_a5a5_a5a5);
        hash.update(b"SHA-512/256");
        hash.pad();
        hash.length = 0;
        hash
    }

    /// Adds a part of the message, which may have 2^32 - 1 bytes in total.
    pub fn update(&mut self, data: &[u8]) {
        for byte in data {
            self.push(*byte);
        }
    }

    /// The hash. For SHA-512/256 it is the first 32 bytes. `self` must not be used afterwards.
    pub fn finish(&mut self) -> [u8; 64] {
        self.pad();
        let mut hash = [0; 64];
        for (bytes, word) in hash.chunks_exact_mut(8).zip(&self.state) {
            bytes.copy_from_slice(&word.to_be_bytes());
        }
        hash
    }

    #[inline(never)]
    fn push(&mut self, byte: u8) {
        let word = &mut self.block[self.length as usize / 8 % 16];
        *word = *word << 8 | u64::from(byte);
        self.length = self.length.wrapping_add(1);
        if self.length.is_multiple_of(128) {
            self.compress();
        }
    }

    /// The end of the message: a bit, zeros, and the length in bits.
    fn pad(&mut self) {
        let bits = u64::from(self.length) * 8;
        self.push(0x80);
        while self.length % 128 != 112 {
            self.push(0);
        }
        self.block[14] = 0;
        self.block[15] = bits;
        self.compress();
    }

    /// Processes the block (FIPS 180-4, 6.4.2).
    #[inline(never)]
    fn compress(&mut self) {
        // The eight working variables, a first, move down one place in each round: only the changed
        // values are written, until sixteen rounds have ended.
        let mut moving = [0; 16 + 8];
        moving[..8].copy_from_slice(&self.state);
        for round in CONSTANTS[STATE..].chunks_exact(16) {
            moving.copy_within(..8, 16);
            for (t, halves) in round.iter().enumerate() {
                let Some([next, a, b, c, d, e, f, g, h]) = moving[15 - t % 16..].first_chunk_mut() else {
                    break;
                };
                let w = self.block[t % 16];
                let sum = h
                    .wrapping_add(turns(*e, 14, 18, e.rotate_right(41)))
                    .wrapping_add(*g ^ (*e & (*f ^ *g)))
                    .wrapping_add(constant(halves))
                    .wrapping_add(w);
                *d = d.wrapping_add(sum);
                *next = sum
                    .wrapping_add(turns(*a, 28, 34, a.rotate_right(39)))
                    .wrapping_add((*a & *b) | (*c & (*a | *b)));
                let early = self.block[(t + 1) % 16];
                let late = self.block[(t + 14) % 16];
                // The value of this word of the block sixteen rounds later.
                self.block[t % 16] = w
                    .wrapping_add(turns(early, 1, 8, early >> 7))
                    .wrapping_add(self.block[(t + 9) % 16])
                    .wrapping_add(turns(late, 19, 61, late >> 6));
            }
        }
        for (state, word) in self.state.iter_mut().zip(&moving) {
            *state = state.wrapping_add(*word);
        }
    }
}

/// The word rotated right by two numbers of bits, and a third word, combined by exclusive-or.
#[inline(always)]
fn turns(word: u64, one: u32, two: u32, third: u64) -> u64 {
    word.rotate_right(one) ^ word.rotate_right(two) ^ third
}

/// SHA-512/256 of these parts in sequence.
#[must_use]
pub fn hash_256(parts: &[&[u8]]) -> [u8; 32] {
    let mut hash = Sha512::new_256();
    parts.iter().for_each(|part| hash.update(part));
    let mut first = [0; 32];
    first.copy_from_slice(&hash.finish()[..32]);
    first
}

/// HMAC-SHA-512 of these parts in sequence.
#[must_use]
pub fn hmac(key: &[u8; 32], parts: &[&[u8]]) -> [u8; 64] {
    let keyed = |pad: u8| {
        let mut hash = Sha512::new();
        for at in 0..128 {
            hash.push(key.get(at).unwrap_or(&0) ^ pad);
        }
        hash
    };
    let mut inner = keyed(0x36);
    parts.iter().for_each(|part| inner.update(part));
    let mut outer = keyed(0x5c);
    outer.update(&inner.finish());
    outer.finish()
}
