//! The behaviour of a device that has crashed or hangs.

use canopen::program::ProgramControl;
use canopen::Address;
use coboot_tests::bench::{Bench, NODE};
use coboot_tests::firmware;
use coflash_core::device::Doing;
use emulator::machine::{Options, ResetCause, Stop};
use emulator::silicon::{Silicon, TYPICAL};
use emulator::time::Span;

/// Overwrites the start of a function in RAM with Thumb code.
fn patch(bench: &mut Bench, function: &str, code: &[u16]) {
    let bytes: Vec<u8> = code.iter().flat_map(|half| half.to_le_bytes()).collect();
    let address = firmware::symbol(firmware::BOOTLOADER, |name| name.contains(function));
    bench.machine().write_ram(address, &bytes).expect("it lies in RAM");
}

fn running_bootloader() -> Bench {
    let mut bench = Bench::new().switched_on();
    bench.run_ms(20);
    bench.events();
    bench
}

/// A board with a program that was called back.
fn bootloader_with_a_program(bench: &mut Bench) {
    bench.switch_on();
    bench.install_unwatched(firmware::APP_V1).expect("it is installed");
    bench.call_back();
    bench.run_ms(20);
    bench.events();
}

/// ARMv7-M A7.7.12: a branch to itself.
const HANG: [u16; 1] = [0xE7FE];
/// ARMv7-M A7.7.194: permanently undefined.
const UNDEFINED: [u16; 1] = [0xDE00];

#[test]
fn a_task_that_hangs_ends_in_a_watchdog_reset_and_the_device_is_back() {
    let mut bench = running_bootloader();
    let hung = bench.time();
    patch(&mut bench, "CAN1_TX", &HANG);
    bench.run_ms(2500);
    let events = bench.events();
    let [(at, Stop::Reset(ResetCause::IndependentWatchdog))] = events[..] else { panic!("{events:?}") };
    // The time is for the LSI's nominal frequency; before, the watchdog is fed every 2 ms.
    let ms = (at - hung).0 / 1_000_000_000;
    assert!((900..=1010).contains(&ms), "reset after {ms} ms");
    assert!(bench.is_bootloader(NODE));
}

#[test]
fn a_task_that_is_alive_does_not_feed_for_one_that_is_not() {
    let mut bench = running_bootloader();
    // `idle` hangs; protocol and tick continue, and so does the heartbeat until the reset.
    bench.replace_idle(HANG[0]);
    bench.run_ms(1500);
    let events = bench.events();
    assert!(matches!(events[..], [(_, Stop::Reset(ResetCause::IndependentWatchdog))]), "{events:?}");
}

#[test]
fn a_fault_of_the_bootloader_is_told_after_the_reset_that_follows() {
    let mut bench = Bench::new();
    // Without the fault the program would start.
    bootloader_with_a_program(&mut bench);
    let from = bench.time();
    patch(&mut bench, "CAN1_TX", &UNDEFINED);
    bench.run_ms(100);
    let events = bench.events();
    assert!(matches!(events[..], [(_, Stop::Reset(ResetCause::Software))]), "{events:?}");
    // 6000h: software; 7: a fault of the bootloader. Then "BOOT" and the same reason.
    let emergencies = bench.emergencies(from);
    assert_eq!(
        emergencies,
        [[0x00, 0x60, 0x01, 7, 0, 0, 0, 0], [0x00, 0xFF, 0x01, b'B', b'O', b'O', b'T', 7]]
    );
    assert!(bench.is_bootloader(NODE));
}

const IWDG_PR: u32 = 0x4000_3004;
const IWDG_RLR: u32 = 0x4000_3008;

fn register(bench: &mut Bench, address: u32) -> u32 {
    bench.machine().register(address).expect("it is modelled")
}

