//! The bootloader's image: every loader writes it to the right place, and an image that is damaged in
//! flash, or is for another device, does not run.

mod gdb;

use coboot_tests::bench::{press, Bench, NODE};
use coboot_tests::firmware;
use coboot_tests::renewal::image_of;
use emulator::machine::{ResetCause, Stop};
use kit::rig::crc32;
use object::elf::{FileHeader32, PT_LOAD};
use object::read::elf::{ElfFile32, FileHeader, ProgramHeader};
use object::{Endianness, Object, ObjectSection, ObjectSymbol};
use shared_abi::abilities::Abilities;
use shared_abi::check_word;
use shared_abi::geometry::Region;
use shared_abi::layout::toml::Toml;
use shared_abi::ram_image::{Header, Host, SERVICES_VERSION};
use shared_abi::services::{Facts, OFFSET};
use shared_abi::warm_start::Damage;

/// The size of the header in bytes (shared_abi::ram_image, typed again).
const HEADER: usize = 64;

fn words(bytes: &[u8]) -> Vec<u32> {
    bytes.chunks_exact(4).map(|word| u32::from_le_bytes(word.try_into().unwrap())).collect()
}

/// A bootloader in flash: the resident part, and the RAM image with its header.
#[derive(Clone)]
struct Parts {
    resident: Vec<u8>,
    /// The address of the header.
    home: u32,
    /// The header, and the image.
    image: Vec<u8>,
}

impl Parts {
    fn of(name: &str) -> Self {
        let elf = firmware::elf(name);
        let (base, resident) = firmware::section(&elf, ".resident");
        assert_eq!(base, firmware::board().bootloader.base);
        let (home, header) = firmware::section(&elf, ".ram_image");
        assert_eq!(header.len(), HEADER);
        Self { resident, home, image: image_of(name) }
    }

    /// The image without its header, as it is in RAM.
    fn ram(&self) -> &[u8] {
        &self.image[HEADER..]
    }

    /// A word of the header, or of the image after it.
    fn set(&mut self, word: usize, value: u32) {
        self.image[word * 4..][..4].copy_from_slice(&value.to_le_bytes());
    }

    fn get(&self, word: usize) -> u32 {
        words(&self.image[word * 4..][..4])[0]
    }

    /// The correct CRC: of the header after it and of as much of the image as the header says.
    fn right_crc(&self) -> u32 {
        crc32(&self.image[8..HEADER + self.get(SIZE) as usize])
    }

    /// The facts of the resident part.
    fn record(&self) -> &[u8] {
        let board = firmware::board();
        Facts::record(&self.resident, board.bootloader.base, board.callgate() + OFFSET).unwrap()
    }

    /// Corrects the CRC.
    fn seal(&mut self) {
        self.set(CRC, self.right_crc());
    }

    /// The chip's flash with both in it.
    fn flash(&self) -> Vec<u8> {
        let place = firmware::board().chip.flash;
        let mut flash = vec![0xFF; place.size as usize];
        for (address, bytes) in
            [(firmware::board().bootloader.base, &self.resident), (self.home, &self.image)]
        {
            flash[(address - place.base) as usize..][..bytes.len()].copy_from_slice(bytes);
        }
        flash
    }
}

/// The words of the header by number, and the first two of the image.
const MAGIC: usize = 0;
const CRC: usize = 1;
const LENGTH: usize = 2;
const SIZE: usize = 3;
const RAM_BASE: usize = 4;
const RAM_END: usize = 5;
const SERVICES: usize = 6;
const FEATURES: usize = 7;
const BOARD: usize = 8;
const VERSION: usize = 12;
const FACTS: usize = 14;
const RESERVED: usize = 15;
const STACK: usize = 16;
const RESET: usize = 17;

