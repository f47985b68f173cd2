//! Intel HEX (Intel, "Hexadecimal Object File Format Specification", revision A, 1988).

use super::fault::{Cause, Place, ReadError};
use super::foreign::UNIVERSAL_HEX;
use super::image::{Image, Pieces};
use super::text::{bytes_of, check_length, lines};

/// The base address for the 16-bit offsets of data records.
#[derive(Clone, Copy)]
enum Base {
    /// Segment base address (record 02; 0 before any base record): data must stay inside its 64
    /// KiB.
    Segment(u32),
    /// Upper half of a linear address (record 04).
    Linear(u32),
}

/// Parses a whole file.
///
/// # Errors
/// The first fault, with its line.
pub fn read(bytes: &[u8]) -> Result<Image, ReadError> {
    let mut base = Base::Segment(0);
    let mut pieces = Pieces::default();
    let mut ended = false;
    for (place, line) in lines(bytes) {
        if ended {
            return Err(place.fault(Cause::AfterEnd));
        }
        let (offset, kind, data) = record(place, line)?;
        match kind {
            0x00 => pieces.add(address(base, offset, data.len(), place)?, data, place),
            0x01 => {
                expect_length(&data, 0, place)?;
                ended = true;
            }
            0x02 => base = Base::Segment(number(&data, 2, place)? << 4),
            0x04 => base = Base::Linear(number(&data, 2, place)? << 16),
            // Start addresses: a device starts through its vector table, so these records are
            // checked and ignored.
            0x03 | 0x05 => expect_length(&data, 4, place)?,
            0x0A..=0x0E => return Err(place.fault(Cause::Foreign(UNIVERSAL_HEX))),
            _ => return Err(place.fault(Cause::UnknownRecord(format!("{kind:02X}")))),
        }
    }
    if !ended {
        return Err(Place::File.fault(Cause::NoEnd("its end record (:00000001FF)")));
    }
    pieces.into_image()
}

/// Offset, type and data of one line.
fn record(place: Place, line: &[u8]) -> Result<(u16, u8, Vec<u8>), ReadError> {
    let digits =
        line.strip_prefix(b":").ok_or(place.fault(Cause::Malformed("the line does not begin with ':'")))?;
    let bytes = bytes_of(digits, 1, place)?;
    // Length, offset (2), type, data, checksum.
    let needed = 5 + bytes.first().copied().map_or(0, usize::from);
    check_length(bytes.len(), needed, place)?;
    let (body, found) = (&bytes[..needed - 1], bytes[needed - 1]);
    let sum = body.iter().fold(0u8, |sum, byte| sum.wrapping_add(*byte)).wrapping_neg();
    if sum != found {
        return Err(place.fault(Cause::Checksum { found, needed: sum }));
    }
    Ok((u16::from_be_bytes([body[1], body[2]]), body[3], body[4..].to_vec()))
}

fn address(base: Base, offset: u16, len: usize, place: Place) -> Result<u32, ReadError> {
    let end = u64::from(offset) + len as u64;
    let (address, fits, what) = match base {
        Base::Segment(base) => (base + u32::from(offset), end <= 0x1_0000, "its 64 KiB segment"),
        Base::Linear(base) => {
            (base + u32::from(offset), u64::from(base) + end <= 1 << 32, "the address space")
        }
    };
    if fits {
        Ok(address)
    } else {
        Err(place.fault(Cause::AddressOverflow { address, what }))
    }
}

fn expect_length(data: &[u8], len: usize, place: Place) -> Result<(), ReadError> {
    if data.len() == len {
        Ok(())
    } else {
        Err(place.fault(Cause::Malformed("this record type has another length")))
    }
}

fn number(data: &[u8], len: usize, place: Place) -> Result<u32, ReadError> {
    expect_length(data, len, place)?;
    Ok(data.iter().fold(0, |number, byte| number << 8 | u32::from(*byte)))
}

