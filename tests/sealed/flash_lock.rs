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
use kit::assembler::assemble;

const DATA: Address = Address::new(0x1F50, 1);
/// The address of the program's log.
const OUT: u32 = 0x2000_0000;

/// The program in flash, which tries the keys: the vectors, and the code at offset 200h.
fn program() -> Vec<u8> {
    let program = assemble("tests/sealed/flash_lock.s", firmware::board().programs[0].base + 0x200);
    [program.vectors, program.code].concat()
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
    bench.switch_on();
    let mut session = bench.session();
    session.transfer_by(Transfers::Blocks);
    session.write(DATA, file, Doing::Program, &mut |_| {}).unwrap();
    session.command(1, ProgramControl::Start).unwrap();
    bench
}

/// Waits for the program, and reads its log since the reset.
fn log(bench: &mut Bench) -> Log {
    for _ in 0..100 {
        bench.run_ms(20);
        if bench.word(OUT + 40) == 1 {
            break;
        }
    }
    assert_eq!(bench.word(OUT + 40), 1, "the program has come to its end");
    let words: Vec<u32> = (0..12).map(|n| bench.word(OUT + 4 * n)).collect();
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
    bench.restart();
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
