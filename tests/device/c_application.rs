//! An application in C: what a program that knows coboot by its generated header alone gets from
//! it, and what it cannot break.

use std::collections::BTreeMap;
use std::time::Duration;

use canopen::program::ProgramControl;
use canopen::{Address, BitRate, NodeId};
use coboot_tests::bench::{Bench, NODE};
use coboot_tests::{call_back, firmware, renewal};
use coflash_core::device::{Doing, Session, Timing};
use coflash_core::file::convert::{self, program_of, Options};
use coflash_core::file::read::read;
use coflash_core::update::{flash, FlashOptions, Report};
use coflash_core::Error;
use emulator::machine;
use emulator::time::Span;
use kit::rig::crc32;
use shared_abi::callgate;
use shared_abi::geometry::Region;
use shared_abi::layout::stm32f407g_disc1_two;

const DEVICE_TYPE: Address = Address::new(0x1000, 0);
const CRC: Address = Address::new(0x1F56, 1);
const ANSWERS: u32 = 0x580 + NODE as u32;

/// The selectors and status codes, typed again.
const CRC32: u32 = 1;
const READ_NODE: u32 = 2;
const STORE_NODE: u32 = 3;
const PROGRAM_INFO: u32 = 4;
const CONFIRM: u32 = 5;
const INVALIDATE: u32 = 6;
const UNCONFIRM: u32 = 7;
const OK: i32 = 0;
const UNKNOWN_SELECTOR: i32 = -1;
const BAD_POINTER: i32 = -2;
const BAD_RANGE: i32 = -3;
const BUSY: i32 = -4;
const FAILED: i32 = -5;
const BAD_ARGUMENT: i32 = -6;
const NO_PROGRAM: i32 = -7;
const FULL: i32 = -9;
/// The version in its label.
const VERSION: u32 = 1;

/// Sub-indices of the application's object 2100h (tests/c/probe.c).
mod probe {
    use canopen::Address;
    pub const SELECTOR: Address = Address::new(0x2100, 1);
    pub const POINTER: Address = Address::new(0x2100, 2);
    pub const WORDS: [Address; 5] = [
        Address::new(0x2100, 3),
        Address::new(0x2100, 4),
        Address::new(0x2100, 5),
        Address::new(0x2100, 6),
        Address::new(0x2100, 7),
    ];
    pub const CALL: Address = Address::new(0x2100, 8);
    pub const STACK: Address = Address::new(0x2100, 9);
    pub const ADDRESS: Address = Address::new(0x2100, 10);
    pub const SEED: Address = Address::new(0x2100, 11);
    pub const FLASH_OPEN: Address = Address::new(0x2100, 12);
    pub const SP: Address = Address::new(0x2100, 13);
    pub const PLAIN_CALL: Address = Address::new(0x2100, 14);
    pub const CYCLES: Address = Address::new(0x2100, 15);
}

/// The unit in which the emulator reports accesses.
const PAGE: u32 = 4096;

fn install(bench: &mut Bench, image: &str) -> Report {
    let options = FlashOptions::default().verify(true).trial_run(false);
    flash(&mut bench.session(), firmware::blocks(image), &options, &mut |_| {}).unwrap()
}

/// A board that runs the application, and the report of its installation.
fn running_board() -> (Bench, Report) {
    let mut bench = Bench::new().switched_on();
    let report = install(&mut bench, firmware::APP_C_PROBE);
    bench.events();
    (bench, report)
}

fn number(bench: &mut Bench, at: Address) -> u32 {
    bench.session().read_number(at).unwrap()
}

/// Writes a word. A call that erases a sector of the journal may take longer than a host usually
/// waits.
fn put(bench: &mut Bench, at: Address, value: u32) {
    let timing = Timing::default().sdo(Duration::from_secs(3));
    let mut session = Session::new(bench, NodeId::new(NODE).unwrap(), timing);
    session.write(at, &value.to_le_bytes(), Doing::Write(at), &mut |_| {}).unwrap();
}

/// What a call did.
struct Called {
    status: i32,
    words: [u32; 5],
    stack: u32,
}

