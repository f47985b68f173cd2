//! Program images: ELF and Intel HEX.

use object::elf::{self, FileHeader32, ProgramHeader32, PT_LOAD};
use object::read::elf::{FileHeader, ProgramHeader};
use object::LittleEndian;

use crate::error::Error;

/// A run of bytes that an image puts into flash.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Segment {
    /// Where it is stored (the load address, not where it runs).
    pub address: u32,
    /// What is stored.
    pub bytes: Vec<u8>,
}

/// What was loaded.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LoadedImage {
    /// Its segments as (address, length), in file order.
    pub segments: Vec<(u32, u32)>,
    /// The entry point, where the format has one.
    pub entry: Option<u32>,
}

/// The segments of a 32-bit little-endian ARM ELF by their physical addresses.
///
/// # Errors
/// [`Error::Image`] says what is wrong with the file.
pub fn parse_elf(image: &[u8]) -> Result<(Vec<Segment>, u32), Error> {
    let bad = |what: &str| Error::Image(what.to_string());
    let header =
        FileHeader32::<LittleEndian>::parse(image).map_err(|e| bad(&format!("not an ELF file: {e}")))?;
    let endian = header.endian().map_err(|e| bad(&format!("not an ELF file: {e}")))?;
    if header.e_machine(endian) != elf::EM_ARM || !header.is_little_endian() {
        return Err(bad("the ELF file is not for a little-endian ARM"));
    }
    let headers: &[ProgramHeader32<LittleEndian>] =
        header.program_headers(endian, image).map_err(|e| bad(&format!("the program headers: {e}")))?;
    let mut segments = Vec::new();
    for (index, segment) in headers.iter().enumerate() {
        if segment.p_type(endian) != PT_LOAD || segment.p_filesz(endian) == 0 {
            continue;
        }
        let bytes = segment.data(endian, image).map_err(|()| {
            bad(&format!("segment {index} reaches beyond the end of the file: is it truncated?"))
        })?;
        segments.push(Segment { address: segment.p_paddr(endian), bytes: bytes.to_vec() });
    }
    if segments.is_empty() {
        return Err(bad("the ELF file has nothing to load"));
    }
    Ok((segments, header.e_entry(endian)))
}

/// The bytes of an Intel HEX file (record types 00 to 05), runs that touch joined, in file order.
///
/// # Errors
/// [`Error::Image`] names the line and what is wrong with it.
pub fn parse_hex(text: &str) -> Result<Vec<Segment>, Error> {
    let mut segments: Vec<Segment> = Vec::new();
    let mut upper = 0_u32;
    for (number, line) in (1..).zip(text.lines()) {
        let bad = |what: &str| Error::Image(format!("line {number}: {what}"));
        let line = line.trim();
        if line.is_empty() {
            continue;
        }
        let digits = line.strip_prefix(':').ok_or_else(|| bad("does not start with a colon"))?;
        let record = hex_bytes(digits).ok_or_else(|| bad("not pairs of hexadecimal digits"))?;
        let [count, high, low, kind, rest @ ..] = record.as_slice() else {
            return Err(bad("too short for a record"));
        };
        let Some((_, data)) = rest.split_last().filter(|(_, data)| data.len() == usize::from(*count)) else {
            return Err(bad("its length is not the one it says"));
        };
        if record.iter().fold(0_u8, |sum, byte| sum.wrapping_add(*byte)) != 0 {
            return Err(bad("its checksum is wrong"));
        }
        match (kind, data) {
            (0, data) => {
                let offset = u32::from(u16::from_be_bytes([*high, *low]));
                let address = upper.checked_add(offset).ok_or_else(|| bad("beyond the address space"))?;
                match segments.last_mut() {
                    Some(last) if u64::from(last.address) + last.bytes.len() as u64 == u64::from(address) => {
                        last.bytes.extend_from_slice(data);
                    }
                    _ => segments.push(Segment { address, bytes: data.to_vec() }),
                }
            }
            (1, []) => return Ok(segments),
            (2, [a, b]) => upper = u32::from(u16::from_be_bytes([*a, *b])) << 4,
            (4, [a, b]) => upper = u32::from(u16::from_be_bytes([*a, *b])) << 16,
            (3 | 5, [_, _, _, _]) => {}
            _ => return Err(bad("a record of unknown type or length")),
        }
    }
    Err(Error::Image("the end record is missing: is the file truncated?".into()))
}

fn hex_bytes(digits: &str) -> Option<Vec<u8>> {
    let nibbles: Vec<u8> = digits
        .chars()
        .map(|digit| digit.to_digit(16).and_then(|value| u8::try_from(value).ok()))
        .collect::<Option<_>>()?;
    if !nibbles.len().is_multiple_of(2) {
        return None;
    }
    Some(nibbles.chunks_exact(2).map(|pair| pair[0] << 4 | pair[1]).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The example of the format's article in Wikipedia, with an address record before it.
    const EXAMPLE: &str = ":020000040800F2\n\
        :10010000214601360121470136007EFE09D2190140\n\
        :100110002146017E17C20001FF5F16002148011928\n\
        :10012000194E79234623965778239EDA3F01B2CAA7\n\
        :100130003F0156702B5E712B722B732146013421C7\n\
        :00000001FF\n";

    #[test]
    fn reads_the_published_example() {
        let segments = parse_hex(EXAMPLE).unwrap();
        assert_eq!(segments.len(), 1);
        assert_eq!((segments[0].address, segments[0].bytes.len()), (0x0800_0100, 64));
        assert_eq!(segments[0].bytes[..4], [0x21, 0x46, 0x01, 0x36]);
    }

    #[test]
    fn names_the_line_that_is_wrong() {
        for (bad, line) in [
            (EXAMPLE.replace("2146017E", "2146017F"), "line 3"),
            (EXAMPLE.replace(":10012000", "10012000"), "line 4"),
            (EXAMPLE.replace("732146013421C7", "7321460134"), "line 5"),
            (EXAMPLE.replace("CAA7", "CAÄ7"), "line 4"),
            (EXAMPLE.replace(":00000001FF\n", ""), "end record"),
            (":0000\n".into(), "line 1"),
        ] {
            let error = parse_hex(&bad).unwrap_err().to_string();
            assert!(error.contains(line), "{error}");
        }
    }
}
