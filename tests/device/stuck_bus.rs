//! A line of the bus that something holds dominant for minutes (a short circuit, a transceiver without its
//! supply), and then lets go.

use coboot_tests::bench::{Bench, NODE};
use coboot_tests::firmware;
use emulator::machine::Options;
use emulator::silicon::{Silicon, TYPICAL, WORST};
use emulator::time::{Span, Time};

const MINUTE_MS: u64 = 60_000;
/// The device's own wait after bus-off, the longest (docs/testing.md, "The slowest answer").
const PATIENCE_MS: u64 = 5_400;

fn board(silicon: Silicon) -> Bench {
    Bench::with(Options { silicon, ..Options::default() })
}

/// The line is free again: the device, which was never reset, is back in time.
fn comes_back(bench: &mut Bench, what: &str) {
    bench.world.hold_dominant(false);
    bench.run_ms(PATIENCE_MS);
    assert_eq!(bench.events(), [], "{what}: a reset");
}

/// From power-on: the boot-up waits, and the watchdog finds a program that lives.
#[test]
fn a_bootloader_that_starts_on_a_dominant_line_is_there_when_it_is_free() {
    for silicon in [TYPICAL, WORST] {
        let what = silicon.to_string();
        let mut bench = board(silicon);
        bench.world.hold_dominant(true);
        bench.power_on();
        bench.run_ms(2 * MINUTE_MS);
        assert_eq!(bench.frames_since(Time(0)), [], "{what}");
        comes_back(&mut bench, &what);
        assert!(bench.is_bootloader(NODE), "{what}");
        bench.install_unwatched(firmware::APP_V1).expect(&what);
    }
}

/// In the middle of an update: it breaks off, and a new one works.
#[test]
fn an_update_on_a_line_that_falls_breaks_off_and_works_later() {
    // Before the erase, in it, between blocks of data.
    for (after_ms, silicon) in [(5, TYPICAL), (800, WORST), (2_500, WORST)] {
        let what = format!("after {after_ms} ms, {silicon}");
        let mut bench = board(silicon).switched_on();
        bench.install_unwatched(firmware::APP_V1).expect(&what);
        bench.call_back();
        bench.run_ms(20);
        bench.events();
        bench.world.hold_dominant_after(Span::from_millis(after_ms));
        assert!(bench.install_unwatched(firmware::APP_V2).is_err(), "{what}");
        bench.run_ms(MINUTE_MS);
        comes_back(&mut bench, &what);
        bench.install_unwatched(firmware::APP_V2).expect(&what);
        assert!(!bench.is_bootloader(NODE), "{what}");
    }
}

/// A program that runs, and one that starts: the way back works afterwards.
#[test]
fn a_program_on_a_dominant_line_can_be_called_back_later() {
    for from_power_on in [false, true] {
        let what = format!("from power-on: {from_power_on}");
        let mut bench = board(TYPICAL).switched_on();
        bench.install_unwatched(firmware::APP_V1).expect(&what);
        bench.confirm_program();
        if from_power_on {
            bench.power_off();
            bench.run_ms(100);
        }
        bench.events();
        bench.world.hold_dominant(true);
        bench.power_on();
        bench.run_ms(2 * MINUTE_MS);
        comes_back(&mut bench, &what);
        assert!(!bench.is_bootloader(NODE), "{what}");
        bench.call_back();
        assert!(bench.is_bootloader(NODE), "{what}");
    }
}