/// Calls a selector with these words as its argument structure.
fn call(bench: &mut Bench, selector: u32, words: [u32; 5]) -> Called {
    let good = number(bench, probe::ADDRESS);
    call_with(bench, selector, good, words)
}

/// Calls a selector with a pointer of the caller's choice.
fn call_with(bench: &mut Bench, selector: u32, pointer: u32, words: [u32; 5]) -> Called {
    put(bench, probe::SELECTOR, selector);
    put(bench, probe::POINTER, pointer);
    for (at, word) in probe::WORDS.into_iter().zip(words) {
        put(bench, at, word);
    }
    put(bench, probe::CALL, 0);
    let stack = number(bench, probe::STACK);
    // The way in alone puts something on it; more than it may would be RAM that is not the
    // callgate's.
    assert!((8..=callgate::STACK).contains(&stack), "selector {selector} took {stack} bytes of stack");
    Called {
        status: number(bench, probe::CALL) as i32,
        words: probe::WORDS.map(|at| number(bench, at)),
        stack,
    }
}

/// Bytes of a selector's argument structure.
fn size_of_arguments(selector: u32) -> u32 {
    match selector {
        CRC32 => 12,
        READ_NODE | STORE_NODE => 8,
        _ => 20,
    }
}

#[test]
fn it_is_a_node_like_any_other() {
    assert_eq!(crc32(b"123456789"), 0xCBF4_3926, "the check value of the CRC catalogue");
    let mut bench = Bench::new().switched_on();
    let identity = [1, 2, 3, 4].map(|sub| Address::new(0x1018, sub));
    let of_bootloader = identity.map(|at| number(&mut bench, at));
    let report = install(&mut bench, firmware::APP_C_PROBE);
    bench.events();
    let program = firmware::board().programs[0];
    let start = (program.base - firmware::board().chip.flash.base) as usize;
    let image = &bench.machine().flash()[start..start + report.program_size as usize];
    assert_eq!(report.program_crc, crc32(image));
    assert_eq!(number(&mut bench, CRC), report.program_crc, "through the callgate");
    assert_eq!(number(&mut bench, DEVICE_TYPE), 0);
    assert_eq!(number(&mut bench, Address::new(0x1F51, 1)), 1, "running");
    let of_application = identity.map(|at| number(&mut bench, at));
    assert_eq!((of_application[0], of_application[1]), (of_bootloader[0], of_bootloader[1]));
    assert_eq!(of_application[3], of_bootloader[3], "from the handoff");

    bench.assert_takes_every_dlc();
    // Requests byte for byte, and the answers that CiA 301 gives them.
    for (request, answer) in [
        ([0x40, 0x00, 0x10, 0, 0, 0, 0, 0], [0x43, 0x00, 0x10, 0, 0, 0, 0, 0]),
        ([0x40, 0x18, 0x10, 0, 0, 0, 0, 0], [0x4F, 0x18, 0x10, 0, 4, 0, 0, 0]),
        ([0x2B, 0x17, 0x10, 0, 100, 0, 0, 0], [0x60, 0x17, 0x10, 0, 0, 0, 0, 0]),
        ([0x40, 0x17, 0x10, 0, 0, 0, 0, 0], [0x4B, 0x17, 0x10, 0, 100, 0, 0, 0]),
        ([0x2F, 0x17, 0x10, 0, 100, 0, 0, 0], [0x80, 0x17, 0x10, 0, 0x10, 0, 0x07, 0x06]),
        ([0x21, 0x17, 0x10, 0, 100, 0, 0, 0], [0x80, 0x17, 0x10, 0, 0x10, 0, 0x07, 0x06]),
        ([0x23, 0x00, 0x10, 0, 1, 0, 0, 0], [0x80, 0x00, 0x10, 0, 0x02, 0, 0x01, 0x06]),
        ([0x40, 0x08, 0x10, 0, 0, 0, 0, 0], [0x80, 0x08, 0x10, 0, 0, 0, 0x02, 0x06]),
        ([0x40, 0x18, 0x10, 5, 0, 0, 0, 0], [0x80, 0x18, 0x10, 5, 0x11, 0, 0x09, 0x06]),
        ([0x2F, 0x51, 0x1F, 1, 0x42, 0, 0, 0], [0x80, 0x51, 0x1F, 1, 0x30, 0, 0x09, 0x06]),
        ([0x2F, 0x51, 0x1F, 1, 0x83, 0, 0, 0], [0x80, 0x51, 0x1F, 1, 0x22, 0, 0, 0x08]),
        ([0x2F, 0x51, 0x1F, 1, 1, 0, 0, 0], [0x60, 0x51, 0x1F, 1, 0, 0, 0, 0]),
        ([0xC6, 0x50, 0x1F, 1, 0, 0, 0, 0], [0x80, 0x50, 0x1F, 1, 0x01, 0, 0x04, 0x05]),
    ] {
        assert_eq!(bench.ask(0x601, &request, ANSWERS).as_deref(), Some(&answer[..]), "{request:02X?}");
    }
    // What is no SDO, and an abort, get none.
    for request in [&[0x40, 0, 0x10][..], &[0x80, 0, 0x10, 0, 0, 0, 0, 0]] {
        assert_eq!(bench.ask(0x601, request, ANSWERS), None);
    }

    // A heartbeat every 100 ms from now on; it has the NMT state. Who is stopped answers no SDO.
    for (command, state) in [(0x01, 0x05), (0x02, 0x04), (0x80, 0x7F)] {
        bench.post(0x000, &[command, NODE]);
        bench.run_ms(20);
        let from = bench.time();
        bench.run_ms(1000);
        let heartbeats = bench.frames_since(from);
        assert!((9..=11).contains(&heartbeats.len()), "{heartbeats:?}");
        for (_, id, data) in heartbeats {
            assert_eq!((id, &data[..]), (0x701, &[state][..]));
        }
        let answer = bench.ask(0x601, &[0x40, 0x00, 0x10, 0, 0, 0, 0, 0], ANSWERS);
        assert_eq!(answer.is_some(), state != 0x04);
    }
    // Not for this node.
    bench.post(0x000, &[0x81, NODE + 1]);
    bench.run_ms(100);
    assert_eq!(bench.events(), []);
    // Nobody has crashed when an NMT command asked for a reset.
    for _ in 0..4 {
        bench.post(0x000, &[0x81, NODE]);
        bench.await_boot_up(1000);
        assert!(!bench.is_bootloader(NODE));
    }
    bench.assert_nothing_unmodelled();
}

