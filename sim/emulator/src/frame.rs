//! Classical CAN frames and the bits they become on the wire (ISO 11898-1:2015, clauses 10.4 and
//! 10.5).

use std::fmt;

pub use embedded_can::{ExtendedId, Id, StandardId};

/// Bits after the CRC sequence that carry no stuff bits: CRC delimiter, ACK slot, ACK delimiter,
/// end of frame.
const TAIL_BITS: u32 = 1 + 1 + 1 + END_OF_FRAME_BITS;
/// End of frame: seven recessive bits.
pub const END_OF_FRAME_BITS: u32 = 7;
/// Intermission between two frames: three recessive bits.
pub const INTERMISSION_BITS: u32 = 3;
/// A sixth equal bit in a row never leaves a transmitter: it inserts the opposite bit after five.
pub const STUFF_WIDTH: u32 = 5;

/// The most data bytes of a frame: a data length code of 9 to 15 means eight, too (ISO 11898-1:2015,
/// table 5).
const MOST_DATA: u8 = 8;

/// A data or remote frame with 11- or 29-bit identifier.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub struct Frame {
    id: Id,
    remote: bool,
    /// As on the wire, 0 to 15.
    dlc: u8,
    data: [u8; 8],
}

impl Frame {
    /// A data frame; `None` for more than eight bytes.
    #[must_use]
    pub fn data_frame(id: Id, data: &[u8]) -> Option<Self> {
        let mut frame = Self { id, remote: false, dlc: u8::try_from(data.len()).ok()?, data: [0; 8] };
        frame.data.get_mut(..data.len())?.copy_from_slice(data);
        Some(frame)
    }

    /// A remote frame with this data length code; `None` for more than 15.
    #[must_use]
    pub fn remote_frame(id: Id, dlc: u8) -> Option<Self> {
        (dlc <= 15).then_some(Self { id, remote: true, dlc, data: [0; 8] })
    }

    /// The same frame with another data length code; `None` for more than 15, or if that means another
    /// number of data bytes.
    #[must_use]
    pub fn with_dlc(self, dlc: u8) -> Option<Self> {
        let same = self.remote || usize::from(dlc.min(MOST_DATA)) == self.data().len();
        (dlc <= 15 && same).then_some(Self { dlc, ..self })
    }

    /// A data frame with an 11-bit identifier; `None` if the identifier needs more bits, or for
    /// more than eight bytes.
    #[must_use]
    pub fn standard(id: u16, data: &[u8]) -> Option<Self> {
        Self::data_frame(Id::Standard(StandardId::new(id)?), data)
    }

    /// A data frame with a 29-bit identifier; `None` if the identifier needs more bits, or for more
    /// than eight bytes.
    #[must_use]
    pub fn extended(id: u32, data: &[u8]) -> Option<Self> {
        Self::data_frame(Id::Extended(ExtendedId::new(id)?), data)
    }

    /// The identifier.
    #[must_use]
    pub fn id(&self) -> Id {
        self.id
    }

    /// The identifier's number, without saying whether it has 11 or 29 bits.
    #[must_use]
    pub fn raw_id(&self) -> u32 {
        match self.id {
            Id::Standard(id) => u32::from(id.as_raw()),
            Id::Extended(id) => id.as_raw(),
        }
    }

    /// Whether the identifier has 29 bits.
    #[must_use]
    pub fn is_extended(&self) -> bool {
        matches!(self.id, Id::Extended(_))
    }

    /// Whether it asks for data instead of carrying some.
    #[must_use]
    pub fn is_remote(&self) -> bool {
        self.remote
    }

    /// The data length code as on the wire, 0 to 15.
    #[must_use]
    pub fn dlc(&self) -> u8 {
        self.dlc
    }

    /// The data; empty in a remote frame.
    #[must_use]
    pub fn data(&self) -> &[u8] {
        let len = if self.remote { 0 } else { usize::from(self.dlc.min(MOST_DATA)) };
        &self.data[..len]
    }

    /// The same frame with other bits in one data byte; unchanged where it has no such byte.
    #[must_use]
    pub fn with_flipped_bits(mut self, byte: usize, mask: u8) -> Self {
        if byte < self.data().len() {
            self.data[byte] ^= mask;
        }
        self
    }