#[test]
fn the_header_says_what_was_linked() {
    let board = firmware::board();
    for name in [firmware::BOOTLOADER, firmware::BOOTLOADER_LEAST] {
        let parts = Parts::of(name);
        assert_eq!(parts.get(MAGIC), u32::from_le_bytes(*b"CBI2"));
        assert_eq!(parts.get(CRC), parts.right_crc(), "{name}");
        assert_eq!(parts.get(LENGTH), 64);
        assert_eq!(parts.get(SIZE) as usize, parts.ram().len());
        assert_eq!([parts.get(RAM_BASE), parts.get(RAM_END)], [board.ram.base, board.bootloader_ram().end()]);
        let renews = board.staging.is_some() && name == firmware::BOOTLOADER;
        assert_eq!(
            [parts.get(SERVICES), parts.get(FEATURES)],
            [SERVICES_VERSION, if renews { 2 } else { 0 }]
        );
        assert_eq!(parts.get(BOARD), crc32(Toml(board).to_string().as_bytes()));
        assert_eq!([parts.get(FACTS), parts.get(RESERVED)], [crc32(parts.record()), 0]);
        match board.home {
            Some(home) => assert_eq!(parts.home, home.base),
            None => assert_eq!(parts.home, board.bootloader.base + parts.resident.len() as u32),
        }
    }
}

/// The resident part says what it decides by: what the products of the tests choose.
#[test]
fn the_resident_part_has_its_facts() {
    let board = firmware::board();
    let identity = crc32(Toml(board).to_string().as_bytes());
    let facts = |image: &str| {
        let resident = Parts::of(image).resident;
        let (version, facts) =
            Facts::of_resident(&resident, board.bootloader.base, board.callgate() + OFFSET).unwrap();
        assert_eq!((version, facts.size, facts.board), (2, 20, identity), "{image}");
        let sdo = [facts.sdo_request_base, facts.sdo_response_base];
        ([facts.autostart, facts.crc_bits, facts.node_ids, facts.bit_rates], sdo)
    };
    let predefined = [0x600, 0x580];
    // A compact board has no CRC-16, and detects no bit rate.
    let is_split = board.home.is_some();
    let bit_rates = if is_split { 0x3FF } else { 0x1FF };
    assert_eq!(facts(firmware::BOOTLOADER), ([1, 32, 0x7F01, bit_rates], predefined));
    assert_eq!(facts(firmware::BOOTLOADER_LEAST), ([0, 32, 0x7F01, 0x1FF], predefined));
    if is_split {
        assert_eq!(facts(firmware::BOOTLOADER_CRC_16), ([1, 16, 0x7F01, bit_rates], predefined));
    }
    assert_eq!(facts(firmware::BOOTLOADER_SWITCHES), ([1, 32, 0x6402, 0x27C & bit_rates], [0x300, 0x480]));
}

/// The flash contains the 16 vectors of the core; the RAM image begins with all vectors.
#[test]
fn vectors() {
    let board = firmware::board();
    let parts = Parts::of(firmware::BOOTLOADER);
    let in_flash = words(&parts.resident[..64]);
    assert_eq!(parts.resident[64..68], *b"CBCG", "the callgate follows them");
    assert_eq!(in_flash[0], board.bootloader_ram().end());
    for vector in &in_flash[1..] {
        assert!(vector & 1 == 1 && board.bootloader.contains(vector & !1, 2), "{vector:#x}");
    }
    let in_ram = words(&parts.ram()[..board.chip.vector_table_size() as usize]);
    assert_eq!(in_ram[0], in_flash[0]);
    // No handler is in flash, because the flash may be busy. Some interrupts have no handler.
    let handlers: Vec<_> = in_ram[1..].iter().filter(|vector| **vector != 0).collect();
    assert!(handlers.iter().all(|vector| board.ram.contains(**vector & !1, 2)), "{in_ram:x?}");
    assert!(handlers.len() > 80);
    let (address, _) = firmware::section(&firmware::elf(firmware::BOOTLOADER), ".data");
    assert_eq!(address, board.ram.base);
}

/// By the rule of probe-rs: segments with contents, at their physical address, if a section lies in
/// them.
#[test]
fn probe_rs_loads_it() {
    let elf = firmware::elf(firmware::BOOTLOADER);
    let file = ElfFile32::<Endianness>::parse(&*elf).unwrap();
    let header = FileHeader32::<Endianness>::parse(&*elf).unwrap();
    let endian = Endianness::Little;
    let place = firmware::board().chip.flash;
    let mut flash = vec![0xFF; place.size as usize];
    for segment in header.program_headers(endian, &*elf).unwrap() {
        let range = u64::from(segment.p_offset(endian))..;
        let end = range.start + u64::from(segment.p_filesz(endian));
        let holds_a_section = file.sections().any(|section| {
            section.file_range().is_some_and(|(at, size)| at >= range.start && at + size <= end && size > 0)
        });
        if segment.p_type(endian) == PT_LOAD && segment.p_filesz(endian) > 0 && holds_a_section {
            let at = (segment.p_paddr(endian) - place.base) as usize;
            let data = segment.data(endian, &*elf).unwrap();
            flash[at..at + data.len()].copy_from_slice(data);
        }
    }
    assert!(flash == Parts::of(firmware::BOOTLOADER).flash());
    // A debugger that starts the program at the file's entry starts where the chip does.
    let reset = words(&Parts::of(firmware::BOOTLOADER).resident[4..8])[0];
    assert_eq!(header.e_entry(endian), reset);
}

