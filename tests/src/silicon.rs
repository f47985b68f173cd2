//! The main scenarios on chips that seeds draw ([`Silicon`]). A scenario fails by a panic, as the tests
//! do; what was drawn is printed before.

use canopen::program::ProgramControl;
use canopen::Address;
use coflash_core::device::{Doing, Transfers};
use coflash_core::update::{flash, FlashOptions};
use emulator::bus::Outcome;
use emulator::frame::Frame;
use emulator::machine::{Cut, FlashCut, Operation, Options, ResetCause, Stop};
use emulator::silicon::{Choice, Silicon};
use emulator::time::Span;
use kit::random::Random;

use crate::bench::{Bench, BIT_RATE, NODE};
use crate::{firmware, renewal, sealed_board};

const VERSION: u16 = 0x100A;
/// Object 2000h of the tests' application: the way back.
const REENTRY_PATH: Address = Address::new(0x2000, 0);
/// A branch to itself (ARMv7-M A7.7.12).
const HANG: u16 = 0xE7FE;
/// Operations of the flash in an update, and in a store of a node-ID, are fewer than these.
const UPDATE_OPERATIONS: usize = 8_000;
const STORE_OPERATIONS: usize = 24;

/// A story of a device, with the numbers that the seed draws.
pub struct Scenario {
    /// Its name in reports.
    pub name: &'static str,
    /// The bootloader.
    image: &'static str,
    play: fn(&mut Bench, &mut Random),
}

/// All of them. A seed plays one, and the next seed the next one. Those at the end need the split map.
const STORIES: [Scenario; 19] = {
    const fn story(name: &'static str, play: fn(&mut Bench, &mut Random)) -> Scenario {
        Scenario { name, image: firmware::BOOTLOADER, play }
    }
    let watchdog =
        Scenario { image: firmware::BOOTLOADER_WATCHDOG, ..story("watchdog of a product", watchdog) };
    let sealed = Scenario { image: firmware::BOOTLOADER_SEALED, ..story("sealed image", sealed_image) };
    [
        story("main job, reset", |bench, _| main_job(bench, 0)),
        story("main job, watchdog", |bench, _| main_job(bench, 1)),
        story("main job, jump", |bench, _| main_job(bench, 2)),
        story("trial that dies", trial_dies),
        story("program that hangs", |bench, _| program_hangs(bench)),
        story("bootloader that hangs", |bench, _| bootloader_hangs(bench)),
        story("store with a cut", store_with_a_cut),
        story("update with a cut", update_with_a_cut),
        watchdog,
        story("worn cells, caches on", |bench, _| worn_cells(bench)),
        story("option bytes", option_bytes),
        story("bit rate on a busy bus", |bench, _| bit_rate_on_a_busy_bus(bench)),
        story("bus held dominant", dominant_bus),
        story("supply that falls", falling_supply),
        story("Standby", standby),
        story("crystal that stops", stopping_crystal),
        story("bit rate that is found", |bench, _| found_bit_rate(bench)),
        story("renewal", |bench, _| renewal_and_program(bench)),
        sealed,
    ]
};
/// How many of them need the split map.
const OF_SPLIT: usize = 3;

/// The stories that this board has.
#[must_use]
pub fn scenarios() -> &'static [Scenario] {
    let count = STORIES.len() - if firmware::board().home.is_some() { 0 } else { OF_SPLIT };
    &STORIES[..count]
}

/// Plays the scenario of a seed on the chip that the seed draws.
///
/// # Panics
/// If the device does not do its job.
pub fn play(seed: u64) {
    let scenarios = scenarios();
    let scenario = &scenarios[(seed % scenarios.len() as u64) as usize];
    play_on(scenario, Choice::Seed(seed).of_board(0), seed);
}

/// Plays a scenario on a chip.
///
/// # Panics
/// As [`play`].
pub fn play_on(scenario: &Scenario, silicon: Silicon, seed: u64) {
    println!("{}, silicon {seed}: {silicon}", scenario.name);
    let mut bench = Bench::of_image_with(scenario.image, Options { silicon, seed, ..Options::default() });
    if scenario.image == firmware::BOOTLOADER_SEALED {
        sealed_board::provision(&mut bench);
    }
    bench.switch_on();
    (scenario.play)(&mut bench, &mut Random(seed));
    // A worn cell, a crystal that does not start, and the clock at a supply at which nothing is promised are reported,
    // and are the story.
    let told = [
        "programs a 1 over a 0",
        "HSEON is set, but this board has no crystal",
        " flash wait states: it needs 7",
    ];
    let is_told = |what: &str| told.iter().any(|told| what.contains(told));
    let reports = bench.machine().reports().iter().filter(|report| !is_told(&report.what));
    assert_eq!(reports.map(|report| report.to_string()).collect::<Vec<_>>(), [""; 0]);
}

