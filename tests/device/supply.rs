//! The supply of the chip, and its option bytes (2007h/6 and 7). Thresholds: datasheet DS8626, typical.

use canopen::program::{FlashError, ProgramControl};
use canopen::Address;
use coboot_tests::bench::{Bench, NODE};
use coboot_tests::firmware;
use coflash_core::device::option_bytes::OptionBytes;
use coflash_core::device::read_state::read_state;
use coflash_core::device::{Doing, Error};
use emulator::machine::{Operation, Options, ResetCause, Stop};
use emulator::silicon::{self, Silicon};
use emulator::time::Span;
use shared_abi::geometry::{Line, Region};

const OPTION_BYTES: Address = Address::new(0x2007, 6);
const SUPPLY: Address = Address::new(0x2007, 7);
const PWR_CR: u32 = 0x4000_7000;
/// Below every level of the voltage detector that a board for 32 bits may have, and above the power-down reset.
const LOW: u32 = 2_500;

/// A board with a program, in its bootloader.
fn board_with_a_program() -> Bench {
    let mut bench = Bench::new().switched_on();
    update(&mut bench, firmware::APP_V1).unwrap();
    bench.call_back();
    bench.run_ms(20);
    bench.events();
    bench
}

fn update(bench: &mut Bench, image: &str) -> Result<(), Error> {
    bench.install_unwatched(image).map(drop)
}

fn set_supply(bench: &mut Bench, mv: u32) {
    bench.machine().set_supply(mv, Span(0));
}

fn is_low_supply(result: &Result<(), Error>) -> bool {
    matches!(result, Err(Error::Failed { error: FlashError::NoAccess, detail: 1, .. }))
}

/// What the program is, by its place in flash.
fn program(bench: &mut Bench) -> Vec<u8> {
    let board = firmware::board();
    let (base, region) = (board.chip.flash.base, board.programs[0]);
    let at = (region.base - base) as usize;
    bench.machine().flash()[at..at + 0x4000].to_vec()
}

/// Nothing is lost, and nothing is written; the words say what is wrong. When the supply is good again, the
/// same command works.
#[test]
fn an_update_with_a_supply_that_is_too_low_is_refused_before_anything_is_lost() {
    let mut bench = board_with_a_program();
    let old = program(&mut bench);
    assert_eq!(bench.session().read_number(SUPPLY).unwrap(), 1);
    set_supply(&mut bench, LOW);
    bench.run_ms(1);
    assert_eq!(bench.session().read_number(SUPPLY).unwrap(), 2);
    let state = read_state(&mut bench.session()).unwrap().unwrap();
    assert!(state.to_string().contains("its supply is too low to write its flash"), "{state}");
    bench.machine().keep_flash_log();
    let refused = update(&mut bench, firmware::APP_V2);
    assert!(is_low_supply(&refused), "{refused:?}");
    let error = refused.unwrap_err();
    assert!(error.to_string().contains("the supply of the device is too low to write its flash"), "{error}");
    assert_eq!(bench.machine().take_flash_log(), []);
    assert_eq!((program(&mut bench) == old, bench.machine().counters().flash_weak), (true, 0));
    set_supply(&mut bench, 3_300);
    bench.run_ms(1);
    update(&mut bench, firmware::APP_V2).unwrap();
    assert!(!bench.is_bootloader(NODE));
    assert_eq!(bench.machine().counters().flash_weak, 0);
}

/// The supply falls as a ramp, at different times of an update. Nothing is started with it; an erase that runs
/// may end with too little, and is repeated. Back after a millisecond or some seconds, the device takes the program.
#[test]
fn a_supply_that_falls_in_the_middle_of_an_update_leaves_no_weak_word() {
    for (after_ms, for_ms) in [(1_000, 1), (2_300, 1_000), (3_000, 10_000)] {
        let mut bench = board_with_a_program();
        bench.machine().set_supply(3_300, Span(0));
        // It begins to fall so long after the start of the update.
        let slope = Span::from_millis(after_ms);
        bench.machine().set_supply(LOW, slope);
        let refused = update(&mut bench, firmware::APP_V2);
        assert!(is_low_supply(&refused), "after {after_ms} ms: {refused:?}");
        let weak = bench.machine().counters().flash_weak;
        // The erase that ran.
        assert!(weak <= 1, "after {after_ms} ms: {weak}");
        bench.run_ms(for_ms);
        set_supply(&mut bench, 3_300);
        bench.run_ms(1);
        update(&mut bench, firmware::APP_V2).unwrap();
        assert_eq!(bench.machine().counters().flash_weak, weak);
        // In the journal a weak record may be left: it counts as one that a power cut has torn.
        let (base, region) = (firmware::board().chip.flash.base, firmware::board().programs[0]);
        let cells = bench.machine().flash_cells();
        let left: Vec<_> = cells.unstable.keys().filter(|at| region.contains(base + **at, 1)).collect();
        assert_eq!(left, [&0; 0], "after {after_ms} ms");
        assert_eq!(bench.events().iter().filter(|(_, stop)| is_by_supply(*stop)).count(), 0);
    }
}

