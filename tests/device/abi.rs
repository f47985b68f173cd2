//! The ABI of the built images: what bootloader and application agree on is where the layout says.
//! (`tests/abi` tests the numbers themselves.)

use coboot_tests::firmware;
use object::elf::{FileHeader32, PT_LOAD, STT_FUNC};
use object::read::elf::{ElfFile32, FileHeader, ProgramHeader};
use object::{Endianness, Object, ObjectSection, ObjectSymbol, SectionFlags, SymbolFlags, SymbolSection};
use shared_abi::geometry::Region;
use shared_abi::layout::Layout;
use shared_abi::vectors::VectorTable;

#[test]
fn the_warm_start_cell_is_the_last_of_the_ram_and_in_no_image() {
    let layout = firmware::board();
    assert_eq!(layout.warm_start.end(), layout.chip.sram.end());
    for image in [firmware::BOOTLOADER, firmware::BOOTLOADER_PAULUS, firmware::APP_V1, firmware::APP_V2] {
        for (address, size) in memory_ranges(&firmware::elf(image)) {
            for cell in [layout.warm_start, layout.handoff] {
                assert!(!Region::new(address, size).overlaps(&cell), "{image}: {address:#x}+{size:#x}");
            }
        }
    }
}

/// Every address range that a running image uses: its segments and its stack.
fn memory_ranges(elf: &[u8]) -> Vec<(u32, u32)> {
    let header = FileHeader32::<Endianness>::parse(elf).unwrap();
    let segments = header.program_headers(Endianness::Little, elf).unwrap();
    let mut ranges: Vec<_> = segments
        .iter()
        .filter(|segment| segment.p_type(Endianness::Little) == PT_LOAD)
        .map(|s| (s.p_vaddr(Endianness::Little), s.p_memsz(Endianness::Little)))
        .filter(|(_, size)| *size > 0)
        .collect();
    let (initial_sp, _) = vectors(elf);
    // The stack grows down from the initial pointer: its first word is below it.
    ranges.push((initial_sp - 4, 4));
    ranges
}

/// The first two words of an image: of a program in flash, and of the bootloader's resident part.
fn vectors(elf: &[u8]) -> (u32, u32) {
    let file = ElfFile32::<Endianness>::parse(elf).unwrap();
    let table = file.section_by_name(".vector_table").or_else(|| file.section_by_name(".resident")).unwrap();
    let data = table.data().unwrap();
    let word = |at: usize| u32::from_le_bytes(data[at..at + 4].try_into().unwrap());
    (word(0), word(4))
}

#[test]
fn every_segment_lies_in_its_own_flash_and_in_the_images_ram() {
    let layout = firmware::board();
    // The bootloader has two places in the split map.
    let home = layout.home.unwrap_or(layout.bootloader);
    let images = [
        (firmware::BOOTLOADER, [layout.bootloader, home]),
        (firmware::APP_V1, [layout.programs[0]; 2]),
        (firmware::APP_V2, [layout.programs[0]; 2]),
    ];
    for (image, flash) in images {
        let is_in_flash = |address, size| flash.iter().any(|place| place.contains(address, size));
        let elf = firmware::elf(image);
        let header = FileHeader32::<Endianness>::parse(&*elf).unwrap();
        let mut loaded = 0;
        for segment in header.program_headers(Endianness::Little, &*elf).unwrap() {
            let endian = Endianness::Little;
            if segment.p_type(endian) != PT_LOAD || segment.p_memsz(endian) == 0 {
                continue;
            }
            let (paddr, vaddr) = (segment.p_paddr(endian), segment.p_vaddr(endian));
            let (filesz, memsz) = (segment.p_filesz(endian), segment.p_memsz(endian));
            if filesz > 0 {
                assert!(is_in_flash(paddr, filesz), "{image}: {paddr:#x} is not its flash");
                loaded += filesz;
            }
            assert!(
                is_in_flash(vaddr, memsz) || layout.ram.contains(vaddr, memsz),
                "{image}: {vaddr:#x}+{memsz:#x}"
            );
        }
        assert!(loaded > 1024, "{image} has only {loaded} bytes");
    }
}

