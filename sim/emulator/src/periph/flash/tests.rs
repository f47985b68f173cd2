//! The flash interface against the reference manual and the datasheet.

use super::*;
use crate::silicon::TYPICAL;
use shared_abi::geometry::{STM32F407VG, STM32F429ZI};

const KEYR: u32 = 0x04;
const SR: u32 = 0x0C;
const CR: u32 = 0x10;
const X32: u32 = 2 << 8;

fn locked(chip: &'static Geometry) -> Flash {
    Flash::new(chip, FlashTimes::Typical, TYPICAL)
}

fn unlock(mut flash: Flash) -> Flash {
    flash.write(KEYR, 0x4567_0123, Time(0)).unwrap();
    flash.write(KEYR, 0xCDEF_89AB, Time(0)).unwrap();
    flash
}

fn unlocked() -> Flash {
    unlock(locked(&STM32F407VG))
}

/// The one with two banks; its array holds zeros.
fn two_banks() -> Flash {
    let mut flash = unlock(locked(&STM32F429ZI));
    flash.array.bytes_mut().fill(0);
    flash
}

fn status(flash: &mut Flash, now: Time) -> u32 {
    flash.read(SR, now).unwrap()
}

#[test]
fn programming_a_word_takes_16_us_and_clears_bits_only() {
    let mut flash = unlocked();
    flash.write(CR, CR_PG | X32, Time(0)).unwrap();
    assert_eq!(flash.store(8, &0x1234_5678_u32.to_le_bytes(), Time(0)), Store::Started);
    assert_eq!(status(&mut flash, Time(15_999_999)), 0x0001_0000);
    assert_eq!(flash.array.bytes()[8..12], [0xFF; 4]);
    assert_eq!(status(&mut flash, Time(16_000_000)), 0);
    assert_eq!(flash.array.bytes()[8..12], [0x78, 0x56, 0x34, 0x12]);
    assert_eq!(flash.store(8, &0xFFFF_F00F_u32.to_le_bytes(), Time(20_000_000)), Store::Started);
    flash.advance(Time(40_000_000));
    assert_eq!(flash.array.bytes()[8..12], [0x08, 0x50, 0x34, 0x12]);
    assert_eq!(flash.take_changed(), [(8, 4), (8, 4)]);
}

/// RM0090 table 13: 8 bits from 1.8 V on, 16 from 2.1 V, 32 from 2.7 V, 64 with VPP alone.
#[test]
fn each_width_needs_its_supply() {
    for (psize, lowest) in [(0, Some(1_800)), (1, Some(2_100)), (2, Some(2_700)), (3, None)] {
        for mv in [1_799, 1_800, 2_099, 2_100, 2_699, 2_700, 3_600] {
            let mut flash = unlocked();
            flash.set_supply(mv);
            flash.write(CR, CR_PG | psize << 8, Time(0)).unwrap();
            let bytes = &[0x5A; 8][..1 << psize];
            assert_eq!(flash.store(16, bytes, Time(0)), Store::Started);
            flash.advance(Time(16_000_000));
            assert_eq!(&flash.array.bytes()[16..16 + bytes.len()], bytes, "it is there, at first");
            let lasts = lowest.is_some_and(|lowest| mv >= lowest);
            assert_eq!(flash.unstable.is_empty(), lasts, "{mv} mV, PSIZE {psize}");
            assert_eq!(flash.counters.weak, u64::from(!lasts));
            let erase = CR_SER | 4 << 3 | psize << 8 | CR_STRT;
            assert_eq!(flash.write(CR, erase, Time(20_000_000)).is_ok(), lasts, "{mv} mV, PSIZE {psize}");
        }
    }
}

#[test]
fn erasing_takes_the_times_of_the_datasheet() {
    for (times, sector, width, ms) in [
        (FlashTimes::Typical, 0, 2, 250),
        (FlashTimes::Worst, 3, 2, 500),
        (FlashTimes::Typical, 4, 2, 550),
        (FlashTimes::Worst, 4, 0, 2_400),
        (FlashTimes::Typical, 11, 2, 1_000),
        (FlashTimes::Worst, 5, 2, 2_000),
    ] {
        let mut flash = unlocked();
        flash.times = times;
        flash.write(CR, CR_SER | sector << 3 | width << 8, Time(0)).unwrap();
        flash.write(CR, CR_SER | sector << 3 | width << 8 | CR_STRT, Time(0)).unwrap();
        assert_eq!(flash.next_event(), Some(Time(ms * 1_000_000_000)), "sector {sector}");
    }
}

