//! Verification of an Ed25519 signature (RFC 8032, 5.1.7), optimised for size, and in steps.
//!
//! The rules are those of strict libraries: S is less than L, the public key and R are canonical
//! encodings of points that are not of small order, and R equals the result of the equation without
//! the cofactor, bit by bit. No input is secret, so the time may depend on the inputs.
//!
//! All arithmetic in the field is one operation, `a * b + c`, on sixteen registers, five of which
//! are constants: an addition multiplies by one, a subtraction by minus one. A formula is therefore
//! a list of half words (`PLUS` and others); as code it would be five times as long. The cost is
//! time: a verification takes about 0.2 s at 168 MHz.

use crate::words::{add_product, words};

/// A number of 256 bits, the lowest word first. As an element of the field with 2^255 - 19
/// elements, any number stands for its remainder.
type Number = [u32; 8];

/// 2^255 - 19.
const P: Number = [0xffff_ffed, !0, !0, !0, !0, !0, !0, 0x7fff_ffff];

/// The order of the base point, 2^252 + 27742317777372353535851937790883648493.
const L: Number = [0x5cf5_d3ed, 0x5812_631a, 0xa2f7_9cd6, 0x14de_f9de, 0, 0, 0, 0x1000_0000];

const ONE: Number = [1, 0, 0, 0, 0, 0, 0, 0];

/// X, Y, Z of x = X/Z, y = Y/Z.
type Point = [Number; 3];

/// The base point.
const BASE: Point = [
    [0x8f25_d51a, 0xc956_2d60, 0x9525_a7b2, 0x692c_c760, 0xfdd6_dc5c, 0xc0a4_e231, 0xcd6e_53fe, 0x2169_36d3],
    [0x6666_6658, 0x6666_6666, 0x6666_6666, 0x6666_6666, 0x6666_6666, 0x6666_6666, 0x6666_6666, 0x6666_6666],
    ONE,
];

// Formulas: lists of half words 0xDABC, each of which means D = A * B + C for the registers D, A, B
// and C.
//
// | registers | |
// |---|---|
// | 0, 1, 2 | the point that is worked on: X, Y, Z of x = X/Z, y = Y/Z |
// | 3, 4, 5 | the point that is added to it |
// | 6 | what is raised to a power |
// | 7 | the power |
// | 8 to A | intermediate results, as all the others when they are free |
// | B to F | 0, 1, -1, 121666, 121665 |
//
// The curve is y^2 - x^2 = 1 + d x^2 y^2 with d = -121665/121666; a factor d is replaced by -121665
// where the whole formula is multiplied by 121666.

/// All formulas, each terminated by a 0.
const FORMULAS: [u16; 56] = [
    // FRACTION
    0x211b, 0x32cd, 0x33eb, 0x22fb, 0x22de, 0x62cb, 0, //
    // QUOTIENT
    0x437b, 0x64c4, 0, //
    // ROOT
    0x867b, 0x887d, 0x047b, 0x008b, 0x400b, 0x442b, 0x44d3, 0x2ccb, 0, //
    // MINUS
    0x00db, 0, //
    // DIVISOR
    0x62cb, 0, //
    // DIVIDED
    0x007b, 0x117b, 0x2ccb, 0, //
    // SQUARE
    0x777b, 0, //
    // TIMES
    0x776b, 0, //
    // DOUBLE, which continues with PLUS
    0x30cb, 0x41cb, 0x52cb, //
    // PLUS
    0x625b, 0x76eb, 0x667b, 0x814b, 0x903b, 0xa98b, 0x99c8, 0x804b, 0x8138, 0xaafb, 0x0ac6, 0x1ad6, 0x201b,
    0x880b, 0x087b, 0x991b, 0x197b, 0, //
    // NEUTRAL
    0x0bbb, 0x1ccb, 0x2ccb, 0,
];
/// For a point with y in register 1: the fraction whose square root is x, its numerator to register
/// 3, its denominator to registers 2 and 6.
const FRACTION: usize = 0;
/// With the inverse of the denominator: the fraction itself to register 4, twice the fraction to 6.
const QUOTIENT: usize = 7;
/// The square root of these (Atkin's method; the method of RFC 8032 needs one more constant) to
/// register 0; to register 4 a value that is zero if it is a root; and 1 to register 2.
const ROOT: usize = 10;
/// Changes the sign of x.
const MINUS: usize = 19;
/// Z to the register for the inversion.
const DIVISOR: usize = 21;
/// With the inverse of Z: the point with Z = 1.
const DIVIDED: usize = 23;
/// The power squared.
const SQUARE: usize = 27;
/// The power times the base.
const TIMES: usize = 29;
/// The point plus itself.
const DOUBLE: usize = 31;
/// The sum of the two points, which may be equal ("add-2008-bbjlp" of the Explicit-Formulas
/// Database: complete, because d is not a square and -1 is one).
const PLUS: usize = 34;
/// The neutral point.
const NEUTRAL: usize = 52;

