//! The ABI between bootloader, application and tools: byte for byte, and against the built images.

use std::mem::{align_of, offset_of, size_of};

use coboot_tests::firmware;
use object::elf::{FileHeader32, PT_LOAD, STT_FUNC};
use object::read::elf::{ElfFile32, FileHeader, ProgramHeader};
use object::{Endianness, Object, ObjectSection, ObjectSymbol, SectionFlags, SymbolFlags, SymbolSection};
use shared_abi::callgate::{self, Crc32Args};
use shared_abi::geometry::Region;
use shared_abi::handoff::{BootInfo, Handoff, ResetCause};
use shared_abi::layout::Layout;
use shared_abi::vectors::VectorTable;
use shared_abi::warm_start::{BootRequest, Owed, WarmStart};

/// The bytes of a structure in RAM. (The host is little-endian, like the chip.)
fn bytes<T: Copy>(value: &T) -> Vec<u8> {
    const { assert!(cfg!(target_endian = "little")) };
    // SAFETY: `T` is one of the ABI's `repr(C)` structures without padding (the sizes are checked
    // in these tests).
    unsafe { std::slice::from_raw_parts(std::ptr::from_ref(value).cast(), size_of::<T>()) }.to_vec()
}

/// The check words below come from an implementation of the fold in another language.
#[test]
fn warm_start_cell_byte_for_byte() {
    assert_eq!((size_of::<WarmStart>(), align_of::<WarmStart>()), (16, 4));
    assert_eq!(offset_of!(WarmStart, magic), 0);
    assert_eq!(offset_of!(WarmStart, request), 4);
    assert_eq!(offset_of!(WarmStart, argument), 8);
    assert_eq!(offset_of!(WarmStart, check), 12);
    #[rustfmt::skip]
    let cells: [(BootRequest, [u8; 16]); 6] = [
        (BootRequest::Stay, [b'C', b'B', b'W', b'1', 1, 0, 0, 0, 0, 0, 0, 0, 0xF0, 0xB7, 0x28, 0xD9]),
        (BootRequest::Trial(1), [b'C', b'B', b'W', b'1', 2, 0, 0, 0, 1, 0, 0, 0, 0xCD, 0x59, 0x20, 0xE5]),
        (BootRequest::Start(1), [b'C', b'B', b'W', b'1', 3, 0, 0, 0, 1, 0, 0, 0, 0xF9, 0x81, 0xE0, 0x52]),
        (BootRequest::Fresh(1), [b'C', b'B', b'W', b'1', 9, 0, 0, 0, 1, 0, 0, 0, 0x5F, 0xD5, 0xAC, 0xE8]),
        // STOP of program 1, sent to node 5; CLEAR of program 2, sent to node 127.
        (BootRequest::Owed(Owed { program: 1, value: 0, node_id: 5 }),
         [b'C', b'B', b'W', b'1', 7, 0, 0, 0, 1, 0, 5, 0, 0x56, 0xAA, 0x9D, 0xE8]),
        (BootRequest::Owed(Owed { program: 2, value: 3, node_id: 127 }),
         [b'C', b'B', b'W', b'1', 7, 0, 0, 0, 2, 3, 127, 0, 0xA5, 0x7F, 0x86, 0xCC]),
    ];
    for (request, expected) in cells {
        assert_eq!(bytes(&WarmStart::new(request)), expected);
    }
}

#[test]
fn handoff_byte_for_byte() {
    assert_eq!((size_of::<Handoff>(), align_of::<Handoff>()), (48, 4));
    let offsets = [
        (offset_of!(Handoff, magic), 0),
        (offset_of!(Handoff, version), 4),
        (offset_of!(Handoff, length), 6),
        (offset_of!(Handoff, node_id), 8),
        (offset_of!(Handoff, program), 9),
        (offset_of!(Handoff, reset_cause), 10),
        (offset_of!(Handoff, trial), 11),
        (offset_of!(Handoff, bit_rate), 12),
        (offset_of!(Handoff, bootloader_version), 16),
        (offset_of!(Handoff, serial_number), 20),
        (offset_of!(Handoff, flags), 24),
        (offset_of!(Handoff, reserved), 28),
        (offset_of!(Handoff, check), 44),
    ];
    for (actual, expected) in offsets {
        assert_eq!(actual, expected);
    }
    let handoff = Handoff::new(&BootInfo {
        node_id: 5,
        bit_rate: 125_000,
        program: 1,
        reset_cause: ResetCause::Software,
        trial: true,
        fresh: true,
        bootloader_version: 0x0001_0002,
        serial_number: 0xDEAD_BEEF,
    });
    #[rustfmt::skip]
    let expected = [
        b'C', b'B', b'H', b'O', 2, 0, 48, 0,
        5, 1, 3, 1, 0x48, 0xE8, 0x01, 0x00,
        0x02, 0x00, 0x01, 0x00, 0xEF, 0xBE, 0xAD, 0xDE,
        1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0,
        0x91, 0x69, 0x48, 0x4E,
    ];
    assert_eq!(bytes(&handoff), expected);
}

