//! The supply of the chip, and its option bytes (2007h/6 and 7). Thresholds: datasheet DS8626, typical.

use canopen::program::{FlashError, ProgramControl};
use canopen::Address;
use coboot_tests::bench::{Bench, NODE};
use coboot_tests::firmware;
use coflash_core::device::option_bytes::OptionBytes;
use coflash_core::device::read_state::read_state;
use coflash_core::device::{Doing, Error};
use coflash_core::update::{flash, FlashOptions};
use emulator::machine::{Operation, ResetCause, Stop};
use emulator::time::Span;

const OPTION_BYTES: Address = Address::new(0x2007, 6);
const SUPPLY: Address = Address::new(0x2007, 7);
const PWR_CR: u32 = 0x4000_7000;
/// Below every level of the voltage detector that a board for 32 bits may have, and above the power-down reset.
const LOW: u32 = 2_500;

/// A board with a program, in its bootloader.
fn board_with_a_program() -> Bench {
    let mut bench = Bench::new();
    bench.power_on();
    bench.await_boot_up(100);
    update(&mut bench, firmware::APP_V1).unwrap();
    bench.session().command(1, ProgramControl::StartBootloader).unwrap();
    bench.await_boot_up(1000);
    bench.run_ms(20);
    bench.events();
    bench
}

fn update(bench: &mut Bench, image: &str) -> Result<(), Error> {
    let options = FlashOptions::default().trial_run(false).watch(Some(std::time::Duration::ZERO));
    flash(&mut bench.session(), &firmware::blocks(image), &options, &mut |_| {}).map(drop)
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
        // Level 4, for boards with 2.9 V, falls at 2.66 V: between that and 2.7 V words are written that may not
        // last. The next update erases them.
        let is_tight = bsp::voltage::detector_level(bsp::SUPPLY_MV) >= Some(5);
        assert!(!is_tight || weak <= 1, "after {after_ms} ms: {weak}");
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
            let stops: Vec<_> = bench.events().into_iter().map(|(_, stop)| stop).collect();
            assert_eq!(stops.first(), Some(&Stop::Reset(cause)), "{what}");
            bench.run_ms(400);
            update(&mut bench, firmware::APP_V2).unwrap();
            assert!(!bench.is_bootloader(NODE), "{what}");
        }
    }
}

/// The width of all that is programmed follows from the board's supply (RM0090 table 7).
#[test]
fn a_word_is_programmed_as_wide_as_the_supply_allows() {
    let mut bench = Bench::new();
    bench.power_on();
    bench.await_boot_up(100);
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
    bench.session().command(1, ProgramControl::Start).unwrap();
    bench.await_boot_up(1000);
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
        bench.session().command(1, ProgramControl::StartBootloader).unwrap();
        bench.await_boot_up(1_000);
        bench.run_ms(20);
        bench.session().command(1, ProgramControl::Clear).unwrap();
        bench.session().await_idle(1, Doing::Block(0)).unwrap();
        assert_eq!(bench.session().read_number(OPTION_BYTES).unwrap(), optcr | 1, "{optcr:08X}h");
    }
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
        bench.await_boot_up(1000);
        let told = bench.session().read_number(OPTION_BYTES).unwrap();
        // OPTLOCK is set.
        assert_eq!(told, optcr | 1, "{optcr:08X}h");
        let warnings = OptionBytes(told).warnings();
        let has = |word: &str| warnings.iter().any(|warning| warning.contains(word));
        assert_eq!(has("brown-out"), level == 3, "{optcr:08X}h");
        assert_eq!(has("BFB2"), bits >> 2 & 1 != 0, "{optcr:08X}h");
        assert_eq!(has("WDG_SW"), bits >> 3 & 1 == 0, "{optcr:08X}h");
        assert_eq!(has("SPRMOD"), bits >> 4 & 1 != 0, "{optcr:08X}h");
        assert_eq!(has("not write-protected"), bits >> 5 & 1 == 0, "{optcr:08X}h");
    }
}
