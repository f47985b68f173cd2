//! The return from the application to the bootloader, and the application's requests.

use canopen::program::ProgramControl;
use canopen::{AbortCode, Address, BitRate};
use coboot_tests::bench::{Bench, NODE, RESPONSE};
use coboot_tests::{call_back, firmware};
use coflash_core::device::Doing;
use coflash_core::Error;
use emulator::machine::{ResetCause, Stop};
use emulator::silicon::{Silicon, TYPICAL};
use emulator::time::Span;
use shared_abi::check_word;

const VERSION: u16 = 0x100A;
/// Objects of the tests' application: the return, and its confirmation.
const REENTRY_PATH: Address = Address::new(0x2000, 0);
const CONFIRMATION: Address = Address::new(0x2001, 0);
const INSTALLED: u32 = 1;
const SIGNED: u32 = 2;

/// A board that runs the tests' application, on a chip whose LSI has this frequency.
fn running_board_with(lsi_hz: u32) -> Bench {
    let silicon = Silicon { lsi_hz, ..TYPICAL };
    crate::standby::running_board(firmware::BOOTLOADER, firmware::APP_TEST, silicon, false)
}

fn running_board() -> Bench {
    running_board_with(TYPICAL.lsi_hz)
}

fn write(bench: &mut Bench, at: Address, value: u8) -> Result<(), Error> {
    bench.session().write(at, &[value], Doing::Write(at), &mut |_| {})
}

/// Each way leads to a bootloader with all its functions.
#[test]
fn three_ways_lead_back_and_the_bootloader_is_whole_behind_each() {
    for (way, expected) in [
        (0, vec![Stop::Reset(ResetCause::Software)]),
        (1, vec![Stop::Reset(ResetCause::IndependentWatchdog)]),
        // A jump: there is no reset.
        (2, vec![]),
    ] {
        let mut bench = running_board();
        write(&mut bench, REENTRY_PATH, way).unwrap();
        let from = bench.time();
        bench.session().command(1, ProgramControl::StartBootloader).unwrap();
        let boot_up = bench.await_boot_up(1000);
        let stops = bench.stops();
        assert_eq!(stops, expected, "way {way}");
        let (answered, _) = bench.frames_of(RESPONSE, from)[0];
        assert!(boot_up - answered >= Span::from_millis(10), "way {way}");
        assert!(bench.is_bootloader(NODE), "way {way}");

        bench.install(firmware::APP_V2);
        assert_eq!(bench.text(VERSION), "2.0.0", "way {way}");
        // A request is valid once.
        bench.restart();
        assert!(!bench.is_bootloader(NODE), "way {way}");
        bench.assert_nothing_unmodelled();
    }
    let mut bench = running_board();
    assert!(write(&mut bench, REENTRY_PATH, 3).is_err(), "there is no fourth way");
}

/// The design's 18 ms from the answer to 80h to the boot-up, of which the application takes 11. By the
/// watchdog it is some periods of the LSI longer: five until its values are there, and two counts of four
/// (RM0090 section 21.4); the LSI has 17 to 47 kHz.
#[test]
fn each_way_back_is_short_with_the_slowest_and_the_fastest_lsi() {
    for lsi_hz in [17_000, 32_000, 47_000] {
        for (way, periods) in [(0, 0), (1, 5 + 2 * 4), (2, 0)] {
            let mut bench = running_board_with(lsi_hz);
            write(&mut bench, REENTRY_PATH, way).unwrap();
            bench.session().command(1, ProgramControl::StartBootloader).unwrap();
            let answered = bench.time();
            let us = (bench.await_boot_up(1500) - answered).0 / 1_000_000;
            println!(
                "boot-up of the bootloader by way {way}, LSI {lsi_hz} Hz: {us} us after the answer to 80h"
            );
            let limit = 18_000 + periods * 1_000_000 / u64::from(lsi_hz);
            assert!((10_000..=limit).contains(&us), "way {way}, LSI {lsi_hz} Hz: {us} us");
            bench.assert_nothing_unmodelled();
        }
    }
}

