//! The main scenarios on chips that differ in what the manuals leave open: drawn by seeds, and the worst.

use coboot_tests::bench::{Bench, NODE};
use coboot_tests::firmware;
use coboot_tests::silicon::{play, play_on, SCENARIOS};
use emulator::bus::Outcome;
use emulator::machine::{Operation, Options};
use emulator::silicon::{Choice, Silicon, TYPICAL};
use emulator::time::{Span, Time};

/// Seeds of the tests with a scenario of their own.
const SEEDS: u64 = 6;

/// Each scenario twice; `cargo xtask attack --silicon N` plays as many as a night allows.
#[test]
fn each_scenario_works_with_the_chips_that_seeds_draw() {
    for seed in 0..2 * SCENARIOS.len() as u64 {
        play(seed);
    }
}

#[test]
fn each_scenario_works_with_the_worst_chip() {
    for (scenario, seed) in SCENARIOS.iter().zip(1_000..) {
        play_on(scenario, Choice::Worst.of_board(0), seed);
    }
}

/// The chips of the tests below.
fn chips() -> impl Iterator<Item = Silicon> {
    let drawn = (0..SEEDS).map(Choice::Seed);
    [Choice::Worst].into_iter().chain(drawn).map(|choice| choice.of_board(0))
}

fn board(silicon: Silicon, hse_hz: u32) -> Bench {
    println!("{silicon}");
    let mut bench = Bench::with(Options { silicon, hse_hz, ..Options::default() });
    bench.power_on();
    bench
}

const CRYSTAL: u32 = 8_000_000;
const LSS: u16 = 0x7E5;
/// Switch state global to configuration (CiA 305).
const CONFIGURATION: [u8; 8] = [0x04, 1, 0, 0, 0, 0, 0, 0];

fn lss(bench: &mut Bench, request: [u8; 8]) {
    let answer = bench.ask(LSS, &request, 0x7E4).expect("an answer");
    assert_eq!(answer[..2], [request[0], 0]);
}

/// A controller that sticks on a busy bus, whose acknowledgements come late, or whose aborts do not end.
#[test]
fn the_bit_rate_changes_on_a_busy_bus_with_every_chip() {
    for silicon in chips() {
        let mut bench = board(silicon, CRYSTAL);
        bench.await_boot_up(200);
        let other = bench.world.add_host_port(125_000);
        bench.post(LSS, &CONFIGURATION);
        // 500 kbit/s, after 50 ms.
        lss(&mut bench, [0x13, 0, 2, 0, 0, 0, 0, 0]);
        bench.post(LSS, &[0x15, 50, 0, 0, 0, 0, 0, 0]);
        bench.run_ms(2);
        // A frame takes a millisecond, and has the higher priority.
        for n in 0..300 {
            let data = [n as u8; 8];
            bench.world.send(other, emulator::frame::Frame::standard(0x200, &data).expect("11 bits"));
        }
        bench.run_ms(250);
        bench.world.port_mut(other).set_bit_rate(500_000);
        bench.set_host_bit_rate(500_000);
        let resets = bench.events();
        assert_eq!(resets, [], "it needed no watchdog");
        bench.run_ms(1000);
        assert!(bench.is_bootloader(NODE));
    }
}

/// A last error code that was lost would make the first bit rate a found one.
#[test]
#[cfg_attr(not(split_map), ignore = "needs the split map")]
fn the_bit_rate_is_found_and_nobody_is_disturbed_with_every_chip() {
    for silicon in chips() {
        let mut bench = board(silicon, CRYSTAL);
        bench.await_boot_up(200);
        bench.post(LSS, &CONFIGURATION);
        lss(&mut bench, [0x13, 0, 9, 0, 0, 0, 0, 0]);
        lss(&mut bench, [0x17, 0, 0, 0, 0, 0, 0, 0]);
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
}

/// HSI may be 4 % too fast or too slow, and CAN tolerates 1 % at most.
#[test]
fn a_device_without_its_crystal_disturbs_nobody_whatever_its_oscillator_makes() {
    let mut joined = [0; 2];
    for hsi_hz in (15_360_000..=16_640_000).step_by(80_000) {
        let mut bench = board(Silicon { hsi_hz, ..TYPICAL }, 0);
        bench.world.add_host_port(125_000);
        for n in 0..20 {
            bench.run_ms(20);
            bench.post(0x300, &[n; 8]);
        }
        bench.post(LSS, &CONFIGURATION);
        bench.run_ms(200);
        let frames = bench.frames_since(Time(0));
        let speaks = frames.iter().any(|(_, id, _)| *id == 0x700 + u32::from(NODE));
        let is_exact = hsi_hz.abs_diff(16_000_000) <= 16_000_000 / 1000 * 9;
        assert_eq!(speaks, is_exact, "{hsi_hz} Hz");
        assert!(bench.records().iter().all(|record| record.outcome == Outcome::Good), "{hsi_hz} Hz");
        joined[usize::from(speaks)] += 1;
    }
    assert!(joined.iter().all(|count| *count > 1), "{joined:?}");
}

const FLASH_ACR: u32 = 0x4002_3C00;
/// DCEN.
const DATA_CACHE: u32 = 1 << 10;

/// The application runs, whose HAL switches the data cache on.
fn board_with_the_data_cache_on() -> Bench {
    let mut bench = board(Silicon { stale_lines: true, ..TYPICAL }, CRYSTAL);
    bench.await_boot_up(200);
    bench.install(firmware::APP_V1);
    bench.confirm_program();
    assert_ne!(bench.machine().register(FLASH_ACR).unwrap() & DATA_CACHE, 0);
    bench
}

/// The offset in the flash of the next word that is programmed, when its operation has begun.
fn await_programming(bench: &mut Bench) -> u32 {
    for _ in 0..20_000 {
        bench.machine().keep_flash_log();
        bench.world.run_for(Span::from_micros(5));
        if let [Operation::Program { offset, .. }] = bench.machine().take_flash_log()[..] {
            return offset;
        }
    }
    panic!("nothing was programmed within 100 ms");
}

/// Programming changes the data cache, too, and what the cells have become is seen without it alone (RM0090 section
/// 3.6.4). A store reads back what it has written: with a cell that is worn out it takes another place.
#[test]
fn an_application_with_the_data_cache_on_does_not_lose_a_value_to_a_worn_cell() {
    let mut bench = board_with_the_data_cache_on();
    let mut node = NODE;
    // A slot has seven words: after four of them the places of its words in a line have all been there.
    for next in [20, 21, 22, 23] {
        bench.post(LSS, &CONFIGURATION);
        lss(&mut bench, [0x11, next, 0, 0, 0, 0, 0, 0]);
        let from = bench.time();
        bench.post(LSS, &[0x17, 0, 0, 0, 0, 0, 0, 0]);
        // The word after the tag has the node-ID.
        let word = firmware::board().chip.flash.base + await_programming(&mut bench) + 4;
        bench.machine().load_bin(word, &[0; 4]).unwrap();
        bench.run_ms(100);
        let answers = bench.frames_since(from).into_iter().filter(|(_, id, _)| *id == 0x7E4);
        let answers: Vec<_> = answers.map(|(_, _, data)| data).collect();
        assert_eq!(answers, [[0x17, 0, 0, 0, 0, 0, 0, 0]], "node {next}");
        bench.power_cycle();
        bench.await_boot_up_of(next, 1_000);
        bench.run_ms(50);
        assert!(!bench.is_bootloader(next), "node {next} after {node}");
        node = next;
    }
}
