//! Motorola S-record (M68000 Family Programmer's Reference Manual, appendix C).

use super::fault::{Cause, Place, ReadError};
use super::image::{Image, Pieces};
use super::text::{bytes_of, check_length, lines};

/// Parses a whole file.
///
/// # Errors
/// The first fault, with its line.
pub fn read(bytes: &[u8]) -> Result<Image, ReadError> {
    let mut pieces = Pieces::default();
    let mut counted = 0usize;
    let mut ended = false;
    // Whether a count record after the data says that none is missing. Some writers (bincopy) end a
    // file with it.
    let mut complete = false;
    for (place, line) in lines(bytes) {
        if ended {
            return Err(place.fault(Cause::AfterEnd));
        }
        let Record { kind, address, data } = record(place, line)?;
        match kind {
            // The header is a text for people. The checksum does not cover the record type, so a
            // damaged data record could look like a header and be lost.
            b'0' if counted > 0 => {
                return Err(
                    place.fault(Cause::Malformed("a header (S0) after data records; the line is damaged"))
                )
            }
            b'0' => {}
            b'1'..=b'3' => {
                if u64::from(address) + data.len() as u64 > 1 << 32 {
                    let what = "the address space";
                    return Err(place.fault(Cause::AddressOverflow { address, what }));
                }
                counted += 1;
                complete = false;
                pieces.add(address, data, place);
            }
            b'5' | b'6' => {
                let mask = if kind == b'5' { 0xFFFF } else { 0xFF_FFFF };
                if counted & mask != address as usize {
                    return Err(place.fault(Cause::Count { says: address, counted }));
                }
                complete = true;
            }
            // b'7'..=b'9': the start address; a device starts through its vector table.
            _ => ended = true,
        }
    }
    if !ended && !complete {
        return Err(Place::File.fault(Cause::NoEnd(
            "its end record (S7, S8 or S9) and without a count of its records (S5 or S6)",
        )));
    }
    pieces.into_image()
}

struct Record {
    /// `b'0'` to `b'9'` without `b'4'`.
    kind: u8,
    address: u32,
    data: Vec<u8>,
}

