//! What an image takes of its flash, from its ELF file.

use std::cmp;

use object::elf::PT_LOAD;
use object::read::elf::{ElfFile32, ProgramHeader};
use object::LittleEndian;
use shared_abi::geometry::Region;
use shared_abi::label::{self, Label};

use crate::outcome::Outcome;

/// A piece of an image that is loaded into the flash.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Segment<'f> {
    /// Offset of its bytes in the file.
    pub offset: u32,
    /// The load address (LMA): the address of the bytes in flash.
    pub address: u32,
    pub bytes: &'f [u8],
}

/// Reads the headers of an ELF file.
///
/// # Errors
/// When it is not a 32-bit little-endian ELF file, or one of its tables is outside the file.
pub fn parse(file: &[u8]) -> Outcome<ElfFile32<'_, LittleEndian>> {
    ElfFile32::parse(file)
        .map_err(|error| format!("this is no 32-bit little-endian ELF file, or it is cut off: {error}."))
}

/// The loaded pieces of an ELF file.
///
/// # Errors
/// When it is no ELF file of a chip, or a piece is outside the file.
pub fn segments(file: &[u8]) -> Outcome<Vec<Segment<'_>>> {
    let elf = parse(file)?;
    let mut segments = Vec::new();
    for header in elf.elf_program_headers().iter().filter(|header| header.p_type(LittleEndian) == PT_LOAD) {
        let bytes = header.data(LittleEndian, file).map_err(|()| "a segment is outside of the ELF file.")?;
        let (offset, address) = (header.p_offset(LittleEndian), header.p_paddr(LittleEndian));
        segments.push(Segment { offset, address, bytes });
    }
    segments.retain(|segment| !segment.bytes.is_empty());
    Ok(segments)
}

/// The bytes of each region from its base to the last loaded one, gaps included.
///
/// # Errors
/// When the image loads nothing, or loads a byte outside its regions.
pub fn used(segments: &[Segment], regions: &[Region]) -> Outcome<Vec<u32>> {
    let mut used = vec![0; regions.len()];
    for Segment { address, bytes, .. } in segments {
        let Some(number) = regions.iter().position(|region| region.contains(*address, 1)) else {
            let regions: Vec<_> =
                regions.iter().map(|region| format!("{:#010x}, {}", region.base, kib(region.size))).collect();
            return Err(format!(
                "{} bytes are loaded at {address:#010x}, outside the image's flash ({}); the linker script and the \
                 layout do not agree.",
                bytes.len(),
                regions.join("; ")
            ));
        };
        let region = regions[number];
        let end = address.saturating_add(bytes.len() as u32);
        if end > region.end() {
            return Err(format!(
                "it needs {} bytes of flash at {:#010x}, and has {}: {} too many.",
                end - region.base,
                region.base,
                region.size,
                end - region.end()
            ));
        }
        used[number] = cmp::max(used[number], end - region.base);
    }
    match segments {
        [] => Err("the image loads nothing into flash.".into()),
        _ => Ok(used),
    }
}

/// The label of the program in a region, if it has one.
pub fn label(segments: &[Segment], region: Region) -> Option<Label> {
    let at = region.base + label::OFFSET;
    segments.iter().find_map(|Segment { address, bytes, .. }| {
        let from = at.checked_sub(*address)? as usize;
        Label::parse(bytes.get(from..from + label::SIZE)?.try_into().ok()?)
    })
}

/// A number of bytes, in KiB if it is a whole number of them.
pub fn kib(bytes: u32) -> String {
    match bytes {
        bytes if bytes.is_multiple_of(1024) => format!("{} KiB", bytes / 1024),
        bytes => format!("{bytes} bytes"),
    }
}

#[cfg(test)]
pub mod tests {
    use super::*;

    /// A file built by hand after the System V ABI: vectors at 0800_0000, data that run at 2000_0000 and
    /// are loaded after the vectors, and no sections.
    pub fn by_hand() -> Vec<u8> {
        let mut file = vec![
            0x7F, b'E', b'L', b'F', 1, 1, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, // e_ident
            2, 0, 40, 0, 1, 0, 0, 0, // ET_EXEC, EM_ARM, EV_CURRENT
            1, 0, 0, 8, // e_entry
            52, 0, 0, 0, // e_phoff
            0, 0, 0, 0, // e_shoff
            0, 2, 0, 5, // e_flags
            52, 0, 32, 0, 4, 0, // e_ehsize, e_phentsize, e_phnum
            40, 0, 0, 0, 0, 0, // e_shentsize, e_shnum, e_shstrndx
        ];
        for header in [
            // type, offset, vaddr, paddr, filesz, memsz, flags, align
            [1, 0x100, 0x0800_0000, 0x0800_0000, 0x20, 0x20, 5, 4],
            [1, 0x120, 0x2000_0000, 0x0800_0020, 0x08, 0x108, 6, 4],
            [1, 0x128, 0x2000_0108, 0x2000_0108, 0, 0x10, 6, 4], // zeroed, not loaded
            [0x6474_E551, 0, 0, 0, 0x10, 0, 6, 0],               // PT_GNU_STACK
        ] {
            file.extend(header.into_iter().flat_map(u32::to_le_bytes));
        }
        file.resize(0x128, 0xAA);
        file
    }

