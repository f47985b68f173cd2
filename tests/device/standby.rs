//! A program that puts the chip into Standby: the device starts it again when it wakes up.

use coboot_tests::bench::{Bench, NODE};
use coboot_tests::firmware;
use emulator::machine::{Options, ResetCause, Stop};
use emulator::silicon::{Silicon, TYPICAL};

const RCC_CSR: u32 = 0x4002_3874;
const RCC_APB1ENR: u32 = 0x4002_3840;
const PWR_CR: u32 = 0x4000_7000;
const PWR_CSR: u32 = 0x4000_7004;
const SCR: u32 = 0xE000_ED10;
/// The handoff's reset cause 8 is Standby (docs/protocol.md, 2007h/3).
const STANDBY: u8 = 8;

/// A board with a confirmed program that runs.
pub(super) fn running_board(image: &str, program: &str, silicon: Silicon, has_watchdog: bool) -> Bench {
    let mut bench = Bench::of_image_with(image, Options { silicon, ..Options::default() });
    bench.machine().set_hardware_watchdog(has_watchdog);
    let mut bench = bench.switched_on();
    bench.install_unwatched(program).expect("it is installed");
    bench.confirm_program();
    bench.events();
    bench
}

/// What the program would do (RM0090 table 27): PDDS, CWUF, SLEEPDEEP. It sleeps whenever it is idle.
fn enter_standby(bench: &mut Bench) {
    let clocks = bench.machine().register(RCC_APB1ENR).unwrap();
    for (register, value) in [(RCC_APB1ENR, clocks | 1 << 28), (PWR_CR, 0xC006), (SCR, 1 << 2)] {
        bench.machine().poke(register, &value.to_le_bytes()).unwrap();
    }
    bench.run_ms(5);
    assert!(bench.machine().is_in_standby());
}

/// Whether a wake-up sets a flag in RCC_CSR or none, whether the LSI runs or not, sealed or not: it is
/// no jump and no crash, and the program gets the cause.
#[test]
fn a_device_that_wakes_up_starts_its_program_each_time() {
    let cases = [
        (firmware::BOOTLOADER_SEALED, false),
        // The watchdog of the option bytes starts with the wake-up.
        (firmware::BOOTLOADER, true),
        (firmware::BOOTLOADER, false),
    ];
    // A board with the compact map has no sealed images.
    let is_split = firmware::board().home.is_some();
    for (image, has_watchdog) in cases.into_iter().filter(|(image, _)| is_split || !image.contains("sealed"))
    {
        for flags_after_standby in [false, true] {
            let what = format!("{image}, watchdog {has_watchdog}, flags {flags_after_standby}");
            let silicon = Silicon { flags_after_standby, ..TYPICAL };
            let mut bench = running_board(image, firmware::APP_V1, silicon, has_watchdog);
            // Twice as often as a program may crash.
            for wake in 1..=6 {
                enter_standby(&mut bench);
                bench.run_ms(100);
                bench.machine().wake_up();
                bench.await_boot_up(100);
                let stops = bench.stops();
                assert_eq!(stops, [Stop::Reset(ResetCause::Standby)], "{what}, wake-up {wake}");
                assert!(!bench.is_bootloader(NODE), "{what}, wake-up {wake}");
            }
            let cause = bench.memory(firmware::board().handoff.base + 10, 1);
            assert_eq!(cause, [STANDBY], "{what}");
            // The flags are cleared, for the next reset; and the program finds the power controller off.
            assert_eq!(bench.machine().register(PWR_CSR).unwrap() & 0b10, 0, "{what}");
            assert_eq!(bench.machine().register(RCC_CSR).unwrap() >> 24, 0, "{what}");
            bench.assert_nothing_unmodelled();
        }
    }
}

/// Standby that the watchdog ends is a wake-up like any other: programs use it as an alarm.
#[test]
fn a_watchdog_that_ends_standby_is_no_crash() {
    let mut bench = running_board(firmware::BOOTLOADER, firmware::APP_V1, TYPICAL, false);
    for wake in 1..=6 {
        bench.machine().preset_watchdog(0x400);
        enter_standby(&mut bench);
        bench.await_boot_up(1000);
        let stops = bench.stops();
        assert_eq!(stops, [Stop::Reset(ResetCause::IndependentWatchdog)], "wake-up {wake}");
        assert!(!bench.is_bootloader(NODE), "wake-up {wake}");
    }
    // And it can be called back.
    bench.call_back();
    assert!(bench.is_bootloader(NODE));
}
