//! Intel HEX from the bus: processed byte by byte, independent of the segments of the transfer
//! (Intel, "Hexadecimal Object File Format Specification", revision A, 1988).
//!
//! Between records there may be line ends of any kind and blanks. Only the header of a record is
//! stored: the owner takes the data as they arrive, and must not use them before [`Event::Good`].

use canopen::program::FlashError;
use canopen::AbortCode;

use super::format::{Destination, Format, Recognition};
use super::stream::Stream;
use crate::choices::Choices;
use crate::policy::Judge;
use crate::queue::{Queue, PIECE_HEADER};
use crate::refusal::Refusal;

/// A program in Intel HEX.
pub(super) struct IntelHex {
    reader: Hex,
    stream: Stream,
}

impl Format for IntelHex {
    const IS_STREAM: bool = true;

    fn is_taken<C: Choices>() -> bool {
        C::INTEL_HEX
    }

    fn recognise(first: &[u8], judge: &Judge<'_>) -> Recognition<Self> {
        if first.first() == Some(&b':') && !judge.is_data() {
            Recognition::Yes(Self { reader: Hex::new(), stream: Stream::new(judge) })
        } else {
            Recognition::No
        }
    }

    fn begin(&mut self, _size: Option<u32>, judge: &Judge<'_>, _queue: &Queue<'_>) -> Result<(), Refusal> {
        judge.may_begin(true)
    }

    fn data(&mut self, bytes: &[u8], to: &mut Destination<'_, '_>) -> Result<(), Refusal> {
        for character in bytes {
            match self.reader.push(*character)? {
                Event::Nothing => {}
                // The queue must have room for a whole record beside the piece that it belongs to.
                Event::Data { size, .. } if size as usize + 4 * PIECE_HEADER > to.queue.capacity() / 2 => {
                    return Err(Refusal(FlashError::Format, AbortCode::OUT_OF_MEMORY));
                }
                Event::Data { address, size } => {
                    self.stream.seek(address, to)?;
                    self.stream.check_place(size, &to.judge)?;
                }
                Event::Byte(byte) => self.stream.append(&[byte], to)?,
                Event::Good => self.stream.close_if_full(to)?,
            }
        }
        Ok(())
    }

    fn end(&mut self, to: &mut Destination<'_, '_>) -> Result<(), Refusal> {
        if !self.reader.has_ended() {
            return Err(Refusal::unfit(FlashError::Format));
        }
        self.stream.end(to)
    }
}

/// The result of a byte.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Event {
    Nothing,
    /// A data record begins: the address and the number of its data.
    Data {
        address: u32,
        size: u32,
    },
    /// A byte of the data.
    Byte(u8),
    /// The data record is complete, and its checksum is right.
    Good,
}

/// The state of the parser.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Hex {
    /// The base of the 16-bit offsets of data records.
    base: u32,
    /// The base comes from record type 02: data must stay inside its 64 KiB.
    segment: bool,
    place: Place,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Place {
    Between,
    Within(Record),
    /// After the EOF record.
    End,
}

/// A record, as far as it has arrived.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Record {
    /// The first digit of a byte.
    digit: Option<u8>,
    /// The number of bytes that have arrived.
    len: u16,
    /// The sum of all bytes, modulo 256; 0 after the checksum.
    sum: u8,
    /// Length of the data, offset (2), type.
    header: [u8; HEADER],
    /// The last four bytes of data.
    value: u32,
}

const HEADER: usize = 4;

/// Record types.
const DATA: u8 = 0;
const END_OF_FILE: u8 = 1;
const SEGMENT_BASE: u8 = 2;
const SEGMENT_START: u8 = 3;
const LINEAR_BASE: u8 = 4;
const LINEAR_START: u8 = 5;

impl Hex {
    const fn new() -> Self {
        Self { base: 0, segment: true, place: Place::Between }
    }

    /// Whether the EOF record has arrived.
    fn has_ended(&self) -> bool {
        self.place == Place::End
    }