/// The progress of a [`Verification`]: the action of the next step.
#[derive(Clone, Copy, Debug)]
enum Phase {
    Fraction,
    Quotient,
    Root,
    Sum,
    Divide,
    Compare,
    Done(bool),
}

/// A verification of a signature.
#[derive(Clone, Debug)]
// Small fields come first, within reach of short instructions.
#[repr(C)]
pub struct Verification {
    phase: Phase,
    /// The number of remaining bits of an exponent.
    power: u8,
    /// The lowest bits of the exponent that are zeros.
    zeros: u8,
    /// The number of remaining bits of the factors.
    bits: u8,
    registers: [Number; 16],
    /// The points of the sum, to be multiplied by these factors.
    points: [Point; 2],
    factors: [Number; 2],
    public: Number,
    r: Number,
}

impl Verification {
    /// Space for a verification; [`start`](Self::start) starts one. This value is a verification that
    /// has ended with a bad signature. All zeros, so that it takes no flash.
    pub const IDLE: Self = Self {
        registers: [[0; 8]; 16],
        points: [[[0; 8]; 3]; 2],
        factors: [[0; 8]; 2],
        public: [0; 8],
        r: [0; 8],
        phase: Phase::Done(false),
        power: 0,
        zeros: 0,
        bits: 0,
    };

    /// Starts with a signature (R and S), the public key to check it with (A), and SHA-512 of R, A
    /// and the message. In place: the value has more than a kilobyte, which no stack has to hold.
    pub fn start(&mut self, public: &[u8; 32], signature: &[u8; 64], digest: &[u8; 64]) {
        *self = Self::IDLE;
        self.bits = 253;
        self.points = [BASE; 2];
        words(public, &mut self.public);
        words(signature, &mut self.r);
        words(&signature[32..], &mut self.factors[0]);
        let is_reduced = remainder(&self.factors[0], &L) == self.factors[0];
        self.phase = if is_reduced { Phase::Fraction } else { Phase::Done(false) };
        let mut hash = [0; 16];
        words(digest, &mut hash);
        self.factors[1] = remainder(&hash, &L);
        self.registers[1] = self.public;
        self.registers[1][7] &= !SIGN;
        self.registers[0xc] = ONE;
        // 2^256 - 38 is twice the prime.
        self.registers[0xd] = [!0; 8];
        self.registers[0xd][0] = !38;
        self.registers[0xe][0] = 121_666;
        self.registers[0xf][0] = 121_665;
    }

    /// Continues for at most about a millisecond at 168 MHz; returns the result, or `None` if there
    /// is more to do.
    pub fn step(&mut self) -> Option<bool> {
        if self.power != 0 {
            self.go_on_with_power();
            return None;
        }
        self.phase = match self.phase {
            Phase::Fraction => {
                self.run(FRACTION);
                self.invert();
                Phase::Quotient
            }
            Phase::Quotient => {
                self.run(QUOTIENT);
                // 2^252 - 3
                self.start_power(251, 0b10);
                Phase::Root
            }
            Phase::Root => {
                self.run(ROOT);
                // A or -A, whichever is needed.
                let mut encoding = self.encoding();
                if encoding == self.public {
                    self.run(MINUS);
                } else {
                    encoding[7] ^= SIGN;
                }
                self.points[1].copy_from_slice(&self.registers[..3]);
                let fits = encoding == self.public
                    && self.value(4) == self.registers[0xb]
                    && !self.has_small_order();
                self.run(NEUTRAL);
                if fits {
                    Phase::Sum
                } else {
                    Phase::Done(false)
                }
            }
            Phase::Sum => {
                self.run(DOUBLE);
                self.bits -= 1;
                for at in 0..2 {
                    let word = self.factors[at][usize::from(self.bits / 32 % 8)];
                    if word >> (self.bits % 32) & 1 != 0 {
                        self.registers[3..6].copy_from_slice(&self.points[at]);
                        self.run(PLUS);
                    }
                }
                if self.bits == 0 {
                    Phase::Divide
                } else {
                    Phase::Sum
                }
            }
            Phase::Divide => {
                self.run(DIVISOR);
                self.invert();
                Phase::Compare
            }
            Phase::Compare => {
                self.run(DIVIDED);
                Phase::Done(self.encoding() == self.r && !self.has_small_order())
            }
            Phase::Done(valid) => return Some(valid),
        };
        None
    }