/// Download, start, way back, download again.
fn main_job(bench: &mut Bench, way: u8) {
    bench.update(firmware::APP_TEST);
    bench.session().write(REENTRY_PATH, &[way], Doing::Write(REENTRY_PATH), &mut |_| {}).unwrap();
    bench.events();
    bench.session().command(1, ProgramControl::StartBootloader).unwrap();
    let answered = bench.time();
    // 18 ms; and with the slowest LSI five periods of two prescalers, and two counts of four, until the watchdog bites.
    let ms = (bench.await_boot_up(1_500) - answered).0 / 1_000_000_000;
    assert!(ms < 45, "{ms} ms from the answer to the boot-up");
    assert!(bench.is_bootloader(NODE));
    bench.update(firmware::APP_V2);
    assert_eq!(bench.text(VERSION), "2.0.0");
    // A request for the bootloader, a start: no crash, and no watchdog that bites a program that lives.
    bench.restart();
    assert!(!bench.is_bootloader(NODE));
}

/// A program that was never confirmed loses its power before it could prove anything, once or twice, and
/// then works.
fn trial_dies(bench: &mut Bench, random: &mut Random) {
    bench.install(firmware::APP_V1);
    for _ in 0..=random.below(2) {
        bench.run_ms(random.below(400) as u64);
        bench.restart();
    }
    assert!(!bench.is_bootloader(NODE), "it starts after the rescue window");
    // Three watchdog resets: it is given up, and starts on request.
    crashes_until_given_up(bench);
    bench.restart();
    assert!(bench.is_bootloader(NODE), "a power-on alone does not try it again");
    bench.start_program();
    assert!(!bench.is_bootloader(NODE));
}

/// A program that has started the watchdog and feeds it no more.
fn program_hangs(bench: &mut Bench) {
    bench.install(firmware::APP_V1);
    bench.confirm_program();
    crashes_until_given_up(bench);
    bench.install(firmware::APP_V2);
    assert_eq!(bench.text(VERSION), "2.0.0");
}

fn crashes_until_given_up(bench: &mut Bench) {
    for crash in 1..=3 {
        bench.events();
        // 4 × 64 periods of the LSI: 15 ms at 17 kHz. A program without a confirmation has a rescue window.
        bench.machine().preset_watchdog(64);
        bench.run_ms(600);
        let events = bench.events();
        let bites = |(_, stop): &&_| matches!(stop, Stop::Reset(ResetCause::IndependentWatchdog));
        assert_eq!(events.iter().filter(bites).count(), 1, "{events:?}");
        assert_eq!(bench.is_bootloader(NODE), crash == 3, "after crash {crash}");
    }
}

/// A loop without an end in the bootloader: its watchdog of a second at 32 kHz brings it back.
fn bootloader_hangs(bench: &mut Bench) {
    bench.run_ms(20);
    let lsi_hz = bench.machine().silicon().lsi_hz;
    let from = bench.time();
    bench.replace_idle(HANG);
    bench.run_ms(3_000);
    let events = bench.events();
    let [(at, Stop::Reset(ResetCause::IndependentWatchdog))] = events[..] else { panic!("{events:?}") };
    let periods = (at - from).0 / 1_000_000 * u64::from(lsi_hz) / 1_000_000;
    assert!((28_000..=33_000).contains(&periods), "after {periods} periods of the LSI");
    assert!(bench.is_bootloader(NODE));
    bench.install(firmware::APP_V1);
}

/// A cut of the power somewhere in the next `operations` of the flash, or after them.
fn cut_somewhere(bench: &mut Bench, random: &mut Random, operations: usize) {
    let operation = random.below(operations) as u64;
    let seed = random.next();
    let when = random.pick(&[Cut::Before, Cut::After, Cut::Torn { seed }, Cut::Unstable { seed }]);
    println!("the power is cut at operation {operation}: {when:?}");
    bench.machine().cut_power_at(Some(FlashCut { operation, when }));
}

/// The power returns, if it was cut, and goes off once more if not.
fn power_returns(bench: &mut Bench) {
    bench.machine().cut_power_at(None);
    bench.power_cycle();
}

