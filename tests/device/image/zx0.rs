//! The format of the compressed image by its description, implemented for clarity: a ZX0 stream, or
//! one with offsets in half-words, after other bytes.

/// The form of offsets in a stream.
#[derive(Clone, Copy)]
pub struct Offsets {
    /// The unit of offsets in bytes.
    unit: usize,
    /// Whether the lowest bit of the lower part's byte is the first bit of the length: whether the
    /// length is 1.
    shares_byte: bool,
}

/// The original format.
pub const BYTES: Offsets = Offsets { unit: 1, shares_byte: true };
/// The format in the bootloader.
pub const HALF_WORDS: Offsets = Offsets { unit: 2, shares_byte: false };

/// The decompressed stream, with `front` before it; `None` if it ends too early, reads missing
/// data, copies beyond the end of `front`, or continues after its end.
pub fn unpack(front: &[u8], stream: &[u8], Offsets { unit, shares_byte }: Offsets) -> Option<Vec<u8>> {
    let mut bits = Bits { stream: stream.iter(), byte: 0, left: 0 };
    let (mut out, mut offset) = (Vec::new(), 1);
    loop {
        for _ in 0..bits.number(1, false)? {
            out.push(*bits.stream.next()?);
        }
        let mut from_another = bits.bit()?;
        if !from_another {
            let length = bits.number(1, false)?;
            copy(front, &mut out, offset * unit, length)?;
            from_another = bits.bit()?;
        }
        while from_another {
            let upper = bits.number(1, true)?;
            if upper == 256 {
                return bits.stream.next().is_none().then_some(out);
            }
            let lower = usize::from(*bits.stream.next()?);
            let length = if shares_byte {
                offset = upper * 128 - lower / 2;
                if lower % 2 == 1 {
                    1
                } else {
                    bits.digits(1, false)?
                }
            } else {
                offset = upper * 256 - lower;
                bits.number(1, false)?
            };
            copy(front, &mut out, offset * unit, length + 1)?;
            from_another = bits.bit()?;
        }
    }
}

fn copy(front: &[u8], out: &mut Vec<u8>, offset: usize, length: usize) -> Option<()> {
    if let Some(before) = offset.checked_sub(out.len()).filter(|before| *before > 0) {
        let from = front.len().checked_sub(before)?;
        out.extend(front.get(from..from + length)?);
        return Some(());
    }
    for _ in 0..length {
        out.push(*out.get(out.len().checked_sub(offset)?)?);
    }
    Some(())
}

struct Bits<'s> {
    stream: std::slice::Iter<'s, u8>,
    byte: u8,
    left: u32,
}

impl Bits<'_> {
    fn bit(&mut self) -> Option<bool> {
        if self.left == 0 {
            (self.byte, self.left) = (*self.stream.next()?, 8);
        }
        self.left -= 1;
        Some(self.byte >> self.left & 1 == 1)
    }

    /// An interlaced Elias gamma code.
    fn number(&mut self, so_far: usize, inverted: bool) -> Option<usize> {
        if self.bit()? {
            return Some(so_far);
        }
        self.digits(so_far, inverted)
    }

    /// The same with a leading 0.
    fn digits(&mut self, so_far: usize, inverted: bool) -> Option<usize> {
        let digit = self.bit()? != inverted;
        self.number(so_far.checked_mul(2)? + usize::from(digit), inverted)
    }
}
