//! Finds the smallest ZX0 stream (format version 2, Einar Saukas) of some bytes.
//!
//! A stream consists of literals and copies in turn: literals; a copy from the last offset, only
//! after literals; a copy from another offset. Numbers are interlaced Elias gamma codes. The choice
//! between them is found by trying all: for each prefix of the input, the cheapest stream of it.
//!
//! The format counts offsets in bytes, and has seven bits for their lower part. Thumb code consists
//! of half-words, and nearly every copy in it comes from an even offset, often from far away; so
//! both are a choice here ([`Offsets`]). A copy may also come from data before the output, if the
//! unpacker has such data. The savings are in docs/adr/0011-packed-ram-image.md.

/// The upper part of an offset that marks the end of the stream.
const END: usize = 256;

/// The format of the offsets in a stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Offsets {
    /// The unit of an offset in bytes.
    pub unit: usize,
    /// Whether the lower part fills its byte. Otherwise it has seven bits, and the eighth is the
    /// first one of the length.
    pub is_low_byte: bool,
}

impl Offsets {
    /// The offsets of the standard format.
    #[cfg(test)]
    const ZX0: Self = Self { unit: 1, is_low_byte: false };

    /// Number of bits of the lower part.
    fn low_bits(self) -> u32 {
        7 + u32::from(self.is_low_byte)
    }

    /// The upper part, from 1 on, and the lower part, which counts down to 0.
    fn parts(self, offset: usize) -> (usize, usize) {
        let values = 1 << self.low_bits();
        ((offset - 1) / values + 1, values - 1 - (offset - 1) % values)
    }
}
/// A piece of a stream: literals, or a copy.
#[derive(Clone, Copy)]
struct Piece {
    /// Bits of the stream up to the end of the piece.
    bits: u32,
    /// Bytes of the input up to the end of the piece.
    end: usize,
    /// 0 for literals; otherwise the distance of the copy's source in units.
    offset: usize,
    /// The piece before it.
    before: usize,
}

/// The state of one offset.
#[derive(Clone, Copy, Default)]
struct Offset {
    /// The end of the last bytes that equal the bytes at this distance before, and their number.
    end: usize,
    equal: usize,
    /// The last copy of the cheapest stream whose last offset is this one.
    copy: Option<usize>,
    /// The same with literals after the copy, up to the start of the equal bytes.
    literals: Option<usize>,
}

/// Packs some bytes, at least one. They follow `before`, whose length is a multiple of the unit.
pub fn compress(before: &[u8], bytes: &[u8], offsets: Offsets) -> Vec<u8> {
    let input = [before, bytes].concat();
    write(&input, before.len(), offsets, &cheapest(&input, before.len(), offsets))
}