/// gdb itself, connected to a stub that has only memory.
#[test]
fn gdb_loads_it_and_finds_symbols_in_ram() {
    let board = firmware::board();
    let commands = [
        "load",
        // Reads back what it wrote, section by section.
        "compare-sections",
        "info address main",
        "info line bootloader::app::idle",
    ];
    let run = gdb::run(&firmware::dir().join(firmware::BOOTLOADER), &commands);
    let said = &run.said;
    let parts = Parts::of(firmware::BOOTLOADER);
    for (address, bytes) in [(board.bootloader.base, &parts.resident), (parts.home, &parts.image)] {
        assert!(run.memory(address, bytes.len()) == *bytes, "gdb wrote something else:\n{said}");
    }
    let places = [
        Region::new(board.bootloader.base, parts.resident.len() as u32),
        Region::new(parts.home, parts.image.len() as u32),
    ];
    let flash = board.chip.flash;
    let is_ours = |address| places.iter().any(|place| place.contains(address, 1));
    assert!(run.written().all(|address| is_ours(address) || !flash.contains(address, 1)));
    assert!(said.contains(".ram_image") && !said.contains("MIS-MATCHED"), "{said}");
    let main = said.split_once("Symbol \"main\" is at 0x").unwrap_or_else(|| panic!("{said}")).1;
    let main = u32::from_str_radix(&main[..8], 16).unwrap();
    assert!(board.ram.contains(main, 2), "{main:#x}");
    assert!(said.contains("of \"bootloader/src/main.rs\" starts at address 0x2"), "{said}");
}

// --- on the emulated board

/// A board with version 1 of the application, switched off.
fn board_with_a_program() -> Bench {
    let mut bench = Bench::new().switched_on();
    bench.install(firmware::APP_V1);
    bench.confirm_program();
    bench.power_off();
    bench
}

fn load(bench: &mut Bench, parts: &Parts) {
    bench.machine().load_bin(firmware::board().bootloader.base, &parts.resident).unwrap();
    bench.machine().load_bin(parts.home, &parts.image).unwrap();
}

/// A new board with these parts, in its bootloader.
fn started(parts: &Parts) -> Bench {
    let mut bench = Bench::new();
    load(&mut bench, parts);
    let mut bench = bench.switched_on();
    assert!(bench.is_bootloader(NODE));
    bench
}

/// The warm-start cell as a debugger reads it: request and argument, if it is valid.
fn cell(bench: &Bench) -> Option<(u32, u32)> {
    let bytes = bench.memory(firmware::board().warm_start.base, 16);
    let [magic, request, argument, check] = words(&bytes)[..] else { unreachable!("16 bytes") };
    let sound = check == check_word(&[magic, request, argument]);
    (magic == u32::from_le_bytes(*b"CBW1") && sound).then_some((request, argument))
}

/// The request that reports a damaged image, and its arguments.
const DAMAGED: u32 = 8;
const BY_HEADER: u32 = 1;
const BY_SERVICES: u32 = 2;
const BY_CRC: u32 = 3;
const BY_BOARD: u32 = 4;
const BY_VECTORS: u32 = 5;
const BY_FACTS: u32 = 6;

