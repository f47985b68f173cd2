//! A board with its transceiver at CAN2: the same job through the other controller.

use canopen::Address;
use coboot_tests::bench::Bench;
use coboot_tests::firmware;
use coflash_core::file::convert::{program_of, Options, Region};
use coflash_core::file::read::read;
use coflash_core::file::Program;
use coflash_core::update::{flash, FlashOptions};
use emulator::peripheral::Peripheral;
use shared_abi::layout::stm32f407g_disc1_can2::LAYOUT;

fn bench_at(controller: u8) -> Bench {
    Bench::of_image_at(&firmware::of_board(LAYOUT.board, firmware::BOOTLOADER), controller)
}

fn blocks(image: &str) -> Program {
    let elf = firmware::elf(&firmware::of_board(LAYOUT.board, image));
    let options = Options::default().region(Region::Strict(LAYOUT.programs[0].into()));
    program_of(read(&elf, None, None).expect("an ELF of ours"), &options).expect("it fits").program
}

fn version(bench: &mut Bench) -> String {
    bench.session().read_text(Address::new(0x100A, 0)).unwrap()
}

// Registers by the addresses of RM0090 (table 1 and the register maps of sections 7, 8 and 32).
const APB1ENR: u32 = 0x4002_3840;
const GPIOB_MODER: u32 = 0x4002_0400;
const GPIOB_AFRH: u32 = 0x4002_0424;
const GPIOD_MODER: u32 = 0x4002_0C00;
const CAN1: u32 = 0x4000_6400;
const CAN2: u32 = 0x4000_6800;

/// Network management, request to node 1, layer setting services; in the application SYNC and its RPDO, too.
const OF_SLAVE: [u32; 3] = [0x000, 0x601, 0x7E5];
const OF_APPLICATION: [u32; 5] = [0x000, 0x080, 0x201, 0x601, 0x7E5];

/// The settings of the running program: CAN2 on its pins, CAN1 with a clock and in sleep mode, and
/// the first filter banks of CAN2 with these identifiers, four in each. `priorities` are the transmit and
/// receive interrupts' priorities in the core.
fn assert_set_up(bench: &mut Bench, identifiers: &[u32], priorities: [u32; 2]) {
    let machine = bench.machine();
    let mut register = |address: u32| machine.register(address).expect("a register that is modelled");
    assert_eq!(register(APB1ENR) >> 25 & 3, 3, "CAN1EN and CAN2EN");
    // Alternate function (10b) 9 on PB12 and PB13; PD0 and PD1, the pins of CAN1 on the other
    // board, are inputs as after a reset.
    assert_eq!(register(GPIOB_MODER) >> 24 & 0xF, 0b1010);
    assert_eq!(register(GPIOB_AFRH) >> 16 & 0xFF, 0x99);
    assert_eq!(register(GPIOD_MODER) & 0xF, 0);
    assert_eq!(register(CAN1), 0x0001_0002, "CAN1_MCR as after a reset: it sleeps");
    assert_eq!(register(CAN1 + 0x14), 0, "CAN1_IER");
    assert_eq!(register(CAN2) & 3, 0, "CAN2_MCR: neither INRQ nor SLEEP");
    assert_eq!(register(CAN1 + 0x200), 0x2A1C_0E00, "FMR: CAN2SB is 14, FINIT is clear");
    let end = 14 + identifiers.len().div_ceil(4) as u32;
    let banks = (14..end).map(|bank| 1 << bank).sum();
    for (offset, value) in [(0x204, banks), (0x20C, 0), (0x214, 0), (0x21C, banks)] {
        assert_eq!(register(CAN1 + offset), value, "FM1R, FS1R, FFA1R, FA1R: {offset:#x}");
    }
    for bank in (0..14).chain(end..28) {
        let words = [register(CAN1 + 0x240 + 8 * bank), register(CAN1 + 0x244 + 8 * bank)];
        assert_eq!(words, [0, 0], "bank {bank}");
    }
    // STID at 15:5, RTR and IDE clear.
    let words = (0x2B0..0x2B0 + 8 * (end - 14)).step_by(4).map(|offset| register(CAN1 + offset));
    let mut listed: Vec<u32> = words.flat_map(|word| [word & 0xFFFF, word >> 16]).collect();
    listed.sort_unstable();
    listed.dedup();
    assert_eq!(listed, identifiers.iter().map(|id| id << 5).collect::<Vec<_>>());
    // NVIC_IPR, a byte for each interrupt. CAN1 and CAN2 have the same handlers: with another
    // priority one of them would interrupt itself.
    let mut priority = |line: u32| register(0xE000_E400 + (line & !3)) >> (8 * (line & 3)) & 0xFF;
    assert_eq!([priority(19), priority(63)], [priorities[0]; 2], "CAN1_TX, CAN2_TX");
    assert_eq!([priority(20), priority(64)], [priorities[1]; 2], "CAN1_RX0, CAN2_RX0");
}