    /// The encoding (RFC 8032, 5.1.2) of a point with Z = 1.
    fn encoding(&self) -> Number {
        let mut encoding = self.value(1);
        encoding[7] |= self.value(0)[0] << 31;
        encoding
    }

    /// The element of the field in a register, below 2^255 - 19.
    fn value(&self, register: usize) -> Number {
        remainder(&self.registers[register % 16], &P)
    }

    /// Whether the point times eight is the neutral one: the point times four is then the neutral
    /// one or (0, -1). Changes the point.
    fn has_small_order(&mut self) -> bool {
        self.run(DOUBLE);
        self.run(DOUBLE);
        self.value(0) == self.registers[0xb]
    }

    /// Starts to raise register 6 to 2^255 - 21, which inverts it.
    fn invert(&mut self) {
        self.start_power(254, 0b1_0100);
    }

    /// Starts to raise register 6 to a power: `bits` is the number of exponent bits without the top
    /// bit, and `zeros` marks the zeros among the lowest bits.
    fn start_power(&mut self, bits: u8, zeros: u8) {
        self.registers[7] = self.registers[6];
        self.power = bits;
        self.zeros = zeros;
    }

    fn go_on_with_power(&mut self) {
        for _ in 0..16 {
            if self.power != 0 {
                self.power -= 1;
                self.run(SQUARE);
                if self.power > 7 || self.zeros >> self.power & 1 == 0 {
                    self.run(TIMES);
                }
            }
        }
    }

    /// Computes a formula.
    #[inline(never)]
    fn run(&mut self, formula: usize) {
        for operation in FORMULAS.get(formula..).unwrap_or(&[]) {
            if *operation == 0 {
                break;
            }
            let register = |shift: u32| usize::from(*operation >> shift) % 16;
            let mut wide = [0; 16];
            wide[..8].copy_from_slice(&self.registers[register(0)]);
            for (at, factor) in self.registers[register(8)].iter().enumerate() {
                wide[at + 8] = add_product(&mut wide[at..at + 8], *factor, &self.registers[register(4)]);
            }
            let Some((sum, rest)) = wide.split_first_chunk_mut::<8>() else { return };
            let Some(high) = rest.first_chunk() else { return };
            // 2^256 equals 38.
            let mut carry = add_product(sum, 38, high);
            for _ in 0..2 {
                carry = add_product(sum, carry * 38, &self.registers[0xc]);
            }
            self.registers[register(12)] = *sum;
        }
    }
}

/// The sign of x in the last word of a point.
const SIGN: u32 = 1 << 31;

/// The remainder of a number of at least seven words, divided by a modulus between 2^224 and 2^255,
/// bit by bit.
#[inline(never)]
fn remainder(number: &[u32], modulus: &Number) -> Number {
    let mut rest = [0; 8];
    // The first seven words are less than the modulus.
    let Some((number, first)) = number.split_last_chunk::<7>() else { return rest };
    rest[..7].copy_from_slice(first);
    for word in number.iter().rev() {
        for bit in (0..32).rev() {
            let mut less = [0; 8];
            let mut carry = word >> bit & 1;
            let mut borrow = 0;
            for ((rest, less), modulus) in rest.iter_mut().zip(&mut less).zip(modulus) {
                let twice: u32 = *rest << 1 | carry;
                carry = *rest >> 31;
                *rest = twice;
                let difference = u64::from(twice).wrapping_sub(u64::from(*modulus)).wrapping_sub(borrow);
                *less = difference as u32;
                borrow = difference >> 63;
            }
            if borrow == 0 {
                rest = less;
            }
        }
    }
    rest
}