/// Ways to damage an image, and the boot stage's report.
fn damages() -> Vec<(&'static str, Parts, u32)> {
    let board = firmware::board();
    let ram = board.bootloader_ram();
    let good = Parts::of(firmware::BOOTLOADER);
    let size = good.get(SIZE);
    let damaged = |words: &[(usize, u32)]| {
        let mut parts = good.clone();
        words.iter().for_each(|(word, value)| parts.set(*word, *value));
        parts
    };
    // What a maker of images could have written: its CRC is right.
    let sealed = |words: &[(usize, u32)]| {
        let mut parts = damaged(words);
        parts.seal();
        parts
    };
    let bit = |at: usize| {
        let mut parts = good.clone();
        parts.image[at] ^= 1;
        parts
    };
    let erased: Vec<(usize, u32)> = (0..16).map(|word| (word, !0)).collect();
    let last = good.image.len() - 1;
    vec![
        ("a bit of the magic", bit(0), BY_HEADER),
        ("the magic of another format", damaged(&[(MAGIC, u32::from_le_bytes(*b"CBI1"))]), BY_HEADER),
        ("an erased header", damaged(&erased), BY_HEADER),
        ("another length of the header", sealed(&[(LENGTH, 24)]), BY_HEADER),
        ("another format", sealed(&[(LENGTH, 64 | 1 << 16)]), BY_HEADER),
        ("more bytes than flash", damaged(&[(SIZE, 0x1_0000)]), BY_HEADER),
        ("as many as there can be", damaged(&[(SIZE, !3)]), BY_HEADER),
        ("more bytes than RAM", damaged(&[(SIZE, ram.size - 4092)]), BY_HEADER),
        ("no bytes", sealed(&[(SIZE, 0)]), BY_HEADER),
        ("a half word", sealed(&[(SIZE, size - 2)]), BY_HEADER),
        ("another place in RAM", sealed(&[(RAM_BASE, board.ram.base + 0x200)]), BY_HEADER),
        ("a place in flash", sealed(&[(RAM_BASE, good.home)]), BY_HEADER),
        ("RAM that is kept", sealed(&[(RAM_END, ram.end() + 4)]), BY_HEADER),
        ("RAM that ends before it begins", sealed(&[(RAM_END, 0)]), BY_HEADER),
        ("RAM that is shorter than the image", sealed(&[(RAM_END, board.ram.base + size - 4)]), BY_HEADER),
        ("newer services", sealed(&[(SERVICES, SERVICES_VERSION + 1)]), BY_SERVICES),
        ("an ability that the resident part has not", sealed(&[(FEATURES, 1)]), BY_SERVICES),
        ("an unknown ability", sealed(&[(FEATURES, 1 << 31)]), BY_SERVICES),
        ("another resident part", sealed(&[(FACTS, !good.get(FACTS))]), BY_FACTS),
        ("another board", sealed(&[(BOARD, !good.get(BOARD))]), BY_BOARD),
        ("a bit of the CRC", bit(5), BY_CRC),
        ("a bit of the version", bit(VERSION * 4), BY_CRC),
        ("a word less", damaged(&[(SIZE, size - 4)]), BY_CRC),
        ("the first bit", bit(HEADER), BY_CRC),
        ("the last bit", bit(last), BY_CRC),
        ("a stack over the end of the RAM", sealed(&[(STACK, ram.end() + 8)]), BY_VECTORS),
        ("an uneven stack", sealed(&[(STACK, ram.end() - 4)]), BY_VECTORS),
        ("a stack in flash", sealed(&[(STACK, good.home + 8)]), BY_VECTORS),
        ("a Reset in flash", sealed(&[(RESET, good.home + 0x201)]), BY_VECTORS),
        ("a Reset in the vectors", sealed(&[(RESET, board.ram.base + 1)]), BY_VECTORS),
        ("a Reset after the end", sealed(&[(RESET, board.ram.base + size + 1)]), BY_VECTORS),
        ("a Reset without the Thumb bit", sealed(&[(RESET, good.get(RESET) & !1)]), BY_VECTORS),
    ]
}

