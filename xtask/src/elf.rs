//! A reader of ELF files with the parts that the size gate needs: 32 bit, little-endian (System V
//! ABI, chapters 4 and 5).
//!
//! Every offset in the file may be hostile: an offset outside the file is an error with a message.

use crate::Outcome;

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

/// A function or a static.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Symbol {
    /// The name as mangled by the compiler.
    pub name: String,
    /// Its address; bit 0 is set for a Thumb function.
    pub address: u32,
    /// Its length in bytes.
    pub size: u32,
    /// Index of its section in [`Elf::sections`].
    pub section: usize,
}

/// The contents of an ELF file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Elf {
    /// The loaded segments.
    pub segments: Vec<Segment>,
    /// All sections, in the order of the file, so that a symbol's section index is valid.
    pub sections: Vec<Section>,
    /// Functions and statics; empty in a stripped file.
    pub symbols: Vec<Symbol>,
}

const PT_LOAD: u32 = 1;
const SHT_SYMTAB: u32 = 2;
const SHT_NOBITS: u32 = 8;
const SHF_ALLOC: u32 = 2;
const STT_OBJECT: u8 = 1;
const STT_FUNC: u8 = 2;

impl Elf {
    /// Reads an ELF file.
    ///
    /// # Errors
    /// When it is not a 32-bit little-endian ELF file, or one of its tables points outside the
    /// file.
    pub fn parse(file: &[u8]) -> Outcome<Self> {
        let file = File(file);
        if file.bytes(0, 6)? != [0x7F, b'E', b'L', b'F', 1, 1] {
            return Err("this is no 32-bit little-endian ELF file.".into());
        }
        let mut segments = Vec::new();
        for header in file.table(file.word(0x1C)?, file.half(0x2A)?, file.half(0x2C)?, 32)? {
            if file.word(header)? == PT_LOAD {
                let segment = Segment {
                    offset: file.word(header + 4)?,
                    load_address: file.word(header + 12)?,
                    file_size: file.word(header + 16)?,
                };
                file.bytes(segment.offset as usize, segment.file_size as usize)?;
                segments.push(segment);
            }
        }

        let headers: Vec<usize> =
            file.table(file.word(0x20)?, file.half(0x2E)?, file.half(0x30)?, 40)?.collect();
        let extent = |header: usize| -> Outcome<(usize, usize)> {
            Ok((file.word(header + 16)? as usize, file.word(header + 20)? as usize))
        };
        let names = match headers.get(usize::from(file.half(0x32)?)) {
            Some(&header) => extent(header)?,
            None => (0, 0),
        };
        let mut sections = Vec::new();
        let mut symbols = Vec::new();
        for &header in &headers {
            let kind = file.word(header + 4)?;
            sections.push(Section {
                name: file.name(names, file.word(header)?)?,
                address: file.word(header + 12)?,
                offset: file.word(header + 16)?,
                size: file.word(header + 20)?,
                loaded: file.word(header + 8)? & SHF_ALLOC != 0 && kind != SHT_NOBITS,
            });
            if kind == SHT_SYMTAB {
                let Some(&strings) = headers.get(file.word(header + 24)? as usize) else {
                    return Err("the symbol table names a string table that is not there.".into());
                };
                let strings = extent(strings)?;
                let (offset, size) = extent(header)?;
                for entry in file.bytes(offset, size)?.chunks_exact(16) {
                    let entry = File(entry);
                    let [info] = entry.bytes(12, 1)? else { unreachable!("one byte was asked for") };
                    let section = usize::from(entry.half(14)?);
                    if matches!(info & 0xF, STT_OBJECT | STT_FUNC) && section < headers.len() {
                        symbols.push(Symbol {
                            name: file.name(strings, entry.word(0)?)?,
                            address: entry.word(4)?,
                            size: entry.word(8)?,
                            section,
                        });
                    }
                }
            }
        }
        Ok(Self { segments, sections, symbols })
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

/// A file whose every access is checked.
#[derive(Clone, Copy)]
struct File<'a>(&'a [u8]);

impl<'a> File<'a> {
    fn bytes(self, offset: usize, len: usize) -> Outcome<&'a [u8]> {
        offset.checked_add(len).and_then(|end| self.0.get(offset..end)).ok_or_else(|| {
            format!("the ELF file is cut off: it refers to {len} bytes at offset {offset:#x}.")
        })
    }

    fn half(self, offset: usize) -> Outcome<u16> {
        self.bytes(offset, 2).map(|bytes| u16::from_le_bytes([bytes[0], bytes[1]]))
    }

    fn word(self, offset: usize) -> Outcome<u32> {
        self.bytes(offset, 4).map(|bytes| u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]))
    }

    /// The offsets of a table's entries, each at least `least` bytes long and all inside the file.
    fn table(self, offset: u32, size: u16, count: u16, least: u16) -> Outcome<impl Iterator<Item = usize>> {
        if count > 0 && size < least {
            return Err(format!("the ELF file has table entries of {size} bytes where {least} are needed."));
        }
        let (offset, size, count) = (offset as usize, usize::from(size), usize::from(count));
        self.bytes(offset, size * count)?;
        Ok((0..count).map(move |entry| offset + entry * size))
    }

    /// A string of a string table (its offset and length).
    fn name(self, (offset, len): (usize, usize), at: u32) -> Outcome<String> {
        let strings = self.bytes(offset, len)?;
        let rest = strings.get(at as usize..).unwrap_or_default();
        let end = rest.iter().position(|&byte| byte == 0).unwrap_or(rest.len());
        Ok(String::from_utf8_lossy(&rest[..end]).into_owned())
    }
}

#[cfg(test)]
pub mod tests {
    use super::*;

    /// A file built by hand after the System V ABI: a vector table at 0800_0000, and `.data` that
    /// runs at 2000_0000 and is loaded after the vectors; one function in `.vectors`.
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
        // name, value, size, info/other/shndx
        put(&mut file, &[0, 0, 0, 0]);
        put(&mut file, &[39, 0x0800_0011, 0x10, 0x0001_0012]); // FUNC, GLOBAL, section 1
        put(&mut file, &[39, 0x0800_0000, 0, 0x0001_0003]); // SECTION: of no interest
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
        let symbol = Symbol { name: "start".into(), address: 0x0800_0011, size: 0x10, section: 1 };
        assert_eq!(elf.symbols, [symbol]);
    }

    #[test]
    fn a_file_cut_off_anywhere_is_refused_or_read_but_never_a_panic() {
        let file = by_hand();
        for len in 0..file.len() {
            assert!(Elf::parse(&file[..len]).is_err(), "{len}");
        }
    }

    #[test]
    fn garbage_in_any_byte_is_no_panic() {
        let file = by_hand();
        for at in 0..file.len() {
            for value in [0, 1, 0x7F, 0x80, 0xFF] {
                let mut file = file.clone();
                file[at] = value;
                if let Ok(elf) = Elf::parse(&file) {
                    for section in &elf.sections {
                        let _ = elf.load_address(section);
                    }
                }
            }
        }
        let mut foreign = by_hand();
        foreign[4] = 2; // 64 bit
        assert!(Elf::parse(&foreign).unwrap_err().contains("32-bit"));
    }
}