    /// The arbitration field as a number that compares like the field on the wire: the smaller one
    /// wins the bus.
    ///
    /// Bits from the first sent on: 11 identifier bits; RTR and IDE of a standard frame, or SRR and
    /// IDE (both recessive), 18 identifier bits and RTR of an extended one. A standard frame wins
    /// over an extended frame that begins with the same 11 bits, a data frame over the remote frame
    /// of the same identifier.
    #[must_use]
    pub fn arbitration_key(&self) -> u32 {
        let remote = u32::from(self.remote);
        match self.id {
            Id::Standard(id) => u32::from(id.as_raw()) << 21 | remote << 20,
            Id::Extended(id) => {
                let (base, rest) = (id.as_raw() >> 18, id.as_raw() & 0x3_FFFF);
                base << 21 | 0b11 << 19 | rest << 1 | remote
            }
        }
    }

    /// The bits from the start of frame to the end of the data field, without stuff bits (`true` is
    /// recessive).
    fn head(&self) -> Vec<bool> {
        let mut bits = Vec::with_capacity(128);
        let mut put = |value: u32, count: u32| {
            bits.extend((0..count).rev().map(|n| value >> n & 1 == 1));
        };
        put(0, 1); // start of frame
        let remote = u32::from(self.remote);
        match self.id {
            Id::Standard(id) => {
                put(u32::from(id.as_raw()), 11);
                put(remote, 1);
                put(0, 2); // IDE, reserved (FDF)
            }
            Id::Extended(id) => {
                put(id.as_raw() >> 18, 11);
                put(0b11, 2); // SRR, IDE
                put(id.as_raw() & 0x3_FFFF, 18);
                put(remote, 1);
                put(0, 2); // reserved (FDF), r0
            }
        }
        put(u32::from(self.dlc), 4);
        for byte in self.data() {
            put(u32::from(*byte), 8);
        }
        bits
    }

    /// The 15-bit CRC sequence of the frame.
    #[must_use]
    pub fn crc15(&self) -> u16 {
        crc15(&self.head())
    }

    /// Every bit of the frame as it is sent, from the start of frame to the last bit of the end of
    /// frame (`true` is recessive). The ACK slot holds what the transmitter sends there: recessive.
    #[must_use]
    pub fn wire_bits(&self) -> Vec<bool> {
        let mut bits = self.head();
        let crc = crc15(&bits);
        bits.extend((0..15).rev().map(|n| crc >> n & 1 == 1));
        let mut wire = Vec::with_capacity(160);
        let (mut last, mut run) = (true, 0);
        for bit in bits {
            wire.push(bit);
            run = if bit == last { run + 1 } else { 1 };
            last = bit;
            if run == STUFF_WIDTH {
                wire.push(!bit);
                (last, run) = (!bit, 1);
            }
        }
        wire.extend((0..TAIL_BITS).map(|_| true));
        wire
    }

    /// Length on the wire in bits, from the start of frame to the last bit of the end of frame,
    /// stuff bits included, intermission not.
    #[must_use]
    pub fn wire_len(&self) -> u32 {
        u32::try_from(self.wire_bits().len()).unwrap_or(u32::MAX)
    }

    /// The bits that the frame occupies on the bus: [`wire_len`](Self::wire_len) and the
    /// intermission after it.
    #[must_use]
    pub fn bus_bits(&self) -> u32 {
        self.wire_len() + INTERMISSION_BITS
    }
}

/// CRC sequence over unstuffed bits: polynomial x^15+x^14+x^10+x^8+x^7+x^4+x^3+1, start value 0
/// (ISO 11898-1:2015, 10.4.2.6).
fn crc15(bits: &[bool]) -> u16 {
    bits.iter().fold(0, |crc: u16, &bit| {
        let next = bit != (crc >> 14 & 1 == 1);
        let shifted = crc << 1 & 0x7FFF;
        if next {
            shifted ^ 0x4599
        } else {
            shifted
        }
    })
}

/// Where the tail of a frame of `wire_len` bits begins to matter: the first bit after the ACK
/// slot.
#[must_use]
pub fn ack_delimiter(wire_len: u32) -> u32 {
    wire_len - END_OF_FRAME_BITS - 1
}

impl fmt::Display for Frame {
    /// As candump's log writes it: `601#4000100000000000`, `00000123#` with 29 bits, `601#R8` for a
    /// remote frame; `_F` at the end is a data length code above 8.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.id {
            Id::Standard(id) => write!(f, "{:03X}#", id.as_raw())?,
            Id::Extended(id) => write!(f, "{:08X}#", id.as_raw())?,
        }
        if self.remote {
            f.write_str("R")?;
            if self.dlc > 0 {
                write!(f, "{}", self.dlc.min(MOST_DATA))?;
            }
        }
        self.data().iter().try_for_each(|byte| write!(f, "{byte:02X}"))?;
        if self.dlc > MOST_DATA {
            write!(f, "_{:X}", self.dlc)?;
        }
        Ok(())
    }
}

