//! The flash lock: the state that a sealed program finds, and the effect of writing the keys of
//! flash and option bytes.

use canopen::program::ProgramControl;
use canopen::Address;
use coboot_tests::bench::{Bench, NODE};
use coboot_tests::firmware;
use coboot_tests::sealed_board::{board, board_of, open_board, release, sealer, status, write, COUNTER};
use coflash_core::device::{Doing, Transfers};
use coflash_core::file::sealed::Sealer;
use emulator::machine::{ResetCause, Stop};

const DATA: Address = Address::new(0x1F50, 1);
/// The address of the program's log.
const OUT: u32 = 0x2000_0000;

/// Runs at offset 200h of the program's flash. Logs from 2000_0004h on the values of ACTLR, CCR,
/// SHCSR, CFSR, ICSR, FAULTMASK and PRIMASK; confirms itself by the callgate (at 0800_0040h; the
/// answer goes to 2000_002Ch); writes the right keys to FLASH_KEYR and FLASH_OPTKEYR; logs FLASH_CR
/// and FLASH_OPTCR, and then 1. The handler of HardFault counts at 2000_0000h.
#[rustfmt::skip]
const TRIES_THE_KEYS: &[u16] = &[
    0xF04F, 0x5600,      // 200 start:   mov.w r6, #536870912
    0x2000,              // 204  movs r0, #0
    0x6030,              // 206  str r0, [r6, #0]
    0x62B0,              // 208  str r0, [r6, #40]
    0xF04F, 0x21E0,      // 20A  mov.w r1, #3758153728
    0x6888,              // 20E  ldr r0, [r1, #8]
    0x6070,              // 210  str r0, [r6, #4]
    0xF8D1, 0x0D14,      // 212  ldr.w r0, [r1, #3348]
    0x60B0,              // 216  str r0, [r6, #8]
    0xF8D1, 0x0D24,      // 218  ldr.w r0, [r1, #3364]
    0x60F0,              // 21C  str r0, [r6, #12]
    0xF8D1, 0x0D28,      // 21E  ldr.w r0, [r1, #3368]
    0x6130,              // 222  str r0, [r6, #16]
    0xF8D1, 0x0D04,      // 224  ldr.w r0, [r1, #3332]
    0x6170,              // 228  str r0, [r6, #20]
    0xF3EF, 0x8013,      // 22A  mrs r0, FAULTMASK
    0x61B0,              // 22E  str r0, [r6, #24]
    0xF3EF, 0x8010,      // 230  mrs r0, PRIMASK
    0x61F0,              // 234  str r0, [r6, #28]
    0x2001,              // 236  movs r0, #1
    0x6430,              // 238  str r0, [r6, #64]
    0x4C15,              // 23A  ldr r4, [pc, #84]
    0x68E4,              // 23C  ldr r4, [r4, #12]
    0x2005,              // 23E  movs r0, #5
    0xF106, 0x0140,      // 240  add.w r1, r6, #64
    0x47A0,              // 244  blx r4
    0x62F0,              // 246  str r0, [r6, #44]
    0x4D12,              // 248  ldr r5, [pc, #72]
    0x4813,              // 24A  ldr r0, [pc, #76]
    0x6068,              // 24C  str r0, [r5, #4]
    0xF3BF, 0x8F4F,      // 24E  dsb sy
    0xF3BF, 0x8F6F,      // 252  isb sy
    0x4811,              // 256  ldr r0, [pc, #68]
    0x6068,              // 258  str r0, [r5, #4]
    0xF3BF, 0x8F4F,      // 25A  dsb sy
    0xF3BF, 0x8F6F,      // 25E  isb sy
    0x480F,              // 262  ldr r0, [pc, #60]
    0x60A8,              // 264  str r0, [r5, #8]
    0xF3BF, 0x8F4F,      // 266  dsb sy
    0xF3BF, 0x8F6F,      // 26A  isb sy
    0x480D,              // 26E  ldr r0, [pc, #52]
    0x60A8,              // 270  str r0, [r5, #8]
    0xF3BF, 0x8F4F,      // 272  dsb sy
    0xF3BF, 0x8F6F,      // 276  isb sy
    0x6928,              // 27A  ldr r0, [r5, #16]
    0x6230,              // 27C  str r0, [r6, #32]
    0x6968,              // 27E  ldr r0, [r5, #20]
    0x6270,              // 280  str r0, [r6, #36]
    0x2001,              // 282  movs r0, #1
    0x62B0,              // 284  str r0, [r6, #40]
    0xE7FE,              // 286  b.n 286
    0x6830,              // 288 fault:   ldr r0, [r6, #0]
    0x3001,              // 28A  adds r0, #1
    0x6030,              // 28C  str r0, [r6, #0]
    0x4770,              // 28E  bx lr
    0x0040, 0x0800,      // 290  .word 0x08000040
    0x3C00, 0x4002,      // 294  .word 0x40023c00
    0x0123, 0x4567,      // 298  .word 0x45670123
    0x89AB, 0xCDEF,      // 29C  .word 0xcdef89ab
    0x2A3B, 0x0819,      // 2A0  .word 0x08192a3b
    0x6E7F, 0x4C5D,      // 2A4  .word 0x4c5d6e7f
];
/// The address of the handler.
const HANDLER: u32 = 0x288;

/// The program in flash.
fn program() -> Vec<u8> {
    let layout = firmware::board();
    let base = layout.programs[0].base;
    let mut table = [0_u32; 128];
    table[0] = layout.chip.sram.base + 0x4000;
    table[1] = base + 0x201;
    table[3] = base + HANDLER + 1;
    let code = TRIES_THE_KEYS.iter().flat_map(|half| half.to_le_bytes());
    table.iter().flat_map(|word| word.to_le_bytes()).chain(code).collect()
}