/// A device with a program continues as an application: it runs, the callgate works, and a call to
/// the bootloader leads back to the application.
#[test]
fn a_damaged_image_does_not_run_and_the_program_does() {
    let mut bench = board_with_a_program();
    for (what, image, damage) in damages() {
        load(&mut bench, &image);
        bench.switch_on();
        assert!(!bench.is_bootloader(NODE), "{what}: the start of a program needs nothing of the image");
        assert_eq!(cell(&bench), None, "{what}");
        bench.events();
        bench.call_back();
        assert_eq!(bench.events().len(), 1, "{what}: one reset");
        assert!(!bench.is_bootloader(NODE), "{what}");
        assert_eq!(cell(&bench), Some((DAMAGED, damage)), "{what}");
        // The application reads it through the callgate.
        let crc = bench.number(0x1F56, 1);
        assert_eq!(crc, firmware::blocks(firmware::APP_V1).crc(), "{what}");
        // It starts as before, with the cell consumed.
        bench.machine().reset_pin();
        bench.await_boot_up(1000);
        assert!(!bench.is_bootloader(NODE), "{what}");
        assert_eq!(cell(&bench), None, "{what}");
        bench.power_off();
    }
    // The entry strap does not prevent the start of a program without a working bootloader.
    let (_, image, damage) = damages().swap_remove(0);
    load(&mut bench, &image);
    press(bench.machine(), true);
    bench.switch_on();
    assert!(!bench.is_bootloader(NODE));
    assert_eq!(cell(&bench), Some((DAMAGED, damage)));
    press(bench.machine(), false);
    bench.power_off();
    // Nor does a journal without room, which nobody compacts.
    bench.fill_journal(0);
    bench.switch_on();
    assert!(!bench.is_bootloader(NODE));
    assert_eq!(cell(&bench), Some((DAMAGED, damage)));
    bench.power_off();
    // The image itself, for comparison: it makes room, and then the program starts.
    load(&mut bench, &Parts::of(firmware::BOOTLOADER));
    bench.switch_on();
    bench.await_boot_up(1000);
    bench.call_back();
    assert!(bench.is_bootloader(NODE));
    assert_eq!(cell(&bench), None);
}

/// While the journal makes room, before the program starts: what belongs to an update keeps the device in the
/// bootloader, and a master that greets each device after its boot-up does not.
#[test]
fn an_update_can_begin_while_the_journal_makes_room() {
    let mut bench = board_with_a_program();
    let coboot = [[0x21, 0x05, 0x60, 1, 6, 0, 0, 0], *b"\x03coboot\0"];
    // Errors in 1003h are deleted, 1201h has no COB-ID, 1017h is constant.
    let greeting = [
        [0x2F, 0x03, 0x10, 0, 0, 0, 0, 0],
        [0x23, 1, 0x12, 1, 0, 0, 0, 0x80],
        [0x2B, 0x17, 0x10, 0, 1, 0, 0, 0],
    ];
    for (image, node, frames, stays) in [
        (firmware::BOOTLOADER, NODE, &greeting[..], false),
        (firmware::BOOTLOADER, NODE, &[[0x2F, 0x51, 0x1F, 1, 0, 0, 0, 0]], true),
        (firmware::BOOTLOADER, NODE, &[[0x21, 0x50, 0x1F, 1, 0, 1, 0, 0]], true),
        (firmware::BOOTLOADER_LIFT, 126, &coboot, true),
        // It makes the program invalid.
        (firmware::BOOTLOADER_ESACADEMY, 64, &[*b"\x23\x50\x7F\x01TINI"], true),
    ] {
        load(&mut bench, &Parts::of(image));
        bench.fill_journal(0);
        bench.power_on();
        bench.await_boot_up_of(node, 100);
        bench.events();
        let mut ask = |data: &[u8]| bench.ask(0x600 + u16::from(node), data, 0x580 + u32::from(node));
        // 2007h/11: COMPACTION.
        assert_eq!(ask(&[0x40, 0x07, 0x20, 11, 0, 0, 0, 0]).unwrap()[4], 14);
        frames.iter().for_each(|frame| drop(ask(frame).expect("an answer")));
        bench.run_ms(800);
        assert_eq!(bench.events().is_empty(), stays, "{image}: {frames:X?}");
        bench.power_off();
    }
}

/// An application that crashes is started again, and the flash is not changed: there is no
/// bootloader to stay in.
#[test]
fn beside_a_damaged_image_a_program_is_not_given_up() {
    let mut bench = board_with_a_program();
    let (_, image, _) = damages().swap_remove(0);
    load(&mut bench, &image);
    bench.switch_on();
    for reset in 1..=6 {
        bench.machine().preset_watchdog(64);
        bench.run_ms(300);
        assert!(!bench.is_bootloader(NODE), "after {reset}");
        assert_eq!(cell(&bench).is_some(), reset >= 3, "after {reset}");
    }
    let [journal, _] = firmware::board().parameters;
    let parameters = |bench: &Bench| bench.memory(journal.base, 2 * journal.size as usize);
    let before = parameters(&bench);
    bench.machine().preset_watchdog(64);
    bench.run_ms(300);
    assert!(parameters(&bench) == before);
}