/// And another program may take its place.
#[test]
fn it_can_be_called_back_at_every_bit_rate() {
    call_back::at_every_bit_rate(firmware::APP_C, |rate, mut bench| {
        // One bit rate is enough for this.
        if rate == BitRate::K1000 {
            install(&mut bench, firmware::APP_V2);
            assert_eq!(bench.text(0x100A), "2.0.0");
        }
    });
}

/// The pages of RAM that the callgate has accessed since the last time: those of its part of the
/// stack, and of the structure that was handed over.
fn assert_stack_alone(bench: &mut Bench, good: u32, selector: u32) {
    let sp = number(bench, probe::SP);
    let pages = |region: Region| region.base / PAGE..=(region.end() - 1) / PAGE;
    let arguments = pages(Region::new(good, size_of_arguments(selector)));
    let stack = pages(Region::new(sp - callgate::STACK, callgate::STACK));
    let touched: Vec<_> = bench.machine().take_touched().into_iter().map(|address| address / PAGE).collect();
    for page in &touched {
        assert!(arguments.contains(page) || stack.contains(page), "selector {selector}: {page:#x}");
    }
    for pages in [arguments, stack] {
        assert!(touched.iter().any(|page| pages.contains(page)), "selector {selector}: {touched:x?}");
    }
}