/// The program's log.
struct Log {
    faults: u32,
    /// ACTLR, CCR, SHCSR, CFSR.
    core: [u32; 4],
    icsr: u32,
    /// FAULTMASK, PRIMASK.
    masks: [u32; 2],
    /// FLASH_CR, FLASH_OPTCR.
    locks: [u32; 2],
    callgate: i32,
}

/// Installs a file on a board and starts it.
fn installed(mut bench: Bench, file: &[u8]) -> Bench {
    bench.power_on();
    bench.await_boot_up(100);
    let mut session = bench.session();
    session.transfer_by(Transfers::Blocks);
    session.write(DATA, file, Doing::Program, &mut |_| {}).unwrap();
    session.command(1, ProgramControl::Start).unwrap();
    bench
}

/// Waits for the program, and reads its log since the reset.
fn log(bench: &mut Bench) -> Log {
    let word = |bench: &mut Bench, at: u32| {
        let mut bytes = [0; 4];
        bench.machine().read_memory(OUT + at, &mut bytes).unwrap();
        u32::from_le_bytes(bytes)
    };
    for _ in 0..100 {
        bench.run_ms(20);
        if word(bench, 40) == 1 {
            break;
        }
    }
    assert_eq!(word(bench, 40), 1, "the program has come to its end");
    let words: Vec<u32> = (0..12).map(|n| word(bench, 4 * n)).collect();
    Log {
        faults: words[0],
        core: [words[1], words[2], words[3], words[4]],
        icsr: words[5],
        masks: [words[6], words[7]],
        locks: [words[8], words[9]],
        callgate: words[11].cast_signed(),
    }
}

/// RM0090 sections 3.6.1 and 3.7.2: locked until the next reset, and a bus error for every key,
/// even the right one. The core's registers are as after a reset (PM0214 section 4.4: CCR has
/// STKALIGN, the others are 0).
#[test]
fn a_sealed_program_cannot_open_flash_and_option_bytes() {
    let mut bench = installed(board(), &sealer(COUNTER).seal(&program(), &release()).unwrap());
    for start in ["fresh", "by itself"] {
        let log = log(&mut bench);
        assert_eq!(log.core, [0, 0x200, 0, 0], "{start}: ACTLR, CCR, SHCSR, CFSR");
        assert_eq!(log.icsr & 0x001F_F1FF, 0, "{start}: nothing active or pending");
        assert_eq!(log.masks, [0, 0], "{start}");
        assert_eq!(log.faults, 4, "{start}: a fault for each key");
        assert_eq!(log.locks, [0x8000_0000, 0x0FFF_AAED], "{start}");
        // Locked: nothing can be stored before the next reset, and a request to store causes no
        // fault.
        assert_eq!(log.callgate, -8, "{start}");
        bench.machine().write_ram(OUT, &[0; 48]).unwrap();
        bench.power_off();
        bench.power_on();
    }
}

/// Return by a jump: the flash is locked, and the boot stage does a reset.
#[test]
fn a_sealed_program_that_jumps_back_can_be_updated() {
    let image = firmware::raw(firmware::APP_TEST);
    let file = |counter| sealer(counter).seal(&image, &release()).unwrap();
    let mut bench = installed(board(), &file(COUNTER));
    bench.await_boot_up(2000);
    // No longer fresh: 80h is a call.
    bench.power_off();
    bench.power_on();
    bench.await_program(1000);
    bench.events();
    let way_back = Address::new(0x2000, 0);
    bench.session().write(way_back, &[2], Doing::Write(way_back), &mut |_| {}).unwrap();
    bench.session().command(1, ProgramControl::StartBootloader).unwrap();
    bench.await_boot_up(1000);
    let stops: Vec<_> = bench.events().into_iter().map(|(_, stop)| stop).collect();
    assert_eq!(stops, [Stop::Reset(ResetCause::Software)]);
    assert!(bench.is_bootloader(NODE));
    bench.session().command(1, ProgramControl::Clear).unwrap();
    bench.session().write(DATA, &file(COUNTER + 1), Doing::Program, &mut |_| {}).unwrap();
    bench.session().command(1, ProgramControl::Start).unwrap();
    bench.await_boot_up(5000);
    assert!(!bench.is_bootloader(NODE));
    bench.assert_nothing_unmodelled();
}

/// The manifest says that the application writes to flash itself.
#[test]
#[cfg_attr(not(staging), ignore = "needs a region for staging")]
fn a_sealed_program_that_writes_flash_is_not_locked_out() {
    let file = Sealer { writes_flash: true, ..sealer(COUNTER) }.seal(&program(), &release()).unwrap();
    let mut bench = installed(board_of(firmware::BOOTLOADER_SEALED_WRITES_FLASH), &file);
    let log = log(&mut bench);
    assert_eq!((log.faults, log.locks), (0, [0, 0x0FFF_AAEC]));
    assert_eq!(log.callgate, 0);
    // Where the bootloader can be renewed, it could write a bootloader that nobody has verified.
    let mut bench = board().switched_on();
    assert_eq!(write(&mut bench, &file, Transfers::Blocks).1, status::WRONG_PRODUCT);
}

/// A device without keys is not sealed.
#[test]
fn a_program_that_is_not_sealed_is_not_locked_out() {
    let mut bench = installed(open_board(), &program());
    let log = log(&mut bench);
    assert_eq!((log.faults, log.locks), (0, [0, 0x0FFF_AAEC]));
    assert_eq!(log.callgate, 0);
}
