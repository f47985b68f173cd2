//! The main job on chips that differ in what the manuals leave open: drawn by seeds, and the worst.

use canopen::program::ProgramControl;
use canopen::Address;
use coboot_tests::bench::{Bench, NODE};
use coboot_tests::firmware;
use coflash::device::Doing;
use coflash::update::{flash, FlashOptions};
use emulator::machine::Options;
use emulator::silicon::Choice;

/// Seeds of each run; `COBOOT_SEEDS` is the number for a night.
const SEEDS: u64 = 6;
const VERSION: Address = Address::new(0x100A, 0);
/// Object 2000h of the application template: the way back.
const REENTRY_PATH: Address = Address::new(0x2000, 0);

fn install(bench: &mut Bench, image: &str) {
    flash(&mut bench.session(), &firmware::blocks(image), &FlashOptions::default(), &mut |_| {}).unwrap();
}

/// Download, start, way back, download again. The chip is printed before, so that a failure can be seen
/// again.
fn main_job(choice: Choice, way: u8) {
    let silicon = choice.of_board(0);
    println!("silicon {choice}, way back {way}: {silicon}");
    let mut bench = Bench::with(Options { silicon, ..Options::default() });
    bench.power_on();
    bench.await_boot_up(100);
    install(&mut bench, firmware::APP_V1);
    let write = Doing::Write(REENTRY_PATH);
    bench.session().write(REENTRY_PATH, &[way], write, &mut |_| {}).unwrap();
    bench.events();
    bench.session().command(1, ProgramControl::StartBootloader).unwrap();
    bench.await_boot_up(100);
    assert!(bench.is_bootloader(NODE));
    install(&mut bench, firmware::APP_V2);
    assert_eq!(bench.session().read_text(VERSION).unwrap(), "2.0.0");
    // A request for the bootloader, a start: no crash, and no watchdog that bites a program that lives.
    bench.power_off();
    bench.run_ms(100);
    bench.power_on();
    bench.await_program(1000);
    assert!(!bench.is_bootloader(NODE));
}

#[test]
fn the_main_job_works_with_every_chip_that_a_seed_draws() {
    let seeds =
        std::env::var("COBOOT_SEEDS").map_or(SEEDS, |text| text.parse().expect("COBOOT_SEEDS: a number"));
    for seed in 0..seeds {
        main_job(Choice::Seed(seed), (seed % 3) as u8);
    }
}

#[test]
fn the_main_job_works_with_the_worst_chip() {
    for way in 0..3 {
        main_job(Choice::Worst, way);
    }
}