fn record(place: Place, line: &[u8]) -> Result<Record, ReadError> {
    let (kind, digits) = match line {
        [b'S', kind, digits @ ..] => (*kind, digits),
        [b'S'] => return Err(place.fault(Cause::CutOff { what: "the record", needed: 2, found: 0 })),
        _ => return Err(place.fault(Cause::Malformed("the line does not begin with 'S'"))),
    };
    let address_size = match kind {
        b'0' | b'1' | b'5' | b'9' => 2,
        b'2' | b'6' | b'8' => 3,
        b'3' | b'7' => 4,
        _ => {
            let name = format!("S{}", char::from(kind).escape_default());
            return Err(place.fault(Cause::UnknownRecord(name)));
        }
    };
    let bytes = bytes_of(digits, 2, place)?;
    // The count includes address, data and checksum, but not itself.
    let count = bytes.first().copied().map_or(0, usize::from);
    check_length(bytes.len(), 1 + count, place)?;
    if count < address_size + 1 {
        return Err(place.fault(Cause::Malformed("the record is too short for its address and checksum")));
    }
    if kind >= b'5' && count != address_size + 1 {
        return Err(place.fault(Cause::Malformed("this record type has no data")));
    }
    let (body, found) = (&bytes[..count], bytes[count]);
    let needed = !body.iter().fold(0u8, |sum, byte| sum.wrapping_add(*byte));
    if needed != found {
        return Err(place.fault(Cause::Checksum { found, needed }));
    }
    let (address, data) = body[1..].split_at(address_size);
    let address = address.iter().fold(0, |number, byte| number << 8 | u32::from(*byte));
    Ok(Record { kind, address, data: data.to_vec() })
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

    /// The example of the programmer's reference manual, appendix C.2 (S0, four S1 and S9).
    const EXAMPLE: &str = "\
        S00600004844521B\n\
        S1130000285F245F2212226A000424290008237C2A\n\
        S11300100002000800082629001853812341001813\n\
        S113002041E900084E42234300182342000824A952\n\
        S107003000144ED492\n\
        S9030000FC\n";

    #[test]
    fn reads_the_example_of_the_standard() {
        let image = image(EXAMPLE);
        let (address, data) = image.segments().next().unwrap();
        assert_eq!((address, data.len()), (0, 0x34));
        assert_eq!((data[0], data[0x10], data[0x33]), (0x28, 0x00, 0xD4));
    }

    /// Checksums by hand: S2 FF-(05+01+00+00+AA)=4F, S3 FF-(06+08+01+00+00+BB)=35, S5
    /// FF-(03+00+02)=FA, S6 FF-(04+00+00+02)=F9, S7 FF-(05+08+01+01+89)=67.
    #[test]
    fn addresses_have_two_three_or_four_bytes() {
        let text = "S205010000AA4F\r\nS30608010000BB35\r\nS5030002FA\r\nS604000002F9\r\nS7050801018967\r\n";
        assert!(image(text)
            .segments()
            .eq([(0x01_0000, vec![0xAA].into()), (0x0801_0000, vec![0xBB].into())]));
    }

    /// The count record (S5, S6) proves that the data are complete, if nothing follows it.
    #[test]
    fn a_count_record_ends_a_file_as_well() {
        let good = "S1040000AA51\nS1040001AA50\n";
        for count in ["S5030002FA", "S604000002F9"] {
            assert!(image(&format!("{good}{count}")).segments().eq([(0, vec![0xAA, 0xAA].into())]));
            let more = fault(&format!("{good}{count}\nS1040002AA4F\n"));
            assert!(more.starts_with("the file: the file ends without its end record"), "{more}");
        }
        assert!(fault(&format!("{good}S5030001FB\n")).contains("its count record has 1"));
    }

    #[test]
    fn blanks_and_what_fills_a_file_are_no_text() {
        let good = "S1040000AA51\nS9030000FC";
        for text in [format!(" \n\t{good} \n"), format!("{good}\u{1a}"), format!("{good}\n\0\0\u{1a}\n")] {
            assert!(image(&text).segments().eq(image(good).segments()), "{text:?}");
        }
        let filled = [good.as_bytes(), &[0xFF; 7]].concat();
        assert_eq!(read(&filled).unwrap(), image(good));
        for text in [format!("{good}\n\u{1a}\n{good}"), format!("{good}\n\0x")] {
            assert!(fault(&text).contains("more text after the end record"), "{text:?}");
        }
    }

    #[test]
    fn a_fault_is_named_with_its_line() {
        let good = "S1040000AA51\n";
        let end = "S9030000FC\n";
        assert_eq!(image(&format!("{good}{end}")).segments().count(), 1);
        for (text, words) in [
            (format!("{good}S1040001AA51\n"), "line 2: checksum is 51 and must be 50"),
            (
                format!("{good}S1050001AA50\n"),
                "line 2: the record is cut off: it must have 6 bytes and has 5",
            ),
            (format!("{good}S1\n"), "line 2: the record is cut off"),
            (format!("{good}S\n"), "line 2: the record is cut off"),
            (format!("{good}S1040001AA5000\n"), "line 2: the record has 6 bytes but announces 5"),
            (format!("{good}S1040001AA5\n"), "line 2: the last byte has only one digit"),
            (format!("{good}S104000xAA50\n"), "line 2: character 8 is not a hexadecimal digit"),
            (format!("{good}X104\n"), "line 2: the line does not begin with 'S'"),
            (format!("{good}S4040001AA50\n"), "line 2: unknown record type S4"),
            (format!("{good}S\u{e9}04\n"), "line 2: unknown record type S\\u{c3}"),
            (format!("{good}S10200FD\n"), "line 2: the record is too short"),
            (format!("{good}S9040000AA51\n"), "line 2: this record type has no data"),
            (format!("{good}S5030002FA\n"), "line 2: the file has 1 data records and its count record has 2"),
            (format!("{good}{end}{good}"), "line 3: there is more text after the end record"),
            (format!("{good}S00600004844521B\n"), "line 2: a header (S0) after data records"),
            (good.to_string(), "the file: the file ends without its end record"),
            (end.to_string(), "the file: holds no data"),
            (format!("{good}S1040000AB50\n{end}"), "line 2: the data at 0x00000000 overlaps that of line 1"),
            (
                format!("S307FFFFFFFF0102F9\n{end}"),
                "line 1: the data from 0xffffffff on exceeds the end of the address space",
            ),
        ] {
            assert!(fault(&text).starts_with(words), "{text:?}\n gave {}\n not  {words}", fault(&text));
        }
    }
}
