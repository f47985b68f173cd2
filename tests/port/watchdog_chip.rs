//! A board with a watchdog chip of 150 ms, which resets by NRST, and a latch that holds the power: a port
//! (`watchdog_chip/`) in a copy of the repository, with that circuit around the emulated chip (docs/porting.md).

use std::path::Path;

use canopen::program::{ProgramControl, DEVICE_STATE};
use coboot_tests::bench::{Bench, BIT_RATE, NODE};
use coboot_tests::firmware;
use coboot_tests::listener::Listener;
use coboot_tests::renewal::{self, version};
use coflash_core::file::checksum::Checksum;
use coflash_core::file::convert::{self, Region};
use coflash_core::file::read::{read, Format};
use coflash_core::update::{flash, FlashOptions};
use emulator::circuit::Circuit;
use emulator::machine::{Cut, FlashCut, Options, ResetCause, Stop};
use emulator::silicon::{Silicon, TYPICAL, WORST};
use emulator::time::Span;

use crate::porting::Copy;

/// The files of the port, and their places.
const FILES: [(&str, &str); 3] = [
    ("board.rs", "bsp/src/boards/watchdog_chip.rs"),
    ("layout.rs", "shared-abi/src/layout/boards/watchdog_chip.rs"),
    ("product.rs", "bootloader/products/bites.rs"),
];

/// The chip as its datasheet has it, and 30 % faster and slower.
const WATCHDOG_MS: [u64; 3] = [150, 105, 195];
/// The longest time between two toggles: 10 ms, and what the software may do before it looks at the time again.
const MOST: Span = Span::from_millis(30);
/// How long a capacitor holds the latch while a reset lets its pin go.
const LATCH_MS: u64 = 1;

/// The images of the board.
struct Images {
    bootloader: String,
    v1: String,
    v2: String,
}

impl Images {
    fn of(copy: &Copy) -> Self {
        for (file, place) in FILES {
            let from = Path::new(env!("CARGO_MANIFEST_DIR")).join("port/watchdog_chip").join(file);
            std::fs::copy(from, copy.root.join(place)).expect("the copy can be written");
        }
        let bootloader = ["build", "bootloader", "--product", "bites", "--board", "watchdog-chip"];
        copy.xtask(&bootloader);
        copy.xtask(&["build", "app-v1", "app-v2", "--board", "watchdog-chip"]);
        let path = |name| path(copy, name);
        Self {
            bootloader: path("bootloader-bites.elf"),
            v1: path(firmware::APP_V1),
            v2: path(firmware::APP_V2),
        }
    }
}

fn path(copy: &Copy, image: &str) -> String {
    copy.target.join("firmware/watchdog-chip").join(image).display().to_string()
}

/// A device with this watchdog chip; another node acknowledges its frames.
fn device(bootloader: &str, watchdog_ms: u64, options: Options) -> Bench {
    let circuit = Circuit {
        watchdog: Some((('D', 14), Span::from_millis(watchdog_ms))),
        latch: Some((('D', 13), Span::from_millis(LATCH_MS))),
    };
    let mut bench = Bench::of_image_with(bootloader, Options { circuit, ..options });
    bench.world.add_host_port(BIT_RATE);
    bench
}

/// Every stop was a reset by software, or a cut that the test has made: the chip never bit, and the power stayed on.
#[track_caller]
fn assert_quiet(bench: &mut Bench, cuts: usize) {
    let stops = bench.stops();
    let is_asked = |stop: &&Stop| matches!(stop, Stop::Reset(ResetCause::Software));
    let others: Vec<_> = stops.iter().filter(|stop| !is_asked(stop)).collect();
    assert_eq!(others, vec![&Stop::PowerCut; cuts]);
    let longest = bench.machine().counters().longest_between_toggles;
    println!("  {} us between two toggles", longest.0 / Span::from_micros(1).0);
    assert!(longest < MOST);
}

/// PD15: a program has the board.
fn is_ready(bench: &mut Bench) -> bool {
    bench.machine().pin('D', 15)
}

/// From power-on to a renewed bootloader: updates over CAN, START, the way back.
fn main_job(images: &Images, bench: &mut Bench) {
    bench.switch_on();
    bench.run_ms(1_000);
    assert!(!is_ready(bench));
    let before = bench.machine().counters();
    let options = FlashOptions::default().trial_run(false).start(false);
    flash(&mut bench.session(), firmware::blocks(&images.v1), &options, &mut |_| {}).expect("an update");
    let after = bench.machine().counters();
    assert!(after.sectors_erased > before.sectors_erased || after.units_programmed > before.units_programmed);
    bench.start_program();
    bench.run_ms(1_000);
    assert!(is_ready(bench) && !bench.is_bootloader(NODE));
    bench.call_back();
    assert!(!is_ready(bench));
    bench.soil_programs();
    // Each sector is erased now; nothing that the board's functions need is in the flash.
    let stalls = bench.machine().counters().flash_stalls;
    flash(&mut bench.session(), firmware::blocks(&images.v2), &options, &mut |_| {}).expect("an update");
    assert_eq!(bench.machine().counters().flash_stalls, stalls);
    bench.session().command(1, ProgramControl::SetSignature).expect("it is released");
    bench.start_program();
    bench.confirm_program();
    bench.call_back();
    renewal::stage(bench, &version(&images.bootloader, 0x0009_0001));
    renewal::start(bench);
    renewal::confirm(bench);
    assert_quiet(bench, 0);
    bench.restart();
    assert!(!bench.is_bootloader(NODE));
    bench.assert_nothing_unmodelled();
}