/// The supply falls to a voltage and hangs there for a minute: each chip either sees it, or can write with it (RM0090
/// table 13).
#[test]
fn a_supply_that_hangs_where_detectors_differ_leaves_no_weak_word() {
    for threshold_permille in [0, 1_000] {
        for mv in [2_650, 2_700, 2_850] {
            let what = format!("{mv} mV, {threshold_permille}");
            let silicon = Silicon { threshold_permille, ..silicon::TYPICAL };
            let mut bench = Bench::with(Options { silicon, ..Options::default() }).switched_on();
            set_supply(&mut bench, mv);
            for _ in 0..2 {
                let ended = update(&mut bench, firmware::APP_V1);
                assert!(ended.is_ok() || is_low_supply(&ended), "{what}: {ended:?}");
                if ended.is_ok() {
                    bench.call_back();
                }
                bench.run_ms(30_000);
            }
            set_supply(&mut bench, 3_300);
            bench.run_ms(1);
            update(&mut bench, firmware::APP_V2).unwrap();
            assert_eq!(bench.machine().counters().flash_weak, 0, "{what}");
        }
    }
}

fn is_by_supply(stop: Stop) -> bool {
    matches!(stop, Stop::Reset(ResetCause::PowerOn | ResetCause::BrownOut))
}

/// BOR level 3, and off: the supply fails in the middle of an update and is back after a millisecond, a second
/// or an hour. The device is there again, and takes the program.
#[test]
fn a_device_that_its_supply_resets_in_the_middle_of_an_update_is_reachable() {
    let cases: [(u8, u32, ResetCause, &[u64]); 2] =
        [(3, 2_400, ResetCause::BrownOut, &[1_000]), (0, 0, ResetCause::PowerOn, &[1, 1_000, 3_600_000])];
    for (level, low, cause, times) in cases {
        for &off_ms in times {
            let what = format!("level {level}, {off_ms} ms");
            let mut bench = board_with_a_program();
            bench.machine().set_brown_out_level(level);
            // In about 0.6 s, when sectors are erased or words are written.
            bench.machine().set_supply(low, Span::from_millis(800));
            let broken = update(&mut bench, firmware::APP_V2);
            assert!(broken.is_err(), "{what}");
            bench.run_ms(1_000);
            assert!(bench.machine().is_held_in_reset(), "{what}");
            bench.run_ms(off_ms);
            bench.events();
            set_supply(&mut bench, 3_300);
            bench.await_boot_up(1_000);
            let stops = bench.stops();
            assert_eq!(stops.first(), Some(&Stop::Reset(cause)), "{what}");
            bench.run_ms(400);
            update(&mut bench, firmware::APP_V2).unwrap();
            assert!(!bench.is_bootloader(NODE), "{what}");
        }
    }
}

/// The width of all that is programmed follows from the board's supply (RM0090 table 13).
#[test]
fn a_word_is_programmed_as_wide_as_the_supply_allows() {
    let mut bench = Bench::new().switched_on();
    bench.machine().keep_flash_log();
    update(&mut bench, firmware::APP_V1).unwrap();
    let log = bench.machine().take_flash_log();
    let widths = log.iter().filter_map(|operation| match operation {
        Operation::Program { bytes, .. } => Some(bytes.len() as u32),
        _ => None,
    });
    assert!(widths.clone().count() > 100);
    assert!(widths.into_iter().all(|width| width == bsp::FLASH_WIDTH));
}

/// The bootloader watches the supply by its detector; a program finds the power controller as after a reset.
#[test]
fn a_program_gets_the_voltage_detector_switched_off() {
    let mut bench = board_with_a_program();
    let level = bsp::voltage::detector_level(bsp::SUPPLY_MV);
    let watches = bench.machine().register(PWR_CR).unwrap() >> 4 & 0xF;
    assert_eq!(watches, level.map_or(0, |level| u32::from(level) << 1 | 1));
    bench.start_program();
    assert_eq!(bench.machine().register(PWR_CR).unwrap() >> 4 & 0xF, 0);
    bench.assert_nothing_unmodelled();
}

