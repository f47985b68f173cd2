//! Program images: ELF and Intel HEX.

use std::ops::Range;

use object::elf::{self, FileHeader32, ProgramHeader32, SectionHeader32, PT_LOAD, SHF_ALLOC, SHT_NOBITS};
use object::read::elf::{FileHeader, ProgramHeader, SectionHeader};
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

/// The segments of a 32-bit little-endian ARM ELF by their physical addresses, or by their virtual
/// ones where no segment has a physical address.
///
/// What a segment has before its first allocated section and after its last one is not stored: linkers
/// with large pages let the first segment begin with the headers of the file, which would lie over the
/// bootloader. A file without sections is stored as it is.
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
    let sections = header.section_headers(endian, image).map_err(|e| bad(&format!("the sections: {e}")))?;
    let contents = contents(sections, endian);
    let is_loaded = |segment: &ProgramHeader32<LittleEndian>| {
        segment.p_type(endian) == PT_LOAD && segment.p_filesz(endian) != 0
    };
    let has_physical = headers.iter().any(|segment| is_loaded(segment) && segment.p_paddr(endian) != 0);
    let mut segments = Vec::new();
    for (index, segment) in headers.iter().enumerate().filter(|(_, segment)| is_loaded(segment)) {
        let bytes = segment.data(endian, image).map_err(|()| {
            bad(&format!("segment {index} reaches beyond the end of the file: is it truncated?"))
        })?;
        let base = if has_physical { segment.p_paddr(endian) } else { segment.p_vaddr(endian) };
        if u64::from(base) + bytes.len() as u64 > 1 << 32 {
            return Err(bad(&format!("segment {index} reaches beyond the end of the address space")));
        }
        // In RAM of its own, and nothing says from where the start-up would copy it.
        if !has_physical && is_ram(base) {
            continue;
        }
        let start = u64::from(segment.p_offset(endian));
        let Some(part) = part_of(&contents, start..start + bytes.len() as u64) else { continue };
        let (from, to) = ((part.start - start) as usize, (part.end - start) as usize);
        segments.push(Segment { address: base + from as u32, bytes: bytes[from..to].to_vec() });
    }
    if segments.is_empty() {
        return Err(bad("the ELF file has nothing to load"));
    }
    Ok((segments, header.e_entry(endian)))
}

/// The bytes of the file that allocated sections have; `None` for a file without sections.
fn contents(sections: &[SectionHeader32<LittleEndian>], endian: LittleEndian) -> Option<Vec<Range<u64>>> {
    let in_memory = |section: &&SectionHeader32<LittleEndian>| {
        section.sh_flags(endian) & SHF_ALLOC != 0 && section.sh_type(endian) != SHT_NOBITS
    };
    let range = |section: &SectionHeader32<LittleEndian>| {
        let start = u64::from(section.sh_offset(endian));
        start..start + u64::from(section.sh_size(endian))
    };
    (!sections.is_empty()).then(|| sections.iter().filter(in_memory).map(range).collect())
}

/// The part of a segment from its first allocated section to its last one; `None` without any.
fn part_of(contents: &Option<Vec<Range<u64>>>, segment: Range<u64>) -> Option<Range<u64>> {
    let Some(contents) = contents else { return Some(segment) };
    let inside = contents.iter().map(|part| part.start.max(segment.start)..part.end.min(segment.end));
    let inside = inside.filter(|part| !part.is_empty());
    inside.reduce(|all, part| all.start.min(part.start)..all.end.max(part.end))
}

/// The SRAM and the core-coupled RAM (RM0090 section 2.3).
fn is_ram(address: u32) -> bool {
    matches!(address, 0x1000_0000..=0x1000_FFFF | 0x2000_0000..=0x3FFF_FFFF)
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

    /// An ELF file by the System V ABI (gABI chapters 4 and 5): a segment of 8 bytes of headers' place
    /// and 8 bytes of program for each (offset, vaddr, paddr, size), and a section table with the null
    /// section and one of SHT_PROGBITS, SHF_ALLOC for each (offset, size).
    fn elf(segments: &[[u32; 4]], sections: &[[u32; 2]]) -> Vec<u8> {
        let (count, table) = (segments.len() as u16, 52 + 32 * segments.len());
        let shoff = if sections.is_empty() { 0 } else { (table + PROGRAM.len()) as u32 };
        let mut bytes = b"\x7FELF\x01\x01\x01\0\0\0\0\0\0\0\0\0\x02\0\x28\0".to_vec();
        bytes.extend([1, 0x0800_C009, 52, shoff, 0].into_iter().flat_map(u32::to_le_bytes));
        let sections_in_table = if sections.is_empty() { 0 } else { 1 + sections.len() as u16 };
        bytes.extend([52, 32, count, 40, sections_in_table, 0].into_iter().flat_map(u16::to_le_bytes));
        for &[offset, vaddr, paddr, size] in segments {
            bytes.extend([1, offset, vaddr, paddr, size, size, 5, 4].into_iter().flat_map(u32::to_le_bytes));
        }
        bytes.extend(PROGRAM);
        if !sections.is_empty() {
            bytes.extend([0; 40]);
        }
        for &[offset, size] in sections {
            bytes.extend([0, 1, 2, 0, offset, size, 0, 0, 4, 0].into_iter().flat_map(u32::to_le_bytes));
        }
        bytes
    }

    const PROGRAM: &[u8] = &[1, 2, 3, 4, 5, 6, 7, 8];
    /// The offset of the program in a file with one segment, and with two.
    const ONE: u32 = 52 + 32;
    const TWO: u32 = 52 + 64;

    fn stored(image: &[u8]) -> Vec<(u32, Vec<u8>)> {
        parse_elf(image).unwrap().0.into_iter().map(|segment| (segment.address, segment.bytes)).collect()
    }

    /// GNU ld with pages of 64 KiB: the first segment begins with the file's headers, before the
    /// program's address.
    #[test]
    fn what_no_section_covers_is_not_stored() {
        let start = 0x0800_C000;
        let headers = elf(&[[0, start - ONE, start - ONE, ONE + 8]], &[[ONE, 4], [ONE + 4, 4]]);
        assert_eq!(stored(&headers), [(start, PROGRAM.to_vec())]);
        // Padding between two sections belongs to the program.
        let padded = elf(&[[0, start - ONE, start - ONE, ONE + 8]], &[[ONE + 6, 1], [ONE + 1, 2]]);
        assert_eq!(stored(&padded), [(start + 1, PROGRAM[1..7].to_vec())]);
        let plain = elf(&[[ONE, start, start, 8]], &[]);
        assert_eq!(stored(&plain), [(start, PROGRAM.to_vec())]);
        assert!(parse_elf(&elf(&[[ONE, start, start, 8]], &[[0, 4]])).is_err(), "nothing to load");
    }

    #[test]
    fn virtual_addresses_count_where_there_are_no_others() {
        let image = elf(&[[TWO, 0x0800_C000, 0, 4], [TWO + 4, 0x2000_0000, 0, 4]], &[]);
        assert_eq!(stored(&image), [(0x0800_C000, PROGRAM[..4].to_vec())]);
        let image = elf(&[[TWO, 0x0800_C000, 0, 4], [TWO + 4, 0x2000_0000, 0x0800_C004, 4]], &[]);
        assert_eq!(stored(&image)[0].0, 0);
        let beyond = elf(&[[ONE, 0xFFFF_FFFC, 0xFFFF_FFFC, 8]], &[]);
        assert!(parse_elf(&beyond).unwrap_err().to_string().contains("address space"));
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