#[test]
fn callgate_byte_for_byte() {
    type Table = callgate::Table<u32>;
    assert_eq!(size_of::<Table>(), callgate::TABLE_SIZE as usize);
    assert_eq!(offset_of!(Table, magic), 0);
    assert_eq!(offset_of!(Table, abi_version), 4);
    assert_eq!(offset_of!(Table, length), 6);
    assert_eq!(offset_of!(Table, bootloader_version), 8);
    assert_eq!(offset_of!(Table, entry), 12);
    assert_eq!(size_of::<Crc32Args>(), 12);
    assert_eq!(offset_of!(Crc32Args, address), 0);
    assert_eq!(offset_of!(Crc32Args, len), 4);
    assert_eq!(offset_of!(Crc32Args, crc), 8);
    assert_eq!(callgate::Selector::Crc32 as u32, 1);
}

/// The memory map of the design, typed again: the only second copy of these numbers.
#[test]
fn the_layout_of_the_stm32f407_is_the_documented_one() {
    let layout = &shared_abi::layout::stm32f407g_disc1::LAYOUT;
    assert_eq!(layout.bootloader, Region::new(0x0800_0000, 0x8000));
    assert_eq!(layout.callgate(), 0x0800_0040);
    assert_eq!(layout.parameters, [Region::new(0x0800_8000, 0x4000), Region::new(0x0800_C000, 0x4000)]);
    assert_eq!(layout.programs, [Region::new(0x0801_0000, 960 * 1024)]);
    assert_eq!(layout.ram, Region::new(0x2000_0000, 128 * 1024 - 64));
    assert_eq!(layout.handoff, Region::new(0x2001_FFC0, 48));
    assert_eq!(layout.warm_start, Region::new(0x2001_FFF0, 16));
}

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

/// The first two words of an image in flash.
fn vectors(elf: &[u8]) -> (u32, u32) {
    let file = ElfFile32::<Endianness>::parse(elf).unwrap();
    let table = file.section_by_name(".vector_table").unwrap();
    let data = table.data().unwrap();
    let word = |at: usize| u32::from_le_bytes(data[at..at + 4].try_into().unwrap());
    (word(0), word(4))
}

#[test]
fn every_segment_lies_in_its_own_flash_and_in_the_images_ram() {
    let layout = firmware::board();
    let images = [
        (firmware::BOOTLOADER, layout.bootloader),
        (firmware::BOOTLOADER, layout.bootloader),
        (firmware::APP_V1, layout.programs[0]),
        (firmware::APP_V2, layout.programs[0]),
    ];
    for (image, flash) in images {
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
                assert!(flash.contains(paddr, filesz), "{image}: {paddr:#x} is not its flash");
                loaded += filesz;
            }
            let runs_in_place = flash.contains(vaddr, memsz);
            assert!(runs_in_place || layout.ram.contains(vaddr, memsz), "{image}: {vaddr:#x}+{memsz:#x}");
        }
        assert!(loaded > 1024, "{image} has only {loaded} bytes");
    }
}

#[test]
fn every_symbol_lies_in_its_own_flash_or_in_the_images_ram() {
    let layout = firmware::board();
    for (image, flash) in [(firmware::BOOTLOADER, layout.bootloader), (firmware::APP_V1, layout.programs[0])]
    {
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
            assert!(within(&flash) || within(&layout.ram), "{image}: {:?} at {address:#x}", symbol.name());
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
    let file = ElfFile32::<Endianness>::parse(&*elf).unwrap();
    let section = file.section_by_name(".callgate").unwrap();
    assert_eq!(section.address() as u32, layout.callgate());
    let data = section.data().unwrap();
    assert_eq!(data[..4], *b"CBCG");
    assert_eq!(data[4..8], [1, 0, 16, 0], "ABI version 1, 16 bytes");
    let entry = u32::from_le_bytes(data[12..16].try_into().unwrap());
    let callgate = Region::new(layout.callgate(), section.size() as u32);
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
        // The thunk comes from the linker: Reset jumps through it from flash to `main` in RAM.
        let start_up = matches!(name, "Reset" | "__pre_init" | "boot_fault" | "__Thumbv7ABSLongThunk_main")
            || name.contains("callgate");
        let address = symbol.address() as u32 & !1;
        if start_up {
            assert!(
                layout.bootloader.contains(address, 2),
                "{name} at {address:#x} runs before the RAM image is there"
            );
        } else {
            assert!(
                layout.ram.contains(address, 2),
                "{name} at {address:#x} would stall while flash is busy"
            );
            in_ram += 1;
        }
    }
    assert!(in_ram > 30, "only {in_ram} functions were looked at");
    for constants in [".rodata", ".text"] {
        assert!(file.section_by_name(constants).is_none(), "{constants} is a section of its own, in flash");
    }
}
