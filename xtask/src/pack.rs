//! Packs the bootloader after the link: the part that runs from RAM is stored in flash as a ZX0
//! stream (`shared_abi::ram_image`).
//!
//! Sections, symbols and debug information keep the linker's contents and their addresses in RAM;
//! only the bytes that are loaded into flash change. Programs that load an ELF file use one of two
//! tables, so the packed bytes are in both: as a segment (probe-rs, OpenOCD) and as a section
//! (gdb). `.data` keeps its contents for the debugger, but belongs to no segment with contents any
//! more: gdb's `load` writes it to the RAM, and the boot stage later puts the same bytes there.

use crc::{Crc, CRC_32_ISO_HDLC};
use shared_abi::ram_image::{Method, MAGIC, SERVICES_VERSION};

use crate::elf::{Elf, Section};
use crate::{zx0, Outcome};

/// The linker's section with the header.
const HEADER: &str = ".ram_image";
/// The section of the image, at its addresses in RAM.
pub const IMAGE: &str = ".data";
/// The stream's format of offsets (`shared_abi::ram_image::Method`).
const OFFSETS: zx0::Offsets = zx0::Offsets { unit: 2, is_low_byte: true };
/// The section of the packed bytes.
pub const PACKED: &str = ".ram_image.packed";

/// The bootloader's ELF file with its RAM image packed.
///
/// # Errors
/// When it is not an ELF file, or not as the linker makes it.
pub fn pack(file: &[u8]) -> Outcome<Vec<u8>> {
    let elf = Elf::parse(file)?;
    let find = |name: &str| -> Outcome<&Section> {
        let found = elf.sections.iter().find(|section| section.name == name);
        found.ok_or_else(|| format!("it has no section {name}; the bootloader's linker script makes one."))
    };
    let (header, image) = (find(HEADER)?, find(IMAGE)?);
    let behind_header = header.address + header.size;
    let is_its_own = elf.segments.iter().any(|segment| {
        (segment.offset, segment.file_size, segment.load_address) == (image.offset, image.size, behind_header)
    });
    if !is_its_own || elf.load_address(header).is_none() {
        return Err(format!("{IMAGE} is no segment of its own, loaded right behind {HEADER}."));
    }
    let contents = |section: &Section| &file[section.offset as usize..][..section.size as usize];
    let linked = [MAGIC, 0, SERVICES_VERSION, Method::Raw as u32, image.size, image.size];
    if contents(header) != bytes(&linked) {
        return Err(format!("{HEADER} is not what the bootloader's start.rs puts there."));
    }

    let front = in_front(&elf, header, contents)?;
    let packed = zx0::compress(&front, &with_absolute_calls(contents(image), image.address), OFFSETS);
    // The words after the CRC, which covers them too.
    let rest = bytes(&[SERVICES_VERSION, Method::Zx0 as u32, word(packed.len())?, image.size]);
    let crc = Crc::<u32>::new(&CRC_32_ISO_HDLC).checksum(&[&front[..], &rest, &packed].concat());
    let packed_header = [bytes(&[MAGIC, crc]), rest].concat();

    let mut out = file.to_vec();
    out[header.offset as usize..][..packed_header.len()].copy_from_slice(&packed_header);
    load_instead(out, image, behind_header, &packed)
}

/// The bootloader's flash before the header: the stream can copy from it.
fn in_front<'a>(elf: &Elf, header: &Section, contents: impl Fn(&Section) -> &'a [u8]) -> Outcome<Vec<u8>> {
    let mut sections: Vec<_> = elf
        .sections
        .iter()
        .filter_map(|section| Some((elf.load_address(section)?, section)))
        .filter(|(address, _)| *address < header.address)
        .collect();
    sections.sort_by_key(|(address, _)| *address);
    let mut front = Vec::new();
    let from = sections.first().map_or(header.address, |(address, _)| *address);
    for (address, section) in sections {
        if address != from + word(front.len())? {
            return Err(format!("there is a gap, or an overlap, in front of {}.", section.name));
        }
        front.extend(contents(section));
    }
    if header.address != from + word(front.len())? {
        return Err(format!("there is a gap, or an overlap, in front of {HEADER}."));
    }
    Ok(front)
}