/// A download that the power fails in, at some operations; then it is done again.
fn power_cuts(images: &Images, bench: &mut Bench) {
    bench.switch_on();
    for (seed, operation) in [0, 3, 40, 900].into_iter().enumerate() {
        let when = Cut::Torn { seed: seed as u64 };
        bench.machine().cut_power_at(Some(FlashCut { operation, when }));
        let options = FlashOptions::default().trial_run(false).start(false);
        let cut = flash(&mut bench.session(), firmware::blocks(&images.v1), &options, &mut |_| {});
        assert!(cut.is_err(), "operation {operation}");
        bench.machine().cut_power_at(None);
        bench.run_ms(100);
        assert_quiet(bench, 1);
        bench.switch_on();
    }
    bench.install(&images.v1);
    assert_quiet(bench, 0);
}

/// No crystal, in the bootloader and in a program, which leaves three times; with the slowest and the fastest HSI.
fn dead_crystals(images: &Images, watchdog_ms: u64) {
    let mut good = device(&images.bootloader, watchdog_ms, Options::default()).switched_on();
    good.install(&images.v1);
    let cells = good.machine().flash().to_vec();
    for hsi_hz in [15_360_000, 16_640_000] {
        let silicon = Silicon { hsi_hz, ..TYPICAL };
        let mut bench =
            device(&images.bootloader, watchdog_ms, Options { silicon, hse_hz: 0, ..Options::default() });
        bench.machine().load_bin(firmware::board().chip.flash.base, &cells).expect("it fits");
        bench.power_on();
        bench.run_ms(5_000);
        assert_quiet(&mut bench, 0);
    }
}

/// A journal that is full, and one that is nearly: the boot stage scans it, the RAM image compacts it.
fn full_journals(images: &Images, bench: &mut Bench) {
    bench.switch_on();
    bench.install(&images.v1);
    bench.confirm_program();
    for left in [0, 1, 15, 60] {
        bench.fill_journal(left);
        bench.power_cycle();
        bench.run_ms(2_500);
        assert!(!bench.is_bootloader(NODE), "{left} free");
        bench.call_back();
        // It compacts the journal.
        bench.run_ms(1_500);
        bench.start_program();
        assert_quiet(bench, 0);
    }
}

/// A task of the bootloader that hangs, while the others work: the chip ends it.
fn a_task_hangs(images: &Images, watchdog_ms: u64) {
    let mut bench = device(&images.bootloader, watchdog_ms, Options::default()).switched_on();
    bench.run_ms(20);
    bench.events();
    let hung = bench.time();
    // ARMv7-M A7.7.12: a branch to itself.
    bench.replace_idle(0xE7FE);
    bench.run_ms(400);
    let events = bench.events();
    let [(at, Stop::Reset(ResetCause::Pin)), ..] = events[..] else { panic!("{events:?}") };
    // The proof is good for 50 ms, the chip waits from the last toggle on.
    let range = watchdog_ms..=watchdog_ms + 50;
    assert!(range.contains(&((at - hung).0 / Span::from_millis(1).0)), "{:?}", at - hung);
    assert!(bench.is_bootloader(NODE));
}

/// A confirmed program that hangs is ended three times, and then kept back: the product counts the resets of the chip.
fn a_confirmed_program_hangs(images: &Images, watchdog_ms: u64) {
    /// 2007h/2 to /4: a crash loop, the pin, three crashes (docs/protocol.md).
    const STATE: [u32; 3] = [2, 2, 3];
    /// SYST_CSR (PM0214 section 4.5.1): without its timer no task of the program runs.
    const TIMER: u32 = 0xE000_E010;
    let mut bench = device(&images.bootloader, watchdog_ms, Options::default()).switched_on();
    bench.install(&images.v1);
    bench.confirm_program();
    bench.events();
    for crash in 1..=3 {
        bench.run_ms(100);
        assert!(!bench.is_bootloader(NODE), "crash {crash}");
        bench.machine().poke(TIMER, &[0; 4]).expect("a register");
        bench.run_ms(watchdog_ms + 100);
        assert_eq!(bench.stops(), [Stop::Reset(ResetCause::Pin)], "crash {crash}");
    }
    bench.run_ms(500);
    assert!(bench.is_bootloader(NODE));
    let state = [2, 3, 4].map(|sub| bench.number(DEVICE_STATE, sub));
    assert_eq!(state, STATE);
    // It goes on as after any crash loop.
    bench.start_program();
    assert!(!bench.is_bootloader(NODE));
}