    /// Takes the next character.
    fn push(&mut self, character: u8) -> Result<Event, Refusal> {
        let malformed = Refusal::unfit(FlashError::Format);
        let Place::Within(record) = &mut self.place else {
            match (character, self.place) {
                (b'\r' | b'\n' | b' ' | b'\t' | 0 | 0x1A, _) => {}
                (b':', Place::Between) => {
                    let record = Record { digit: None, len: 0, sum: 0, header: [0; HEADER], value: 0 };
                    self.place = Place::Within(record);
                }
                _ => return Err(malformed),
            }
            return Ok(Event::Nothing);
        };
        let digit = (character as char).to_digit(16).ok_or(malformed)? as u8;
        let Some(high) = record.digit.take() else {
            record.digit = Some(digit);
            return Ok(Event::Nothing);
        };
        let byte = high << 4 | digit;
        let at = usize::from(record.len);
        record.len += 1;
        record.sum = record.sum.wrapping_add(byte);
        if let Some(place) = record.header.get_mut(at) {
            *place = byte;
            if at + 1 < HEADER {
                return Ok(Event::Nothing);
            }
        }
        let [size, high, low, kind] = record.header;
        let offset = u32::from(u16::from_be_bytes([high, low]));
        let size = u32::from(size);
        if at + 1 == HEADER {
            let fits = match kind {
                DATA => !self.segment || offset + size <= 0x1_0000,
                END_OF_FILE => size == 0,
                SEGMENT_BASE | LINEAR_BASE => size == 2,
                // Start addresses are not used: the vector table contains the start.
                SEGMENT_START | LINEAR_START => size == 4,
                _ => false,
            };
            return match (fits, kind) {
                (false, _) => Err(malformed),
                (true, DATA) => Ok(Event::Data { address: self.base + offset, size }),
                (true, _) => Ok(Event::Nothing),
            };
        }
        if at < HEADER + size as usize {
            record.value = record.value << 8 | u32::from(byte);
            return Ok(if kind == DATA { Event::Byte(byte) } else { Event::Nothing });
        }
        if record.sum != 0 {
            return Err(Refusal::unfit(FlashError::Crc));
        }
        let value = record.value;
        self.place = if kind == END_OF_FILE { Place::End } else { Place::Between };
        match kind {
            DATA => return Ok(Event::Good),
            SEGMENT_BASE => (self.base, self.segment) = (value << 4, true),
            LINEAR_BASE => (self.base, self.segment) = (value << 16, false),
            _ => {}
        }
        Ok(Event::Nothing)
    }
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::*;
    use std::vec::Vec;

    type Records = Vec<(u32, Vec<u8>)>;

    /// The contents of a text: the data by address, and whether the EOF record was there.
    fn read(text: &str) -> Result<(Records, bool), FlashError> {
        let mut hex = Hex::new();
        let mut records = Records::new();
        let mut good = 0;
        for character in text.bytes() {
            match hex.push(character).map_err(|Refusal(error, _)| error)? {
                Event::Nothing => {}
                Event::Data { address, .. } => records.push((address, Vec::new())),
                Event::Byte(byte) => records.last_mut().unwrap().1.push(byte),
                Event::Good => good += 1,
            }
        }
        records.truncate(good);
        Ok((records, hex.has_ended()))
    }

    /// The best-known example (Wikipedia "Intel HEX", from the specification).
    const EXAMPLE: &str = ":10010000214601360121470136007EFE09D2190140";

    #[test]
    fn a_data_record() {
        let data = [0x21, 0x46, 0x01, 0x36, 1, 0x21, 0x47, 1, 0x36, 0, 0x7E, 0xFE, 9, 0xD2, 0x19, 1];
        assert_eq!(read(EXAMPLE), Ok(([(0x100, data.to_vec())].to_vec(), false)));
        assert_eq!(read(&EXAMPLE.to_lowercase()), read(EXAMPLE));
    }

    /// Checksums computed by hand: two's complement of 02+02+12+34 = 4A, 02+04+08+01 = 0F, and so
    /// on.
    #[test]
    fn base_records_move_what_follows_and_start_records_do_nothing() {
        let text = ":020000021234B6\r\n:0100100001EE\r:020000040801F1 \n\n:0100200002DD\n\
            :0400000308010000F0\n:040000050801018964\n:00000001FF\r\n\x1A";
        assert_eq!(read(text), Ok(([(0x1_2350, [1].to_vec()), (0x0801_0020, [2].to_vec())].to_vec(), true)));
    }

    #[test]
    fn what_is_no_record_is_refused() {
        let cases = [
            ("x", FlashError::Format),
            (":0G", FlashError::Format),
            (":01 0", FlashError::Format),
            (&EXAMPLE.replace("40", "41"), FlashError::Crc),
            // Unknown types, and lengths that do not belong to the type.
            (":00000006FA", FlashError::Format),
            (":000000FF01", FlashError::Format),
            (":0100000100FE", FlashError::Format),
            (":0100000408F3", FlashError::Format),
            (":0300000500010203", FlashError::Format),
            // Beyond the end of its segment: FFFFh and two bytes.
            (":02FFFF0000", FlashError::Format),
            // After the end.
            (":00000001FF\n:", FlashError::Format),
            (":00000001FFF", FlashError::Format),
        ];
        for (text, error) in cases {
            assert_eq!(read(text), Err(error), "{text}");
        }
        assert_eq!(read(&EXAMPLE[..EXAMPLE.len() - 1]), Ok((Vec::new(), false)), "not complete");
    }
}