/// The image at this address, with absolute calls (`shared_abi::ram_image::Method`): then two calls
/// of one function are the same bytes, and pack better.
fn with_absolute_calls(image: &[u8], address: u32) -> Vec<u8> {
    let mut out = image.to_vec();
    let mut at = 0;
    while at + 4 <= out.len() {
        let [first, second] = [0, 2].map(|i| u32::from(u16::from_le_bytes([out[at + i], out[at + i + 1]])));
        at += 2;
        if first >> 11 != 0b11110 || second >> 11 != 0b11111 {
            continue;
        }
        let target = ((first & 0x7FF) << 11 | second & 0x7FF) + (address + at as u32) / 2;
        let call = [0xF000 | target >> 11 & 0x7FF, 0xF800 | target & 0x7FF];
        for (bytes, half) in out[at - 2..].chunks_exact_mut(2).zip(call) {
            bytes.copy_from_slice(&(half as u16).to_le_bytes());
        }
        at += 2;
    }
    out
}

/// One of the two tables of an ELF file (System V ABI, chapter 4): the positions of its offset, its
/// entry size and its number of entries in the file's header.
struct Table(usize, usize, usize);

const PROGRAM_HEADERS: Table = Table(0x1C, 0x2A, 0x2C);
const SECTION_HEADERS: Table = Table(0x20, 0x2E, 0x30);
/// The position in the file's header of the number of the section with the sections' names.
const SECTION_OF_NAMES: usize = 0x32;

impl Table {
    /// The entries. The parser has checked that they are in the file.
    fn read(&self, file: &[u8]) -> Vec<Vec<u8>> {
        let (at, size, count) = (get(file, self.0), get_half(file, self.1), get_half(file, self.2));
        file[at as usize..][..size * count].chunks(size).map(<[u8]>::to_vec).collect()
    }

    /// Writes the changed table to the end of the file.
    fn write(&self, file: &mut Vec<u8>, entries: &[Vec<u8>]) -> Outcome {
        let offset = append(file, &entries.concat())?;
        let count = u16::try_from(entries.len()).map_err(|_| "it has too many headers.")?;
        file[self.0..][..4].copy_from_slice(&offset.to_le_bytes());
        file[self.2..][..2].copy_from_slice(&count.to_le_bytes());
        Ok(())
    }
}

/// Appends `packed` to the file, as a segment and a section at `address`, instead of the contents
/// of the segment of `image`. That segment stays without contents: it only reserves RAM.
fn load_instead(mut file: Vec<u8>, image: &Section, address: u32, packed: &[u8]) -> Outcome<Vec<u8>> {
    const PT_LOAD: u32 = 1;
    const PF_R: u32 = 4;
    const SHT_PROGBITS: u32 = 1;
    const SHF_ALLOC: u32 = 2;
    const ALIGNMENT: u32 = 4;
    let (offset, size) = (append(&mut file, packed)?, word(packed.len())?);

    // Type, offset, virtual and physical address, size in the file and in memory, flags, alignment.
    let mut headers = PROGRAM_HEADERS.read(&file);
    let of_image = |header: &Vec<u8>| {
        (get(header, 0), get(header, 4), get(header, 16)) == (PT_LOAD, image.offset, image.size)
    };
    let at = headers.iter().position(of_image).ok_or("its program headers have changed.")?;
    headers[at][12..20].copy_from_slice(&bytes(&[image.address, 0]));
    headers.insert(at, bytes(&[PT_LOAD, offset, address, address, size, size, PF_R, ALIGNMENT]));
    PROGRAM_HEADERS.write(&mut file, &headers)?;

    // Name, type, flags, address, offset, size, link, information, alignment, size of an entry. The
    // new one is the last, since symbols name the others by number.
    let mut headers = SECTION_HEADERS.read(&file);
    let names = get_half(&file, SECTION_OF_NAMES);
    let names = headers.get_mut(names).ok_or("its sections have no names.")?;
    let mut strings = file[get(names, 16) as usize..][..get(names, 20) as usize].to_vec();
    let name = word(strings.len())?;
    strings.extend(PACKED.bytes().chain([0]));
    let place = [append(&mut file, &strings)?, word(strings.len())?];
    names[16..24].copy_from_slice(&bytes(&place));
    headers.push(bytes(&[name, SHT_PROGBITS, SHF_ALLOC, address, offset, size, 0, 0, ALIGNMENT, 0]));
    SECTION_HEADERS.write(&mut file, &headers)?;
    Ok(file)
}

/// Appends to a file, aligned to words; returns the offset.
fn append(file: &mut Vec<u8>, contents: &[u8]) -> Outcome<u32> {
    file.resize(file.len().next_multiple_of(4), 0);
    let offset = word(file.len());
    file.extend(contents);
    offset
}

