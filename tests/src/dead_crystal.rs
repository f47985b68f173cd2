//! A program on a board whose crystal has failed: it must not speak from the internal oscillator, which CAN does
//! not tolerate, and must not wait for the crystal, or the device could not be reached any more.

use coflash_core::file::Program;
use coflash_core::update::{flash, FlashOptions};
use emulator::bus::Outcome;
use emulator::machine::Options;
use emulator::silicon::{Silicon, TYPICAL};
use emulator::time::Time;

use crate::bench::{Bench, BIT_RATE, NODE};
use crate::firmware;

/// 2007h/2, why it stays in the bootloader: a crash loop; and 2007h/5, the source of the clock: the internal oscillator
/// (docs/protocol.md).
const CRASH_LOOP: u32 = 2;
const INTERNAL: u32 = 2;
/// The time for three starts with their rescue windows, with room to spare.
const THREE_STARTS_MS: u64 = 3_000;

/// The cells of a flash with the bootloader and this program, which starts by itself.
fn installed(program: &Program) -> Vec<u8> {
    let mut bench = Bench::new().switched_on();
    let options = FlashOptions::default().trial_run(false);
    flash(&mut bench.session(), program, &options, &mut |_| {}).expect("it is installed");
    bench.machine().flash().to_vec()
}

/// A board with these cells and another node on its bus, powered.
fn board(cells: &[u8], options: Options) -> Bench {
    let mut bench = Bench::of_image_with(firmware::BOOTLOADER, options);
    bench.world.add_host_port(BIT_RATE);
    bench.machine().load_bin(firmware::board().chip.flash.base, cells).expect("it fits");
    bench.power_on();
    bench
}

/// Checks that the program leaves for the bootloader without a word, and that the device can be reached there;
/// with its crystal it starts again.
///
/// # Panics
/// If it does not.
pub fn brings_the_bootloader(program: &Program) {
    let cells = installed(program);
    // 3 % is within HSI's range (DS8626 table 41), and more than any bit timing of CAN tolerates.
    for hsi_hz in [16_480_000, 16_000_000] {
        let mut bench = board(
            &cells,
            Options { silicon: Silicon { hsi_hz, ..TYPICAL }, hse_hz: 0, ..Options::default() },
        );
        let mut ran = false;
        for n in 0..THREE_STARTS_MS / 20 {
            bench.run_ms(20);
            bench.post(0x300, &[n as u8; 8]);
            ran |= firmware::board().programs[0].contains(bench.machine().pc(), 2);
        }
        assert!(ran, "it was started");
        assert!(bench.records().iter().all(|record| record.outcome == Outcome::Good), "HSI {hsi_hz} Hz");
        assert!(bench.frames_since(Time(0)).iter().all(|(_, id, _)| *id == 0x300), "HSI {hsi_hz} Hz");
        if hsi_hz == TYPICAL.hsi_hz {
            // Switch state global to configuration (CiA 305): the clock of the device is good enough for it.
            bench.post(0x7E5, &[0x04, 1, 0, 0, 0, 0, 0, 0]);
            bench.run_ms(200);
            assert!(bench.is_bootloader(NODE));
            assert_eq!([bench.number(0x2007, 2), bench.number(0x2007, 5)], [CRASH_LOOP, INTERNAL]);
        }
    }
    // A power-on begins a new count.
    let mut bench = board(&cells, Options::default());
    bench.await_program(1_000);
    bench.run_ms(50);
    assert!(!bench.is_bootloader(NODE));
}
