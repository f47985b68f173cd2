//! A device with two programs: each has its own region, record and release, and neither affects the
//! other.

use canopen::program::{ProgramControl, DEVICE_STATE, STATE_PROGRAM_START};
use canopen::Address;
use coboot_tests::bench::{Bench, NODE};
use coboot_tests::firmware;
use coflash_core::device::{Doing, Transfers};
use coflash_core::file::convert::{program_of, Options, Region};
use coflash_core::file::read::read;
use coflash_core::file::Program;
use coflash_core::update::{flash, FlashOptions};
use coflash_core::Error;
use emulator::time::Span;
use shared_abi::layout::stm32f407g_disc1_two::LAYOUT;

/// A board with two programs; `None` if the tests run for another chip.
fn board() -> Option<Bench> {
    if firmware::board().chip != LAYOUT.chip {
        println!("not run: {} has the chip of another board", LAYOUT.board);
        return None;
    }
    Some(Bench::of_image(&firmware::of_board(LAYOUT.board, firmware::BOOTLOADER)).switched_on())
}

/// Version of the program that runs: 100Ah.
const VERSION: u16 = 0x100A;

fn identification(bench: &mut Bench, program: u8) -> u32 {
    let answer = bench.ask(0x601, &[0x40, 0x56, 0x1F, program, 0, 0, 0, 0], 0x581).expect("an answer");
    u32::from_le_bytes([answer[4], answer[5], answer[6], answer[7]])
}

fn blocks(image: &str, program: usize) -> Program {
    let elf = firmware::elf(&firmware::of_board(LAYOUT.board, image));
    let options = Options::default().region(Region::Strict(LAYOUT.programs[program - 1].into()));
    program_of(read(&elf, None, None).expect("an ELF of ours"), &options).expect("it fits").program
}

fn install(bench: &mut Bench, program: u8, file: &Program) {
    let options = FlashOptions::default().program(program).start(false);
    flash(&mut bench.session(), file, &options, &mut |_| {}).unwrap();
    coflash_core::update::steps::release(&mut bench.session(), program, &mut |_| {}).unwrap();
}

fn restart(bench: &mut Bench) {
    bench.restart();
    bench.run_ms(20);
}

#[test]
fn two_programs_are_installed_started_and_erased_each_by_itself() {
    let Some(mut bench) = board() else { return };
    // 1F50h to 1F57h have the two programs, the bootloader, and nothing more.
    for index in [0x50, 0x51, 0x56, 0x57] {
        let highest = bench.ask(0x601, &[0x40, index, 0x1F, 0, 0, 0, 0, 0], 0x581).unwrap();
        assert_eq!((highest[0], highest[4]), (0x4F, 3));
        let next = bench.ask(0x601, &[0x40, index, 0x1F, 4, 0, 0, 0, 0], 0x581).unwrap();
        assert_eq!(next, [0x80, index, 0x1F, 4, 0x11, 0, 0x09, 0x06]);
    }

    let (first, second) = (blocks(firmware::APP_V1, 1), blocks(firmware::PROGRAM_2, 2));
    install(&mut bench, 2, &second);
    // The first program is preferred; as long as there is none, the second one starts by itself.
    let start = bench.session().read_number(Address::new(DEVICE_STATE, STATE_PROGRAM_START)).unwrap();
    assert_eq!(start, 0x0201_0000);
    restart(&mut bench);
    assert_eq!((identification(&mut bench, 1), bench.text(VERSION).as_str()), (0, "2.0.0"));
    assert_eq!(identification(&mut bench, 2), second.crc());

    install(&mut bench, 1, &first);
    restart(&mut bench);
    assert_eq!(bench.text(VERSION), "1.0.0");
    bench.session().command(1, ProgramControl::StartBootloader).unwrap();
    bench.await_boot_up(1000);
    bench.run_ms(20);

    // The erase of one program leaves every byte of the other unchanged.
    let place = (LAYOUT.programs[1].base - LAYOUT.chip.flash.base) as usize;
    let before = bench.machine().flash()[place..].to_vec();
    for _ in 0..2 {
        bench.session().command(1, ProgramControl::Clear).unwrap();
    }
    bench.session().await_idle(1, Doing::Command(ProgramControl::Clear)).unwrap();
    assert_eq!(identification(&mut bench, 1), 0);
    assert!(bench.machine().flash()[place..] == before);
    restart(&mut bench);
    assert_eq!(bench.text(VERSION), "2.0.0");
}

/// A program that was linked for the other place is refused: its vectors would point into the other
/// program.
#[test]
fn a_block_for_the_other_program_is_refused() {
    let Some(mut bench) = board() else { return };
    let second = blocks(firmware::PROGRAM_2, 2);
    let options = FlashOptions::default().program(1).start(false).repeats(0);
    // The device reports its regions to the host, and the host sends nothing. A host without this
    // check gets the refusal from the device.
    let refused = flash(&mut bench.session(), &second, &options, &mut |_| {}).unwrap_err();
    assert!(matches!(refused, Error::OtherRegion { .. }), "{refused}");
    let refused = flash(&mut bench.session(), &second, &options.force(true), &mut |_| {}).unwrap_err();
    let status = bench.ask(0x601, &[0x40, 0x57, 0x1F, 1, 0, 0, 0, 0], 0x581).unwrap();
    assert_eq!(status[4], 0x0C, "ADDRESS: {refused}");
    let (start, end) = (0x2_0000, LAYOUT.chip.flash.size as usize);
    assert!(bench.machine().flash()[start..end].iter().all(|byte| *byte == 0xFF));
}