/// A product in which no program starts by itself: with the image it stays in the bootloader, and
/// without it the program is better than nothing.
#[test]
fn without_autostart_the_program_runs_beside_a_damaged_image() {
    let least = Parts::of(firmware::BOOTLOADER_LEAST);
    let mut bench = board_with_a_program();
    load(&mut bench, &least);
    bench.switch_on();
    assert!(bench.is_bootloader(NODE));
    bench.power_off();
    let mut damaged = least;
    damaged.image[0] ^= 1;
    load(&mut bench, &damaged);
    bench.switch_on();
    assert!(!bench.is_bootloader(NODE));
    assert_eq!(cell(&bench), Some((DAMAGED, BY_HEADER)));
}

/// Without a program nothing can run: the chip resets again and again, which is visible at its NRST
/// pin, and the cell contains the reason.
#[test]
fn a_damaged_image_without_a_program_resets_again_and_again() {
    for (what, image, damage) in damages() {
        let mut bench = Bench::new();
        load(&mut bench, &image);
        bench.power_on();
        let mut seen = 0;
        for _ in 0..80 {
            bench.run_ms(5);
            if let Some(found) = cell(&bench) {
                assert_eq!(found, (DAMAGED, damage), "{what}");
                seen += 1;
            }
        }
        // A debugger finds it there at almost any time.
        assert!(seen > 70, "{what}: {seen} times of 80");
        let resets = bench.stops();
        assert!((3..=6).contains(&resets.len()), "{what}: {} resets in 400 ms", resets.len());
        assert!(resets.iter().all(|stop| *stop == Stop::Reset(ResetCause::Software)), "{what}");
        assert!(bench.records().is_empty(), "{what}: nothing on the bus");
        bench.assert_nothing_unmodelled();
    }
}

/// The products of the tests by what their resident parts decide by (bootloader/products): those of a row have the
/// same facts. The others have CRC-16; no autostart, and a fixed bit rate; node-IDs, COB-IDs and nameplates; the loader
/// in the ROM; sealed images, with renewal and without.
const BY_FACTS_OF: [&str; 7] = [
    "bootloader bootloader-paulus bootloader-esacademy bootloader-lift bootloader-watchdog bootloader-log-rtt \
     bootloader-log-defmt bootloader-log-uart bootloader-debugger bootloader-virtual-can",
    "bootloader-crc-16",
    "bootloader-least",
    "bootloader-switches",
    "bootloader-ways-in",
    "bootloader-sealed bootloader-sealed-log-rtt bootloader-sealed-debugger",
    "bootloader-sealed-writes-flash",
];

/// Each image on each resident part, as the running bootloader and the resident part judge its header. Without staging the
/// last two rows are the same.
#[test]
#[cfg_attr(not(staging), ignore = "needs a region for staging")]
fn an_image_is_for_the_resident_parts_with_its_facts_alone() {
    let board = firmware::board();
    let rows = BY_FACTS_OF.iter().enumerate();
    let all = rows.flat_map(|(row, names)| names.split_whitespace().map(move |name| (row, name)));
    let all: Vec<_> = all.map(|(row, name)| (row, name, Parts::of(&format!("{name}.elf")))).collect();
    for (row, resident, parts) in &all {
        let base = board.bootloader.base;
        let (services, facts) = Facts::of_resident(&parts.resident, base, board.callgate() + OFFSET).unwrap();
        let features = Abilities(facts.abilities.into());
        let host = Host { board: facts.board, services, features, facts: crc32(parts.record()) };
        for (other, image, Parts { image: bytes, .. }) in &all {
            let judged = Header::of_bytes(bytes.first_chunk().unwrap()).check(u32::MAX, board.ram, host);
            let is_refused = matches!(judged, Err(Damage::Facts | Damage::Services));
            let expected = if row == other { judged == Ok(()) } else { is_refused };
            assert!(expected, "{image} on {resident}: {judged:?}");
        }
    }
}