/// Each service does what it says, with two kinds of garbage in all RAM that the application does
/// not use, and with an eye on each page of RAM.
#[test]
fn every_service_works_on_the_stack_alone() {
    let (mut bench, report) = running_board();
    let layout = firmware::board();
    let flash = layout.chip.flash;
    let program = layout.programs[0];
    let mut stacks = BTreeMap::new();
    // Once it was installed, nothing of the bootloader runs but the callgate.
    bench.machine().watch(layout.bootloader);
    let good = number(&mut bench, probe::ADDRESS);
    for seed in [0, 0xDEAD_BEEF] {
        put(&mut bench, probe::SEED, seed);
        // The CCM is nobody's, and the cells between the parts are not the callgate's.
        let ccm = vec![seed as u8 | 1; layout.chip.ccm.size as usize];
        if !ccm.is_empty() {
            bench.machine().write_ram(layout.chip.ccm.base, &ccm).unwrap();
        }
        let cells = bench.memory(layout.ram.end(), 64);

        let mut run = |bench: &mut Bench, selector, words| {
            bench.machine().take_touched();
            let called = call(bench, selector, words);
            // Loads count as well: the pattern shows stores alone.
            assert_stack_alone(bench, good, selector);
            let most = stacks.entry(selector).or_insert(0);
            *most = called.stack.max(*most);
            (called.status, called.words)
        };
        for (address, len) in [
            (program.base, report.program_size),
            (program.base + 1, 7),
            (flash.base, layout.bootloader.size),
            (flash.end() - 1, 1),
        ] {
            let place = (address - flash.base) as usize;
            let expected = crc32(&bench.machine().flash()[place..place + len as usize]);
            let (status, words) = run(&mut bench, CRC32, [address, len, !expected, 4, 5]);
            assert_eq!((status, words), (OK, [address, len, expected, 4, 5]), "{address:#x}, {len}");
        }
        // What is after the structure is not touched.
        let (status, words) = run(&mut bench, READ_NODE, [0, 0, 3, 4, 5]);
        assert_eq!((status, words), (OK, [1, 125_000, 3, 4, 5]));
        let installed_signed = 0b11;
        let info = [1, report.program_size, report.program_crc, VERSION, installed_signed];
        assert_eq!(run(&mut bench, PROGRAM_INFO, [1, 9, 9, 9, 9]), (OK, info));
        assert_eq!(run(&mut bench, INVALIDATE, [1, 6, 7, 8, 9]), (OK, [1, 6, 7, 8, 9]));
        assert_eq!(run(&mut bench, PROGRAM_INFO, [1; 5]).1[4], 0b01);
        assert_eq!(run(&mut bench, CONFIRM, [1, 6, 7, 8, 9]), (OK, [1, 6, 7, 8, 9]));
        assert_eq!(run(&mut bench, PROGRAM_INFO, [1; 5]).1, info);
        if layout.staging.is_some() {
            let (status, words) = run(&mut bench, PROGRAM_INFO, [255; 5]);
            let crc = renewal::crc_of(&renewal::image_of(firmware::BOOTLOADER));
            assert_eq!((status, words[0], words[2], words[4]), (OK, 255, crc, 0b01));
        }
        assert_eq!(run(&mut bench, STORE_NODE, [9, 250_000, 3, 4, 5]), (OK, [9, 250_000, 3, 4, 5]));
        assert_eq!(run(&mut bench, READ_NODE, [0; 5]).1[..2], [9, 250_000]);
        assert_eq!(run(&mut bench, STORE_NODE, [1, 125_000, 3, 4, 5]).0, OK);

        assert!(
            ccm.is_empty() || bench.memory(layout.chip.ccm.base, ccm.len()) == ccm,
            "the CCM was written to"
        );
        assert_eq!(bench.memory(layout.ram.end(), 64), cells, "handoff and warm-start cell");
    }
    println!("bytes of stack by selector: {stacks:?} of {}", callgate::STACK);
    assert_eq!(bench.events(), []);
    bench.assert_nothing_unmodelled();
}