/// Interrupt lines are those of RM0090 table 61, and exception 16 is line 0.
fn taken(bench: &mut Bench, line: usize) -> u64 {
    bench.machine().counters().exceptions[16 + line]
}

#[test]
fn an_update_and_the_way_back_through_can2() {
    let mut bench = bench_at(2).switched_on();
    assert!(bench.is_bootloader(1));
    // Tasks of priority 2 and 3 out of 16, in the upper four bits, where 0 is the highest.
    assert_set_up(&mut bench, &OF_SLAVE, [0xE0, 0xD0]);

    let options = FlashOptions::default().trial_run(false);
    let report = flash(&mut bench.session(), blocks(firmware::APP_V1), &options, &mut |_| {}).unwrap();
    assert_eq!(version(&mut bench), "1.0.0");
    assert!(!bench.is_bootloader(1));
    let identification = bench.number(0x1F56, 1);
    assert_eq!(identification, report.program_crc);
    // Priorities 3 and 4.
    assert_set_up(&mut bench, &OF_APPLICATION, [0xD0, 0xC0]);

    // Back to the bootloader, and to the program again without a download.
    bench.call_back();
    assert!(bench.is_bootloader(1));
    assert_set_up(&mut bench, &OF_SLAVE, [0xE0, 0xD0]);
    bench.start_program();
    assert_eq!(version(&mut bench), "1.0.0");

    // The next version, from the running application; it starts by itself.
    flash(&mut bench.session(), blocks(firmware::APP_V2), &options, &mut |_| {}).unwrap();
    assert_eq!(version(&mut bench), "2.0.0");
    bench.power_cycle();
    bench.await_program(1000);
    assert_eq!(version(&mut bench), "2.0.0");

    assert!(taken(&mut bench, 64) > 1000, "CAN2_RX0: a frame each");
    assert!(taken(&mut bench, 63) > 0, "CAN2_TX");
    assert_eq!(taken(&mut bench, 20), 0, "CAN1_RX0");
    bench.assert_nothing_unmodelled();
}

/// The frames that the test above receives come from CAN2.
#[test]
fn nothing_comes_out_of_can1() {
    let mut bench = bench_at(1);
    bench.power_on();
    bench.run_ms(500);
    assert_eq!(bench.records(), []);
    bench.assert_nothing_unmodelled();
}

/// An application may use CAN1 for itself: when the filters of CAN2 change, the banks below CAN2SB
/// stay unchanged.
#[test]
fn the_filters_of_can1_stay() {
    let mut bench = bench_at(2).switched_on();
    // Banks 0 and 13, CAN1's first and last: one filter of 32 bits each for FIFO 1, and bank 13
    // active.
    let kept = [(0x20C, 1 | 1 << 13), (0x214, 1 | 1 << 13), (0x21C, 1 << 13), (0x240, 7), (0x2AC, 8)];
    let now = bench.time();
    let can1 = bench.machine().can_mut(0);
    can1.write(0x200, 0x2A1C_0E01, now).unwrap();
    for (offset, value) in kept {
        let before = can1.read(offset, now).unwrap();
        can1.write(offset, before | value, now).unwrap();
    }
    can1.write(0x200, 0x2A1C_0E00, now).unwrap();

    // A new node-ID by layer setting services (CiA 305), effective after a reset of communication,
    // changes the filters.
    bench.post(0x7E5, &[0x04, 1, 0, 0, 0, 0, 0, 0]);
    assert_eq!(bench.ask(0x7E5, &[0x11, 5, 0, 0, 0, 0, 0, 0], 0x7E4), Some(vec![0x11, 0, 0, 0, 0, 0, 0, 0]));
    bench.post(0x7E5, &[0x04, 0, 0, 0, 0, 0, 0, 0]);
    bench.post(0x000, &[0x82, 1]);
    bench.await_boot_up_of(5, 100);
    assert!(bench.is_bootloader(5), "605h is let through");

    let now = bench.time();
    let can1 = bench.machine().can_mut(0);
    for (offset, value) in kept {
        let own = if offset == 0x21C { 1 << 14 } else { 0 };
        assert_eq!(can1.read(offset, now), Ok(value | own), "{offset:#x}");
    }
    assert_eq!(can1.read(0x204, now), Ok(1 << 14), "FM1R");
    bench.assert_nothing_unmodelled();
}
