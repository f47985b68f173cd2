//! What is made from a layout: regions, symbols and texts, worked out by hand for the board
//! STM32F407G-DISC1 (RM0090 table 5; 82 interrupts, so 392 bytes of vectors).

use shared_abi::geometry::Region;
use shared_abi::layout::stm32f407g_disc1::LAYOUT;
use shared_abi::layout::toml::Toml;
use shared_abi::layout::{by_name, chosen, nucleo_f446re, Image};

#[test]
fn regions_of_the_bootloader_and_its_programs() {
    assert_eq!(LAYOUT.callgate(), 0x0800_0040);
    assert_eq!(LAYOUT.key_block(), Region::new(0x0800_3F00, 0x100));
    assert_eq!(LAYOUT.resident(), Region::new(0x0800_0000, 0x3F00));
    // The compact map has no key block.
    assert_eq!(nucleo_f446re::LAYOUT.resident(), Region::new(0x0800_0000, 0x8000));
    assert_eq!(LAYOUT.program(1), Some(Region::new(0x0802_0000, 0xE_0000)));
    assert_eq!((LAYOUT.program(0), LAYOUT.program(2)), (None, None));
}

/// The sectors of RM0090 table 5 and RM0390 table 4: 16 KiB each up to sector 3, then 64 KiB.
#[test]
fn the_write_protection_covers_the_bootloader_and_leaves_what_a_renewal_writes() {
    for (layout, renewal, mask) in
        [(&LAYOUT, false, 0b1_0001), (&LAYOUT, true, 0b0_0001), (&nucleo_f446re::LAYOUT, false, 0b0_0011)]
    {
        assert_eq!(layout.protected_sectors(renewal), mask, "{}, {renewal}", layout.board);
    }
}

#[test]
fn boards_have_names() {
    assert_eq!(by_name("nucleo-f446re").map(|layout| layout.chip.chip), Some("stm32f446re"));
    assert_eq!(by_name("nucleo"), None);
    assert_eq!(chosen(None).board, "stm32f407g-disc1");
    assert_eq!(chosen(Some("stm32f429i-disc1")).board, "stm32f429i-disc1");
    let panic = std::panic::catch_unwind(|| chosen(Some("x"))).unwrap_err();
    let said = panic.downcast_ref::<String>().unwrap();
    assert!(
        said.starts_with("COBOOT_BOARD=x: ") && said.contains("nucleo-f446re, stm32f407g-disc1, "),
        "{said}"
    );
}

#[test]
fn the_linker_script_of_a_program() {
    let whole = LAYOUT.linker_script(Image::WholeProgram(1)).to_string();
    assert!(whole.contains("FLASH : ORIGIN = 0x08020000, LENGTH = 0xe0000\n"), "{whole}");
    let text = LAYOUT.linker_script(Image::Program(1)).to_string();
    for line in [
        "  FLASH : ORIGIN = 0x08020000, LENGTH = 0xc0000",
        "  RAM   : ORIGIN = 0x20000000, LENGTH = 0x1ffc0",
        "__vector_table_alignment = 0x00000200;",
        "__vector_table_size = 0x00000188;",
        "__core_vectors_size = 0x00000040;",
        "__label = 0x080201e0;",
        "__label_end = 0x08020200;",
        "__callgate_table = 0x08000040;",
        "__callgate_table_size = 0x00000010;",
        "__kept = 0x2001fbc0;",
        "__kept_end = 0x2001ffc0;",
        "__handoff = 0x2001ffc0;",
        "__warm_start = 0x2001fff0;",
        "__sram_end = 0x20020000;",
        "__programs = 0x00000001;",
    ] {
        assert!(text.lines().any(|of| of == line), "{line}\n{text}");
    }
    // A KiB less, with the symbols of panic-persist 0.3.
    let keeping = LAYOUT.linker_script(Image::Program(1)).keeping_ram().to_string();
    assert!(keeping.contains("RAM   : ORIGIN = 0x20000000, LENGTH = 0x1fbc0\n"), "{keeping}");
    assert!(keeping.contains("_panic_dump_start = __kept;\n_panic_dump_end = __kept_end;\n"), "{keeping}");
    let bootloader = LAYOUT.linker_script(Image::Bootloader).to_string();
    assert!(bootloader.contains("RAM   : ORIGIN = 0x20000000, LENGTH = 0x1fbc0\n"), "{bootloader}");
    assert!(bootloader.contains("FLASH : ORIGIN = 0x08000000, LENGTH = 0x3f00\n"), "{bootloader}");
    assert!(bootloader.contains("HOME  : ORIGIN = 0x08010000, LENGTH = 0x10000\n"), "{bootloader}");
    let compact = nucleo_f446re::LAYOUT.linker_script(Image::Bootloader).to_string();
    assert!(compact.contains("FLASH : ORIGIN = 0x08000000, LENGTH = 0x8000\n"), "{compact}");
    assert!(compact.contains("REGION_ALIAS(\"HOME\", FLASH)\n"), "{compact}");
}

/// Each row by its words: name, first and last address, size, sectors.
#[test]
fn the_map_for_people() {
    let text = LAYOUT.to_string();
    let rows: Vec<Vec<&str>> = text.lines().map(|line| line.split_whitespace().collect()).collect();
    for row in [
        "stm32f407g-disc1 (stm32f407vg: flash 1024 KiB, SRAM 128 KiB)",
        "resident part 0800_0000 - 0800_3FFF 16 KiB sector 0: vectors of the core, then the callgate",
        "parameters A 0800_4000 - 0800_7FFF 16 KiB sector 1",
        "parameters B 0800_8000 - 0800_BFFF 16 KiB sector 2",
        "data 0800_C000 - 0800_FFFF 16 KiB sector 3: the application's own",
        "RAM image 0801_0000 - 0801_FFFF 64 KiB sector 4: the rest of the bootloader",
        "program 1 0802_0000 - 080F_FFFF 896 KiB sectors 5-11",
        "handoff 2001_FFC0 - 2001_FFEF 48 B bootloader -> application",
        "The callgate is at 0800_0040.",
    ] {
        assert!(rows.contains(&row.split_whitespace().collect()), "{row}\n{text}");
    }
}

#[test]
fn the_layout_as_toml() {
    let text = Toml(&LAYOUT).to_string();
    for line in [
        "board = \"stm32f407g-disc1\"",
        "bootloader = { base = 0x08000000, size = 0x4000 }",
        "callgate-offset = 0x40",
        "home = { base = 0x08010000, size = 0x10000 }",
        "data = { base = 0x0800c000, size = 0x4000 }",
        "programs = [\n  { base = 0x08020000, size = 0xe0000 },\n]",
        "warm-start = { base = 0x2001fff0, size = 0x10 }",
        "name = \"stm32f407vg\"",
        "  { count = 7, size = 0x20000 },\n]",
        "interrupts = 82\nports = 9",
    ] {
        assert!(text.contains(&format!("{line}\n")), "{line}\n{text}");
    }
}
