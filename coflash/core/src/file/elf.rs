//! ELF executables: what the sections put into the loadable segments, at its load addresses.

use std::ops::Range;

use object::elf::{
    FileHeader32, ProgramHeader32, SectionHeader32, EM_ARM, ET_CORE, ET_DYN, ET_EXEC, ET_REL, PF_R, PF_X,
    PT_LOAD, SHF_ALLOC, SHF_EXECINSTR, SHT_NOBITS, SHT_PROGBITS, SHT_STRTAB,
};
use object::read::elf::{FileHeader, ProgramHeader, SectionHeader};
use object::Endianness;

use super::area::Area;
use super::fault::{Cause, Place, ReadError};
use super::image::{Image, Pieces};
use super::note::Note;
use super::program::MAX_PROGRAM_SIZE;
use super::range::AddressRange;

/// Parses a whole file.
///
/// The memory contents are those of the `PT_LOAD` program headers: `p_filesz` bytes at `p_paddr`,
/// their address in flash. (Sections and `p_vaddr` give the addresses at run time, which lie in RAM
/// for initialised data.) If no segment has a load address, the virtual addresses count, as for GNU
/// binutils.
///
/// What a segment has before its first allocated section and after its last one is no program: with
/// large pages GNU ld and lld let the first segment begin with the headers of the file.
///
/// # Errors
/// The first fault, with its offset.
pub fn read(bytes: &[u8]) -> Result<Image, ReadError> {
    let (header, endian) = header_of(bytes)?;
    let table = u64::from(header.e_phoff(endian));
    let table_end = table + u64::from(header.e_phentsize(endian)) * u64::from(header.e_phnum(endian));
    let program_headers = header
        .program_headers(endian, bytes)
        .map_err(|_| cut_off(bytes, "the table of program headers", table_end))?;

    let loads = || {
        let with_size = program_headers.iter().map(|segment| (segment, u64::from(segment.p_filesz(endian))));
        with_size.filter(|(segment, size)| segment.p_type(endian) == PT_LOAD && *size != 0)
    };
    // Headers are small and may all refer to the same bytes: check the sum of their sizes before
    // copying. It cannot overflow: there are at most 65535 headers of 32 bits each.
    if loads().map(|(_, size)| size).sum::<u64>() > MAX_PROGRAM_SIZE.into() {
        return Err(Place::File.fault(Cause::SegmentsTooLarge { most: MAX_PROGRAM_SIZE }));
    }
    for (segment, size) in loads() {
        let end = u64::from(segment.p_offset(endian)) + size;
        if end > bytes.len() as u64 {
            return Err(cut_off(bytes, "the file", end));
        }
    }
    // Linkers write the section headers last: without them the file was cut off, even if all
    // segments are present.
    let table = u64::from(header.e_shoff(endian));
    let table_end = table + u64::from(header.e_shentsize(endian)) * u64::from(header.e_shnum(endian));
    if table != 0 && table_end > bytes.len() as u64 {
        return Err(cut_off(bytes, "the table of section headers", table_end));
    }
    let sections = header.section_headers(endian, bytes).map_err(|_| {
        Place::Offset(table as usize).fault(Cause::WrongElf("has a damaged table of sections"))
    })?;
    let contents = Contents::of(sections, endian);

    let has_load_addresses = loads().any(|(segment, _)| segment.p_paddr(endian) != 0);
    let address_of = |segment: &ProgramHeader32<Endianness>| match has_load_addresses {
        true => segment.p_paddr(endian),
        false => segment.p_vaddr(endian),
    };
    let runs_in_ram = |address| Area::of(address).is_some_and(Area::is_ram);
    let only_ram = loads().all(|(segment, _)| runs_in_ram(address_of(segment)));
    let mut pieces = Pieces::default();
    for (segment, size) in loads() {
        let (start, address) = (u64::from(segment.p_offset(endian)), address_of(segment));
        if u64::from(address) + size > 1 << 32 {
            let what = "the address space";
            return Err(Place::Offset(start as usize).fault(Cause::AddressOverflow { address, what }));
        }
        if !has_load_addresses && runs_in_ram(address) && !only_ram {
            let last = address + (size - 1) as u32;
            pieces.note(Note::NoLoadAddress(AddressRange { first: address, last }));
            continue;
        }
        if let Some(part) = contents.inside(start..start + size, bytes) {
            // Inside the file and inside the address space, as the segment is.
            let (from, to) = (part.start as usize, part.end as usize);
            pieces.add(address + (part.start - start) as u32, bytes[from..to].to_vec(), Place::Offset(from));
        }
    }
    pieces.into_image()
}

