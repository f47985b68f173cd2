//! The RAM image of a bootloader, which lies packed in its flash (`shared_abi::ram_image`): what the
//! bootloader can do is in there.

use shared_abi::ram_image::{Header, Method, MAGIC, SERVICES_VERSION};

use crate::file::block_file::CRC;

/// More RAM than any STM32F4 has.
const MOST: u32 = 1 << 20;
/// Bytes of the header.
const HEADER: usize = Header::SIZE as usize;
/// In place of the upper part of an offset: the end of the stream.
const END: u32 = 256;

/// The RAM image in a bootloader's flash; `None` where there is none, or a damaged one.
pub(super) fn unpacked(flash: &[u8]) -> Option<Vec<u8>> {
    // Code may hold the header's first word, too: the CRC tells which is one.
    (0..flash.len().saturating_sub(HEADER - 1)).step_by(4).find_map(|at| unpacked_at(flash, at))
}

/// The same, if its header stands there.
fn unpacked_at(flash: &[u8], at: usize) -> Option<Vec<u8>> {
    let (front, rest) = flash.split_at_checked(at)?;
    let (words, stored) = rest.split_at_checked(HEADER)?;
    let word = |number: usize| seal::wire::word(words, 4 * number);
    let header = Header {
        magic: word(0),
        crc: word(1),
        services: word(2),
        method: word(3),
        stored: word(4),
        unpacked: word(5),
    };
    if header.magic != MAGIC {
        return None;
    }
    // Whichever version it has of what concerns itself alone.
    let method = Header { services: SERVICES_VERSION, ..header }.check(stored.len() as u32, MOST).ok()?;
    let stored = stored.get(..header.stored as usize)?;
    let mut crc = CRC.digest();
    [front, &words[Header::CRC_FROM as usize..], stored].into_iter().for_each(|part| crc.update(part));
    if header.has_crc() && crc.finalize() != header.crc {
        return None;
    }
    match method {
        Method::Raw => Some(stored.to_vec()),
        Method::Zx0 => zx0(front, stored, header.unpacked as usize),
    }
}

/// What is left of a stream: bytes, and bits that stand in bytes between them.
struct Stream<'s> {
    bytes: std::slice::Iter<'s, u8>,
    bits: u8,
    left: u8,
}

impl Stream<'_> {
    fn byte(&mut self) -> Option<u8> {
        self.bytes.next().copied()
    }

    fn bit(&mut self) -> Option<u32> {
        if self.left == 0 {
            (self.bits, self.left) = (self.byte()?, 8);
        }
        self.left -= 1;
        Some(u32::from(self.bits >> self.left & 1))
    }

    /// An interlaced Elias gamma code, whose digits are inverted by this.
    fn number(&mut self, inverted: u32) -> Option<u32> {
        let mut number: u32 = 1;
        while self.bit()? == 0 {
            number = number.checked_mul(2)? | self.bit()? ^ inverted;
        }
        Some(number)
    }
}

/// Unpacks a stream to `size` bytes (`shared_abi::ram_image::Method::Zx0`); calls are left absolute.
/// It comes to an end: every step takes from the stream.
fn zx0(front: &[u8], packed: &[u8], size: usize) -> Option<Vec<u8>> {
    let mut stream = Stream { bytes: packed.iter(), bits: 0, left: 0 };
    let mut out = Vec::with_capacity(size);
    let mut offset = 2;
    let mut is_literals = true;
    loop {
        if is_literals {
            for _ in 0..stream.number(0)? {
                out.push(stream.byte()?);
            }
        }
        let is_another = stream.bit()? == 1;
        let length = match (is_literals, is_another) {
            (true, false) => stream.number(0)?,
            // Literals behind a copy.
            (false, false) => {
                is_literals = true;
                continue;
            }
            (_, true) => {
                let upper = stream.number(1)?;
                if upper == END {
                    return (stream.bytes.len() == 0 && out.len() == size).then_some(out);
                }
                let units = upper.checked_mul(256)? - u32::from(stream.byte()?);
                offset = units.checked_mul(2)? as usize;
                stream.number(0)?.checked_add(1)?
            }
        };
        is_literals = false;
        if length as usize > size.checked_sub(out.len())? {
            return None;
        }
        for _ in 0..length {
            let byte = match out.len().checked_sub(offset) {
                Some(from) => *out.get(from)?,
                None => *front.get((front.len() + out.len()).checked_sub(offset)?)?,
            };
            out.push(byte);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Streams made by hand, bit by bit, from the format's description.
    #[test]
    fn streams_are_unpacked() {
        // Two literals, a copy of two from the last offset, the end.
        assert_eq!(zx0(b"", b"\x23AB\x55\x55\x80", 4).unwrap(), b"ABAB");
        // Four literals, a copy of four from an offset of four.
        assert_eq!(zx0(b"", b"\x0EABCD\xFE\xEA\xAA\xB0", 8).unwrap(), b"ABCDABCD");
        // Two literals, a copy of two from in front of the output.
        assert_eq!(zx0(b"WXYZ", b"\x3EAB\xFE\xAA\xAB", 4).unwrap(), b"ABYZ");
        assert_eq!(zx0(b"Z", b"\x3EAB\xFE\xAA\xAB", 4), None);
        for end in 0..6 {
            assert_eq!(zx0(b"WXYZ", &b"\x3EAB\xFE\xAA\xAB"[..end], 4), None);
        }
        for size in [0, 1, 3, 5] {
            assert_eq!(zx0(b"WXYZ", b"\x3EAB\xFE\xAA\xAB", size), None);
        }
        assert_eq!(zx0(b"WXYZ", b"\x3EAB\xFE\xAA\xAB\0", 4), None);
        assert_eq!(zx0(b"", &[0; 100], 1000), None);
    }

    /// A bootloader's flash: what is in front, the header, and the stream.
    fn flash(front: &[u8], method: u32, stored: &[u8], size: u32) -> Vec<u8> {
        let words = [SERVICES_VERSION, method, stored.len() as u32, size].map(u32::to_le_bytes).concat();
        let crc = CRC.checksum(&[front, &words, stored].concat());
        [front, b"CBI1", &crc.to_le_bytes(), &words, stored].concat()
    }

    #[test]
    fn the_image_is_found_by_its_crc() {
        let packed = b"\x3EAB\xFE\xAA\xAB";
        // The first word of a header that is none stands in front of it.
        let good = flash(b"CBI1WXYZ", 1, packed, 4);
        assert_eq!(unpacked(&good).unwrap(), b"ABYZ");
        assert_eq!(unpacked(&[&good[..], &[0xFF; 100]].concat()).unwrap(), b"ABYZ");
        assert_eq!(unpacked(&flash(b"", 0, b"ABCD", 4)).unwrap(), b"ABCD");
        for at in 0..good.len() {
            let mut wrong = good.clone();
            wrong[at] ^= 1;
            assert_eq!(unpacked(&wrong), None, "{at}");
            assert_eq!(unpacked(&good[..at]), None);
        }
        assert_eq!(unpacked(&flash(b"", 1, packed, MOST + 1)), None);
        assert_eq!(unpacked(&flash(b"", 2, packed, 4)), None);
    }
}