fn word(number: usize) -> Outcome<u32> {
    u32::try_from(number).map_err(|_| "it is too long.".to_owned())
}

fn bytes(words: &[u32]) -> Vec<u8> {
    words.iter().flat_map(|word| word.to_le_bytes()).collect()
}

fn get(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
}

fn get_half(bytes: &[u8], at: usize) -> usize {
    usize::from(u16::from_le_bytes([bytes[at], bytes[at + 1]]))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A bootloader's file made by hand: the header at 0800_0020, followed by the image of 64
    /// bytes.
    fn linked() -> Vec<u8> {
        const RAW: u32 = 64;
        let mut file = vec![0x7F, b'E', b'L', b'F', 1, 1, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0];
        file.extend([2, 0, 40, 0, 1, 0, 0, 0]);
        file.extend(bytes(&[0x0800_0001, 52, 0x200, 0x0500_0200]));
        file.extend([52, 0, 32, 0, 2, 0, 40, 0, 4, 0, 3, 0]);
        file.extend(bytes(&[1, 0x100, 0x0800_0020, 0x0800_0020, 24, 24, 4, 4]));
        file.extend(bytes(&[1, 0x118, 0x2000_0000, 0x0800_0038, RAW, RAW, 5, 4]));
        file.resize(0x100, 0);
        file.extend(bytes(&[MAGIC, 0, SERVICES_VERSION, 0, RAW, RAW]));
        file.extend(b"The quick brown fox, and the quick brown fox, and the quick fox.");
        file.extend(b"\0.ram_image\0.data\0.shstrtab\0");
        file.resize(0x200, 0);
        file.extend([0; 40]);
        file.extend(bytes(&[1, 1, 2, 0x0800_0020, 0x100, 24, 0, 0, 4, 0]));
        file.extend(bytes(&[12, 1, 3, 0x2000_0000, 0x118, RAW, 0, 0, 4, 0]));
        file.extend(bytes(&[18, 3, 0, 0, 0x158, 28, 0, 0, 1, 0]));
        file
    }

    #[test]
    fn the_packed_bytes_are_loaded_in_the_place_of_the_image() {
        let before = linked();
        let after = pack(&before).unwrap();
        let elf = Elf::parse(&after).unwrap();
        let sections: Vec<_> =
            elf.sections.iter().map(|section| (section.name.as_str(), section.address)).collect();
        let expected =
            [("", 0), (HEADER, 0x0800_0020), (IMAGE, 0x2000_0000), (".shstrtab", 0), (PACKED, 0x0800_0038)];
        assert_eq!(sections, expected);
        let packed = &elf.sections[4];
        assert!(packed.size < 64);
        let loads: Vec<_> = elf.sections.iter().map(|section| elf.load_address(section)).collect();
        assert_eq!(loads, [None, Some(0x0800_0020), None, None, Some(0x0800_0038)]);
        let segments: Vec<_> =
            elf.segments.iter().map(|segment| (segment.load_address, segment.file_size)).collect();
        assert_eq!(segments, [(0x0800_0020, 24), (0x0800_0038, packed.size), (0x2000_0000, 0)]);
        // The image is unchanged, for the debugger.
        assert_eq!(after[0x118..0x158], before[0x118..0x158]);
        // It has no calls; `zx0` tests the contents of the stream.
        let stream = &after[packed.offset as usize..][..packed.size as usize];
        assert_eq!(stream, zx0::compress(&[], &before[0x118..0x158], OFFSETS));
        let header: Vec<u32> = (0..6).map(|word| get(&after, 0x100 + word * 4)).collect();
        assert_eq!(header[2..], [SERVICES_VERSION, 1, packed.size, 64]);
        let crc = Crc::<u32>::new(&CRC_32_ISO_HDLC);
        let loaded = [&after[0x108..0x118], &after[packed.offset as usize..][..packed.size as usize]];
        assert_eq!(header[..2], [MAGIC, crc.checksum(&loaded.concat())]);
    }

    #[test]
    fn what_is_no_bootloader_or_packed_already_is_refused() {
        let packed = pack(&linked()).unwrap();
        assert!(pack(&packed).unwrap_err().contains("segment"));
        assert!(pack(&crate::elf::tests::by_hand()).unwrap_err().contains("no section .ram_image"));
        let mut other = linked();
        other[0x104] = 1;
        assert!(pack(&other).unwrap_err().contains("start.rs"));
    }
}