/// The option byte WDG_SW starts the watchdog with each reset, with 512 ms at 32 kHz (RM0090 table
/// 107); at 47 kHz the erase of a sector of 16 KiB may take longer. The boot stage slows it down, and
/// leaves it to a program as after the reset.
#[test]
fn a_watchdog_of_the_option_bytes_is_slow_in_the_boot_stage_alone() {
    let mut bench = Bench::new();
    bench.machine().set_hardware_watchdog(true);
    bootloader_with_a_program(&mut bench);
    // The bootloader feeds it.
    bench.run_ms(5000);
    assert_eq!(bench.events(), []);
    bench.session().command(1, ProgramControl::Start).unwrap();
    let mut prescalers = Vec::new();
    while bench.events().is_empty() {
        bench.world.run_for(Span::from_micros(5));
    }
    for _ in 0..400 {
        prescalers.push(register(&mut bench, IWDG_PR));
        bench.world.run_for(Span::from_micros(5));
    }
    // First thing, before anything else is waited for: five periods of 32 kHz are 156 us.
    let first = prescalers.iter().position(|prescaler| *prescaler == 6).expect("it is slowed down");
    assert!(5 * first <= 156 + 30, "after {} us", 5 * first);
    prescalers.dedup();
    // After the reset; in the boot stage; in the program.
    assert_eq!(prescalers, [0, 6, 0]);
    assert_eq!(register(&mut bench, IWDG_RLR), 0xFFF);
    let from = bench.time();
    // This program does not feed it.
    bench.run_ms(600);
    let events = bench.events();
    let [(at, Stop::Reset(ResetCause::IndependentWatchdog))] = events[..] else { panic!("{events:?}") };
    let ms = (at - from).0 / 1_000_000_000;
    assert!((505..=512).contains(&ms), "reset after {ms} ms");
    bench.assert_nothing_unmodelled();
}

/// A product that starts programs with a watchdog of 1000 ms (`watchdog.program_ms`): it bites after a second
/// of the LSI's nominal 32 kHz, also beside the option byte, and the registers are those that were asked for.
#[test]
fn a_program_that_never_feeds_its_watchdog_is_ended_after_a_second_of_the_lsi() {
    for (lsi_hz, has_watchdog) in [(17_000, false), (32_000, false), (32_000, true), (47_000, false)] {
        let silicon = Silicon { lsi_hz, ..TYPICAL };
        let options = Options { silicon, ..Options::default() };
        let mut bench = Bench::of_image_with(firmware::BOOTLOADER_WATCHDOG, options);
        bench.machine().set_hardware_watchdog(has_watchdog);
        bootloader_with_a_program(&mut bench);
        bench.start_program();
        // RM0090 section 21.4.2: LSI / 64, 2 ms a count.
        let values = [IWDG_PR, IWDG_RLR].map(|address| register(&mut bench, address));
        assert_eq!(values, [4, 500], "{lsi_hz} Hz, {has_watchdog}");
        bench.run_ms(3_000);
        let events = bench.events();
        let [(started, Stop::Reset(ResetCause::Software)), (bitten, Stop::Reset(ResetCause::IndependentWatchdog)), ..] =
            events[..]
        else {
            panic!("{lsi_hz} Hz, {has_watchdog}: {events:?}")
        };
        // The boot stage takes some milliseconds of it.
        let ms = (bitten - started).0 / 1_000_000_000;
        let nominal = 1000 * 32_000 / u64::from(lsi_hz);
        println!("watchdog.program_ms 1000, LSI {lsi_hz} Hz: reset {ms} ms after START");
        assert!(
            (nominal..=nominal + nominal / 100 + 5).contains(&ms),
            "{lsi_hz} Hz, {has_watchdog}: {ms} ms"
        );
        bench.assert_nothing_unmodelled();
    }
}

/// An application that jumps to the bootloader while its watchdog runs: a reset ends the watchdog, and
/// the request is kept.
#[test]
fn a_watchdog_does_not_survive_a_jump_into_the_bootloader() {
    let mut bench = Bench::new().switched_on();
    bench.install(firmware::APP_TEST);
    // Object 2000h of the tests' application: the way back, 2 for a jump.
    let way_back = Address::new(0x2000, 0);
    bench.session().write(way_back, &[2], Doing::Write(way_back), &mut |_| {}).unwrap();
    bench.events();
    // LSI / 4, 100 ms: longer than the way back, and shorter than the bootloader stays.
    bench.machine().preset_watchdog(800);
    bench.call_back();
    assert!(bench.is_bootloader(NODE));
    bench.run_ms(2000);
    let events = bench.stops();
    assert_eq!(events, [Stop::Reset(ResetCause::Software)]);
    assert!(bench.is_bootloader(NODE));
}