/// An image as an ELF executable: a segment and a section for each contiguous range (System V ABI, chapters 4 and
/// 5; section names `.flash`). `entry` is the address where a debugger starts.
#[must_use]
pub fn emit(image: &Image, entry: u32) -> Vec<u8> {
    const HEADER: u32 = 52;
    const NAMES: &[u8] = b"\0.flash\0.shstrtab\0\0\0";
    const FLASH: u32 = 1;
    const SHSTRTAB: u32 = 8;
    let segments: Vec<_> = image.segments().collect();
    let count = segments.len() as u32;
    let from = HEADER + 32 * count;
    let mut data = Vec::new();
    let mut loads = Vec::new();
    let mut sections = vec![[0; 10]];
    for (address, bytes) in &segments {
        let (offset, size) = (from + data.len() as u32, bytes.len() as u32);
        loads.push([PT_LOAD, offset, *address, *address, size, size, PF_R | PF_X, 4]);
        let flags = SHF_ALLOC | SHF_EXECINSTR;
        sections.push([FLASH, SHT_PROGBITS, flags, *address, offset, size, 0, 0, 4, 0]);
        data.extend_from_slice(bytes);
        data.resize(data.len().next_multiple_of(4), 0xFF);
    }
    let names = from + data.len() as u32;
    sections.push([SHSTRTAB, SHT_STRTAB, 0, 0, names, NAMES.len() as u32, 0, 0, 1, 0]);
    data.extend_from_slice(NAMES);
    let mut file = vec![0x7F, b'E', b'L', b'F', 1, 1, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0];
    file.extend([ET_EXEC, EM_ARM].into_iter().flat_map(u16::to_le_bytes));
    // Version, entry, offsets of the two tables, and the flags of the EABI 5.
    let words = [1, entry, HEADER, from + data.len() as u32, 0x0500_0000];
    file.extend(words.into_iter().flat_map(u32::to_le_bytes));
    let sizes = [HEADER, 32, count, 40, count + 2, count + 1];
    file.extend(sizes.into_iter().flat_map(|size| (size as u16).to_le_bytes()));
    file.extend(loads.into_iter().flatten().flat_map(u32::to_le_bytes));
    file.extend(data);
    file.extend(sections.into_iter().flatten().flat_map(u32::to_le_bytes));
    file
}

/// The header of a linked program for the device.
fn header_of(bytes: &[u8]) -> Result<(&FileHeader32<Endianness>, Endianness), ReadError> {
    const CLASS: Place = Place::Offset(4);
    const DATA: Place = Place::Offset(5);
    // It is at the same place in each class. The build for the computer is an ELF file, too.
    let machine = bytes.get(18..20).map(|two| match bytes[5] {
        2 => u16::from_be_bytes([two[0], two[1]]),
        _ => u16::from_le_bytes([two[0], two[1]]),
    });
    if let Some(machine) = machine.filter(|machine| *machine != EM_ARM) {
        return Err(Place::Offset(18).fault(Cause::WrongMachine(machine)));
    }
    match bytes {
        [0x7F, b'E', b'L', b'F', 1, 1, ..] => {}
        [0x7F, b'E', b'L', b'F', 1, _, ..] => {
            return Err(DATA.fault(Cause::WrongElf("is not little-endian; the device is")))
        }
        [0x7F, b'E', b'L', b'F', ..] => {
            return Err(CLASS.fault(Cause::WrongElf("is not a 32-bit ELF file; the device needs one")))
        }
        _ => return Err(Place::Offset(0).fault(Cause::WrongElf("is not an ELF file"))),
    }
    let header =
        FileHeader32::<Endianness>::parse(bytes).map_err(|_| cut_off(bytes, "the ELF header", 52))?;
    let endian = header.endian().map_err(|_| DATA.fault(Cause::WrongElf("has an unknown byte order")))?;
    let words = match header.e_type(endian) {
        ET_EXEC => None,
        ET_REL => Some("is not a linked program (it is an object file): give the linker's output"),
        ET_DYN => Some(
            "is linked for no address (it is a library, or a position-independent program): link it for the \
             flash of the device (-no-pie)",
        ),
        ET_CORE => Some("is not a linked program (it is a dump of the memory): give the linker's output"),
        _ => Some("is not a linked program: give the linker's output"),
    };
    if let Some(words) = words {
        return Err(Place::Offset(16).fault(Cause::WrongElf(words)));
    }
    let header_size = header.e_phentsize(endian);
    if header.e_phnum(endian) > 0 && usize::from(header_size) != size_of::<ProgramHeader32<Endianness>>() {
        return Err(Place::Offset(42).fault(Cause::ProgramHeaderSize(header_size)));
    }
    Ok((header, endian))
}