/// An application fills the journal: no call erases a sector, node parameters are refused while a confirmation still
/// finds room, and the next start makes room for both. It says so while it does, whatever a master reads meanwhile.
/// The cycles, at 8 MHz and with the costs of the manuals, are those of docs/application.md.
#[test]
fn a_journal_that_is_nearly_full_refuses_what_can_wait_and_the_next_start_makes_room() {
    let mut bench =
        Bench::with(machine::Options { costs: true, ..machine::Options::default() }).switched_on();
    install(&mut bench, firmware::APP_C_PROBE);
    let plain_call = |bench: &mut Bench, selector, words: [u32; 2]| {
        let address = number(bench, probe::ADDRESS);
        probe::WORDS.into_iter().zip(words).for_each(|(at, word)| put(bench, at, word));
        put(bench, probe::POINTER, address);
        put(bench, probe::SELECTOR, selector);
        put(bench, probe::PLAIN_CALL, 0);
        (number(bench, probe::CALL) as i32, number(bench, probe::CYCLES))
    };
    let erased = bench.machine().counters().sectors_erased;
    for (left, stored) in [(500, OK), (292, OK), (20, OK), (15, FULL), (8, FULL)] {
        bench.fill_journal(left);
        let calls = [(INVALIDATE, [1, 0]), (CONFIRM, [1, 0]), (STORE_NODE, [1, 125_000])];
        let [(no, _), (yes, cycles), (node, _)] =
            calls.map(|(selector, words)| plain_call(&mut bench, selector, words));
        println!("{left} free slots: a confirmation takes {cycles} cycles");
        assert_eq!((no, yes, node), (OK, OK, stored), "{left} free slots");
        assert!(cycles < 60_000, "{left} free slots: {cycles} cycles");
    }
    assert_eq!(bench.machine().counters().sectors_erased, erased, "a call erased a sector");

    bench.power_cycle();
    let from = bench.await_boot_up(100);
    // COMPACTION, whatever a master asks that greets each device; it does not keep the program.
    assert_eq!(number(&mut bench, Address::new(0x2007, 11)), 14);
    let started = bench.await_boot_up(1_000);
    assert!(started - from < Span::from_millis(600), "{} ms", (started - from).0 / 1_000_000_000);
    assert!(bench.machine().counters().sectors_erased > erased && !bench.is_bootloader(NODE));
    assert_eq!(plain_call(&mut bench, STORE_NODE, [2, 125_000]).0, OK);
    assert_eq!(call(&mut bench, READ_NODE, [0; 5]).words[0], 2);
    bench.assert_nothing_unmodelled();
}

/// RCC_AHB1ENR (RM0090 section 7.3.10), and the bit that gives the CRC unit its clock.
const AHB1ENR: u32 = 0x4002_3830;
const CRCEN: u32 = 1 << 12;

/// An interrupt of the application uses the CRC unit, and switches its clock on and off, or leaves it on: a CRC is
/// right all the same.
#[test]
fn a_crc_is_right_although_an_interrupt_uses_the_crc_unit() {
    let (mut bench, _) = running_board();
    let bytes = &bench.machine().flash()[..0x1_0000].to_vec();
    let address = number(&mut bench, probe::ADDRESS);
    for (use_of_tick, how) in [(0, "does not use it"), (1, "switches it off"), (2, "leaves it on")] {
        let words = [firmware::board().chip.flash.base, bytes.len() as u32, 0];
        probe::WORDS.into_iter().zip(words).for_each(|(at, word)| put(&mut bench, at, word));
        put(&mut bench, probe::POINTER, address);
        put(&mut bench, probe::SELECTOR, CRC32);
        put(&mut bench, probe::PLAIN_CALL, use_of_tick);
        println!("the interrupt {how}: {} cycles", number(&mut bench, probe::CYCLES));
        let found = (number(&mut bench, probe::CALL) as i32, number(&mut bench, probe::WORDS[2]));
        assert_eq!(found, (OK, crc32(bytes)), "the interrupt {how}");
        let has_clock = bench.machine().register(AHB1ENR).unwrap() & CRCEN != 0;
        assert_eq!(has_clock, use_of_tick == 2, "the interrupt {how}");
    }
}