/// A watchdog of its own that the application feeds, LSI / 256 with 61 s, does not make the way longer than the update of
/// its prescaler, which takes five periods of the LSI (RM0090 section 21.4.4), or of the prescaler (ST's HAL), and that of
/// the bootloader's own watchdog, LSI / 64.
#[test]
fn the_way_back_by_the_watchdog_is_short_though_it_runs_already() {
    const IWDG_KR: u32 = 0x4000_3000;
    const IWDG_PR: u32 = 0x4000_3004;
    for (iwdg_update_prescaled, periods) in [(false, 5 + 2 * 4), (true, 5 * (256 + 64) + 2 * 4)] {
        let silicon = Silicon { lsi_hz: 17_000, iwdg_update_prescaled, ..TYPICAL };
        let mut bench =
            crate::standby::running_board(firmware::BOOTLOADER, firmware::APP_TEST, silicon, false);
        write(&mut bench, REENTRY_PATH, 1).unwrap();
        bench.machine().preset_watchdog(0xFFF);
        for (register, value) in [(IWDG_KR, 0x5555_u32), (IWDG_PR, 6)] {
            bench.machine().poke(register, &value.to_le_bytes()).unwrap();
        }
        bench.run_ms(200);
        bench.session().command(1, ProgramControl::StartBootloader).unwrap();
        let answered = bench.time();
        let us = (bench.await_boot_up(1000) - answered).0 / 1_000_000;
        let limit = 18_000 + periods * 1_000_000 / 17_000;
        assert!((10_000..=limit).contains(&us), "{iwdg_update_prescaled}: {us} us");
        assert!(bench.is_bootloader(NODE));
        bench.assert_nothing_unmodelled();
    }
}

/// Jumps during thousands of interrupts, repeated: no stray interrupt reaches the other program.
#[test]
fn both_programs_take_interrupts_in_turn_and_none_goes_astray() {
    let mut bench = running_board();
    for round in 0..10 {
        write(&mut bench, REENTRY_PATH, 2).unwrap();
        // SDO requests without pauses keep both CAN vectors busy until the last moment; SysTick
        // always runs.
        for _ in 0..100 {
            bench.text(VERSION);
        }
        bench.call_back();
        for _ in 0..100 {
            assert!(bench.is_bootloader(NODE), "round {round}");
        }
        bench.start_program();
    }
    // Only the resets after START: no fault, no watchdog.
    let events = bench.events();
    assert_eq!(events.len(), 10, "{events:?}");
    assert!(events.iter().all(|(_, stop)| *stop == Stop::Reset(ResetCause::Software)), "{events:?}");
    let counters = bench.machine().counters();
    let taken = |exception: usize| counters.exceptions[exception];
    // SysTick is exception 15; CAN1_TX and CAN1_RX0 are interrupts 19 and 20 (RM0090 table 61).
    for exception in [15, 16 + 19, 16 + 20] {
        assert!(taken(exception) > 2000, "exception {exception}: {}", taken(exception));
    }
    // Vectors of this program and the other one only.
    let expected = [15, 16 + 19, 16 + 20, 16 + 35];
    let stray: Vec<_> = (0..counters.exceptions.len())
        .filter(|exception| taken(*exception) > 0 && !expected.contains(exception))
        .collect();
    assert!(stray.is_empty(), "{stray:?}");
    bench.assert_nothing_unmodelled();
}

/// The answer to 80h is on the bus, and 10 ms more have passed, at every bit rate.
#[test]
fn the_answer_comes_before_the_departure_at_every_bit_rate() {
    call_back::at_every_bit_rate(firmware::APP_V1, |_, _| {});
}

/// Restarts the node with another node-ID and bit rate.
fn restart_as(bench: &mut Bench, node: u8, rate: BitRate) {
    bench.store_by_lss(node, rate);
    bench.power_cycle();
    bench.set_host_bit_rate(rate.bits_per_second().expect("a rate that can be set"));
}

/// Node-ID and bit rate set in the application also apply in the bootloader, and the other way
/// round (SYS TEC manual L-1112d_10, 3.4.4): if both support LSS, and if only the application does.
#[test]
fn node_id_and_bit_rate_are_shared() {
    for bootloader in [firmware::BOOTLOADER, firmware::BOOTLOADER_LEAST] {
        let mut bench = Bench::of_image(bootloader).switched_on();
        bench.install(firmware::APP_V1);
        let serial = bench.number(0x1018, 4);

        restart_as(&mut bench, 9, BitRate::K250);
        bench.await_program_of(9, 1000);
        if bootloader == firmware::BOOTLOADER_LEAST {
            // No program starts by itself.
            assert!(bench.is_bootloader(9));
            bench.session_with(9).command(1, ProgramControl::Start).unwrap();
            bench.await_boot_up_of(9, 1000);
        }
        assert!(!bench.is_bootloader(9));
        bench.session_with(9).command(1, ProgramControl::StartBootloader).unwrap();
        bench.await_boot_up_of(9, 1000);
        assert!(bench.is_bootloader(9));
        assert_eq!(bench.session_with(9).read_number(Address::new(0x1018, 4)).unwrap(), serial);
        if bootloader == firmware::BOOTLOADER_LEAST {
            continue;
        }
        // And from the bootloader: the program gets it from the handoff, and reports it by LSS.
        restart_as(&mut bench, 21, BitRate::K500);
        bench.await_boot_up_of(21, 1000);
        assert!(!bench.is_bootloader(21));
        bench.post(0x7E5, &[0x04, 1, 0, 0, 0, 0, 0, 0]);
        bench.assert_answer(0x7E5, &[0x5E, 0, 0, 0, 0, 0, 0, 0], 0x7E4, &[0x5E, 21, 0, 0, 0, 0, 0, 0]);
        assert_eq!(bench.session_with(21).read_number(Address::new(0x1018, 4)).unwrap(), serial);
    }
}

