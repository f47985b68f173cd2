//! Raw LZMA (lc = 0, lp = 1, pb = 1, neither header nor end marker), optimised for size.
//!
//! The format is that of the LZMA SDK's `LZMA specification`. The decoder does not keep
//! decompressed bytes: the caller has them, for example in flash, and returns them byte by byte.

/// The stream is invalid: its first byte is not 0, it copies from before the first byte, or it ends
/// too early.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Corrupt;

/// The offsets of the probabilities for each kind of bit. Kinds that depend on the position have
/// two of each (pb = lp = 1): `MATCH` and `LONG` have them one after the other for each state.
const MATCH: u32 = 0;
/// Whether a match has one of the last four distances, and whether it is not the last, not the
/// second last, not the third last: 12 states each.
const REPEATED: u32 = 24;
const LONG: u32 = REPEATED + 4 * 12;
const SLOT: u32 = LONG + 24;
const SPECIAL: u32 = SLOT + 4 * 64;
const ALIGN: u32 = SPECIAL + 128;
const MATCH_LENGTH: u32 = ALIGN + 16;
/// Two choices, two trees of three bits for two ranges, and one tree of eight bits.
const LENGTH: u32 = 2 + 2 * 8 + 2 * 8 + 256;
const LITERAL: u32 = MATCH_LENGTH + 2 * LENGTH;
const LITERALS: u32 = 0x300;
const COUNT: usize = (LITERAL + 2 * LITERALS) as usize;
/// A bit without a probability: 0 and 1 are equally likely.
const DIRECT: u32 = u32::MAX;

/// More input than any symbol can take, in bytes.
const SYMBOL: usize = 24;

/// The state of a stream after its last byte so far.
#[derive(Clone, Debug)]
// Small fields come first, within reach of short instructions.
#[repr(C)]
pub struct Decoder {
    /// 0 before the first byte.
    range: u32,
    code: u32,
    /// Bytes consumed from the input of this call.
    at: usize,
    /// Bytes decompressed, including the dictionary's.
    position: u32,
    /// Bytes that must still be copied.
    pending: u32,
    /// The kinds of the last symbols (0 to 11; below 7 the last one was a literal).
    state: u32,
    /// The last four distances minus one, the latest first.
    distances: [u32; 4],
    probabilities: [u16; COUNT],
}

impl Default for Decoder {
    fn default() -> Self {
        Self::new()
    }
}