/// After a cut in a store of a node-ID the device has the old one or the new one.
fn store_with_a_cut(bench: &mut Bench, random: &mut Random) {
    const OTHER: u8 = 9;
    bench.run_ms(20);
    for round in 0..3 {
        let node = if round % 2 == 0 { OTHER } else { NODE };
        cut_somewhere(bench, random, STORE_OPERATIONS);
        bench.post(0x7E5, &[0x04, 1, 0, 0, 0, 0, 0, 0]);
        for [command, value] in [[0x11, node], [0x17, 0]] {
            let _ = bench.ask(0x7E5, &[command, value, 0, 0, 0, 0, 0, 0], 0x7E4);
        }
        bench.run_ms(20);
        power_returns(bench);
        let from = bench.time();
        bench.run_ms(200);
        let boot_ups = bench.frames_since(from).into_iter().filter(|(_, _, data)| *data == [0]);
        let nodes: Vec<u32> = boot_ups.map(|(_, id, _)| id & 0x7F).collect();
        assert!(matches!(nodes[..], [1 | 9]), "round {round}: {nodes:?}");
        assert!(bench.is_bootloader(nodes[0] as u8));
        bench.events();
    }
}

/// After a cut in an update the device can be reached, and the update works.
fn update_with_a_cut(bench: &mut Bench, random: &mut Random) {
    bench.install(firmware::APP_V1);
    bench.confirm_program();
    cut_somewhere(bench, random, UPDATE_OPERATIONS);
    let options = FlashOptions::default().trial_run(false);
    let _ = flash(&mut bench.session(), firmware::blocks(firmware::APP_V2), &options, &mut |_| {});
    bench.events();
    power_returns(bench);
    bench.await_program(1000);
    bench.run_ms(50);
    bench.install(firmware::APP_V2);
    bench.run_ms(500);
    assert_eq!(bench.text(VERSION), "2.0.0");
    assert!(bench.time() < emulator::time::Time(0) + Span::from_millis(600_000), "it took minutes");
}

const LSS: u16 = 0x7E5;
const LSS_ANSWER: u32 = 0x7E4;
/// Switch state global to configuration (CiA 305).
const CONFIGURATION: [u8; 8] = [0x04, 1, 0, 0, 0, 0, 0, 0];

fn lss(bench: &mut Bench, request: [u8; 8]) {
    let answer = bench.ask(LSS, &request, LSS_ANSWER).expect("an answer");
    assert_eq!(answer[..2], [request[0], 0]);
}

/// A program with a release, which runs.
fn running(bench: &mut Bench) {
    bench.install(firmware::APP_V1);
    bench.confirm_program();
    bench.events();
}

/// The device is whole: it is called back, and takes a program.
fn takes_a_program(bench: &mut Bench) {
    if !bench.is_bootloader(NODE) {
        bench.call_back();
    }
    bench.run_ms(20);
    bench.install(firmware::APP_V2);
    assert_eq!(bench.text(VERSION), "2.0.0");
}

/// The product starts each program with a watchdog of a second at the LSI's nominal 32 kHz: one that does not feed it is
/// given up.
fn watchdog(bench: &mut Bench, _: &mut Random) {
    let (_, endless) = firmware::endless_loop();
    let options = FlashOptions::default().trial_run(false);
    let _ = flash(&mut bench.session(), endless, &options, &mut |_| {});
    bench.events();
    bench.power_cycle();
    bench.run_ms(8_000);
    let lsi_hz = u64::from(bench.machine().silicon().lsi_hz);
    let bites: Vec<_> = bench
        .events()
        .into_iter()
        .filter(|(_, stop)| matches!(stop, Stop::Reset(ResetCause::IndependentWatchdog)))
        .collect();
    assert_eq!(bites.len(), 3, "{bites:?}");
    for pair in bites.windows(2) {
        let periods = (pair[1].0 - pair[0].0).0 / 1_000_000 * lsi_hz / 1_000_000;
        // A start with a rescue window comes between.
        assert!((32_000..=32_000 + lsi_hz / 2).contains(&periods), "{periods} periods of the LSI");
    }
    assert!(bench.is_bootloader(NODE));
}