/// BOR level 3 and off, WDG_SW, nRST_STOP, nRST_STDBY, and nWRP of the bootloader's first sector: the
/// program starts, can be called back and erased, and the device says in 2007h/6 what its option bytes
/// are.
#[test]
fn with_every_combination_of_option_bytes_a_program_is_called_back_and_erased() {
    let pristine = board_with_a_program().machine().flash().to_vec();
    for bits in (0_u32..64).filter(|bits| matches!(bits & 0b11, 0 | 3)) {
        let pick = |bit: u32, mask: u32| if bits >> bit & 1 != 0 { mask } else { 0 };
        let optcr = (bits & 0b11) << 2
            | pick(2, 1 << 5)
            | pick(3, 1 << 6)
            | pick(4, 1 << 7)
            | 0xAA << 8
            | 0xFFE << 16
            | pick(5, 1 << 16);
        let mut bench = Bench::new();
        bench.machine().load_bin(firmware::board().chip.flash.base, &pristine).unwrap();
        bench.machine().set_option_bytes(optcr);
        bench.power_on();
        bench.await_program(1_000);
        bench.run_ms(50);
        bench.call_back();
        bench.run_ms(20);
        bench.session().command(1, ProgramControl::Clear).unwrap();
        bench.session().await_idle(1, Doing::Block(0)).unwrap();
        assert_eq!(bench.session().read_number(OPTION_BYTES).unwrap(), optcr | 1, "{optcr:08X}h");
    }
}

fn has_sprmod() -> bool {
    !matches!(firmware::board().chip.line, Line::F405 | Line::F407)
}

/// Each combination of brown-out level, WDG_SW, BFB2, SPRMOD, RDP and a protected sector is shown as it is, and
/// `coflash info` names what is wrong with it.
#[test]
fn every_combination_of_option_bytes_is_shown() {
    for bits in 0_u32..256 {
        let pick = |bit: u32, value: u32| if bits >> bit & 1 != 0 { value } else { 0 };
        let level = bits & 0b11;
        let rdp = [0xAA_u32, 0x55, 0xCC, 0xAA][(bits >> 6 & 0b11) as usize];
        // With SPRMOD ones protect.
        let nwrp = match (bits >> 4 & 1, bits >> 5 & 1) {
            (0, 0) => 0xFFF,
            (0, _) => 0xFFE,
            (_, 0) => 0x000,
            (_, _) => 0x001,
        };
        let optcr =
            level << 2 | pick(2, 1 << 4) | pick(3, 1 << 5) | 0xC0 | rdp << 8 | nwrp << 16 | pick(4, 1 << 31);
        let mut bench = Bench::new();
        bench.machine().set_option_bytes(optcr);
        bench.power_on();
        if has_sprmod() && bits >> 4 & 0b11 == 0b11 {
            // Sector 0 cannot be read: the boot stage has no constants.
            bench.run_ms(100);
            assert_eq!(bench.records().len(), 0, "{optcr:08X}h");
            continue;
        }
        bench.await_boot_up(1000);
        let option_bytes = bench.session().read_number(OPTION_BYTES).unwrap();
        // OPTLOCK is set.
        assert_eq!(option_bytes, optcr | 1, "{optcr:08X}h");
        let warnings = OptionBytes(option_bytes).warnings();
        let has = |word: &str| warnings.iter().any(|warning| warning.contains(word));
        assert_eq!(has("brown-out"), level == 3, "{optcr:08X}h");
        assert_eq!(has("BFB2"), bits >> 2 & 1 != 0, "{optcr:08X}h");
        assert_eq!(has("WDG_SW"), bits >> 3 & 1 == 0, "{optcr:08X}h");
        assert_eq!(has("SPRMOD"), bits >> 4 & 1 != 0, "{optcr:08X}h");
        assert_eq!(has("not write-protected"), bits >> 5 & 1 == 0, "{optcr:08X}h");
    }
}