/// With a bootloader with another version of the ABI, or without a callgate, the application works
/// without it, and can be called back.
#[test]
fn an_application_on_a_bootloader_with_another_abi_does_without_it() {
    let table = firmware::board().callgate();
    // The version of the ABI (a half-word after the magic), and the magic itself.
    for (at, value) in [(table + 4, 0_u16), (table, 0)] {
        let mut bench = running_board();
        bench.power_off();
        bench.machine().load_bin(at, &value.to_le_bytes()).unwrap();
        bench.switch_on();
        assert!(!bench.is_bootloader(NODE));
        assert_eq!(bench.number(0x1F56, 1), 0, "no CRC without a callgate");
        // 08000022h: not in this state of the device.
        let refused = bench.session().read_number(CONFIRMATION).unwrap_err();
        assert!(matches!(refused, Error::Refused { code: AbortCode::DEVICE_STATE, .. }), "{refused:?}");
        assert!(write(&mut bench, CONFIRMATION, SIGNED as u8).is_err());
        bench.call_back();
        assert!(bench.is_bootloader(NODE));
    }
}

/// The bootloader stops starting an application that ends again and again without a request; a
/// request resets the count.
#[test]
fn an_application_that_crashes_is_given_up_until_somebody_asks_for_it() {
    let mut bench = running_board();
    for reset in 1..=3 {
        let from = bench.time();
        // An application that started the watchdog and then hangs: LSI / 4, 8 ms.
        bench.machine().preset_watchdog(64);
        bench.run_ms(300);
        assert_eq!(bench.stops(), [Stop::Reset(ResetCause::IndependentWatchdog)], "{reset}");
        assert_eq!(bench.is_bootloader(NODE), reset == 3, "after {reset}");
        if reset == 3 {
            // 6000h: software; 2: a crash loop.
            assert_eq!(bench.emergencies(from)[0], [0x00, 0x60, 0x01, 2, 0, 0, 0, 0]);
        }
    }
    bench.restart();
    assert!(bench.is_bootloader(NODE), "a power-on alone does not try it again");
    bench.start_program();
    assert!(!bench.is_bootloader(NODE), "a request does");
    // NMT reset node is a request, and does not count as a crash.
    for _ in 0..5 {
        bench.post(0x000, &[0x81, NODE]);
        bench.await_boot_up(1000);
        assert!(!bench.is_bootloader(NODE));
    }
    // A confirmed program has not crashed.
    for _ in 0..2 {
        bench.machine().preset_watchdog(64);
        bench.run_ms(300);
        assert!(!bench.is_bootloader(NODE));
        write(&mut bench, CONFIRMATION, SIGNED as u8).unwrap();
        bench.machine().preset_watchdog(64);
        bench.run_ms(300);
        assert!(!bench.is_bootloader(NODE));
        write(&mut bench, CONFIRMATION, SIGNED as u8).unwrap();
    }
}