/// Programming changes the data cache, too, and what the cells have become is seen without it alone (RM0090 section
/// 3.6.4). A store of the application reads back what it has written: with a cell that is worn out it takes another
/// place.
fn worn_cells(bench: &mut Bench) {
    const FLASH_ACR: u32 = 0x4002_3C00;
    const DATA_CACHE: u32 = 1 << 10;
    running(bench);
    assert_ne!(bench.machine().register(FLASH_ACR).unwrap() & DATA_CACHE, 0);
    // A slot has seven words: after four of them the places of its words in a line have all been there.
    for next in [20, 21, 22, 23] {
        bench.post(LSS, &CONFIGURATION);
        lss(bench, [0x11, next, 0, 0, 0, 0, 0, 0]);
        let from = bench.time();
        bench.post(LSS, &[0x17, 0, 0, 0, 0, 0, 0, 0]);
        // The word after the tag has the node-ID.
        let word = firmware::board().chip.flash.base + await_programming(bench) + 4;
        bench.machine().load_bin(word, &[0; 4]).unwrap();
        bench.run_ms(100);
        let answers: Vec<_> = bench.frames_of(LSS_ANSWER, from).into_iter().map(|(_, data)| data).collect();
        assert_eq!(answers, [[0x17, 0, 0, 0, 0, 0, 0, 0]], "node {next}");
        bench.power_cycle();
        bench.await_boot_up_of(next, 1_000);
        bench.run_ms(50);
        assert!(!bench.is_bootloader(next), "node {next}");
    }
    // The controller is free for the next one.
    for next in [24, 25] {
        bench.post(LSS, &CONFIGURATION);
        lss(bench, [0x11, next, 0, 0, 0, 0, 0, 0]);
        lss(bench, [0x17, 0, 0, 0, 0, 0, 0, 0]);
    }
}

/// The offset in the flash of the next word that is programmed, when its operation has begun.
fn await_programming(bench: &mut Bench) -> u32 {
    for _ in 0..20_000 {
        bench.machine().keep_flash_log();
        bench.world.run_for(Span::from_micros(5));
        if let [Operation::Program { offset, .. }, ..] = bench.machine().take_flash_log()[..] {
            return offset;
        }
    }
    panic!("nothing was programmed within 100 ms");
}

/// A sector that is write-protected: nothing is lost, and the same update works without.
fn option_bytes(bench: &mut Bench, random: &mut Random) {
    running(bench);
    bench.call_back();
    let board = firmware::board();
    let sector = board.chip.sector_at(board.programs[0].base).expect("it is in flash").number;
    bench.machine().set_brown_out_level(random.below(4) as u8);
    bench.machine().protect_sector(sector, true);
    assert!(bench.install_unwatched(firmware::APP_V2).is_err());
    bench.start_program();
    assert_eq!(bench.text(VERSION), "1.0.0");
    bench.machine().protect_sector(sector, false);
    takes_a_program(bench);
}

/// A controller that sticks on a busy bus, whose acknowledgements come late, or whose aborts do not end.
fn bit_rate_on_a_busy_bus(bench: &mut Bench) {
    let other = bench.world.add_host_port(125_000);
    bench.run_ms(20);
    bench.events();
    bench.post(LSS, &CONFIGURATION);
    // 500 kbit/s, after 50 ms.
    lss(bench, [0x13, 0, 2, 0, 0, 0, 0, 0]);
    bench.post(LSS, &[0x15, 50, 0, 0, 0, 0, 0, 0]);
    bench.run_ms(2);
    // A frame takes a millisecond, and has the higher priority.
    for n in 0..300 {
        let frame = Frame::standard(0x200, &[n as u8; 8]).expect("11 bits");
        bench.world.send(other, frame);
    }
    bench.run_ms(250);
    bench.world.port_mut(other).set_bit_rate(500_000);
    bench.set_host_bit_rate(500_000);
    assert_eq!(bench.events(), [], "it needed no watchdog");
    bench.run_ms(1_000);
    assert!(bench.is_bootloader(NODE));
}

/// A short circuit in the middle of an update, for some seconds.
fn dominant_bus(bench: &mut Bench, random: &mut Random) {
    running(bench);
    bench.call_back();
    bench.run_ms(20);
    bench.events();
    bench.world.hold_dominant_after(Span::from_millis(random.below(3_000) as u64));
    let _ = bench.install_unwatched(firmware::APP_V2);
    bench.run_ms(random.below(10_000) as u64);
    bench.world.hold_dominant(false);
    // The device's own wait after bus-off, the longest (docs/testing.md, "The slowest answer").
    bench.run_ms(5_400);
    let resets = bench.stops();
    assert!(resets.iter().all(|stop| matches!(stop, Stop::Reset(ResetCause::Software))), "{resets:?}");
    takes_a_program(bench);
}