#[test]
fn every_symbol_lies_in_its_own_flash_or_in_the_images_ram() {
    let layout = firmware::board();
    let home = layout.home.unwrap_or(layout.bootloader);
    let images =
        [(firmware::BOOTLOADER, [layout.bootloader, home]), (firmware::APP_V1, [layout.programs[0]; 2])];
    for (image, flash) in images {
        let elf = firmware::elf(image);
        let file = ElfFile32::<Endianness>::parse(&*elf).unwrap();
        let mut count = 0;
        for symbol in file.symbols() {
            // Numbers (absolute symbols) and names of sections that are not loaded have no address
            // in memory.
            let SymbolSection::Section(section) = symbol.section() else { continue };
            let SectionFlags::Elf { sh_flags } = file.section_by_index(section).unwrap().flags() else {
                continue;
            };
            if sh_flags & u64::from(object::elf::SHF_ALLOC) == 0 {
                continue;
            }
            let (address, size) = (symbol.address() as u32 & !1, symbol.size() as u32);
            // A border symbol may be the address directly after the last byte.
            let within = |region: &Region| address >= region.base && address + size <= region.end();
            assert!(
                flash.iter().any(within) || within(&layout.ram),
                "{image}: {:?} at {address:#x}",
                symbol.name()
            );
            count += 1;
        }
        assert!(count > 50, "{image}: only {count} symbols were looked at");
    }
}

#[test]
fn what_the_jump_demands_of_a_program_the_template_keeps() {
    let layout = firmware::board();
    for image in [firmware::APP_V1, firmware::APP_V2] {
        let (initial_sp, reset) = vectors(&firmware::elf(image));
        let table = VectorTable::check([initial_sp, reset], layout.programs[0], layout);
        assert!(table.is_ok(), "{image}: {table:?}");
        assert_eq!(initial_sp, layout.ram.end(), "{image}: the application gets all of the RAM");
    }
}

#[test]
fn the_callgate_is_where_the_layout_says() {
    let layout = firmware::board();
    let elf = firmware::elf(firmware::BOOTLOADER);
    let (base, resident) = firmware::section(&elf, ".resident");
    assert_eq!(base, layout.bootloader.base);
    let data = &resident[layout.callgate_offset as usize..];
    assert_eq!(data[..4], *b"CBCG");
    assert_eq!(data[4..8], [1, 0, 16, 0], "ABI version 1, 16 bytes");
    let entry = u32::from_le_bytes(data[12..16].try_into().unwrap());
    let callgate = Region::new(layout.callgate(), data.len() as u32);
    assert!(entry & 1 == 1 && callgate.contains(entry & !1, 2), "{entry:#x} leaves the callgate");
}

/// The F4 stalls the core on every access to busy flash: code that runs in bootloader mode must not
/// be in flash.
#[test]
fn the_bootloader_runs_from_ram() {
    let layout: &Layout = firmware::board();
    let elf = firmware::elf(firmware::BOOTLOADER);
    let file = ElfFile32::<Endianness>::parse(&*elf).unwrap();
    let mut in_ram = 0;
    for symbol in file.symbols() {
        let SymbolFlags::Elf { st_info, .. } = symbol.flags() else { continue };
        if st_info & 0xF != STT_FUNC {
            continue;
        }
        let name = symbol.name().unwrap();
        let address = symbol.address() as u32 & !1;
        // The resident part, which runs from flash, is a program of its own: it has no symbols here.
        assert!(layout.ram.contains(address, 2), "{name} at {address:#x} would stall while flash is busy");
        in_ram += 1;
    }
    assert!(in_ram > 30, "only {in_ram} functions were looked at");
    for constants in [".rodata", ".text"] {
        assert!(file.section_by_name(constants).is_none(), "{constants} is a section of its own, in flash");
    }
}
