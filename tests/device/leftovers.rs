//! What an application leaves switched wrong before it jumps into the bootloader: the bootloader works.

use canopen::program::ProgramControl;
use coboot_tests::bench::{Bench, NODE, REQUEST, RESPONSE};
use coboot_tests::firmware;
use coflash::file::convert::{blocks_of, Options};
use coflash::file::read::{read, Format};
use coflash::update::{flash, FlashOptions};
use emulator::machine::{ResetCause, Stop};
use emulator::time::Span;

/// A program that takes every peripheral's clock in sleep mode away, spreads the clock of the PLL by 3 %
/// (RM0090 section 7.3.23), leaves a large count in SysTick, and jumps.
const CODE: [u16; 34] = [
    0x480D, 0x2100, // ldr r0, =RCC; movs r1, #0
    0x6501, 0x6541, 0x6581, 0x6601, 0x6641, // str r1, [r0, #0x50], 54h, 58h, 60h, 64h: the LPENRs
    0x4A0B, 0xF8C0, 0x2080, // ldr r2, =0xC01060FA; str r2, [r0, #0x80]: SSCGR
    0x4B0A, 0xF06F, 0x447F, // ldr r3, =SYST_CSR; mvn r4, #0xFF000000
    0x605C, 0x6099, // str r4, [r3, #4]: SYST_RVR; str r1, [r3, #8]: SYST_CVR
    0x2405, 0x601C, 0xBF00, 0xBF00, 0x6019, // SysTick on for a moment
    0xF04F, 0x6000, // mov r0, #0x08000000, the bootloader
    0x6801, 0xF381, 0x8808, // ldr r1, [r0]; msr MSP, r1
    0x6841, 0x4708, 0x0000, // ldr r1, [r0, #4]; bx r1
    0x3800, 0x4002, 0x60FA, 0xC010, 0xE010, 0xE000,
];

fn foreign_program() -> Vec<u8> {
    let program = firmware::board().programs[0].base;
    let mut image = vec![0; 0x400];
    image[..4].copy_from_slice(&firmware::board().ram.end().to_le_bytes());
    image[4..8].copy_from_slice(&(program + 0x201).to_le_bytes());
    for (place, half) in image[0x200..].chunks_exact_mut(2).zip(CODE) {
        place.copy_from_slice(&half.to_le_bytes());
    }
    image
}

/// Every request is answered in time: a controller that stands still while the core sleeps would not
/// hear most of them, and would be wrong by more than a bus tolerates.
fn assert_alive(bench: &mut Bench) {
    for _ in 0..100 {
        let from = bench.time();
        // 1000h, device type.
        let answer = bench.ask(REQUEST, &[0x40, 0, 0x10, 0, 0, 0, 0, 0], RESPONSE);
        assert!(answer.is_some_and(|answer| answer[0] == 0x43));
        assert!(bench.time() - from < Span::from_millis(5));
        bench.run_ms(3);
    }
    assert!(bench.is_bootloader(NODE));
    let errors =
        bench.records().iter().filter(|record| record.outcome != emulator::bus::Outcome::Good).count();
    assert_eq!(errors, 0, "error frames");
}

#[test]
fn a_foreign_program_that_jumps_with_everything_wrong_does_no_harm() {
    assert_eq!(firmware::board().bootloader.base, 0x0800_0000);
    let mut bench = Bench::new();
    bench.power_on();
    bench.await_boot_up(100);
    let image =
        read(&foreign_program(), Some(Format::Raw), Some(firmware::board().programs[0].base)).unwrap();
    let blocks = blocks_of(image, &Options::default()).unwrap().file;
    flash(&mut bench.session(), &blocks, &FlashOptions::default().start(false), &mut |_| {}).unwrap();
    bench.run_ms(100);
    bench.events();
    bench.session().command(1, ProgramControl::Start).unwrap();
    let from = bench.time();
    // It jumps at once, and the program is not released: the device stays in the bootloader.
    let boot_up = bench.await_boot_up(200);
    // The answer to START has 20 ms, docs/masters.md; the rest is the start of the bootloader, twice.
    assert!(boot_up - from < Span::from_millis(60), "{} us", (boot_up - from).0 / 1_000_000);
    let stops: Vec<_> = bench.events().into_iter().map(|(_, stop)| stop).collect();
    assert_eq!(stops, [Stop::Reset(ResetCause::Software)], "START alone");
    assert_alive(&mut bench);
    bench.assert_nothing_unmodelled();
}