/// The pieces of the smallest stream of `input` from `start` on, in order.
fn cheapest(input: &[u8], start: usize, coding: Offsets) -> Vec<Piece> {
    // Before the first byte the last offset is 1, and the flag before the first literals is left
    // out.
    const START: usize = 0;
    let unit = coding.unit;
    let mut pieces = vec![Piece { bits: u32::MAX, end: start, offset: 1, before: START }];
    // For each prefix, the last piece of its cheapest stream.
    let mut best = vec![START; input.len() + 1];
    let mut offsets = vec![Offset::default(); input.len() / unit + 2];
    offsets[1].copy = Some(START);
    // For each number of equal bytes, the best length of a copy.
    let mut lengths = vec![2; input.len() + 3];
    // The places of each byte, by their distance from a multiple of the unit.
    let mut places = vec![Vec::new(); 256 * unit];
    let place = |at: usize| usize::from(input[at]) * unit + at % unit;
    (0..start).for_each(|at| places[place(at)].push(at));
    // The copies behind which literals may be the cheapest.
    let mut open = vec![START];

    for end in start + 1..=input.len() {
        let here = end - 1;
        let literals = |copy: &usize| with_literals(&pieces[*copy], end);
        let copy = open.iter().copied().min_by_key(literals).expect("one is the cheapest");
        let bits = literals(&copy);
        // Of the codes of two lengths, one is longer by so many bits at most.
        open.retain(|copy| literals(copy) <= bits + number_bits(usize::MAX));
        pieces.push(Piece { bits, end, offset: 0, before: copy });
        best[end] = pieces.len() - 1;

        let mut known = 2;
        let mut cheapest_copy: Option<usize> = None;
        // A stream begins with a literal. In RAM the output does not follow the data before it: no
        // copy crosses that border.
        let equal = places[place(here)].iter().rev().copied();
        for from in equal.filter(|from| here > start && (*from != start || start == 0)) {
            let offset = (here - from) / unit;
            let state = &mut offsets[offset];
            if state.end != here {
                state.equal = 0;
                state.literals = state.copy.map(|copy| {
                    let bits = with_literals(&pieces[copy], here);
                    pieces.push(Piece { bits, end: here, offset: 0, before: copy });
                    pieces.len() - 1
                });
            }
            state.equal += 1;
            state.end = end;
            let mut candidate = state.literals.map(|literals| {
                let bits = pieces[literals].bits + 1 + number_bits(end - pieces[literals].end);
                Piece { bits, end, offset, before: literals }
            });
            if state.equal > 1 {
                let cost =
                    |length: usize| pieces[best[end - length]].bits.wrapping_add(number_bits(length - 1));
                while known < state.equal {
                    known += 1;
                    let shorter = lengths[known - 1];
                    lengths[known] = if cost(known) <= cost(shorter) { known } else { shorter };
                }
                let length = lengths[state.equal];
                let bits = cost(length) + 1 + coding.low_bits() + number_bits(coding.parts(offset).0);
                if candidate.is_none_or(|other| bits < other.bits) {
                    candidate = Some(Piece { bits, end, offset, before: best[end - length] });
                }
            }
            let Some(piece) = candidate else { continue };
            pieces.push(piece);
            let copy = pieces.len() - 1;
            state.copy = Some(copy);
            if cheapest_copy.is_none_or(|other| piece.bits < pieces[other].bits) {
                cheapest_copy = Some(copy);
            }
        }
        if let Some(copy) = cheapest_copy {
            open.push(copy);
            if pieces[copy].bits < pieces[best[end]].bits {
                best[end] = copy;
            }
        }
        places[place(here)].push(here);
    }

    let mut found = Vec::new();
    let mut last = best[input.len()];
    while last != START {
        found.push(pieces[last]);
        last = pieces[last].before;
    }
    found.reverse();
    found
}

/// Bits of a stream that ends with this copy and literals after it up to `end`.
fn with_literals(copy: &Piece, end: usize) -> u32 {
    let length = end - copy.end;
    copy.bits.wrapping_add(1 + number_bits(length) + 8 * length as u32)
}

/// Bits of the code of a number, from 1 on.
fn number_bits(number: usize) -> u32 {
    2 * number.ilog2() + 1
}

/// Writes the pieces as a stream.
fn write(input: &[u8], start: usize, offsets: Offsets, pieces: &[Piece]) -> Vec<u8> {
    let mut stream = Stream { bytes: Vec::new(), bits: 0, left: 0, in_last: false };
    let (mut at, mut offset) = (start, 1);
    let mut before = None;
    for piece in pieces {
        let length = piece.end - at;
        match (before, piece.offset) {
            (None, 0) => stream.number(length, false),
            (_, 0) => {
                stream.bit(false);
                stream.number(length, false);
            }
            (Some(0), same) if same == offset => {
                stream.bit(false);
                stream.number(length, false);
            }
            (_, other) => {
                offset = other;
                stream.bit(true);
                let (upper, lower) = offsets.parts(offset);
                stream.number(upper, true);
                stream.bytes.push((lower << (8 - offsets.low_bits())) as u8);
                stream.in_last = !offsets.is_low_byte;
                stream.number(length - 1, false);
            }
        }
        if piece.offset == 0 {
            stream.bytes.extend(&input[at..piece.end]);
        }
        (at, before) = (piece.end, Some(piece.offset));
    }
    debug_assert!(at == input.len());
    stream.bit(true);
    stream.number(END, true);
    stream.bytes
}