/// No argument of an application brings the device down or changes anything.
#[test]
fn every_hostile_call_has_its_status_and_does_nothing() {
    let (mut bench, _) = running_board();
    let layout = firmware::board();
    let flash = layout.chip.flash;
    let ram = layout.chip.sram;
    let before = bench.machine().flash().to_vec();
    let good = number(&mut bench, probe::ADDRESS);
    for selector in [0, 8, 9, 0x7FFF_FFFF, 0x8000_0001, u32::MAX] {
        // The selector is looked at first: no pointer makes another one of it.
        for pointer in [good, 0] {
            let status = call_with(&mut bench, selector, pointer, [1; 5]).status;
            assert_eq!(status, UNKNOWN_SELECTOR, "{selector}");
        }
    }
    let pointers = [
        0,
        4,
        good + 1,
        good + 2,
        flash.base,
        layout.programs[0].base,
        ram.base - 4,
        // Its end lies beyond that of the RAM.
        ram.end() - 4,
        ram.end(),
        0x4000_0000,
        0xE000_ED00,
        0xFFFF_FFFC,
        u32::MAX,
    ];
    for selector in [CRC32, READ_NODE, STORE_NODE, PROGRAM_INFO, CONFIRM, INVALIDATE, UNCONFIRM] {
        for pointer in pointers {
            let status = call_with(&mut bench, selector, pointer, [1; 5]).status;
            assert_eq!(status, BAD_POINTER, "{selector}, {pointer:#x}");
        }
    }
    hostile_arguments(&mut bench);
    // Somebody has the flash controller open.
    put(&mut bench, probe::FLASH_OPEN, 1);
    for (selector, words) in [
        (CRC32, [flash.base, 4, 0, 0, 0]),
        (READ_NODE, [0; 5]),
        (STORE_NODE, [5, 125_000, 0, 0, 0]),
        (PROGRAM_INFO, [1; 5]),
        (CONFIRM, [1; 5]),
        (INVALIDATE, [1; 5]),
        (UNCONFIRM, [1; 5]),
    ] {
        let called = call(&mut bench, selector, words);
        assert_eq!((called.status, called.words), (BUSY, words), "{selector}");
    }
    put(&mut bench, probe::FLASH_OPEN, 0);

    assert!(bench.machine().flash() == before, "flash was changed");
    assert_eq!(bench.events(), [], "the device went down");
    assert_eq!(call(&mut bench, READ_NODE, [0; 5]).words[..2], [1, 125_000]);
    bench.call_back();
    assert!(bench.is_bootloader(NODE));
}

/// Ranges, node parameters and programs that are not there.
fn hostile_arguments(bench: &mut Bench) {
    let layout = firmware::board();
    let (flash, ram) = (layout.chip.flash, layout.chip.sram);
    for (address, len) in [
        (flash.base, 0),
        (flash.base, flash.size + 1),
        (flash.base, u32::MAX),
        (flash.base - 1, 1),
        (flash.end(), 1),
        (flash.end() - 1, 2),
        (flash.end() - 4, 0xF800_0000),
        (0, 4),
        (0x1FFF_7A10, 12),
        (ram.base, 4),
        (0x4002_3C00, 4),
        (u32::MAX, 1),
        (u32::MAX, u32::MAX),
    ] {
        let called = call(bench, CRC32, [address, len, 3, 4, 5]);
        assert_eq!((called.status, called.words[2]), (BAD_RANGE, 3), "{address:#x}, {len:#x}");
    }
    for node in [
        [0, 125_000],
        [128, 125_000],
        [254, 125_000],
        [256, 125_000],
        [257, 125_000],
        [u32::MAX, 125_000],
        [5, 1],
        [5, 125_001],
        [5, u32::MAX],
    ] {
        let called = call(bench, STORE_NODE, [node[0], node[1], 3, 4, 5]);
        assert_eq!(called.status, BAD_ARGUMENT, "{node:?}");
    }
    for selector in [PROGRAM_INFO, CONFIRM, INVALIDATE, UNCONFIRM] {
        let absent = layout.programs.len() as u32 + 1;
        for program in [0, absent, 254, 255, 256, 257, u32::MAX] {
            let status = call(bench, selector, [program; 5]).status;
            // 255 is the bootloader, of which there is information alone.
            let is_own = program == 255 && selector == PROGRAM_INFO && firmware::board().staging.is_some();
            assert_eq!(status, if is_own { OK } else { BAD_ARGUMENT }, "{selector}, program {program}");
        }
    }
}