/// Applications at the first program's place, and the same applications at the second's.
const PAIRS: [(&str, &str); 2] =
    [(firmware::APP_V1, firmware::PROGRAM_2), (firmware::APP_C, firmware::APP_C_PROGRAM_2)];

/// The second program of a device is written while the first one runs: 1F51h/1 calls the
/// bootloader, as in the manual, and the application serves each program's sub-index.
#[test]
fn a_second_program_is_written_to_a_running_device() {
    for (first, second) in PAIRS {
        let Some(mut bench) = board() else { return };
        let (one, two) = (blocks(first, 1), blocks(second, 2));
        flash(&mut bench.session(), &one, &FlashOptions::default().trial_run(false), &mut |_| {}).unwrap();
        let read = |bench: &mut Bench, index: u8, sub: u8| {
            bench.ask(0x601, &[0x40, index, 0x1F, sub, 0, 0, 0, 0], 0x581).expect("an answer")
        };
        // 1F51h: running, absent; the third one is the bootloader, and there is no fourth one (06090011h).
        for (sub, state) in [(1, 1), (2, 3), (3, 0)] {
            assert_eq!(read(&mut bench, 0x51, sub), [0x4F, 0x51, 0x1F, sub, state, 0, 0, 0], "{first}");
        }
        for index in [0x51, 0x56, 0x57] {
            assert_eq!(read(&mut bench, index, 0), [0x4F, index, 0x1F, 0, 3, 0, 0, 0]);
            assert_eq!(read(&mut bench, index, 4), [0x80, index, 0x1F, 4, 0x11, 0, 0x09, 0x06]);
        }
        assert_eq!(identification(&mut bench, 1), one.crc(), "{first}");
        assert_eq!(identification(&mut bench, 2), 0, "{first}");
        // START of the running program changes nothing. START of another program, and all other
        // commands for it, are left to the bootloader (08000022h). A program that does not exist
        // has its own code.
        for (sub, value, code) in
            [(2, 1, 0x0800_0022_u32), (2, 2, 0x0800_0022), (2, 0x83, 0x0800_0022), (4, 3, 0x0609_0011)]
        {
            let answer = bench.ask(0x601, &[0x2F, 0x51, 0x1F, sub, value, 0, 0, 0], 0x581).unwrap();
            let expected = [&[0x80, 0x51, 0x1F, sub][..], &code.to_le_bytes()].concat();
            assert_eq!(answer, expected, "{first}");
        }

        let options = FlashOptions::default().program(2).verify(true);
        let report = flash(&mut bench.session(), &two, &options, &mut |_| {}).unwrap();
        assert!(report.running.is_some(), "{second}");
        // The second program runs now; the first one is installed and stopped.
        assert_eq!(read(&mut bench, 0x51, 1), [0x4F, 0x51, 0x1F, 1, 0, 0, 0, 0]);
        assert_eq!(read(&mut bench, 0x51, 2), [0x4F, 0x51, 0x1F, 2, 1, 0, 0, 0]);
        assert_eq!(identification(&mut bench, 1), one.crc(), "{second}");
        assert_eq!(identification(&mut bench, 2), two.crc(), "{second}");
        // The update of the first program starts in the second one.
        let options = FlashOptions::default().verify(true);
        flash(&mut bench.session(), &one, &options, &mut |_| {}).unwrap();
        assert_eq!(read(&mut bench, 0x51, 1), [0x4F, 0x51, 0x1F, 1, 1, 0, 0, 0]);
        bench.assert_nothing_unmodelled();
    }
}

/// The bootloader also carries out STOP and CLEAR of a program that does not run, and answers them.
/// 80h to another program's sub-index calls the bootloader, also if that program is fresh.
#[test]
fn commands_for_the_other_program_lead_into_the_bootloader() {
    for (first, _) in PAIRS {
        for value in [0x00, 0x03, 0x80] {
            let Some(mut bench) = board() else { return };
            let mut session = bench.session();
            session.transfer_by(Transfers::Segments);
            let image = firmware::raw_from(LAYOUT.programs[0].base, &firmware::of_board(LAYOUT.board, first));
            session.write(Address::new(0x1F50, 1), &image, Doing::Program, &mut |_| {}).unwrap();
            session.await_idle(1, Doing::Program).unwrap();
            session.command(1, ProgramControl::Start).unwrap();
            bench.await_boot_up(1000);
            bench.run_ms(50);
            let from = bench.time();
            let answer = bench.ask(0x601, &[0x2F, 0x51, 0x1F, 2, value, 0, 0, 0], 0x581).unwrap();
            assert_eq!(answer, [0x60, 0x51, 0x1F, 2, 0, 0, 0, 0], "{first}, {value:02X}h");
            assert!(bench.time() - from <= Span::from_millis(25), "{first}, {value:02X}h");
            bench.run_ms(100);
            assert!(bench.is_bootloader(NODE), "{first}, {value:02X}h");
        }
    }
}
