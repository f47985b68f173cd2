//! Ways into a bootloader without an entry strap, in a product that has them: two resets by the NRST pin, and
//! the loader in the chip's ROM.

use canopen::program::{DEVICE_STATE, STATE_CRASH_RESETS, STATE_LAST_REASON};
use canopen::{AbortCode, Address};
use coboot_tests::bench::{Bench, NODE, REQUEST, RESPONSE};
use coboot_tests::firmware;
use emulator::machine::{ResetCause, Stop};
use emulator::silicon::TYPICAL;
use emulator::time::Span;
use shared_abi::geometry::Line;

/// 2007h/11: two resets (docs/protocol.md).
const TWO_RESETS: u8 = 13;

/// A board with a confirmed program that runs.
fn running_board(image: &str) -> Bench {
    let mut bench = crate::standby::running_board(image, firmware::APP_V1, TYPICAL, false);
    bench.run_ms(20);
    bench
}

fn reset(bench: &mut Bench) {
    bench.machine().reset_pin();
}

/// 2007h/11 and 2007h/4.
fn state(bench: &mut Bench) -> (u8, u8) {
    let mut session = bench.session();
    let mut read = |sub| session.read(Address::new(DEVICE_STATE, sub)).unwrap()[0];
    (read(STATE_LAST_REASON), read(STATE_CRASH_RESETS))
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
    let frames = bench.frames_since(from);
    assert!(!bench.is_bootloader(NODE));
    let ms = (started - from).0 / 1_000_000_000;
    println!("two_resets: the program's boot-up {ms} ms after a reset by the pin");
    assert!((500..=525).contains(&ms), "{ms} ms");
    assert_eq!(frames.len(), 1, "the boot stage is silent: {frames:x?}");

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
    let events = bench.stops();
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
#[cfg_attr(not(split_map), ignore = "needs the split map")]
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

/// PM0214 section 4.4.4, RM0090 sections 7.3 and 9.2.1, 21.4: VTOR, CPACR; RCC_CR, PLLCFGR, CFGR, AHB1ENR, APB1ENR,
/// APB2ENR; PWR_CR; FLASH_ACR; IWDG_PR; SYSCFG_MEMRMP.
const REGISTERS: [u32; 12] = [
    0xE000_ED08,
    0xE000_ED88,
    0x4002_3800,
    0x4002_3804,
    0x4002_3808,
    0x4002_3830,
    0x4002_3840,
    0x4002_3844,
    0x4000_7000,
    0x4002_3C00,
    0x4000_3000,
    0x4001_3800,
];

/// Puts a program in place of ST's loader: it writes 600Dh to the RAM and stays.
fn load_rom(bench: &mut Bench) {
    // movw r0, #600Dh; movs r1, #1; lsls r1, r1, #29; str r0, [r1, #80h]; b . (ARMv7-M A7.7)
    let code: [u16; 6] = [0xF246, 0x000D, 0x2101, 0x0749, 0xF8C1, 0x0080];
    let mut rom = vec![0; 0x1F0];
    rom[..8].copy_from_slice(&[0x2000_2D40_u32, 0x1FFF_01E1].map(u32::to_le_bytes).concat());
    rom[0x1E0..0x1EC].copy_from_slice(&code.map(u16::to_le_bytes).concat());
    rom[0x1EC..0x1EE].copy_from_slice(&0xE7FE_u16.to_le_bytes());
    bench.machine().load_rom(&rom).unwrap();
}

fn rom_runs(bench: &mut Bench) -> bool {
    bench.machine().pc() & !0xFFF == 0x1FFF_0000 && bench.word(0x2000_0080) == 0x600D
}

/// Writes the signature to 2008h.
fn start_rom_loader(bench: &mut Bench) -> Result<(), AbortCode> {
    let [a, b, c, d] = *b"roml";
    let answer = bench.ask(REQUEST, &[0x23, 0x08, 0x20, 0, a, b, c, d], RESPONSE).expect("an answer");
    if answer[0] == 0x60 {
        return Ok(());
    }
    Err(AbortCode(u32::from_le_bytes(answer[4..].try_into().unwrap())))
}

/// The loader finds the chip as after a reset with BOOT0 high. The answer is on the bus before; the next reset
/// brings the device back.
#[test]
fn the_rom_loader_finds_the_chip_as_after_a_reset() {
    let mut bench = running_board(firmware::BOOTLOADER_WAYS_IN);
    load_rom(&mut bench);
    assert_eq!(start_rom_loader(&mut bench), Err(AbortCode(0x0602_0000)), "a program has no such object");
    bench.call_back();
    bench.run_ms(20);
    bench.events();
    assert_eq!(start_rom_loader(&mut bench), Ok(()));
    bench.run_ms(100);
    let stops = bench.stops();
    assert_eq!(stops, [Stop::Reset(ResetCause::Software)]);
    assert!(rom_runs(&mut bench));
    let core = bench.machine().core_registers();
    assert_eq!(core[13], 0x2000_2D40);
    let found = REGISTERS.map(|register| bench.machine().register(register).unwrap());
    // HSI runs and is ready; the calibration is the chip's.
    assert_eq!(found[2] & 0xFFFF_00FF, 0x0000_0083);
    // PWR_CR: VOS is 01 in the F405 and F407, 11 in those with three scales (RM0090 section 5.4, RM0390).
    let power = if firmware::board().chip.line == Line::F407 { 0x0000_4000 } else { 0x0000_C000 };
    let expected = [0x1FFF_0000, 0, found[2], 0x2400_3010, 0, 0x0010_0000, 0, 0, power, 0, 0, 1];
    assert_eq!(found, expected, "{found:08X?}");
    // The vectors at address 0 are those of the ROM, too.
    assert_eq!(bench.word(0), 0x2000_2D40);
    bench.run_ms(5000);
    assert!(rom_runs(&mut bench), "no watchdog ends it");
    bench.assert_nothing_unmodelled();
    bench.power_off();
    // While the journal makes room the program waits, and then it does not start instead.
    bench.fill_journal(0);
    bench.switch_on();
    assert_eq!(start_rom_loader(&mut bench), Ok(()));
    bench.run_ms(800);
    assert!(rom_runs(&mut bench));
    bench.power_off();
    bench.switch_on();
    assert!(!bench.is_bootloader(NODE));
}

/// A watchdog that runs after each reset would end the loader, and a request that another reset finds is old.
#[test]
fn the_rom_loader_is_not_started_beside_a_watchdog_or_by_another_reset() {
    let mut bench = running_board(firmware::BOOTLOADER_WAYS_IN);
    load_rom(&mut bench);
    let request =
        [0x3157_4243_u32, 14, 0, shared_abi::check_word(&[0x3157_4243, 14, 0])].map(u32::to_le_bytes);
    let cell = firmware::board().warm_start.base;
    bench.machine().write_ram(cell, &request.concat()).unwrap();
    reset(&mut bench);
    bench.run_ms(600);
    assert!(!bench.is_bootloader(NODE), "the program runs");
    bench.machine().set_hardware_watchdog(true);
    bench.call_back();
    bench.run_ms(20);
    assert_eq!(start_rom_loader(&mut bench), Err(AbortCode(0x0800_0022)));
    bench.machine().set_hardware_watchdog(false);
    assert_eq!(start_rom_loader(&mut bench), Ok(()));
}

/// A product without the choices.
#[test]
fn without_the_choices_there_is_no_such_object_and_two_resets_are_two_starts() {
    let mut bench = running_board(firmware::BOOTLOADER);
    for _ in 0..3 {
        reset(&mut bench);
        bench.run_ms(100);
    }
    assert!(!bench.is_bootloader(NODE));
    load_rom(&mut bench);
    bench.call_back();
    bench.run_ms(20);
    assert_eq!(start_rom_loader(&mut bench), Err(AbortCode(0x0602_0000)));
}
