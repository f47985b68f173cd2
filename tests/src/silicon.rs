//! The main scenarios on chips that seeds draw ([`Silicon`]). A scenario fails by a panic, as the tests
//! do; what was drawn is printed before.

use canopen::Address;
use coflash_core::device::Doing;
use coflash_core::update::{flash, FlashOptions};
use emulator::machine::{Cut, FlashCut, Options, ResetCause, Stop};
use emulator::silicon::{Choice, Silicon};
use emulator::time::Span;
use kit::random::Random;

use crate::bench::{Bench, NODE};
use crate::firmware;

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
    play: fn(&mut Bench, &mut Random),
}

/// All of them. A seed plays one, and the next seed the next one.
pub const SCENARIOS: [Scenario; 8] = [
    Scenario { name: "main job, reset", play: |bench, _| main_job(bench, 0) },
    Scenario { name: "main job, watchdog", play: |bench, _| main_job(bench, 1) },
    Scenario { name: "main job, jump", play: |bench, _| main_job(bench, 2) },
    Scenario { name: "trial that dies", play: trial_dies },
    Scenario { name: "program that hangs", play: |bench, _| program_hangs(bench) },
    Scenario { name: "bootloader that hangs", play: |bench, _| bootloader_hangs(bench) },
    Scenario { name: "store with a cut", play: store_with_a_cut },
    Scenario { name: "update with a cut", play: update_with_a_cut },
];

/// Plays the scenario of a seed on the chip that the seed draws.
///
/// # Panics
/// If the device does not do its job.
pub fn play(seed: u64) {
    let scenario = &SCENARIOS[(seed % SCENARIOS.len() as u64) as usize];
    play_on(scenario, Choice::Seed(seed).of_board(0), seed);
}

/// Plays a scenario on a chip.
///
/// # Panics
/// As [`play`].
pub fn play_on(scenario: &Scenario, silicon: Silicon, seed: u64) {
    println!("{}, silicon {seed}: {silicon}", scenario.name);
    let mut bench = Bench::with(Options { silicon, seed, ..Options::default() }).switched_on();
    (scenario.play)(&mut bench, &mut Random(seed));
    bench.assert_nothing_unmodelled();
}

/// Download, start, way back, download again.
fn main_job(bench: &mut Bench, way: u8) {
    bench.update(firmware::APP_TEST);
    bench.session().write(REENTRY_PATH, &[way], Doing::Write(REENTRY_PATH), &mut |_| {}).unwrap();
    bench.events();
    bench.call_back();
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