/// A chip is as slow as it is drawn, and the choice of the longest times wins.
#[test]
fn times_lie_between_the_typical_and_the_worst_as_the_chip_is() {
    for (times, flash_slowness_permille, ms) in
        [(FlashTimes::Typical, 0, 250), (FlashTimes::Typical, 500, 375), (FlashTimes::Worst, 0, 500)]
    {
        let silicon = Silicon { flash_slowness_permille, ..TYPICAL };
        let mut flash = unlock(Flash::new(&STM32F407VG, times, silicon));
        flash.write(CR, CR_SER | X32 | CR_STRT, Time(0)).unwrap();
        assert_eq!(flash.next_event(), Some(Time(ms * 1_000_000_000)));
    }
}

#[test]
fn an_erase_fills_its_sector_and_no_other() {
    let mut flash = unlocked();
    flash.array.bytes_mut().fill(0);
    flash.write(CR, CR_SER | 4 << 3 | X32 | CR_STRT, Time(0)).unwrap();
    flash.advance(Time(u64::MAX));
    let array = flash.array.bytes();
    assert!(array[0x1_0000..0x2_0000].iter().all(|&byte| byte == 0xFF));
    assert!(array[..0x1_0000].iter().chain(&array[0x2_0000..]).all(|&byte| byte == 0));
    assert_eq!(flash.counters.sectors_erased, 1);
}

/// RM0090 section 3.9.8: SNB is 10000b for sector 12, the first of the second bank; 01100b to
/// 01111b are not allowed.
#[test]
fn sectors_of_the_second_bank_have_codes_of_their_own() {
    for (code, erased) in [
        (0b01011, Some(0x000E_0000..0x0010_0000)),
        (0b10000, Some(0x0010_0000..0x0010_4000)),
        (0b10100, Some(0x0011_0000..0x0012_0000)),
        (0b11011, Some(0x001E_0000..0x0020_0000)),
        (0b01100, None),
        (0b01111, None),
        (0b11100, None),
    ] {
        let mut flash = two_banks();
        let result = flash.write(CR, CR_SER | code << 3 | X32 | CR_STRT, Time(0));
        flash.advance(Time(u64::MAX));
        assert_eq!(result.is_ok(), erased.is_some(), "{code:05b}");
        let erased = erased.unwrap_or(0..0);
        let mut bytes = flash.array.bytes().iter().enumerate();
        let wrong = bytes.position(|(at, &byte)| (byte == 0xFF) != erased.contains(&at));
        assert_eq!(wrong, None, "{code:05b}");
    }
}

/// Sections 3.9.9 and 3.9.11: bits 16 to 27 of OPTCR and OPTCR1 are sectors 0 to 11 and 12 to 23; a
/// zero protects.
#[test]
fn each_bank_has_its_own_write_protection() {
    for (optcr, optcr1, refused) in
        [(0x0FFF_AAEC_u32, 0x0FFE_0000, 0b10000), (0x0FFE_AAEC, 0x0FFF_0000, 0b00000)]
    {
        let mut flash = open_options(unlock(locked(&STM32F429ZI)));
        // OPTCR1, OPTCR with OPTSTRT.
        flash.write(0x18, optcr1, Time(0)).unwrap();
        flash.write(OPTCR, optcr | 1 << 1, Time(0)).unwrap();
        let later = Time(1_000_000_000_000);
        flash.advance(later);
        assert_eq!(flash.read(0x18, later), Ok(optcr1));
        for code in [0b00000, 0b10000] {
            flash.write(CR, CR_SER | code << 3 | X32 | CR_STRT, later).unwrap();
            let is_refused = flash.read(0x0C, later).unwrap() & SR_WRPERR != 0;
            assert_eq!(is_refused, code == refused, "{code:05b}");
            flash.advance(Time(u64::MAX));
            flash.write(0x0C, SR_WRPERR, later).unwrap();
        }
    }
}

