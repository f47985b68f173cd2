//! How long a frame keeps the bus busy.

use canopen::Frame;
use embedded_can::{Frame as _, Id};

/// Bits of a frame on the wire, stuff bits included, from start of frame to the end of the three
/// bits between frames (ISO 11898-1).
pub(super) fn bits(frame: &Frame) -> u32 {
    let mut line = Stuffed::default();
    line.bits(0, 1);
    let remote = u32::from(frame.is_remote_frame());
    match frame.id() {
        Id::Standard(id) => {
            line.bits(u32::from(id.as_raw()), 11);
            // RTR, IDE, r0.
            line.bits(remote << 2, 3);
        }
        Id::Extended(id) => {
            line.bits(id.as_raw() >> 18, 11);
            // SRR and IDE are recessive.
            line.bits(0b11, 2);
            line.bits(id.as_raw() & 0x3_FFFF, 18);
            // RTR, r1, r0.
            line.bits(remote << 2, 3);
        }
    }
    line.bits(frame.dlc() as u32, 4);
    if !frame.is_remote_frame() {
        frame.data().iter().for_each(|byte| line.bits(u32::from(*byte), 8));
    }
    line.bits(u32::from(line.crc), 15);
    // The bits without stuffing: CRC delimiter, acknowledge slot and delimiter, end of frame,
    // intermission.
    line.count + 1 + 2 + 7 + 3
}

/// The part of a frame with bit stuffing: after five equal bits an opposite bit is inserted.
#[derive(Default)]
struct Stuffed {
    count: u32,
    last: Option<bool>,
    alike: u32,
    crc: u16,
}

impl Stuffed {
    /// Adds the lowest `width` bits of `value`, most significant bit first.
    fn bits(&mut self, value: u32, width: u32) {
        for place in (0..width).rev() {
            let bit = value >> place & 1 != 0;
            let flip = (self.crc >> 14 & 1 != 0) != bit;
            self.crc = self.crc << 1 & 0x7FFF ^ if flip { 0x4599 } else { 0 };
            self.bit(bit);
        }
    }

    fn bit(&mut self, bit: bool) {
        self.count += 1;
        self.alike = if self.last == Some(bit) { self.alike + 1 } else { 1 };
        self.last = Some(bit);
        if self.alike == 5 {
            // The stuff bit is the first bit of the next run.
            self.count += 1;
            self.last = Some(!bit);
            self.alike = 1;
        }
    }
}

#[cfg(test)]
mod tests {
    use embedded_can::{ExtendedId, StandardId};

    use super::*;

    fn standard(id: u16, data: &[u8]) -> u32 {
        bits(&Frame::new(StandardId::new(id).unwrap(), data).unwrap())
    }

    /// Without stuff bits, a frame with an 11-bit identifier and n bytes has 47 + 8 n bits, a frame
    /// with a 29-bit identifier 67 + 8 n. Stuffing adds at most a quarter of the bits that are
    /// subject to it (Tindell, Hansson and Wellings 1994, with the intermission included).
    #[test]
    fn a_frame_is_as_long_as_the_standard_makes_it() {
        // Neither 55h nor the identifier 555h has five equal bits in a row.
        for len in 0..=8 {
            let least = 47 + 8 * len;
            let most = least + (34 + 8 * len - 1) / 4;
            for byte in [0x00, 0x0F, 0x55, 0xFF] {
                for id in [0, 0x555, 0x7FF] {
                    let bits = standard(id, &vec![byte; len as usize]);
                    assert!((least..=most).contains(&bits), "{id:X} {byte:X} {len}: {bits}");
                }
            }
        }
        let long = Frame::new(ExtendedId::new(0x1555_5555).unwrap(), &[0x55; 8]).unwrap();
        assert!((131..=131 + (54 + 64 - 1) / 4).contains(&bits(&long)));
    }

    /// Computed by hand (long division for the CRC, 7753h): identifier 14h, one byte 01h. The bits
    /// subject to stuffing are 0 00000010100 000 0001 00000001 111011101010011: five zeros in a row
    /// are at the start of the frame, before the length, and before the last bit of the data.
    #[test]
    fn stuff_bits_are_those_of_the_frame() {
        assert_eq!(standard(0x14, &[1]), 42 + 3 + 1 + 2 + 7 + 3);
    }
}