#[test]
fn a_node_id_that_it_stores_is_in_force_from_the_next_reset_on() {
    let (mut bench, _) = running_board();
    assert_eq!(call(&mut bench, STORE_NODE, [42, 500_000, 0, 0, 0]).status, OK);
    assert_eq!(number(&mut bench, DEVICE_TYPE), 0, "not before");
    bench.power_off();
    bench.run_ms(100);
    bench.set_host_bit_rate(500_000);
    bench.power_on();
    bench.await_program_of(42, 1000);
    assert!(!bench.is_bootloader(42));
    bench.session_with(42).command(1, ProgramControl::StartBootloader).unwrap();
    bench.await_boot_up_of(42, 1000);
    assert!(bench.is_bootloader(42));
}

/// The flash takes nothing any more, as when somebody has protected the parameters' sectors by the
/// option bytes: each store reports it, everything else goes on, and so does storing once they
/// can be written again.
#[test]
fn a_flash_that_refuses_is_told_and_harms_nothing() {
    let (mut bench, report) = running_board();
    let before = bench.machine().flash().to_vec();
    bench.protect_parameters(true);
    // Twice: a refusal leaves the flash controller as it was, or the next call would report that
    // it is busy.
    for _ in 0..2 {
        for (selector, words) in [(STORE_NODE, [9, 250_000, 3, 4, 5]), (INVALIDATE, [1, 2, 3, 4, 5])] {
            let called = call(&mut bench, selector, words);
            assert_eq!((called.status, called.words), (FAILED, words), "{selector}");
        }
    }
    let info = [1, report.program_size, report.program_crc, VERSION, 0b11];
    assert_eq!(call(&mut bench, PROGRAM_INFO, [1; 5]).words, info, "still signed");
    assert_eq!(call(&mut bench, READ_NODE, [0; 5]).words[..2], [1, 125_000]);
    assert_eq!(call(&mut bench, CRC32, [firmware::board().programs[0].base, 4, 0, 0, 0]).status, OK);
    assert!(bench.machine().flash() == before, "flash was changed");

    bench.protect_parameters(false);
    assert_eq!(call(&mut bench, STORE_NODE, [9, 250_000, 3, 4, 5]).status, OK);
    assert_eq!(call(&mut bench, READ_NODE, [0; 5]).words[..2], [9, 250_000]);
    assert_eq!(call(&mut bench, INVALIDATE, [1; 5]).status, OK);
    assert_eq!(bench.events(), [], "the device went down");
}

#[test]
fn a_trial_confirms_itself_and_takes_it_back() {
    let mut bench = Bench::new().switched_on();
    let options = FlashOptions::default().start(false);
    flash(&mut bench.session(), firmware::blocks(firmware::APP_C_PROBE), &options, &mut |_| {}).unwrap();
    let start_unsigned = |bench: &mut Bench| {
        for command in [ProgramControl::ClrSignature, ProgramControl::Start] {
            bench.session().command(1, command).unwrap();
            bench.run_ms(100);
        }
        bench.run_ms(500);
        assert!(!bench.is_bootloader(NODE));
        assert_eq!(call(bench, PROGRAM_INFO, [1; 5]).words[4], 0b01, "installed, not signed");
    };
    start_unsigned(&mut bench);
    bench.restart();
    assert!(bench.is_bootloader(NODE), "it had not confirmed itself");
    start_unsigned(&mut bench);
    assert_eq!(call(&mut bench, CONFIRM, [1; 5]).status, OK);
    bench.restart();
    assert!(!bench.is_bootloader(NODE), "it had");
    for _ in 0..2 {
        assert_eq!(call(&mut bench, UNCONFIRM, [1; 5]).status, OK);
        assert_eq!(call(&mut bench, PROGRAM_INFO, [1; 5]).words[4], 0b11, "still signed");
    }
    assert_eq!(call(&mut bench, INVALIDATE, [1; 5]).status, OK);
    bench.restart();
    assert!(bench.is_bootloader(NODE), "it has taken that back");
}

