//! The main scenarios on chips that differ in what the manuals leave open: drawn by seeds, and the worst.

use coboot_tests::bench::{Bench, NODE};
use coboot_tests::silicon::{play, play_on, scenarios};
use emulator::bus::Outcome;
use emulator::machine::Options;
use emulator::silicon::{Choice, Silicon, TYPICAL};
use emulator::time::Time;

/// Each scenario once; `cargo xtask attack --silicon N` plays as many as a night allows.
#[test]
fn each_scenario_works_with_the_chips_that_seeds_draw() {
    for seed in 0..scenarios().len() as u64 {
        play(seed);
    }
}

#[test]
fn each_scenario_works_with_the_worst_chip() {
    for (scenario, seed) in scenarios().iter().zip(1_000..) {
        play_on(scenario, Choice::Worst.of_board(0), seed);
    }
}

fn board(silicon: Silicon, hse_hz: u32) -> Bench {
    println!("{silicon}");
    let mut bench = Bench::with(Options { silicon, hse_hz, ..Options::default() });
    bench.power_on();
    bench
}

const LSS: u16 = 0x7E5;
/// Switch state global to configuration (CiA 305).
const CONFIGURATION: [u8; 8] = [0x04, 1, 0, 0, 0, 0, 0, 0];

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