/// RM0090 section 3.7.3: what RDP denies a debugger it does not deny the bootloader, which boots from the flash.
#[test]
fn with_each_level_of_read_out_protection_a_program_is_replaced_and_called_back() {
    for rdp in [0x55, 0xCC] {
        let mut bench = Bench::new();
        bench.machine().set_read_protection(rdp);
        bench.switch_on();
        for image in [firmware::APP_V1, firmware::APP_V2] {
            update(&mut bench, image).unwrap();
            assert!(!bench.is_bootloader(NODE));
            bench.call_back();
            bench.run_ms(20);
        }
        assert_eq!(bench.session().read_number(OPTION_BYTES).unwrap() >> 8 & 0xFF, u32::from(rdp));
    }
}

/// BFB2 of a chip with two banks (RM0090 section 2.4, AN2606): ST's loader starts the first bank as long as the second
/// one does not begin with an address in SRAM. The device works, and says what its option bytes are. A program whose
/// part in the second bank begins like that takes the place of the bootloader.
#[test]
fn with_bfb2_the_device_works_until_its_second_bank_begins_with_a_stack_pointer() {
    const BFB2: u32 = 1 << 4;
    let chip = firmware::board().chip;
    let mut bench = Bench::new();
    bench.machine().set_option_bytes(0x0FFF_AAEC | BFB2);
    bench.switch_on();
    update(&mut bench, firmware::APP_V1).unwrap();
    bench.call_back();
    bench.run_ms(20);
    let option_bytes = bench.session().read_number(OPTION_BYTES).unwrap();
    assert!(OptionBytes(option_bytes).boots_from_bank_2());
    let Some(bank) = chip.second_bank else { return };
    let second = chip.sector(bank).unwrap().region.base;
    bench.machine().load_bin(second, &chip.sram.base.to_le_bytes()).unwrap();
    bench.power_cycle();
    let from = bench.time();
    bench.run_ms(3_000);
    assert_eq!(bench.frames_since(from), []);
}

/// What is left of a device whose data bus is kept out of one of its sectors.
#[derive(Debug, PartialEq, Eq)]
enum Left {
    /// Its program starts.
    Program,
    /// The bootloader answers.
    Bootloader,
    Nothing,
}

/// PCROP (RM0090 section 3.7.5): SPRMOD, and a one of nWRP. A chip without SPRMOD reads all of its flash. The
/// sectors of a program: it is not valid any more, the bootloader says why it stays, and refuses another one before
/// anything changes. The bootloader's own sectors: it cannot read its constants.
#[test]
fn a_sector_that_cannot_be_read_leaves_the_bootloader_unless_it_is_its_own() {
    let board = firmware::board();
    let pristine = board_with_a_program().machine().flash().to_vec();
    let number = |region: Region| board.chip.sector_at(region.base).unwrap().number;
    let of = |region: Option<Region>, left: Left| region.map(|region| (region, left));
    let all_of_it = [
        of(Some(board.bootloader), Left::Nothing),
        // It is damaged, and the program starts.
        of(board.home, Left::Program),
        of(board.data, Left::Program),
        of(Some(board.programs[0]), Left::Bootloader),
        // The region with the records, and the other one.
        of(Some(board.parameters[0]), Left::Bootloader),
        of(Some(board.parameters[1]), Left::Program),
    ];
    for (region, expected) in all_of_it.into_iter().flatten() {
        let mut bench = Bench::new();
        bench.machine().load_bin(board.chip.flash.base, &pristine).unwrap();
        let optcr = 0x8000_AAEC | 1 << (16 + number(region));
        bench.machine().set_option_bytes(optcr);
        bench.power_on();
        let from = bench.time();
        bench.run_ms(2_000);
        let has_boot_up = bench.frames_since(from).iter().any(|(_, _, data)| *data == [0]);
        let left = match has_boot_up {
            false => Left::Nothing,
            true if bench.is_bootloader(NODE) => Left::Bootloader,
            true => Left::Program,
        };
        let expected = if has_sprmod() { expected } else { Left::Program };
        assert_eq!(left, expected, "{region:X?}");
        if left != Left::Bootloader {
            continue;
        }
        let state = read_state(&mut bench.session()).unwrap().unwrap();
        assert_eq!(state.option_bytes, Some(OptionBytes(optcr | 1)), "{region:X?}");
        if region == board.programs[0] {
            bench.machine().keep_flash_log();
            let refused = update(&mut bench, firmware::APP_V2);
            assert!(matches!(refused, Err(Error::Failed { error: FlashError::Secured, .. })), "{refused:?}");
            assert_eq!(bench.machine().take_flash_log(), []);
        }
    }
}
