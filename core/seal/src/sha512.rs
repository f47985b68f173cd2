//! SHA-512, SHA-512/256 (FIPS 180-4) and HMAC-SHA-512 (RFC 2104), optimised for size.
//!
//! The current block is also the message schedule: sixteen words, one of which is replaced in each
//! round. A hash therefore needs 200 bytes of RAM for any message. An HMAC leaves nothing of its key on the
//! stack.

use zeroize::Zeroize;

/// Words of the state.
const STATE: usize = 8;

/// The initial state of SHA-512 (FIPS 180-4, 5.3.5): the first 64 bits of the fractional parts of the
/// square roots of the first eight primes.
#[rustfmt::skip]
const START: [u64; STATE] = [
    0x6a09_e667_f3bc_c908, 0xbb67_ae85_84ca_a73b, 0x3c6e_f372_fe94_f82b, 0xa54f_f53a_5f1d_36f1,
    0x510e_527f_ade6_82d1, 0x9b05_688c_2b3e_6c1f, 0x1f83_d9ab_fb41_bd6b, 0x5be0_cd19_137e_2179,
];

/// The constants of the rounds (FIPS 180-4, 4.2.3): the same of the cube roots of the first eighty
/// primes. A table and not computed at the start of the device, where the first hash would have to
/// wait for them.
#[rustfmt::skip]
const ROUNDS: [u64; 80] = [
    0x428a_2f98_d728_ae22, 0x7137_4491_23ef_65cd, 0xb5c0_fbcf_ec4d_3b2f, 0xe9b5_dba5_8189_dbbc,
    0x3956_c25b_f348_b538, 0x59f1_11f1_b605_d019, 0x923f_82a4_af19_4f9b, 0xab1c_5ed5_da6d_8118,
    0xd807_aa98_a303_0242, 0x1283_5b01_4570_6fbe, 0x2431_85be_4ee4_b28c, 0x550c_7dc3_d5ff_b4e2,
    0x72be_5d74_f27b_896f, 0x80de_b1fe_3b16_96b1, 0x9bdc_06a7_25c7_1235, 0xc19b_f174_cf69_2694,
    0xe49b_69c1_9ef1_4ad2, 0xefbe_4786_384f_25e3, 0x0fc1_9dc6_8b8c_d5b5, 0x240c_a1cc_77ac_9c65,
    0x2de9_2c6f_592b_0275, 0x4a74_84aa_6ea6_e483, 0x5cb0_a9dc_bd41_fbd4, 0x76f9_88da_8311_53b5,
    0x983e_5152_ee66_dfab, 0xa831_c66d_2db4_3210, 0xb003_27c8_98fb_213f, 0xbf59_7fc7_beef_0ee4,
    0xc6e0_0bf3_3da8_8fc2, 0xd5a7_9147_930a_a725, 0x06ca_6351_e003_826f, 0x1429_2967_0a0e_6e70,
    0x27b7_0a85_46d2_2ffc, 0x2e1b_2138_5c26_c926, 0x4d2c_6dfc_5ac4_2aed, 0x5338_0d13_9d95_b3df,
    0x650a_7354_8baf_63de, 0x766a_0abb_3c77_b2a8, 0x81c2_c92e_47ed_aee6, 0x9272_2c85_1482_353b,
    0xa2bf_e8a1_4cf1_0364, 0xa81a_664b_bc42_3001, 0xc24b_8b70_d0f8_9791, 0xc76c_51a3_0654_be30,
    0xd192_e819_d6ef_5218, 0xd699_0624_5565_a910, 0xf40e_3585_5771_202a, 0x106a_a070_32bb_d1b8,
    0x19a4_c116_b8d2_d0c8, 0x1e37_6c08_5141_ab53, 0x2748_774c_df8e_eb99, 0x34b0_bcb5_e19b_48a8,
    0x391c_0cb3_c5c9_5a63, 0x4ed8_aa4a_e341_8acb, 0x5b9c_ca4f_7763_e373, 0x682e_6ff3_d6b2_b8a3,
    0x748f_82ee_5def_b2fc, 0x78a5_636f_4317_2f60, 0x84c8_7814_a1f0_ab72, 0x8cc7_0208_1a64_39ec,
    0x90be_fffa_2363_1e28, 0xa450_6ceb_de82_bde9, 0xbef9_a3f7_b2c6_7915, 0xc671_78f2_e372_532b,
    0xca27_3ece_ea26_619c, 0xd186_b8c7_21c0_c207, 0xeada_7dd6_cde0_eb1e, 0xf57d_4f7f_ee6e_d178,
    0x06f0_67aa_7217_6fba, 0x0a63_7dc5_a2c8_98a6, 0x113f_9804_bef9_0dae, 0x1b71_0b35_131c_471b,
    0x28db_77f5_2304_7d84, 0x32ca_ab7b_40c7_2493, 0x3c9e_be0a_15c9_bebc, 0x431d_67c4_9c10_0d4c,
    0x4cc5_d4be_cb3e_42b6, 0x597f_299c_fc65_7e2a, 0x5fcb_6fab_3ad6_faec, 0x6c44_198c_4a47_5817,
];

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
    pub const fn new() -> Self {
        Self { state: START, block: [0; 16], length: 0 }
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
        for round in ROUNDS.chunks_exact(16) {
            moving.copy_within(..8, 16);
            for (t, constant) in round.iter().enumerate() {
                let Some([next, a, b, c, d, e, f, g, h]) = moving[15 - t % 16..].first_chunk_mut() else {
                    break;
                };
                let w = self.block[t % 16];
                let sum = h
                    .wrapping_add(turns(*e, 14, 18, e.rotate_right(41)))
                    .wrapping_add(*g ^ (*e & (*f ^ *g)))
                    .wrapping_add(*constant)
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
        moving.zeroize();
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
    let mut hash = Sha512::new();
    let start = |hash: &mut Sha512, pad: u8| {
        hash.state = START;
        hash.length = 0;
        for at in 0..128 {
            hash.push(key.get(at).unwrap_or(&0) ^ pad);
        }
    };
    start(&mut hash, 0x36);
    parts.iter().for_each(|part| hash.update(part));
    let mut inner = hash.finish();
    start(&mut hash, 0x5c);
    hash.update(&inner);
    inner.zeroize();
    let mac = hash.finish();
    hash.state.zeroize();
    hash.block.zeroize();
    mac
}
