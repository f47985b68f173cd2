//! The loaded pieces and the sections of a 32-bit little-endian ELF file.

use object::elf::{FileHeader32, PT_LOAD, SHF_ALLOC, SHT_NOBITS};
use object::read::elf::{FileHeader, ProgramHeader, SectionHeader};
use object::LittleEndian;

use crate::outcome::Outcome;

/// A piece of the image from the program headers (only `PT_LOAD`).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Segment {
    /// Offset of its bytes in the file.
    pub offset: u32,
    /// The load address (LMA): the address of the bytes in flash.
    pub load_address: u32,
    /// Number of its bytes in the file.
    pub file_size: u32,
}

/// A section that is part of the image.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Section {
    /// Its name, for example `.text`.
    pub name: String,
    /// The run-time address (VMA).
    pub address: u32,
    /// Offset of its bytes in the file.
    pub offset: u32,
    /// Its length in bytes.
    pub size: u32,
    /// Whether the image contains its bytes: it is allocated, and is neither zeroed nor left
    /// unchanged at start-up.
    pub loaded: bool,
}

/// The contents of an ELF file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Elf {
    /// The loaded segments.
    pub segments: Vec<Segment>,
    /// All sections, in the order of the file.
    pub sections: Vec<Section>,
}

impl Elf {
    /// Reads an ELF file.
    ///
    /// # Errors
    /// When it is not a 32-bit little-endian ELF file, or one of its tables or segments is outside
    /// the file.
    pub fn parse(file: &[u8]) -> Outcome<Self> {
        let invalid = |error| format!("this is no 32-bit little-endian ELF file, or it is cut off: {error}.");
        let header = FileHeader32::<LittleEndian>::parse(file).map_err(invalid)?;
        let mut segments = Vec::new();
        for segment in header.program_headers(LittleEndian, file).map_err(invalid)? {
            if segment.p_type(LittleEndian) == PT_LOAD {
                segment
                    .data(LittleEndian, file)
                    .map_err(|()| "a segment is outside of the ELF file.".to_owned())?;
                segments.push(Segment {
                    offset: segment.p_offset(LittleEndian),
                    load_address: segment.p_paddr(LittleEndian),
                    file_size: segment.p_filesz(LittleEndian),
                });
            }
        }
        let table = header.sections(LittleEndian, file).map_err(invalid)?;
        let section = |section: &_| {
            let name = table.section_name(LittleEndian, section).map_err(invalid)?;
            let is_allocated = section.sh_flags(LittleEndian) & SHF_ALLOC != 0;
            Ok(Section {
                name: String::from_utf8_lossy(name).into_owned(),
                address: section.sh_addr(LittleEndian),
                offset: section.sh_offset(LittleEndian),
                size: section.sh_size(LittleEndian),
                loaded: is_allocated && section.sh_type(LittleEndian) != SHT_NOBITS,
            })
        };
        Ok(Self { segments, sections: table.iter().map(section).collect::<Outcome<_>>()? })
    }

    /// The address of a section's bytes in flash, if the image contains them.
    pub fn load_address(&self, section: &Section) -> Option<u32> {
        if !section.loaded || section.size == 0 {
            return None;
        }
        self.segments.iter().find_map(|segment| {
            let into = section.offset.checked_sub(segment.offset)?;
            let fits = into < segment.file_size && section.size <= segment.file_size - into;
            if fits {
                segment.load_address.checked_add(into)
            } else {
                None
            }
        })
    }
}

#[cfg(test)]
pub mod tests {
    use super::*;

    /// A file built by hand after the System V ABI: a vector table at 0800_0000, and `.data` that
    /// runs at 2000_0000 and is loaded after the vectors.
    pub fn by_hand() -> Vec<u8> {
        let mut file = vec![
            0x7F, b'E', b'L', b'F', 1, 1, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, // e_ident
            2, 0, 40, 0, 1, 0, 0, 0, // ET_EXEC, EM_ARM, EV_CURRENT
            1, 0, 0, 8, // e_entry
            52, 0, 0, 0, // e_phoff
            0, 2, 0, 0, // e_shoff = 0x200
            0, 2, 0, 5, // e_flags
            52, 0, 32, 0, 3, 0, // e_ehsize, e_phentsize, e_phnum
            40, 0, 7, 0, 6, 0, // e_shentsize, e_shnum, e_shstrndx
        ];
        let put = |file: &mut Vec<u8>, words: &[u32]| {
            file.extend(words.iter().flat_map(|word| word.to_le_bytes()));
        };
        // type, offset, vaddr, paddr, filesz, memsz, flags, align
        put(&mut file, &[1, 0x100, 0x0800_0000, 0x0800_0000, 0x20, 0x20, 5, 4]);
        put(&mut file, &[1, 0x120, 0x2000_0000, 0x0800_0020, 0x08, 0x108, 6, 4]);
        put(&mut file, &[0x6474_E551, 0, 0, 0, 0, 0, 6, 0]); // PT_GNU_STACK
        file.resize(0x100, 0);
        file.resize(0x128, 0xAA);
        let strings = b"\0.vectors\0.data\0.bss\0.symtab\0.shstrtab\0start\0"; // 45 bytes at 0x128
        file.extend(strings);
        file.resize(0x160, 0);
        file.resize(0x200, 0);
        // name, type, flags, addr, offset, size, link, info, addralign, entsize
        put(&mut file, &[0; 10]);
        put(&mut file, &[1, 1, 2, 0x0800_0000, 0x100, 0x20, 0, 0, 4, 0]);
        put(&mut file, &[10, 1, 3, 0x2000_0000, 0x120, 8, 0, 0, 4, 0]);
        put(&mut file, &[16, 8, 3, 0x2000_0008, 0x128, 0x100, 0, 0, 4, 0]);
        put(&mut file, &[21, 2, 0, 0, 0x160, 48, 6, 1, 4, 16]);
        put(&mut file, &[21, 1, 0, 0, 0x100, 4, 0, 0, 1, 0]); // like .debug_*: not loaded
        put(&mut file, &[29, 3, 0, 0, 0x128, 45, 0, 0, 1, 0]);
        file
    }

    #[test]
    fn a_file_by_hand_is_read() {
        let elf = Elf::parse(&by_hand()).unwrap();
        assert_eq!(
            elf.segments,
            [
                Segment { offset: 0x100, load_address: 0x0800_0000, file_size: 0x20 },
                Segment { offset: 0x120, load_address: 0x0800_0020, file_size: 8 },
            ]
        );
        let names: Vec<_> = elf.sections.iter().map(|section| section.name.as_str()).collect();
        assert_eq!(names, ["", ".vectors", ".data", ".bss", ".symtab", ".symtab", ".shstrtab"]);
        let loads: Vec<_> = elf.sections.iter().map(|section| elf.load_address(section)).collect();
        assert_eq!(loads, [None, Some(0x0800_0000), Some(0x0800_0020), None, None, None, None]);
    }

    #[test]
    fn a_file_of_64_bits_and_a_file_cut_off_are_refused() {
        let file = by_hand();
        assert!(Elf::parse(&file[..file.len() - 1]).is_err());
        let mut foreign = by_hand();
        foreign[4] = 2; // 64 bit
        assert!(Elf::parse(&foreign).unwrap_err().contains("32-bit"));
    }
}