/// Section 3.9.8: MER erases bank 1, MER1 bank 2.
#[test]
fn a_mass_erase_is_one_of_a_bank() {
    for (bits, erased) in
        [(1 << 2, [true, false]), (1 << 15, [false, true]), (1 << 2 | 1 << 15, [true, true])]
    {
        let mut flash = two_banks();
        flash.write(CR, bits | X32 | CR_STRT, Time(0)).unwrap();
        flash.advance(Time(u64::MAX));
        for (bank, bytes) in flash.array.bytes().chunks(1 << 20).enumerate() {
            let wanted = if erased[bank] { 0xFF } else { 0 };
            assert!(bytes.iter().all(|&byte| byte == wanted), "{bits:X}, bank {bank}");
        }
    }
}

#[test]
fn a_wrong_key_locks_until_reset_with_a_bus_error() {
    let mut flash = locked(&STM32F407VG);
    flash.write(KEYR, 0x4567_0123, Time(0)).unwrap();
    assert!(flash.write(KEYR, 0, Time(0)).is_err());
    assert!(flash.take_bus_error());
    let _ = flash.write(KEYR, 0x4567_0123, Time(0));
    let _ = flash.write(KEYR, 0xCDEF_89AB, Time(0));
    assert_eq!(flash.read(CR, Time(0)), Ok(0x8000_0000));
    flash.reset();
    assert_eq!(unlock(flash).read(CR, Time(0)), Ok(0));
}

#[test]
fn each_refusal_has_its_flag() {
    let mut flash = unlocked();
    let word = 0_u32.to_le_bytes();
    assert!(matches!(flash.store(0, &word, Time(0)), Store::Refused(_)));
    assert_eq!(status(&mut flash, Time(0)), 0x80, "PGSERR: PG not set");
    flash.write(SR, 0x80, Time(0)).unwrap();
    flash.write(CR, CR_PG, Time(0)).unwrap();
    flash.store(0, &word, Time(0));
    assert_eq!(status(&mut flash, Time(0)), 0x40, "PGPERR: x8 is set");
    flash.write(SR, 0x40, Time(0)).unwrap();
    flash.write(CR, CR_PG | X32, Time(0)).unwrap();
    flash.store(14, &word, Time(0));
    assert_eq!(status(&mut flash, Time(0)), 0x20, "PGAERR: crosses a row");
    flash.write(SR, 0x20, Time(0)).unwrap();
    flash.protect_sector(0, true);
    flash.write(CR, CR_PG | X32 | CR_ERRIE, Time(0)).unwrap();
    flash.store(0, &word, Time(0));
    assert_eq!(status(&mut flash, Time(0)), 0x12, "WRPERR, and OPERR because of ERRIE");
    assert_eq!(flash.active(), [4]);
    assert!(flash.array.bytes().iter().all(|&byte| byte == 0xFF), "nothing was written");
}

#[test]
fn end_of_operation_shows_only_with_its_interrupt_enabled() {
    let mut flash = unlocked();
    flash.write(CR, CR_PG | X32 | CR_EOPIE, Time(0)).unwrap();
    flash.store(0, &[0; 4], Time(0));
    flash.advance(Time(16_000_000));
    assert_eq!(status(&mut flash, Time(16_000_000)), 1);
    assert_eq!(flash.active(), [4]);
    flash.write(SR, 1, Time(16_000_000)).unwrap();
    assert_eq!(status(&mut flash, Time(16_000_000)), 0);
}

#[test]
fn a_write_while_busy_waits_for_the_end() {
    let mut flash = unlocked();
    flash.write(CR, CR_PG | X32, Time(0)).unwrap();
    flash.store(0, &[0; 4], Time(0));
    flash.store(4, &[0; 4], Time(1_000_000));
    assert_eq!(flash.take_wait(), Some(Time(16_000_000)));
    assert_eq!(flash.busy_until(), Some(Time(32_000_000)));
}

#[test]
fn a_locked_register_does_not_change() {
    let mut flash = locked(&STM32F407VG);
    assert!(flash.write(CR, CR_PG, Time(0)).is_err());
    assert_eq!(flash.read(CR, Time(0)), Ok(CR_LOCK));
}

