//! The state of the chip at the jump to a program: as after a reset, register by register.

use std::collections::BTreeMap;
use std::ops::Range;

use canopen::program::ProgramControl;
use canopen::Address;
use coboot_tests::bench::{Bench, RESCUE_WINDOW_MS};
use coboot_tests::firmware;
use coflash_core::device::Doing;
use coflash_core::update::steps::release;
use coflash_core::update::{flash, FlashOptions};

/// The return of the tests' application (object 2000h): the value for the jump.
const REENTRY_PATH: Address = Address::new(0x2000, 0);
const JUMP: u8 = 2;

const RCC: u32 = 0x4002_3800;
const AHB1ENR: u32 = RCC + 0x30;
const APB1ENR: u32 = RCC + 0x40;
/// AHB1LPENR, AHB2LPENR, AHB3LPENR, APB1LPENR, APB2LPENR.
const LOW_POWER: [u32; 5] = [RCC + 0x50, RCC + 0x54, RCC + 0x58, RCC + 0x60, RCC + 0x64];
const FLASH_ACR: u32 = 0x4002_3C00;
const CAN_MCR: u32 = 0x4000_6400;
/// All GPIO ports.
const PORTS: Range<u32> = 0x4002_0000..0x4002_2C00;
const SYST_CSR: u32 = 0xE000_E010;
const NVIC_ISER: u32 = 0xE000_E100;
const VTOR: u32 = 0xE000_ED08;

/// Registers that a reset does not set, or that depend on the cause of the reset: the flags of the
/// reset cause (RCC_CSR), and reload and current value of SysTick (ARMv7-M B3.3: unknown).
const LEFT_OUT: [u32; 3] = [RCC + 0x74, 0xE000_E014, 0xE000_E018];

/// All registers that the emulator models, of peripherals and core, with or without clock, except
/// the cycle counter, which depends on time.
fn registers(bench: &mut Bench) -> BTreeMap<u32, u32> {
    let addresses = (0x4000_0000..0x4008_0000).chain(0xE000_E000..0xE000_F000).step_by(4);
    addresses
        .filter(|address| !LEFT_OUT.contains(address))
        .filter_map(|address| Some((address, bench.machine().register(address)?)))
        .collect()
}

/// Replaces a program's first instruction by an endless loop; returns its address.
fn stop_at_reset_of(bench: &mut Bench, table: u32) -> u32 {
    let first = bench.word(table + 4) & !1;
    bench.machine().load_bin(first, &firmware::HERE).unwrap();
    first
}

/// The registers that differ between two chips, as text.
fn differences(found: &BTreeMap<u32, u32>, reset: &BTreeMap<u32, u32>) -> Vec<String> {
    assert_eq!(found.len(), reset.len(), "the same registers are there");
    let differ = found.iter().filter(|(address, value)| reset[address] != **value);
    differ.map(|(address, value)| format!("{address:08X}: {value:08X}, not {:08X}", reset[address])).collect()
}

/// The registers at the bootloader's first instruction after a reset.
fn after_a_reset(bench: &mut Bench) -> BTreeMap<u32, u32> {
    let first = stop_at_reset_of(bench, firmware::board().bootloader.base);
    bench.machine().reset_pin();
    bench.run_ms(10);
    assert_eq!(bench.machine().pc(), first);
    registers(bench)
}

/// An application that jumps restores the state after a reset: clocks, pins, peripherals,
/// interrupts.
#[test]
fn the_bootloader_finds_the_chip_as_after_a_reset() {
    let mut bench = Bench::new().switched_on();
    bench.install(firmware::APP_TEST);
    bench.events();
    bench.session().write(REENTRY_PATH, &[JUMP], Doing::Write(REENTRY_PATH), &mut |_| {}).unwrap();
    // An application that saves current: in sleep mode no clocks but those of the CAN controllers.
    for (register, value) in LOW_POWER.into_iter().zip([0, 0, 0, 3 << 25, 0_u32]) {
        bench.machine().poke(register, &value.to_le_bytes()).unwrap();
    }
    let running = registers(&mut bench);
    let first = stop_at_reset_of(&mut bench, firmware::board().bootloader.base);
    bench.session().command(1, ProgramControl::StartBootloader).unwrap();
    bench.run_ms(100);
    assert_eq!(bench.events(), [], "there is no reset");
    assert_eq!(bench.machine().pc(), first);
    let found = registers(&mut bench);
    let reset = after_a_reset(&mut bench);
    // There was something to restore: the clocks, the controller, a pin, the interrupts, the timer,
    // the caches.
    for register in LOW_POWER {
        assert_ne!(running[&register], reset[&register], "{register:08X}");
    }
    for register in [RCC, AHB1ENR, APB1ENR, FLASH_ACR, CAN_MCR, SYST_CSR, NVIC_ISER, VTOR] {
        assert_ne!(running[&register], reset[&register], "{register:08X}");
    }
    assert!(running.range(PORTS).any(|(register, value)| reset[register] != *value), "pins");
    let differences = differences(&found, &reset);
    assert!(differences.is_empty(), "{differences:#?}");
}

/// The boot stage, which has read the strap and checked the program at full speed, leaves the same
/// state to the application, except for the address of the vector table.
#[test]
fn the_application_finds_the_chip_as_after_a_reset() {
    let program = firmware::board().programs[0].base;
    // It does not change any register.
    let (first, blocks) = firmware::endless_loop();
    let mut bench = Bench::new().switched_on();
    let options = FlashOptions::default().start(false);
    flash(&mut bench.session(), &blocks, &options, &mut |_| {}).unwrap();
    release(&mut bench.session(), 1, &mut |_| {}).unwrap();
    bench.machine().reset_pin();
    bench.run_ms(RESCUE_WINDOW_MS + 100);
    assert_eq!(bench.machine().pc(), first, "it was started");
    let found = registers(&mut bench);
    let mut reset = after_a_reset(&mut bench);
    assert_eq!(reset.insert(VTOR, program), Some(0));
    let differences = differences(&found, &reset);
    assert!(differences.is_empty(), "{differences:#?}");
}