impl Decoder {
    /// The state before a stream. All of it is zero.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            range: 0,
            code: 0,
            at: 0,
            position: 0,
            pending: 0,
            state: 0,
            distances: [0; 4],
            probabilities: [0; COUNT],
        }
    }

    /// Forgets the stream; the next data are the beginning of another one.
    pub fn reset(&mut self) {
        self.range = 0;
        self.pending = 0;
    }

    /// Whether the stream may end here: it has ended if its whole input is consumed, the expected
    /// bytes are decompressed, and this returns true.
    #[must_use]
    pub fn is_finished(&self) -> bool {
        self.code == 0 && self.pending == 0
    }

    /// Decompresses as much as possible: until `out` is full, or until fewer than 24 bytes of input
    /// are left and it is not the `last` input. The caller must put the remaining bytes before the
    /// next input.
    ///
    /// `history(n)` is the byte `n` bytes before the first byte of `out`, for `n` from 1 to
    /// `history_len`. At the first call that is the dictionary.
    ///
    /// Returns the number of consumed bytes and of decompressed bytes.
    ///
    /// # Errors
    /// [`Corrupt`], also if the `last` input does not fill `out`.
    pub fn decode(
        &mut self,
        input: &[u8],
        last: bool,
        history_len: u32,
        history: &impl Fn(u32) -> u8,
        out: &mut [u8],
    ) -> Result<(usize, usize), Corrupt> {
        self.at = 0;
        let mut produced = 0;
        while produced < out.len() {
            if self.pending == 0 {
                if !last && input.len() < self.at + SYMBOL {
                    break;
                }
                if self.range == 0 {
                    self.start(input, history_len)?;
                }
            }
            // The byte at the last distance.
            let back = self.distances[0] as usize;
            let copied = match back.checked_sub(produced) {
                None => out.get(produced - 1 - back).copied(),
                Some(back) if back < history_len as usize => Some(history(back as u32 + 1)),
                Some(_) => None,
            };
            let byte = if self.pending == 0 {
                let literal = self.symbol(input, copied);
                if self.at > input.len() {
                    return Err(Corrupt);
                }
                match literal? {
                    None => continue,
                    Some(literal) => literal,
                }
            } else {
                self.pending -= 1;
                copied.ok_or(Corrupt)?
            };
            if let Some(place) = out.get_mut(produced) {
                *place = byte;
            }
            produced += 1;
            self.position = self.position.wrapping_add(1);
        }
        Ok((self.at, produced))
    }

    fn start(&mut self, input: &[u8], dictionary: u32) -> Result<(), Corrupt> {
        if input.first() != Some(&0) {
            return Err(Corrupt);
        }
        self.position = dictionary;
        self.state = 0;
        self.distances = [0; 4];
        self.probabilities = [1024; COUNT];
        for _ in 0..5 {
            self.shift(input);
        }
        self.range = !0;
        Ok(())
    }

    /// A literal, or `None` for a match: `pending` and the first distance describe it.
    fn symbol(&mut self, input: &[u8], copied: Option<u8>) -> Result<Option<u8>, Corrupt> {
        let odd = self.position & 1;
        if self.bit(input, MATCH + self.state * 2 + odd) == 0 {
            // After a match, the byte that would have continued it predicts the literal, up to the
            // first bit that differs.
            let mut hint = 0;
            let mut alike = 0;
            if self.state >= 7 {
                hint = u32::from(copied.ok_or(Corrupt)?);
                alike = 0x100;
            }
            let mut literal = 1;
            while literal < 0x100 {
                hint <<= 1;
                let bit = self.bit(input, LITERAL + odd * LITERALS + alike + (hint & alike) + literal);
                literal = literal * 2 + bit;
                alike &= if bit != 0 { hint } else { !hint };
            }
            self.state -= match self.state {
                0..4 => self.state,
                4..10 => 3,
                _ => 6,
            };
            return Ok(Some(literal as u8));
        }
        let mut which = 0;
        while which < 4 && self.bit(input, REPEATED + which * 12 + self.state) != 0 {
            which += 1;
        }
        let mut state = 8;
        let mut length = 1;
        if which == 1 && self.bit(input, LONG + self.state * 2 + odd) == 0 {
            state = 9;
        } else {
            let probabilities = MATCH_LENGTH + if which == 0 { 0 } else { LENGTH };
            length = 2 + if self.bit(input, probabilities) == 0 {
                self.tree(input, probabilities + 2 + odd * 8, 8)
            } else if self.bit(input, probabilities + 1) == 0 {
                8 + self.tree(input, probabilities + 18 + odd * 8, 8)
            } else {
                16 + self.tree(input, probabilities + 34, 256)
            };
        }
        let mut distance = if which == 0 {
            state = 7;
            which = 4;
            self.distance(input, length)
        } else {
            self.distances[(which as usize - 1) % 4]
        };
        // Moves the distance to the front, and the previous ones one place back.
        for place in self.distances.iter_mut().take(which as usize) {
            core::mem::swap(place, &mut distance);
        }
        self.state = if self.state < 7 { state } else { 11.min(state + 3) };
        self.pending = length;
        Ok(None)
    }

    fn distance(&mut self, input: &[u8], length: u32) -> u32 {
        let slot = self.tree(input, SLOT + (length - 2).min(3) * 64, 64);
        if slot < 4 {
            return slot;
        }
        let mut bits = slot / 2 - 1;
        let distance = (2 | slot & 1) << bits;
        if slot < 14 {
            return distance + self.reverse(input, SPECIAL + distance - slot, bits);
        }
        let mut direct = 0;
        while bits > 4 {
            direct = direct * 2 + self.bit(input, DIRECT);
            bits -= 1;
        }
        distance + direct * 16 + self.reverse(input, ALIGN, 4)
    }

    /// Bits, the highest first; the tree has `leaves` leaves.
    fn tree(&mut self, input: &[u8], probabilities: u32, leaves: u32) -> u32 {
        let mut node = 1;
        while node < leaves {
            node = node * 2 + self.bit(input, probabilities + node);
        }
        node - leaves
    }

    /// Bits, the lowest first.
    fn reverse(&mut self, input: &[u8], probabilities: u32, bits: u32) -> u32 {
        let mut node = 1;
        let mut value = 0;
        for at in 0..bits {
            let bit = self.bit(input, probabilities + node);
            node = node * 2 + bit;
            value |= bit << at;
        }
        value
    }

    #[inline(never)]
    fn bit(&mut self, input: &[u8], probability: u32) -> u32 {
        let mut probability = self.probabilities.get_mut(probability as usize);
        let bound = match &probability {
            Some(probability) => (self.range >> 11) * u32::from(**probability),
            None => {
                self.range &= !1;
                self.range / 2
            }
        };
        let bit = u32::from(self.code >= bound);
        if let Some(probability) = &mut probability {
            if bit == 0 {
                **probability += (2048 - **probability) >> 5;
            } else {
                **probability -= **probability >> 5;
            }
        }
        if bit == 0 {
            self.range = bound;
        } else {
            self.code -= bound;
            self.range -= bound;
        }
        if self.range < 1 << 24 {
            self.range <<= 8;
            self.shift(input);
        }
        bit
    }

    /// The next byte of the input. After its end there are zeros; the caller detects that from
    /// `at`.
    fn shift(&mut self, input: &[u8]) {
        self.code = self.code << 8 | u32::from(input.get(self.at).copied().unwrap_or(0));
        self.at += 1;
    }
}