/// The fault of a file that must have this many bytes.
fn cut_off(bytes: &[u8], what: &'static str, needed: u64) -> ReadError {
    let needed = usize::try_from(needed).unwrap_or(usize::MAX);
    Place::File.fault(Cause::CutOff { what, needed, found: bytes.len() })
}

/// The parts of a file that are the contents of the memory.
enum Contents {
    /// The bytes of its allocated sections: in order, without overlap and not adjacent.
    Sections(Vec<Range<u64>>),
    /// A file without sections.
    Unknown,
}

impl Contents {
    fn of(sections: &[SectionHeader32<Endianness>], endian: Endianness) -> Self {
        if sections.is_empty() {
            return Self::Unknown;
        }
        let allocated = sections.iter().filter(|section| {
            section.sh_flags(endian) & SHF_ALLOC != 0 && section.sh_type(endian) != SHT_NOBITS
        });
        let mut all: Vec<Range<u64>> = allocated
            .map(|section| {
                let offset = u64::from(section.sh_offset(endian));
                offset..offset + u64::from(section.sh_size(endian))
            })
            .filter(|range| !range.is_empty())
            .collect();
        all.sort_by_key(|range| range.start);
        all.dedup_by(|next, last| {
            let joins = next.start <= last.end;
            if joins {
                last.end = last.end.max(next.end);
            }
            joins
        });
        Self::Sections(all)
    }

    /// The part of a segment that is contents: from its first allocated section to its last one, with
    /// the padding between them. `segment` lies inside the file.
    fn inside(&self, segment: Range<u64>, bytes: &[u8]) -> Option<Range<u64>> {
        match self {
            Self::Sections(all) => {
                let first = all.get(all.partition_point(|part| part.end <= segment.start))?;
                let last = all[..all.partition_point(|part| part.start < segment.end)].last()?;
                let part = first.start.max(segment.start)..last.end.min(segment.end);
                (!part.is_empty()).then_some(part)
            }
            Self::Unknown => Some(after_headers(segment, bytes)),
        }
    }
}