const OPTCR: u32 = 0x14;

/// Writes the two keys into OPTKEYR.
fn open_options(mut flash: Flash) -> Flash {
    flash.write(0x08, 0x0819_2A3B, Time(0)).unwrap();
    flash.write(0x08, 0x4C5D_6E7F, Time(0)).unwrap();
    flash
}

fn with_open_options() -> Flash {
    open_options(unlocked())
}

/// RM0090 section 3.7.2: the register, then OPTSTRT, then BSY.
#[test]
fn option_bytes_take_their_time_and_protect_then() {
    let mut flash = with_open_options();
    flash.write(OPTCR, 0x0FFC_AAEC, Time(0)).unwrap();
    flash.write(OPTCR, 0x0FFC_AAEE, Time(0)).unwrap();
    assert_eq!(flash.read(OPTCR, Time(0)), Ok(0x0FFC_AAEE), "OPTSTRT is set until the end");
    assert_eq!(status(&mut flash, Time(0)), 0x0001_0000);
    let end = Time(250_000_000_000);
    assert_eq!(flash.read(OPTCR, end), Ok(0x0FFC_AAEC));
    flash.write(CR, CR_SER | 1 << 3 | X32 | CR_STRT, end).unwrap();
    assert_eq!(status(&mut flash, end), 0x10, "WRPERR: sector 1");
    flash.write(SR, 0x10, end).unwrap();
    flash.write(CR, CR_SER | 2 << 3 | X32 | CR_STRT, end).unwrap();
    assert_eq!(status(&mut flash, end), 0x0001_0000, "sector 2 is erased");
    flash.reset();
    assert_eq!(flash.read(OPTCR, end), Ok(0x0FFC_AAED), "kept over a reset, and locked");
}

#[test]
fn leaving_read_out_protection_erases_the_array() {
    let mut flash = with_open_options();
    flash.options.preset_read_protection(0x55);
    flash.array.bytes_mut().fill(0);
    flash.write(OPTCR, 0x0FFF_AAEE, Time(0)).unwrap();
    flash.advance(Time(u64::MAX));
    assert!(flash.array.bytes().iter().all(|&byte| byte == 0xFF));
}

#[test]
fn a_cut_while_option_bytes_are_programmed_leaves_level_1() {
    for (when, wanted) in
        [(Cut::Before, 0x0FFF_AAED), (Cut::After, 0x0FFC_AAED), (Cut::Torn { seed: 1 }, 0x0FFF_FFED)]
    {
        let mut flash = with_open_options();
        flash.cut_power_at(Some(FlashCut { operation: 0, when }));
        flash.write(OPTCR, 0x0FFC_AAEE, Time(0)).unwrap();
        assert!(flash.power_has_failed());
        flash.lose_power(0);
        flash.reset();
        assert_eq!(flash.read(OPTCR, Time(0)), Ok(wanted), "{when:?}");
    }
    let mut flash = with_open_options();
    flash.write(OPTCR, 0x0FFC_AAEE, Time(0)).unwrap();
    flash.reset();
    assert_eq!(flash.read(OPTCR, Time(0)), Ok(0x0FFF_FFED), "a reset breaks it off as well");
}

#[test]
fn power_cuts_strike_before_after_and_in_the_middle() {
    for (when, wanted) in
        [(Cut::Before, Some([0xFF; 4])), (Cut::After, Some([0; 4])), (Cut::Torn { seed: 1 }, None)]
    {
        let mut flash = unlocked();
        flash.write(CR, CR_PG | X32, Time(0)).unwrap();
        flash.cut_power_at(Some(FlashCut { operation: 1, when }));
        flash.store(0, &[0; 4], Time(0));
        flash.advance(Time(16_000_000));
        assert!(!flash.power_has_failed());
        assert_eq!(flash.array.bytes()[..4], [0; 4]);
        flash.store(4, &[0; 4], Time(20_000_000));
        assert!(flash.power_has_failed());
        let found = &flash.array.bytes()[4..8];
        match wanted {
            Some(bytes) => assert_eq!(found, bytes),
            None => assert!(found != [0xFF; 4] && found != [0; 4], "torn: {found:02X?}"),
        }
    }
}