    /// The same with a section of this name.
    pub fn with_section(name: &str, bytes: &[u8]) -> Vec<u8> {
        let mut file = by_hand();
        let (at, names) = (file.len() as u32, format!("\0{name}\0.shstrtab\0"));
        file.extend(bytes);
        file.extend(names.as_bytes());
        file.resize(file.len().next_multiple_of(4), 0);
        let (size, names_size, headers) = (bytes.len() as u32, names.len() as u32, file.len() as u32);
        file[32..36].copy_from_slice(&headers.to_le_bytes()); // e_shoff
        file[46..52].copy_from_slice(&[40, 0, 3, 0, 2, 0]); // e_shentsize, e_shnum, e_shstrndx
        for header in [
            // name, type, flags, address, offset, size, link, info, align, entry size
            [0; 10],
            [1, 1, 0, 0, at, size, 0, 0, 1, 0], // SHT_PROGBITS
            [name.len() as u32 + 2, 3, 0, 0, at + size, names_size, 0, 0, 1, 0], // SHT_STRTAB
        ] {
            file.extend(header.into_iter().flat_map(u32::to_le_bytes));
        }
        file
    }

    const VECTORS: Segment = Segment { offset: 0x100, address: 0x0800_0000, bytes: &[0xAA; 0x20] };
    const DATA: Segment = Segment { offset: 0x120, address: 0x0800_0020, bytes: &[0xAA; 8] };

    #[test]
    fn pieces_count_where_they_are_loaded_not_where_they_run() {
        assert_eq!(segments(&by_hand()).unwrap(), [VECTORS, DATA]);
    }

    #[test]
    fn a_file_of_64_bits_and_a_file_cut_off_are_refused() {
        let file = by_hand();
        assert!(segments(&file[..file.len() - 1]).unwrap_err().contains("outside"));
        assert!(segments(&file[..100]).unwrap_err().contains("cut off"));
        let mut foreign = by_hand();
        foreign[4] = 2; // 64 bit
        assert!(segments(&foreign).unwrap_err().contains("32-bit"));
    }

    #[test]
    fn a_gap_counts_as_used() {
        let loaded = [VECTORS, Segment { address: 0x0800_0200, ..DATA }];
        assert_eq!(used(&loaded, &[Region::new(0x0800_0000, 0x1000)]), Ok(vec![0x208]));
        let regions = [Region::new(0x0800_0000, 0x100), Region::new(0x0800_0200, 0x100)];
        assert_eq!(used(&loaded, &regions), Ok(vec![0x20, 8]));
    }

    #[test]
    fn an_image_outside_its_region_is_refused() {
        let used = |base, size| used(&[VECTORS, DATA], &[Region::new(base, size)]);
        assert_eq!(used(0x0800_0000, 0x28), Ok(vec![0x28]));
        assert!(used(0x0801_0000, 0x1000).unwrap_err().contains("outside"));
        let problem = used(0x0800_0000, 0x27).unwrap_err();
        assert_eq!(problem, "it needs 40 bytes of flash at 0x08000000, and has 39: 1 too many.");
        assert!(super::used(&[], &[Region::new(0x0800_0000, 0x27)]).unwrap_err().contains("nothing"));
    }

    #[test]
    fn a_label_is_found_where_the_bootloader_looks_for_it() {
        let region = Region::new(0x0802_0000, 0x1000);
        let mut bytes = vec![0xFF; 0x200];
        bytes[label::OFFSET as usize..].copy_from_slice(&Label::new(1, 0, 3).emit());
        let at = |address| label(&[Segment { offset: 0, address, bytes: &bytes }], region);
        assert_eq!(at(region.base), Some(Label::new(1, 0, 3)));
        assert_eq!([region.base + 4, region.base + 0x1000, 0].map(at), [None; 3]);
    }
}