/// The resident part stays in the field while RAM images come and go: an image in which every address differs
/// runs on it, and calls its services.
#[test]
#[cfg_attr(not(split_map), ignore = "needs the split map")]
fn a_ram_image_runs_on_the_resident_part_of_another_bootloader() {
    if firmware::board().home.is_none() {
        // In the compact map the two are one, written together.
        return;
    }
    let names = [firmware::BOOTLOADER, firmware::BOOTLOADER_DEBUGGER, firmware::BOOTLOADER_LOG_RTT];
    let entries = names.map(|name| Parts::of(name).get(RESET));
    let addresses = |name| {
        let elf = firmware::elf(name);
        let file = ElfFile32::<Endianness>::parse(&*elf).unwrap();
        let all = file.symbols().filter(|symbol| symbol.size() > 0);
        all.filter_map(|symbol| Some((symbol.name().ok()?.to_owned(), symbol.address()))).collect::<Vec<_>>()
    };
    let (here, there) = (addresses(names[0]), addresses(names[1]));
    let same = here.iter().filter(|of_one| there.contains(of_one)).count();
    assert!(same * 10 < here.len(), "{same} of {} are where they were; {entries:x?}", here.len());
    for resident in names {
        for image in names.into_iter().filter(|image| *image != resident) {
            let parts = Parts { resident: Parts::of(resident).resident, ..Parts::of(image) };
            println!("{image} on {resident}");
            let mut bench = started(&parts);
            // The image erases, programs and stores by the services of the other resident part.
            bench.install(firmware::APP_V1);
            bench.confirm_program();
            assert!(!bench.is_bootloader(NODE), "{image} on {resident}");
            bench.call_back();
            assert!(bench.is_bootloader(NODE), "{image} on {resident}");
        }
    }
}

/// The table of services only grows: an image runs on a resident part that has more, and one that needs less than
/// there is.
#[test]
fn an_image_takes_longer_tables_than_it_knows() {
    let board = firmware::board();
    let good = Parts::of(firmware::BOOTLOADER);
    let table = (board.callgate() + OFFSET - board.bootloader.base) as usize;
    let at = |resident: &[u8], at: usize| words(&resident[at..at + 4])[0];
    // Two words, seven functions, the address of the facts, and one more function.
    assert_eq!([at(&good.resident, table), at(&good.resident, table + 4)], [SERVICES_VERSION, 44]);
    let mut longer = good.clone();
    longer.resident[table..][..4].copy_from_slice(&(SERVICES_VERSION + 7).to_le_bytes());
    longer.resident[table + 4..][..4].copy_from_slice(&64_u32.to_le_bytes());
    let with = |word, value| {
        let mut parts = good.clone();
        parts.set(word, value);
        parts.seal();
        parts
    };
    // The result of `cargo build` alone, which differs from that of `cargo xtask build` in this word alone.
    let mut of_linker = good.clone();
    of_linker.set(CRC, 0);
    for (what, parts) in [
        ("a newer resident part", longer),
        ("an older image", with(SERVICES, 0)),
        ("a later header", with(RESERVED, 1)),
        ("an image without a CRC", of_linker),
    ] {
        println!("{what}");
        let mut bench = started(&parts);
        bench.update(firmware::APP_V1);
        assert!(!bench.is_bootloader(NODE), "{what}");
    }
}

/// A fault before the RAM image is ready has its handler in flash, by the vectors in flash: it
/// requests the bootloader and resets.
#[test]
fn a_fault_in_the_boot_stage_is_reported() {
    let board = firmware::board();
    let mut image = Parts::of(firmware::BOOTLOADER);
    // ARMv7-M A7.7.194: udf #0, in place of the first instruction.
    let reset = (words(&image.resident[4..8])[0] & !1) - board.bootloader.base;
    image.resident[reset as usize..][..2].copy_from_slice(&[0x00, 0xDE]);
    let mut bench = Bench::new();
    load(&mut bench, &image);
    bench.power_on();
    bench.run_ms(1);
    let resets = bench.events();
    assert!(resets.len() > 3, "{resets:?}");
    assert!(resets.iter().all(|(_, stop)| *stop == Stop::Reset(ResetCause::Software)), "{resets:?}");
    // 4: a fault of the bootloader.
    assert_eq!(cell(&bench), Some((4, 0)));
}
