//! Ways into a bootloader without an entry strap, in a product that has them: two resets by the NRST pin, and
//! the loader in the chip's ROM.

use canopen::program::{DEVICE_STATE, STATE_CRASH_RESETS, STATE_REASON};
use canopen::Address;
use coboot_tests::bench::{Bench, NODE};
use coboot_tests::firmware;
use coflash::update::{flash, FlashOptions};
use emulator::machine::{ResetCause, Stop};
use emulator::time::Span;

/// 2007h/2: two resets (docs/protocol.md).
const TWO_RESETS: u8 = 13;

/// A board with a confirmed program that runs.
fn running_board(image: &str) -> Bench {
    let mut bench = Bench::of_image(image);
    bench.power_on();
    bench.await_boot_up(100);
    let blocks = firmware::blocks(firmware::APP_V1);
    // This program does not feed a watchdog: it would not live through the watch of the tool.
    let options = FlashOptions::default().trial_run(false).watch(Some(std::time::Duration::ZERO));
    flash(&mut bench.session(), &blocks, &options, &mut |_| {}).unwrap();
    bench.confirm_program();
    bench.run_ms(20);
    bench.events();
    bench
}

fn reset(bench: &mut Bench) {
    bench.machine().reset_pin();
}

/// 2007h/2 and 2007h/4.
fn state(bench: &mut Bench) -> (u8, u8) {
    let mut session = bench.session();
    let mut read = |sub| session.read(Address::new(DEVICE_STATE, sub)).unwrap()[0];
    (read(STATE_REASON), read(STATE_CRASH_RESETS))
}

/// After a reset by the pin the program starts half a second later, and nothing is on the bus before. A second
/// reset in this time keeps the device in the bootloader, and one after this time does not.
#[test]
fn two_resets_by_the_pin_within_half_a_second_keep_the_device_in_the_bootloader() {
    let mut bench = running_board(firmware::BOOTLOADER_WAYS_IN);
    let from = bench.time();
    reset(&mut bench);
    let started = bench.await_boot_up(1000);
    bench.run_ms(1);
    let told = bench.frames_since(from);
    assert!(!bench.is_bootloader(NODE));
    let ms = (started - from).0 / 1_000_000_000;
    println!("two_resets: the program's boot-up {ms} ms after a reset by the pin");
    assert!((500..=525).contains(&ms), "{ms} ms");
    assert_eq!(told.len(), 1, "the boot stage is silent: {told:x?}");

    for between in [40, 250, 480] {
        reset(&mut bench);
        bench.run_ms(between);
        reset(&mut bench);
        bench.await_boot_up(50);
        assert!(bench.is_bootloader(NODE), "{between} ms");
        assert_eq!(state(&mut bench), (TWO_RESETS, 0));
        // It stays there, and no later reset is a second one.
        bench.run_ms(2000);
        assert!(bench.is_bootloader(NODE));
        reset(&mut bench);
        bench.await_boot_up(1000);
        assert!(!bench.is_bootloader(NODE), "{between} ms");
    }
    for between in [5, 530, 2000] {
        reset(&mut bench);
        bench.run_ms(between);
        reset(&mut bench);
        bench.run_ms(550);
        assert!(!bench.is_bootloader(NODE), "{between} ms");
    }
    bench.assert_nothing_unmodelled();
}

/// A power-on also sets the flag of the pin. A watchdog, a software reset or a power-on in the half second are
/// no second reset by the pin, and the mark is then gone.
#[test]
fn only_resets_by_the_pin_count() {
    let mut bench = running_board(firmware::BOOTLOADER_WAYS_IN);
    bench.power_off();
    bench.power_on();
    bench.await_boot_up(30);
    assert!(!bench.is_bootloader(NODE), "a power-on waits for nothing");
    bench.power_off();
    bench.power_on();
    bench.run_ms(2);
    reset(&mut bench);
    bench.await_boot_up(1000);
    assert!(!bench.is_bootloader(NODE), "a power-on is no first reset");

    reset(&mut bench);
    bench.run_ms(200);
    bench.power_off();
    bench.power_on();
    bench.await_boot_up(30);
    assert!(!bench.is_bootloader(NODE), "a power-on is no second reset");

    // The watchdog of the option bytes lets the boot stage wait. Here one ends it, LSI / 4 with 20 ms.
    reset(&mut bench);
    bench.run_ms(200);
    bench.events();
    bench.machine().preset_watchdog(160);
    bench.await_boot_up(100);
    let events: Vec<_> = bench.events().into_iter().map(|(_, stop)| stop).collect();
    assert_eq!(events, [Stop::Reset(ResetCause::IndependentWatchdog)]);
    assert!(!bench.is_bootloader(NODE), "the reset of a watchdog is no second one");
    reset(&mut bench);
    bench.await_boot_up(1000);
    assert!(!bench.is_bootloader(NODE), "the mark is gone");
}

/// The watchdog of the option bytes does not end the wait (349 ms with the fastest LSI), and the program has it
/// as after a reset.
#[test]
fn a_watchdog_of_the_option_bytes_lets_the_device_wait() {
    let mut bench = running_board(firmware::BOOTLOADER_WAYS_IN);
    bench.machine().set_hardware_watchdog(true);
    reset(&mut bench);
    bench.events();
    bench.await_boot_up(1000);
    assert_eq!(bench.events(), []);
    assert!(!bench.is_bootloader(NODE));
    bench.run_ms(200);
    reset(&mut bench);
    bench.run_ms(100);
    reset(&mut bench);
    bench.await_boot_up(50);
    assert_eq!(state(&mut bench), (TWO_RESETS, 0));
}

/// What a program finds is what a reset leaves: the system timer is off.
#[test]
fn the_wait_leaves_the_system_timer_as_after_a_reset() {
    let mut bench = running_board(firmware::BOOTLOADER_WAYS_IN);
    reset(&mut bench);
    bench.run_ms(250);
    assert_eq!(bench.machine().register(0xE000_E010).unwrap() & 0b111, 0b101, "it counts the time");
    loop {
        bench.world.run_for(Span::from_micros(10));
        if firmware::board().programs[0].contains(bench.machine().pc(), 2) {
            break;
        }
    }
    assert_eq!(bench.machine().register(0xE000_E010).unwrap() & 0b111, 0);
}

/// A damaged RAM image is no bootloader to stay in: the program starts as always.
#[test]
fn two_resets_without_a_bootloader_start_the_program() {
    let mut bench = running_board(firmware::BOOTLOADER_WAYS_IN);
    let home = firmware::board().home.expect("the split map");
    bench.machine().load_bin(home.base + 0x400, &[0; 64]).unwrap();
    reset(&mut bench);
    bench.run_ms(100);
    reset(&mut bench);
    bench.run_ms(50);
    assert!(!bench.is_bootloader(NODE));
}

/// A product without the choice.
#[test]
fn without_the_choice_two_resets_are_two_starts() {
    let mut bench = running_board(firmware::BOOTLOADER);
    for _ in 0..3 {
        reset(&mut bench);
        bench.run_ms(100);
    }
    assert!(!bench.is_bootloader(NODE));
}