/// A program must prove once that the device can be called back from it, or confirm itself; each
/// new program again.
#[test]
fn a_program_that_was_confirmed_starts_without_a_rescue_window() {
    let mut bench = Bench::new().switched_on();
    bench.install(firmware::APP_V1);
    assert_eq!(bench.boot_ups(Bench::power_cycle), 2, "the bootloader's, then the program's");
    assert_eq!(bench.boot_ups(Bench::power_cycle), 2, "a window that passes confirms nothing");
    bench.confirm_program();
    assert_eq!(bench.boot_ups(Bench::power_cycle), 1, "it was called back");
    bench.install(firmware::APP_TEST);
    assert_eq!(bench.boot_ups(Bench::power_cycle), 2, "another program");
    write(&mut bench, CONFIRMATION, SIGNED as u8).unwrap();
    assert_eq!(bench.boot_ups(Bench::power_cycle), 1, "it has confirmed itself");
    assert_eq!(bench.session().read_number(CONFIRMATION).unwrap(), INSTALLED | SIGNED);
    write(&mut bench, CONFIRMATION, 0).unwrap();
    assert!(write(&mut bench, CONFIRMATION, 4).is_err());
    bench.power_cycle();
    bench.run_ms(500);
    assert!(bench.is_bootloader(NODE), "it has taken that back");
    bench.assert_nothing_unmodelled();
}

/// With a rescue window, a device with a program that never answers can still be reached: a client
/// that sends a request in time keeps it in the bootloader.
#[test]
fn the_rescue_window_holds_the_device_for_whoever_speaks_to_it() {
    let mut bench = Bench::of_image(firmware::BOOTLOADER).switched_on();
    bench.install(firmware::APP_V1);
    bench.events();

    // Without a request: 300 ms, then the program, after a reset.
    bench.power_off();
    bench.run_ms(100);
    let from = bench.time();
    let window = bench.switch_on();
    let program = bench.await_boot_up(1000);
    assert!(
        (290..340).contains(&((program - window).0 / 1_000_000_000)),
        "{} ms",
        (program - window).0 / 1_000_000_000
    );
    assert!(!bench.is_bootloader(NODE));
    // 8: the rescue window.
    assert_eq!(bench.emergencies(from)[0], [0x00, 0xFF, 0x00, b'B', b'O', b'O', b'T', 8]);

    // Network management concerns all nodes, and keeps no device in the bootloader.
    bench.power_off();
    bench.switch_on();
    bench.post(0x000, &[0x01, 0]);
    bench.await_boot_up(1000);
    assert!(!bench.is_bootloader(NODE));

    // An SDO request does, and so does a layer setting service.
    for (id, data) in
        [(0x600 + u16::from(NODE), [0x40, 0, 0x10, 0, 0, 0, 0, 0]), (0x7E5, [0x4C, 0, 0, 0, 0, 0, 0, 0])]
    {
        bench.power_cycle();
        bench.await_boot_up(100);
        bench.run_ms(100);
        bench.post(id, &data);
        bench.run_ms(2000);
        assert!(bench.is_bootloader(NODE), "{id:X}h");
    }
    // START is a request: it does not wait.
    let from = bench.time();
    bench.session().command(1, ProgramControl::Start).unwrap();
    let at = bench.await_boot_up(1000);
    assert!(at - from < Span::from_millis(200));

    // The window does not reset the count of crashes.
    for reset in 1..=3 {
        bench.machine().preset_watchdog(64);
        bench.run_ms(1200);
        assert_eq!(bench.is_bootloader(NODE), reset == 3, "after {reset}");
    }
    bench.assert_nothing_unmodelled();
}

/// Contents of the warm-start cell from a faulty application, or noise: no request, or an
/// impossible one.
#[test]
fn a_cell_that_asks_for_what_is_not_there_does_no_harm() {
    let magic = u32::from_le_bytes(*b"CBW1");
    let sound = |words: [u32; 3]| [words[0], words[1], words[2], check_word(&words)];
    let older = u32::from_le_bytes(*b"CBW0");
    for (what, cell, stays) in [
        ("noise", [0x1234_5678, 0x9ABC_DEF0, 0x0F1E_2D3C, 0x4B5A_6978], false),
        ("an older version", sound([older, 1, 0]), false),
        ("a wrong check word", [magic, 1, 0, check_word(&[magic, 1, 0]) ^ 1], false),
        ("an unknown request", sound([magic, 99, 0]), false),
        ("an impossible argument", sound([magic, 3, 255]), false),
        ("stay, for comparison", sound([magic, 1, 0]), true),
        ("a program that is not there", sound([magic, 3, 7]), true),
        ("a trial of one", sound([magic, 2, 200]), true),
    ] {
        let mut bench = running_board();
        bench.set_warm_start(cell);
        bench.machine().reset_pin();
        bench.await_boot_up(1000);
        assert_eq!(bench.is_bootloader(NODE), stays, "{what}");
        // Consumed: the next reset starts the program.
        bench.machine().reset_pin();
        bench.await_boot_up(1000);
        assert!(!bench.is_bootloader(NODE), "{what}");
    }
}