/// A segment of a file without sections. If it begins with the file's headers, the program begins
/// after them and after the zeros that fill the page, with a word that is not 0: no stack begins at 0.
fn after_headers(segment: Range<u64>, bytes: &[u8]) -> Range<u64> {
    const WORD: u64 = 4;
    let header = FileHeader32::<Endianness>::parse(bytes).ok().filter(|_| segment.start == 0);
    let Some((header, endian)) = header.and_then(|header| Some((header, header.endian().ok()?))) else {
        return segment;
    };
    let table = u64::from(header.e_phentsize(endian)) * u64::from(header.e_phnum(endian));
    let end = (u64::from(header.e_phoff(endian)) + table).min(segment.end);
    let filled = bytes[end as usize..segment.end as usize].iter().position(|byte| *byte != 0);
    let start = filled.map_or(segment.end, |at| end + at as u64);
    start - start % WORD..segment.end
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An ELF file written by hand from the System V ABI (gABI chapters 4 and 5): header, two
    /// program headers of 32 bytes, and the data of two segments. The second runs in RAM (p_vaddr)
    /// and lies in flash (p_paddr).
    #[rustfmt::skip]
    const EXAMPLE: [u8; 124] = [
        // e_ident: magic, 32 bit, little-endian, version 1, padding
        0x7F, b'E', b'L', b'F', 1, 1, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0,
        2, 0, 40, 0,                // ET_EXEC, EM_ARM
        1, 0, 0, 0,                 // version
        0x89, 0x01, 0x01, 0x08,     // entry 08010189h
        52, 0, 0, 0,                // e_phoff
        0, 0, 0, 0,                 // e_shoff
        0, 0, 0, 5,                 // flags
        52, 0, 32, 0, 2, 0,         // ehsize, phentsize, phnum
        40, 0, 0, 0, 0, 0,          // shentsize, shnum, shstrndx
        // PT_LOAD: offset 116, vaddr = paddr = 08010000h, filesz = memsz = 4, flags r-x, align 1
        1, 0, 0, 0, 116, 0, 0, 0, 0, 0, 1, 8, 0, 0, 1, 8, 4, 0, 0, 0, 4, 0, 0, 0, 5, 0, 0, 0, 1, 0, 0, 0,
        // PT_LOAD: offset 120, vaddr 20000000h, paddr 08010100h, filesz 4, memsz 16, flags rw-,
        // align 1
        1, 0, 0, 0, 120, 0, 0, 0, 0, 0, 0, 0x20, 0, 1, 1, 8, 4, 0, 0, 0, 16, 0, 0, 0, 6, 0, 0, 0, 1, 0, 0, 0,
        1, 2, 3, 4,
        5, 6, 7, 8,
    ];

    /// The example with a section table at its end: one section header of 40 bytes for each
    /// (type, flags, offset, size), after the null section (gABI chapter 4, "Sections").
    fn with_sections(sections: &[[u32; 4]]) -> Vec<u8> {
        let mut bytes = EXAMPLE.to_vec();
        bytes[32..36].copy_from_slice(&124_u32.to_le_bytes());
        bytes[48] = 1 + sections.len() as u8;
        bytes.extend([0; 40]);
        for &[kind, flags, offset, size] in sections {
            for word in [0, kind, flags, 0, offset, size, 0, 0, 1, 0] {
                bytes.extend(u32::to_le_bytes(word));
            }
        }
        bytes
    }

    /// Sets a field of a program header of the example: its number and the offset in it.
    fn set(bytes: &mut [u8], header: usize, field: usize, value: u32) {
        let at = 52 + 32 * header + field;
        bytes[at..at + 4].copy_from_slice(&value.to_le_bytes());
    }

    const OFFSET: usize = 4;
    const VADDR: usize = 8;
    const PADDR: usize = 12;
    const FILESZ: usize = 16;
    /// SHT_PROGBITS, SHT_NOBITS; SHF_ALLOC.
    const PROGBITS: u32 = 1;
    const NOBITS: u32 = 8;
    const ALLOC: u32 = 2;

    fn segments(bytes: &[u8]) -> Vec<(u32, Vec<u8>)> {
        read(bytes).unwrap().segments().map(|(address, data)| (address, data.into_owned())).collect()
    }

    const BOTH: [(u32, &[u8]); 2] = [(0x0801_0000, &[1, 2, 3, 4]), (0x0801_0100, &[5, 6, 7, 8])];

    fn is_both(bytes: &[u8]) -> bool {
        read(bytes).unwrap().segments().eq(BOTH.map(|(address, data)| (address, data.into())))
    }

    /// As GNU ld links with pages of 64 KiB, and rust-lld: the first segment begins with the headers.
    #[test]
    fn what_no_allocated_section_covers_is_no_program() {
        let all = [[PROGBITS, ALLOC, 116, 4], [PROGBITS, ALLOC, 120, 4]];
        assert!(is_both(&with_sections(&all)));
        let mut bytes = with_sections(&all);
        set(&mut bytes, 0, OFFSET, 0);
        set(&mut bytes, 0, PADDR, 0x0801_0000 - 116);
        set(&mut bytes, 0, FILESZ, 120);
        assert!(is_both(&bytes), "{:x?}", segments(&bytes));
        // A section in two parts, one that reaches out of its segment, and sections that are not
        // in the memory: debug information, .bss.
        let mut odd = with_sections(&[
            [PROGBITS, ALLOC, 118, 30],
            [PROGBITS, 0, 0, 100],
            [NOBITS, ALLOC, 52, 64],
            [PROGBITS, ALLOC, 116, 2],
        ]);
        set(&mut odd, 0, OFFSET, 0);
        set(&mut odd, 0, PADDR, 0x0801_0000 - 116);
        set(&mut odd, 0, FILESZ, 120);
        assert!(is_both(&odd), "{:x?}", segments(&odd));
        // Padding between two sections of a segment belongs to the program, as the linker filled it.
        let mut padded = with_sections(&[[PROGBITS, ALLOC, 122, 1], [PROGBITS, ALLOC, 117, 2]]);
        set(&mut padded, 0, FILESZ, 8);
        set(&mut padded, 1, FILESZ, 0);
        assert_eq!(segments(&padded), [(0x0801_0001, vec![2, 3, 4, 5, 6, 7])]);
        let none = with_sections(&[[PROGBITS, 0, 116, 8]]);
        assert_eq!(read(&none).unwrap_err().to_string(), "the file: holds no data");
    }

    /// Without a section table, too: the headers and the zeros after them are no program.
    #[test]
    fn headers_are_no_program_in_a_stripped_file_either() {
        let mut bytes = EXAMPLE.to_vec();
        set(&mut bytes, 0, OFFSET, 0);
        set(&mut bytes, 0, PADDR, 0x0801_0000 - 116);
        set(&mut bytes, 0, FILESZ, 120);
        assert!(is_both(&bytes), "{:x?}", segments(&bytes));
        // A stack at 2001_0000h: its first two bytes are 0 as well.
        bytes[116..120].copy_from_slice(&[0, 0, 1, 0x20]);
        assert_eq!(segments(&bytes)[0], (0x0801_0000, vec![0, 0, 1, 0x20]));
    }

    /// As BFD reads it: without any load address, the virtual addresses are meant.
    #[test]
    fn without_load_addresses_the_virtual_ones_count() {
        let mut bytes = EXAMPLE.to_vec();
        set(&mut bytes, 0, PADDR, 0);
        set(&mut bytes, 1, PADDR, 0);
        let image = read(&bytes).unwrap();
        assert!(image.segments().eq([(0x0801_0000, vec![1, 2, 3, 4].into())]));
        let words = image.notes()[0].to_string();
        assert!(
            words.contains("0x20000000..=0x20000003 were left out") && words.contains("AT > FLASH"),
            "{words}"
        );
        set(&mut bytes, 1, VADDR, 0x0801_0100);
        assert!(is_both(&bytes) && read(&bytes).unwrap().notes().is_empty());
        // One load address is enough: then 0 is an address like any other.
        set(&mut bytes, 1, PADDR, 0x0801_0100);
        assert_eq!(segments(&bytes)[0].0, 0);
    }

    #[test]
    fn the_same_bytes_in_two_segments_are_taken_once() {
        let mut bytes = EXAMPLE.to_vec();
        set(&mut bytes, 1, OFFSET, 118);
        set(&mut bytes, 1, PADDR, 0x0801_0002);
        let image = read(&bytes).unwrap();
        assert!(image.segments().eq([(0x0801_0000, vec![1, 2, 3, 4, 5, 6].into())]));
        let words = "offset 0x76: the data at 0x08010002 are those of offset 0x74 once more";
        assert_eq!(image.notes()[0].to_string(), words);
    }

    fn fault(change: impl FnOnce(&mut Vec<u8>)) -> String {
        let mut bytes = EXAMPLE.to_vec();
        change(&mut bytes);
        read(&bytes).unwrap_err().to_string()
    }

    #[test]
    fn takes_the_load_addresses() {
        let image = read(&EXAMPLE).unwrap();
        assert!(image
            .segments()
            .eq([(0x0801_0000, vec![1, 2, 3, 4].into()), (0x0801_0100, vec![5, 6, 7, 8].into())]));
    }

    #[test]
    fn refuses_what_the_device_cannot_run() {
        for (words, found) in [
            ("offset 0x4: is not a 32-bit ELF file", fault(|b| b[4] = 2)),
            ("offset 0x5: is not little-endian", fault(|b| (b[5], b[18], b[19]) = (2, 0, 40))),
            ("offset 0x12: is an ELF file for machine 243 (RISC-V) and not for Arm", fault(|b| b[18] = 243)),
            // A test that was built for the computer (x86-64 psABI: EM_X86_64 is 62, of 64 bits).
            ("offset 0x12: is an ELF file for machine 62 (x86", fault(|b| (b[4], b[18]) = (2, 62))),
            ("offset 0x10: is not a linked program (it is an object file)", fault(|b| b[16] = 1)),
            ("offset 0x10: is linked for no address", fault(|b| b[16] = 3)),
            ("offset 0x10: is not a linked program (it is a dump", fault(|b| b[16] = 4)),
            ("offset 0x10: is not a linked program:", fault(|b| b[16] = 9)),
            ("offset 0x0: is not an ELF file", fault(|b| b[0] = 0)),
            (
                "offset 0x78: the data at 0x08010003 overlaps that of offset 0x74",
                fault(|b| b[96..98].copy_from_slice(&[3, 0])),
            ),
            ("the file: the file is cut off: it must have 124 bytes and has 123", fault(|b| b.truncate(123))),
            (
                "the file: the table of program headers is cut off: it must have 116 bytes and has 100",
                fault(|b| b.truncate(100)),
            ),
            (
                "the file: the ELF header is cut off: it must have 52 bytes and has 51",
                fault(|b| b.truncate(51)),
            ),
            (
                "the file: the table of section headers is cut off: it must have 164 bytes and has 124",
                // e_shoff 124, one header of 40 bytes.
                fault(|b| (b[32], b[48]) = (124, 1)),
            ),
            ("the file: holds no data", fault(|b| (b[52], b[84]) = (6, 6))),
            (
                "offset 0x74: the data from 0xfffffffd on exceeds the end",
                fault(|b| b[64..68].copy_from_slice(&[0xFD, 0xFF, 0xFF, 0xFF])),
            ),
        ] {
            assert!(found.starts_with(words), "{found}\n not {words}");
        }
    }
}
