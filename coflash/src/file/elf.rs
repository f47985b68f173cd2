//! ELF executables: the loadable segments at their load addresses.

use object::elf::{FileHeader32, EM_ARM, ET_EXEC, PT_LOAD};
use object::read::elf::{FileHeader, ProgramHeader};
use object::Endianness;

use super::block_file::MAX_PROGRAM_SIZE;
use super::fault::{Cause, Place, ReadError};
use super::image::{Image, Pieces};

/// Parses a whole file.
///
/// The memory contents are those of the `PT_LOAD` program headers: `p_filesz` bytes at `p_paddr`,
/// their address in flash. (Sections and `p_vaddr` give the addresses at run time, which lie in RAM
/// for initialised data.)
///
/// # Errors
/// The first fault, with its offset.
pub fn read(bytes: &[u8]) -> Result<Image, ReadError> {
    const CLASS: Place = Place::Offset(4);
    const DATA: Place = Place::Offset(5);
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
    let cut_off = |what, needed: u64| {
        let needed = usize::try_from(needed).unwrap_or(usize::MAX);
        Place::File.fault(Cause::CutOff { what, needed, found: bytes.len() })
    };
    let header = FileHeader32::<Endianness>::parse(bytes).map_err(|_| cut_off("the ELF header", 52))?;
    let endian = header.endian().map_err(|_| DATA.fault(Cause::WrongElf("has an unknown byte order")))?;
    let machine = header.e_machine(endian);
    if machine != EM_ARM {
        return Err(Place::Offset(18).fault(Cause::WrongMachine(machine)));
    }
    if header.e_type(endian) != ET_EXEC {
        let words = "is not a linked program (it is an object file or library): give the linker's output";
        return Err(Place::Offset(16).fault(Cause::WrongElf(words)));
    }
    let table = u64::from(header.e_phoff(endian));
    let table_end = table + u64::from(header.e_phentsize(endian)) * u64::from(header.e_phnum(endian));
    let program_headers = header
        .program_headers(endian, bytes)
        .map_err(|_| cut_off("the table of program headers", table_end))?;

    let loads = || {
        let with_size = program_headers.iter().map(|segment| (segment, u64::from(segment.p_filesz(endian))));
        with_size.filter(|(segment, size)| segment.p_type(endian) == PT_LOAD && *size != 0)
    };
    // Headers are small and may all refer to the same bytes: check the sum of their sizes before
    // copying. It cannot overflow: there are at most 65535 headers of 32 bits each.
    if loads().map(|(_, size)| size).sum::<u64>() > MAX_PROGRAM_SIZE.into() {
        return Err(Place::File.fault(Cause::SegmentsTooLarge { most: MAX_PROGRAM_SIZE }));
    }
    let mut pieces = Pieces::default();
    for (segment, size) in loads() {
        let offset = u64::from(segment.p_offset(endian));
        let data = segment.data(endian, bytes).map_err(|()| cut_off("the file", offset + size))?;
        let place = Place::Offset(offset as usize);
        let address = segment.p_paddr(endian);
        if u64::from(address) + size > 1 << 32 {
            return Err(place.fault(Cause::AddressOverflow { address, what: "the address space" }));
        }
        pieces.add(address, data.to_vec(), place);
    }
    // Linkers write the section headers last: without them the file was cut off, even if all
    // segments are present.
    let sections = u64::from(header.e_shoff(endian));
    let sections_end = sections + u64::from(header.e_shentsize(endian)) * u64::from(header.e_shnum(endian));
    if sections != 0 && sections_end > bytes.len() as u64 {
        return Err(cut_off("the table of section headers", sections_end));
    }
    pieces.into_image()
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

    fn fault(change: impl FnOnce(&mut Vec<u8>)) -> String {
        let mut bytes = EXAMPLE.to_vec();
        change(&mut bytes);
        read(&bytes).unwrap_err().to_string()
    }

    #[test]
    fn takes_the_load_addresses() {
        let image = read(&EXAMPLE).unwrap();
        assert!(image.segments().eq([(0x0801_0000, vec![1, 2, 3, 4]), (0x0801_0100, vec![5, 6, 7, 8])]));
    }

    #[test]
    fn refuses_what_the_device_cannot_run() {
        for (words, found) in [
            ("offset 0x4: is not a 32-bit ELF file", fault(|b| b[4] = 2)),
            ("offset 0x5: is not little-endian", fault(|b| b[5] = 2)),
            ("offset 0x12: is an ELF file for machine 62 and not for Arm", fault(|b| b[18] = 62)),
            ("offset 0x10: is not a linked program", fault(|b| b[16] = 1)),
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