/// An image as Intel HEX text: 16 bytes in each record, extended linear addresses (Intel, revision
/// A, 1988).
#[must_use]
pub fn emit(image: &Image) -> String {
    const RECORD: usize = 16;
    let mut text = String::new();
    let mut record = |offset: u16, kind: u8, data: &[u8]| {
        let [high, low] = offset.to_be_bytes();
        let mut bytes = vec![data.len() as u8, high, low, kind];
        bytes.extend_from_slice(data);
        bytes.push(bytes.iter().fold(0_u8, |sum, byte| sum.wrapping_add(*byte)).wrapping_neg());
        text.push(':');
        text.extend(bytes.iter().map(|byte| format!("{byte:02X}")));
        text.push_str("\r\n");
    };
    let mut upper = None;
    for (start, data) in image.segments() {
        let mut at = start;
        let mut rest = &data[..];
        while !rest.is_empty() {
            if upper != Some(at >> 16) {
                upper = Some(at >> 16);
                record(0, 4, &((at >> 16) as u16).to_be_bytes());
            }
            // End at a multiple of 16, so that no record crosses a 64 KiB border.
            let len = rest.len().min(RECORD - at as usize % RECORD);
            record(at as u16, 0, &rest[..len]);
            at = at.wrapping_add(len as u32);
            rest = &rest[len..];
        }
    }
    record(0, 1, &[]);
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(text: &str) -> Image {
        read(text.as_bytes()).unwrap()
    }

    fn fault(text: &str) -> String {
        read(text.as_bytes()).unwrap_err().to_string()
    }

    /// Two records of the best-known example file (Wikipedia "Intel HEX", from the specification).
    const EXAMPLE: &str = ":10010000214601360121470136007EFE09D2190140\n:00000001FF\n";

    #[test]
    fn reads_data_at_its_address() {
        let image = image(EXAMPLE);
        let data = [0x21, 0x46, 0x01, 0x36, 1, 0x21, 0x47, 1, 0x36, 0, 0x7E, 0xFE, 9, 0xD2, 0x19, 1];
        assert!(image.segments().eq([(0x100, data.to_vec().into())]));
    }

    /// Segment base 1234h (12340h) and linear base 0801h; the checksums of the base records were
    /// computed by hand: two's complement of 02+02+12+34 = 4A and of 02+04+08+01 = 0F.
    #[test]
    fn base_records_move_what_follows() {
        let text = "\
            :020000021234B6\r\n\
            :0100100001EE\r\n\
            :020000040801F1\r\n\
            :0100200002DD\r\n\
            :0400000308010000F0\r\n\
            :040000050801018964\r\n\
            :00000001FF\r\n";
        assert!(image(text).segments().eq([(0x0001_2350, vec![1].into()), (0x0801_0020, vec![2].into())]));
    }

    #[test]
    fn any_line_end_and_lower_case_do() {
        let text = EXAMPLE.replace('\n', "\r").to_lowercase();
        assert_eq!(image(&text), image(EXAMPLE));
        assert_eq!(image(&EXAMPLE.replace('\n', " \n\n")).segments().count(), 1);
        assert_eq!(image(EXAMPLE.trim_end()), image(EXAMPLE));
    }

    #[test]
    fn a_fault_is_named_with_its_line() {
        let good = ":0100000001FE\n";
        for (text, words) in [
            (format!("{good}:0100010001FF\n"), "line 2: checksum is FF and must be FD"),
            (
                format!("{good}:0200010001FE\n"),
                "line 2: the record is cut off: it must have 7 bytes and has 6",
            ),
            (format!("{good}:000001FE\n"), "line 2: the record is cut off: it must have 5 bytes and has 4"),
            (format!("{good}:\n"), "line 2: the record is cut off: it must have 5 bytes and has 0"),
            (format!("{good}:0100010001FDFD\n"), "line 2: the record has 7 bytes but announces 6"),
            (format!("{good}:010001000\n"), "line 2: the last byte has only one digit"),
            (format!("{good}:01000100G1FD\n"), "line 2: character 10 is not a hexadecimal digit"),
            (format!("{good}:0100010\u{e9}01FD\n"), "line 2: character 9 is not a hexadecimal digit"),
            (format!("{good}hello\n"), "line 2: the line does not begin with ':'"),
            (format!("{good}:00000006FA\n"), "line 2: unknown record type 06"),
            // The block of a micro:bit (its specification, "Universal Hex", example of a block
            // start).
            (
                format!("{good}:0400000A9903C0DEB8\n"),
                "line 2: is not a firmware file but a universal HEX file",
            ),
            (format!("{good}:0100000101FD\n"), "line 2: this record type has another length"),
            (format!("{good}:0100000401FA\n"), "line 2: this record type has another length"),
            (format!("{good}:00000001FF\n{good}"), "line 3: there is more text after the end record"),
            (good.to_string(), "the file: the file ends without its end record"),
            (":00000001FF\n".to_string(), "the file: holds no data"),
            (
                format!("{good}:0100000002FD\n:00000001FF\n"),
                "line 2: the data at 0x00000000 overlaps that of line 1",
            ),
            (
                ":02FFFF000102FD\n:00000001FF".to_string(),
                "line 1: the data from 0x0000ffff on exceeds the end of its 64 KiB segment",
            ),
            (
                ":02000004FFFFFC\n:02FFFF000102FD\n:00000001FF".to_string(),
                "line 2: the data from 0xffffffff on exceeds the end of the address space",
            ),
        ] {
            assert!(fault(&text).starts_with(words), "{text:?}\n gave {}\n not  {words}", fault(&text));
        }
    }

    #[test]
    fn a_linear_record_may_cross_a_64_kib_border() {
        let text = ":020000040801F1\n:02FFFF000102FD\n:00000001FF";
        assert!(image(text).segments().eq([(0x0801_FFFF, vec![1, 2].into())]));
    }
}