/// The supply falls in the middle of an update to where the chip runs and its flash does not, and comes back.
fn falling_supply(bench: &mut Bench, random: &mut Random) {
    running(bench);
    bench.call_back();
    bench.run_ms(20);
    let low = random.pick(&[2_000, 1_900]);
    bench.machine().set_supply(low, Span::from_millis(200 + random.below(3_000) as u64));
    let _ = bench.install_unwatched(firmware::APP_V2);
    bench.run_ms(random.below(5_000) as u64);
    bench.machine().set_supply(3_300, Span(0));
    bench.run_ms(500);
    takes_a_program(bench);
}

/// A program that sleeps in Standby (RM0090 table 27: PDDS, CWUF, SLEEPDEEP) and wakes up, more often than it may crash.
fn standby(bench: &mut Bench, random: &mut Random) {
    const RCC_APB1ENR: u32 = 0x4002_3840;
    running(bench);
    for wake in 0..4 {
        let clocks = bench.machine().register(RCC_APB1ENR).unwrap();
        for (register, value) in
            [(RCC_APB1ENR, clocks | 1 << 28), (0x4000_7000, 0xC006), (0xE000_ED10, 1 << 2)]
        {
            bench.machine().poke(register, &u32::to_le_bytes(value)).unwrap();
        }
        bench.run_ms(5 + random.below(500) as u64);
        bench.machine().wake_up();
        bench.await_boot_up(100);
        assert!(!bench.is_bootloader(NODE), "wake-up {wake}");
    }
    // What comes later is no wake-up.
    crashes_until_given_up(bench);
    takes_a_program(bench);
}

/// A crystal that stops while the program runs: a reset, no crash, and no frame of another node is disturbed.
fn stopping_crystal(bench: &mut Bench, random: &mut Random) {
    bench.world.add_host_port(BIT_RATE);
    running(bench);
    for gap in 0..4 {
        bench.run_ms(random.below(100) as u64);
        bench.events();
        bench.machine().set_crystal(0);
        bench.run_ms(1 + random.below(40) as u64);
        let resets = bench.stops();
        assert!(resets.starts_with(&[Stop::Reset(ResetCause::Software)]), "gap {gap}: {resets:?}");
        bench.machine().set_crystal(bsp::CLOCK_TREE.hse);
        bench.power_cycle();
        bench.await_program(1_000);
    }
    takes_a_program(bench);
}

/// A last error code that was lost would make the first bit rate a found one.
fn found_bit_rate(bench: &mut Bench) {
    bench.run_ms(20);
    bench.post(LSS, &CONFIGURATION);
    lss(bench, [0x13, 0, 9, 0, 0, 0, 0, 0]);
    lss(bench, [0x17, 0, 0, 0, 0, 0, 0, 0]);
    bench.power_cycle();
    bench.set_host_bit_rate(500_000);
    bench.world.add_host_port(500_000);
    let from = bench.time();
    for n in 0..100 {
        bench.post(0x300, &[n; 5]);
        bench.run_ms(20);
    }
    assert!(bench.records().iter().all(|record| record.start < from || record.outcome == Outcome::Good));
    assert!(bench.is_bootloader(NODE));
}

/// The bootloader renews itself; the program stays.
fn renewal_and_program(bench: &mut Bench) {
    const NEW: u32 = 0x0009_0001;
    running(bench);
    bench.call_back();
    renewal::stage(bench, &renewal::version(firmware::BOOTLOADER, NEW));
    renewal::start(bench);
    renewal::confirm(bench);
    assert_eq!(renewal::running(bench), NEW);
    bench.start_program();
    assert_eq!(bench.text(VERSION), "1.0.0");
    takes_a_program(bench);
}

/// A sealed device takes two sealed programs, one after the other.
fn sealed_image(bench: &mut Bench, _: &mut Random) {
    for (counter, image, version) in [
        (sealed_board::COUNTER, firmware::APP_V1, "1.0.0"),
        (sealed_board::COUNTER + 1, firmware::APP_V2, "2.0.0"),
    ] {
        bench.run_ms(20);
        let file = sealed_board::seal(&sealed_board::sealer(counter), image);
        assert_eq!(sealed_board::write(bench, &file, Transfers::Blocks), (None, 0));
        sealed_board::start(bench, image, version);
        sealed_board::call_back(bench);
    }
}