/// A CRC-16, which software computes, over a program of half a mebibyte: the boot stage takes longer than the chip waits.
fn a_long_crc(copy: &Copy, images: &Images) {
    let product = std::fs::read_to_string(copy.root.join(FILES[2].1)).expect("it was copied");
    let crc_16 = "download: Download { crc: CrcKind::Crc16, ..Download::DEFAULT }, ..Product::DEFAULT";
    let product = product.replace("..Product::DEFAULT", crc_16);
    std::fs::write(copy.root.join("bootloader/products/bites-crc-16.rs"), product)
        .expect("it can be written");
    copy.xtask(&["build", "bootloader", "--product", "bites-crc-16", "--board", "watchdog-chip"]);
    let bootloader = path(copy, "bootloader-bites-crc-16.elf");
    let mut bench = device(&bootloader, WATCHDOG_MS[1], Options::default()).switched_on();
    let place = firmware::board().programs[0];
    let mut bytes = firmware::raw(&images.v1);
    bytes.resize(512 * 1024, 0x5A);
    let image = read(&bytes, Some(Format::Raw), Some(place.base)).expect("bytes at an address");
    let options = convert::Options::default().region(Region::Strict(place.into())).checksum(Checksum::Crc16);
    let file = convert::program_of(image, &options).expect("it fits").program;
    flash(&mut bench.session(), file, &FlashOptions::default(), &mut |_| {}).expect("an update");
    bench.power_off();
    bench.run_ms(100);
    let took = bench.power_on_to_first_instruction();
    assert!(took > Span::from_millis(WATCHDOG_MS[1]), "{took:?}");
    bench.await_program(100);
    assert!(!bench.is_bootloader(NODE));
    assert_quiet(&mut bench, 0);
}

/// A function that takes 5 ms of each 10: the log says so, and the bootloader answers all the same.
fn a_slow_function(copy: &Copy) {
    const FAST: &str = "each_10_ms: Some(|| crate::toggle(WATCHDOG)),";
    // A pass of the delay has two instructions, each of a cycle here.
    const SLOW: &str = r#"each_10_ms: Some(|| {
        crate::toggle(WATCHDOG);
        #[cfg(target_arch = "arm")]
        cortex_m::asm::delay(5 * 168_000 / 2);
    }),"#;
    copy.edit(FILES[0].1, FAST, SLOW);
    copy.xtask(&["build", "bootloader-log-rtt", "--product", "bites", "--board", "watchdog-chip"]);
    let bootloader = path(copy, "bootloader-log-rtt-bites.elf");
    let mut bench = device(&bootloader, 105, Options::default()).switched_on();
    bench.run_ms(500);
    assert!(bench.is_bootloader(NODE));
    let mut listener = Listener::probe();
    listener.lines(&mut bench);
    // NMT: reset node.
    bench.post(0x000, &[0x81, 0]);
    let mut lines = Vec::new();
    for _ in 0..50 {
        bench.run_ms(1);
        lines.extend(listener.lines(&mut bench));
    }
    let said = lines.iter().find_map(|line| line.strip_prefix("longest each_10_ms; us "));
    let us = u32::from_str_radix(said.unwrap_or_else(|| panic!("{lines:?}")), 16).expect("eight digits");
    assert!((5_000..5_500).contains(&us), "{us} us");
    bench.run_ms(500);
    assert_quiet(&mut bench, 0);
}

#[test]
fn a_board_with_a_watchdog_chip_keeps_it_quiet_and_its_power_on() {
    let copy = Copy::new();
    let images = Images::of(&copy);
    for ms in WATCHDOG_MS {
        let new = || device(&images.bootloader, ms, Options::default());
        for (what, options) in
            [("typical", Options::default()), ("worst", Options { silicon: WORST, ..Options::default() })]
        {
            println!("{ms} ms: the main job, {what} silicon");
            let mut bench = device(&images.bootloader, ms, options);
            main_job(&images, &mut bench);
        }
        println!("{ms} ms: power cuts");
        power_cuts(&images, &mut new());
        println!("{ms} ms: dead crystals");
        dead_crystals(&images, ms);
        println!("{ms} ms: full journals");
        full_journals(&images, &mut new());
        println!("{ms} ms: a task hangs");
        a_task_hangs(&images, ms);
        println!("{ms} ms: a confirmed program hangs");
        a_confirmed_program_hangs(&images, ms);
    }
    println!("a long CRC");
    a_long_crc(&copy, &images);
    println!("a slow function");
    a_slow_function(&copy);
}