impl fmt::Debug for Frame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Frame({self})")
    }
}

impl embedded_can::Frame for Frame {
    fn new(id: impl Into<Id>, data: &[u8]) -> Option<Self> {
        Self::data_frame(id.into(), data)
    }
    fn new_remote(id: impl Into<Id>, dlc: usize) -> Option<Self> {
        Self::remote_frame(id.into(), u8::try_from(dlc).ok()?)
    }
    fn is_extended(&self) -> bool {
        self.is_extended()
    }
    fn is_remote_frame(&self) -> bool {
        self.remote
    }
    fn id(&self) -> Id {
        self.id
    }
    fn dlc(&self) -> usize {
        usize::from(self.dlc.min(MOST_DATA))
    }
    fn data(&self) -> &[u8] {
        self.data()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wire(frame: &Frame) -> String {
        frame.wire_bits().iter().map(|&bit| if bit { '1' } else { '0' }).collect()
    }

    #[test]
    fn all_dominant_frame_without_data() {
        // 1 + 11 + 1 + 1 + 1 + 4 dominant bits, CRC 0 (15 dominant bits): 34 in a row, a recessive
        // stuff bit after every five of them; then the ten unstuffed recessive bits.
        let frame = Frame::standard(0, &[]).unwrap();
        assert_eq!(frame.crc15(), 0);
        assert_eq!(wire(&frame), format!("{}0000{}", "000001".repeat(6), "1".repeat(10)));
        assert_eq!(frame.wire_len(), 34 + 6 + 10);
        assert_eq!(frame.bus_bits(), 53);
    }

    #[test]
    fn frames_worked_out_apart() {
        // CRC by polynomial long division and stuffing by a few lines of Python that share nothing
        // with this code.
        let zeros = Frame::standard(0, &[0; 8]).unwrap();
        assert_eq!((zeros.crc15(), zeros.wire_len()), (0x145B, 124));
        // SOF to r0 and the DLC's first bits: 15 dominant, three stuff bits; the DLC's 1 follows
        // the third.
        assert!(wire(&zeros).starts_with("0000010000010000011000001"));
        let read_1000 = Frame::standard(0x601, &[0x40, 0, 0x10, 0, 0, 0, 0, 0]).unwrap();
        assert_eq!((read_1000.crc15(), read_1000.wire_len()), (0x191A, 121));
        let boot_up = Frame::standard(0x701, &[0]).unwrap();
        assert_eq!((boot_up.crc15(), boot_up.wire_len()), (0x5058, 56));
        assert_eq!(wire(&boot_up), "01110000010010000010100000100010100000110110001111111111");
        let sync = Frame::standard(0x80, &[]).unwrap();
        assert_eq!((sync.crc15(), sync.wire_len()), (0x1C05, 48));
        let long = Frame::extended(0x1FFF_FFFF, &[0xFF; 8]).unwrap();
        assert_eq!((long.crc15(), long.wire_len()), (0x1B69, 146));
        for (dlc, crc, wire_len) in [(9, 0x3244, 121), (15, 0x0C19, 122)] {
            let frame = read_1000.with_dlc(dlc).unwrap();
            assert_eq!((frame.crc15(), frame.wire_len(), frame.data()), (crc, wire_len, read_1000.data()));
        }
    }

    #[test]
    fn crc_by_long_division() {
        // A lone 1 as the last bit is the generator without its x^15; eight bits before the end it
        // is x^23 mod g = 0x4599 shifted eight times: 4599 -> 4EAB -> 58CF -> 7407 -> 2D97 -> 5B2E
        // -> 73C5 -> 2213 -> 4426.
        let mut bits = vec![false; 40];
        bits[39] = true;
        assert_eq!(crc15(&bits), 0x4599);
        bits[39] = false;
        bits[31] = true;
        assert_eq!(crc15(&bits), 0x4426);
        // ID 0, DLC 1, data 00 is exactly that bit pattern.
        assert_eq!(Frame::standard(0, &[0]).unwrap().crc15(), 0x4426);
    }

    #[test]
    fn no_stuff_bits_in_an_alternating_head() {
        // 555h: SOF 0, 101 0101 0101, RTR 0, IDE 0, r0 0, DLC 0000. The run 0000000 after the last
        // identifier bit takes one stuff bit after five.
        let frame = Frame::standard(0x555, &[]).unwrap();
        assert!(wire(&frame).starts_with("0101010101010000010"), "{}", wire(&frame));
    }

    #[test]
    fn lengths_stay_in_the_standards_bounds() {
        // n data bytes: 44 + 8n bits without the intermission and without stuff bits (64 + 8n with
        // 29 bits); of those 34 + 8n (54 + 8n) can be stuffed, at worst one stuff bit for the first
        // five and one for every four after them.
        let mut seed = 0x1234_5678_u32;
        let mut next = || {
            seed ^= seed << 13;
            seed ^= seed >> 17;
            seed ^= seed << 5;
            seed
        };
        let sparse = [0x00, 0xFF, 0x3C, 0xC3, 0x87, 0x78, 0x0F, 0xF0];
        for round in 0..20_000_u32 {
            let len = (round % 9) as usize;
            let data: Vec<u8> = (0..len).map(|_| sparse[(next() >> 7) as usize % 8]).collect();
            for (frame, head) in [
                (Frame::standard((next() & 0x7FF) as u16, &data).unwrap(), 34),
                (Frame::extended(next() & 0x1FFF_FFFF, &data).unwrap(), 54),
            ] {
                let stuffable = head + 8 * len as u32;
                let shortest = stuffable + 10;
                assert!((shortest..=shortest + (stuffable - 1) / 4).contains(&frame.wire_len()), "{frame}");
                assert!(!wire(&frame)[..frame.wire_len() as usize - 10].contains("000000"));
                assert!(!wire(&frame)[..frame.wire_len() as usize - 10].contains("111111"));
            }
        }
        assert_eq!(8 * 8 + 44 + (34 + 8 * 8 - 1) / 4, 132); // and 3 of intermission: the well-known 135
    }

    #[test]
    fn arbitration_order() {
        let standard = |id| Frame::standard(id, &[]).unwrap();
        let extended = |id| Frame::extended(id, &[]).unwrap();
        let remote = Frame::remote_frame(Id::Standard(StandardId::new(0x181).unwrap()), 8).unwrap();
        // From the strongest to the weakest.
        let order = [
            standard(0x000),
            standard(0x080),
            extended(0x080 << 18),
            extended((0x080 << 18) + 1),
            standard(0x181),
            remote,
            extended(0x181 << 18),
            standard(0x7FF),
            extended(0x1FFF_FFFF),
        ];
        for pair in order.windows(2) {
            assert!(pair[0].arbitration_key() < pair[1].arbitration_key(), "{pair:?}");
        }
    }

    #[test]
    fn text() {
        assert_eq!(
            Frame::standard(0x601, &[0x40, 0, 0x10, 0, 0, 0, 0, 0]).unwrap().to_string(),
            "601#4000100000000000"
        );
        assert_eq!(Frame::standard(0x80, &[]).unwrap().to_string(), "080#");
        assert_eq!(Frame::extended(0x80, &[0xAB]).unwrap().to_string(), "00000080#AB");
        let id = Id::Standard(StandardId::new(0x701).unwrap());
        assert_eq!(Frame::remote_frame(id, 0).unwrap().to_string(), "701#R");
        assert_eq!(Frame::remote_frame(id, 1).unwrap().to_string(), "701#R1");
        // can-utils, lib.h: `123#R8_E`, `333#1122334455667788_E`.
        assert_eq!(Frame::remote_frame(id, 14).unwrap().to_string(), "701#R8_E");
        let long = Frame::standard(0x333, &[0x11; 8]).unwrap().with_dlc(14).unwrap();
        assert_eq!(long.to_string(), "333#1111111111111111_E");
    }

    #[test]
    fn what_does_not_fit_is_refused() {
        assert!(Frame::standard(0x800, &[]).is_none());
        assert!(Frame::extended(0x2000_0000, &[]).is_none());
        assert!(Frame::standard(1, &[0; 9]).is_none());
        assert!(Frame::remote_frame(Id::Standard(StandardId::ZERO), 16).is_none());
        for (len, dlc) in [(8, 16), (8, 7), (7, 9)] {
            assert_eq!(Frame::standard(1, &[0; 8][..len]).unwrap().with_dlc(dlc), None);
        }
        assert!(Frame::standard(1, &[0; 300]).is_none());
    }
}
