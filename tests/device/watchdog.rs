//! The behaviour of a device that has crashed or hangs.

use canopen::program::ProgramControl;
use coboot_tests::bench::{Bench, NODE};
use coboot_tests::firmware;
use coflash::update::{flash, FlashOptions};
use emulator::machine::{ResetCause, Stop};
use emulator::time::Time;
use object::{Object, ObjectSymbol};

/// The emergencies since a time.
fn emergencies(bench: &Bench, since: Time) -> Vec<Vec<u8>> {
    let id = 0x80 + u32::from(NODE);
    bench.frames_since(since).into_iter().filter(|frame| frame.1 == id).map(|frame| frame.2).collect()
}

/// The address of a function of the bootloader.
fn address_of(part: &str) -> u32 {
    let file = firmware::elf(firmware::BOOTLOADER);
    let elf = object::File::parse(&file[..]).expect("an ELF of ours");
    let symbol = elf.symbols().find(|symbol| symbol.name().is_ok_and(|name| name.contains(part)));
    symbol.unwrap_or_else(|| panic!("no symbol {part}")).address() as u32 & !1
}

/// Overwrites the start of a function in RAM with Thumb code.
fn patch(bench: &mut Bench, function: &str, code: &[u16]) {
    let bytes: Vec<u8> = code.iter().flat_map(|half| half.to_le_bytes()).collect();
    bench.machine().write_ram(address_of(function), &bytes).expect("it lies in RAM");
}

fn running_bootloader() -> Bench {
    let mut bench = Bench::new();
    bench.power_on();
    bench.await_boot_up(100);
    bench.run_ms(20);
    bench.events();
    bench
}

/// A board with a program that was called back.
fn bootloader_with_a_program(bench: &mut Bench) {
    bench.power_on();
    bench.await_boot_up(100);
    let file = firmware::blocks(firmware::APP_V1);
    flash(&mut bench.session(), &file, &FlashOptions::default().trial_run(false), &mut |_| {}).unwrap();
    bench.session().command(1, ProgramControl::StartBootloader).unwrap();
    bench.await_boot_up(1000);
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
    assert!(bench.session().device_type().unwrap().unwrap().is_bootloader());
}

#[test]
fn a_task_that_is_alive_does_not_feed_for_one_that_is_not() {
    let mut bench = running_bootloader();
    // `idle` hangs; protocol and tick continue, and so does the heartbeat until the reset.
    let idle = bench.machine().pc();
    bench.machine().write_ram(idle, &HANG[0].to_le_bytes()).expect("idle sleeps in RAM");
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
    let told = emergencies(&bench, from);
    assert_eq!(told, [[0x00, 0x60, 0x01, 7, 0, 0, 0, 0], [0x00, 0xFF, 0x01, b'B', b'O', b'O', b'T', 7]]);
    assert!(bench.session().device_type().unwrap().unwrap().is_bootloader());
}

#[test]
fn an_application_that_the_watchdog_ends_again_and_again_is_given_up() {
    let mut bench = Bench::new();
    bench.power_on();
    bench.await_boot_up(100);
    let file = firmware::blocks(firmware::APP_V1);
    flash(&mut bench.session(), &file, &FlashOptions::default().trial_run(false), &mut |_| {}).unwrap();
    bench.confirm_program();
    for crash in 1..=3 {
        bench.events();
        // An application that started the watchdog and then hangs: LSI / 4, 8 ms.
        let from = bench.time();
        bench.machine().start_watchdog(64);
        bench.run_ms(200);
        let events = bench.events();
        assert!(matches!(events[..], [(_, Stop::Reset(ResetCause::IndependentWatchdog))]), "{events:?}");
        let is_bootloader = bench.session().device_type().unwrap().unwrap().is_bootloader();
        assert_eq!(is_bootloader, crash == 3, "after crash {crash}");
        if crash == 3 {
            // 2: a crash loop.
            let told = emergencies(&bench, from);
            assert_eq!(told[0], [0x00, 0x60, 0x01, 2, 0, 0, 0, 0]);
        }
    }
}

/// The option byte WDG_SW starts the watchdog with each reset, with 512 ms at 32 kHz (RM0090 table
/// 107); at 47 kHz the erase of a sector of 16 KiB may take longer. The boot stage gives it its longest
/// time, 4096 periods of LSI / 256, from which on the program has to feed it.
#[test]
fn a_watchdog_of_the_option_bytes_does_not_end_a_store_of_the_boot_stage() {
    let mut bench = Bench::new();
    bench.machine().set_hardware_watchdog(true);
    bootloader_with_a_program(&mut bench);
    // The bootloader feeds it.
    bench.run_ms(5000);
    assert_eq!(bench.events(), []);
    bench.power_off();
    bench.run_ms(10);
    let on = bench.time();
    bench.power_on();
    bench.await_program(1000);
    assert!(!bench.is_bootloader(NODE));
    bench.events();
    // This program does not.
    bench.run_ms(34_000);
    let events = bench.events();
    let [(at, Stop::Reset(ResetCause::IndependentWatchdog))] = events[..] else { panic!("{events:?}") };
    let ms = (at - on).0 / 1_000_000_000;
    assert!((32_768..33_200).contains(&ms), "reset after {ms} ms");
    bench.assert_nothing_unmodelled();
}