/// Bytes, with bytes of bits between them.
struct Stream {
    bytes: Vec<u8>,
    /// The position of the byte of bits, and the number of its free bits.
    bits: usize,
    left: u32,
    /// The next bit is the lowest one of the byte that was written last.
    in_last: bool,
}

impl Stream {
    fn bit(&mut self, bit: bool) {
        if std::mem::take(&mut self.in_last) {
            *self.bytes.last_mut().expect("a byte was written") |= u8::from(bit);
            return;
        }
        if self.left == 0 {
            (self.bits, self.left) = (self.bytes.len(), 8);
            self.bytes.push(0);
        }
        self.left -= 1;
        self.bytes[self.bits] |= u8::from(bit) << self.left;
    }

    /// An interlaced Elias gamma code: a 0 before each binary digit after the first one, and a 1 at
    /// the end. `inverted`: the digits are inverted.
    fn number(&mut self, number: usize, inverted: bool) {
        for digit in (0..number.ilog2()).rev() {
            self.bit(false);
            self.bit((number >> digit & 1 == 1) != inverted);
        }
        self.bit(true);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Bytes with repetitions at all kinds of offsets, from a fixed seed.
    fn sample(seed: u32, len: usize) -> Vec<u8> {
        let mut state = seed;
        let mut random = move || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 16) as usize
        };
        let mut bytes = vec![seed as u8];
        while bytes.len() < len {
            let (from, count) = (random() % bytes.len(), random() % 20);
            match random() % 3 {
                0 => bytes.extend((0..count).map(|_| random() as u8)),
                1 => bytes.extend(vec![bytes[from]; count]),
                _ => (from..bytes.len().min(from + count)).for_each(|at| bytes.push(bytes[at])),
            }
        }
        bytes
    }

    /// With bytes as the unit it is the format itself: another author's unpacker reads it, and
    /// another author's packer, which also finds the smallest stream, finds no smaller one.
    #[test]
    fn with_offsets_in_bytes_it_is_the_format() {
        for (seed, len) in [(1, 1), (2, 2), (3, 40), (4, 1000), (5, 6000)] {
            let input = sample(seed, len);
            let stream = compress(&[], &input, Offsets::ZX0);
            assert_eq!(zx0decompress::decompress(&mut stream.as_slice()).unwrap(), input, "seed {seed}");
            assert_eq!(stream.len(), zx0::compress(&input).len(), "seed {seed}");
        }
    }

    /// By hand, with offsets in half-words.
    #[test]
    fn with_offsets_in_half_words() {
        let bits = [
            // Four literals. A copy of 5 from two units before: 1, the upper part 1, and of 4 the
            // bits after the first one, which is in the byte of the lower part.
            0b0000_1110,
            // Its last bits. One literal. A copy of 2 from the last offset.
            0b0010_1000,
            // Its last bit. The end: 1, and 256 with inverted digits.
            0b1101_0101,
            0b0101_0101,
            0b0110_0000,
        ];
        let stream = [bits[0], b'a', b'b', b'c', b'd', 126 << 1, bits[1], b'X', bits[2], bits[3], bits[4]];
        let offsets = Offsets { unit: 2, is_low_byte: false };
        assert_eq!(compress(&[], b"abcdabcdaXcd", offsets), stream);
    }

    /// By hand, in the format of the bootloader.
    #[test]
    fn with_a_byte_for_the_lower_part_and_behind_other_bytes() {
        let bits = [
            // One literal, though it could be copied, too. A copy of 6 from four units before,
            // which is before the output: 1, the upper part 1, all bits of 5.
            0b1110_0011,
            // One literal, the end.
            0b0110_1010,
            0b1010_1010,
            0b1011_0000,
        ];
        let stream = [bits[0], b'-', 252, bits[1], b'Y', bits[2], bits[3]];
        let offsets = Offsets { unit: 2, is_low_byte: true };
        assert_eq!(compress(b"-abcdef-", b"-abcdefY", offsets), stream);
    }
}