/// Two programs: each knows of the other; one that is not there is reported as such; one that was
/// linked for the place of the other is refused in words.
#[test]
fn the_other_program_and_a_program_for_the_other_place() {
    let layout = &stm32f407g_disc1_two::LAYOUT;
    if firmware::board().chip != layout.chip {
        // The bench is that of another chip.
        return;
    }
    let image = |name: &str| firmware::of_board(layout.board, name);
    let elf = |name: &str| read(&firmware::elf(&image(name)), None, None).expect("an ELF of ours");
    let strict = |program: usize| convert::Region::Strict(layout.programs[program - 1].into());

    // coflash sees it before anything is sent.
    let options = Options::default().region(strict(1));
    let refused = program_of(elf(firmware::APP_C_PROBE_PROGRAM_2), &options).unwrap_err().to_string();
    assert!(refused.contains("0x08080000"), "{refused}");

    let mut bench = Bench::of_image(&image(firmware::BOOTLOADER)).switched_on();
    // A host that does not know the board asks the device, and sends nothing.
    let blocks = program_of(elf(firmware::APP_C_PROBE_PROGRAM_2), &Options::default()).unwrap().program;
    let refused = flash(&mut bench.session(), &blocks, &FlashOptions::default(), &mut |_| {}).unwrap_err();
    assert!(matches!(refused, Error::OtherRegion { .. }), "{refused}");
    assert_eq!(number(&mut bench, Address::new(0x1F57, 1)), 0, "untouched");
    // One that does not judge: the bootloader sees it.
    let once = FlashOptions::default().repeats(0).force(true);
    let refused = flash(&mut bench.session(), &blocks, &once, &mut |_| {}).unwrap_err();
    assert_eq!(number(&mut bench, Address::new(0x1F57, 1)), 0x0C, "ADDRESS: {refused}");
    println!("{refused}");

    // A host that moves it to the first place makes blocks that fit, of a program that does not:
    // its vectors point to the second.
    let moved = layout.programs[0].base.wrapping_sub(layout.programs[1].base);
    let options = Options::default().region(strict(1)).adjust_start(moved);
    let blocks = program_of(elf(firmware::APP_C_PROBE_PROGRAM_2), &options).unwrap().program;
    let refused = flash(&mut bench.session(), &blocks, &once, &mut |_| {}).unwrap_err();
    println!("{refused}");
    let status = number(&mut bench, Address::new(0x1F57, 1));
    assert_eq!(status & 0xFF, 0x04, "FORMAT: {refused}");
    bench.power_cycle();
    bench.await_boot_up(1000);
    assert!(bench.is_bootloader(NODE));

    // And the right ones.
    let blocks =
        program_of(elf(firmware::APP_C_PROBE), &Options::default().region(strict(1))).unwrap().program;
    flash(&mut bench.session(), &blocks, &FlashOptions::default().trial_run(false), &mut |_| {}).unwrap();
    assert_eq!(call(&mut bench, PROGRAM_INFO, [2, 9, 9, 9, 9]).words, [2, 0, 0, 0, 0]);
    for selector in [CONFIRM, INVALIDATE, UNCONFIRM] {
        assert_eq!(call(&mut bench, selector, [2; 5]).status, NO_PROGRAM);
    }
    bench.call_back();
    let options = Options::default().region(strict(2));
    let blocks = program_of(elf(firmware::APP_C_PROBE_PROGRAM_2), &options).unwrap().program;
    let second = FlashOptions::default().program(2).trial_run(false);
    let report = flash(&mut bench.session(), &blocks, &second, &mut |_| {}).unwrap();
    assert_eq!(number(&mut bench, Address::new(0x1F56, 2)), report.program_crc, "its own");
    let info = call(&mut bench, PROGRAM_INFO, [2, 9, 9, 9, 9]).words;
    assert_eq!(info, [2, report.program_size, report.program_crc, VERSION, 0b11]);
}
