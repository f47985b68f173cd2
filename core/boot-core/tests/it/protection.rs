//! Sectors that the option bytes protect against writing: a program that they keep from being replaced is
//! not given up.

use boot_core::flash::is_write_protected;
use boot_core::store::{Journal, Parameters as _};
use canopen::AbortCode;
use kit::bench::CLEAR;
use kit::rig::{
    block, hex, image, words, Rig, AT_ONCE_2, ESACADEMY_1, LIFT_1, PAULUS_1, PRODUCT_CODE, STANDARD_1,
};

/// Program 1 of the model: sector 4 with 400h bytes, then 5 to 11 with 800h each.
const FIRST: u8 = 4;
const LAST: u8 = 11;

/// 1F57h of a protected sector: 0Eh, and the sector in the upper half.
fn secured(sector: u8) -> u32 {
    u32::from(sector) << 16 | 0x0E
}

/// The program is there as it was, and starts.
fn assert_stays(rig: &mut Rig, image: &[u8], what: &str) {
    assert_eq!(&rig.cells(1)[..image.len()], image, "{what}");
    rig.assert_installed(1, image, what);
}

/// In each profile and form, for a protected sector at each place of the new program.
#[test]
fn a_protected_sector_costs_nothing() {
    for setup in [&STANDARD_1, &PAULUS_1, &ESACADEMY_1, &LIFT_1] {
        let (old, new) = (image(setup, 1, 900, 1), image(setup, 1, 5000, 2));
        let base = setup.region(1).base;
        for (form, data) in [("raw", new.clone()), ("HEX", hex(base, &new))] {
            for sector in [FIRST, 5, 6] {
                let what = format!("{}, {form}, sector {sector}", setup.name);
                let mut rig = Rig::new(setup, 8192);
                rig.install(1, &old);
                rig.chip.model().protected = vec![sector];
                // A password gives up a program, unless its flash is protected; data then get nowhere.
                let status = rig.status_of(1, &data);
                assert_eq!(status & 0xFFFF, 0x0E, "{what}");
                assert_eq!(status >> 16, u32::from(sector), "{what}");
                assert_stays(&mut rig, &old, &what);
                rig.chip.model().protected.clear();
                assert_eq!(rig.status_of(1, &data), 0, "{what}");
                assert_eq!(&rig.cells(1)[..new.len()], new, "{what}");
            }
        }
    }
}

/// Where the size of a program is known before its data are written, sectors after it do not matter.
#[test]
fn only_the_sectors_of_the_program_count_where_its_size_is_known() {
    let (old, new) = (image(&STANDARD_1, 1, 900, 1), image(&STANDARD_1, 1, 3000, 2));
    let base = STANDARD_1.region(1).base;
    // 3000 bytes end in sector 5: 400h and 7B8h.
    for (data, sector, takes) in [
        (new.clone(), 5, false),
        (new.clone(), 6, true),
        (new.clone(), LAST, true),
        // Complete before the first of it is written.
        (hex(base, &new), LAST, true),
        (hex(base, &new), 5, false),
    ] {
        let mut rig = Rig::new(&STANDARD_1, 8192);
        rig.install(1, &old);
        rig.chip.model().protected = vec![sector];
        let status = rig.status_of(1, &data);
        assert_eq!(status, if takes { 0 } else { secured(sector) }, "sector {sector}");
        if !takes {
            assert_stays(&mut rig, &old, "it is not taken");
        }
    }
}

/// Otherwise all of the region counts: HEX does not tell its size.
#[test]
fn all_sectors_count_where_the_size_is_not_known() {
    let (old, new) = (image(&STANDARD_1, 1, 900, 1), image(&STANDARD_1, 1, 3000, 2));
    let mut rig = Rig::new(&STANDARD_1, 8192);
    rig.install(1, &old);
    rig.chip.model().protected = vec![LAST];
    rig.command(1, CLEAR).unwrap();
    rig.begin(1, None, &hex(STANDARD_1.region(1).base, &new)[..5000]).unwrap();
    rig.settle();
    assert_eq!(rig.status(1), secured(LAST));
    assert_stays(&mut rig, &old, "HEX in the middle");
}

/// A block file names its size in block 0; the first block with data is refused, and no other follows.
#[test]
fn blocks_are_refused_before_the_record_is_removed() {
    let (old, new) = (image(&STANDARD_1, 1, 900, 1), image(&STANDARD_1, 1, 3000, 2));
    let base = STANDARD_1.region(1).base;
    let control = block(0, 0, &words(&[3000, 0, PRODUCT_CODE]));
    for (sector, takes) in [(FIRST, false), (5, false), (6, true)] {
        let mut rig = Rig::new(&STANDARD_1, 8192);
        rig.install(1, &old);
        rig.chip.model().protected = vec![sector];
        rig.clear(1);
        assert_eq!(rig.status(1), 0, "CLEAR alone loses nothing");
        rig.send_all(1, [&control]);
        let sent = rig.send(1, &block(1, base, &new[..1000]));
        rig.settle();
        if takes {
            assert_eq!((sent, rig.status(1)), (Ok(()), 0));
            continue;
        }
        assert_eq!(rig.status(1), secured(sector));
        assert!(rig.send(1, &block(2, base + 1000, &new[1000..])).is_err());
        let journal = Journal::open(&rig.chip, STANDARD_1.layout.parameters);
        let record = journal.program(&rig.chip, 1).expect("the record stays");
        assert_eq!(record.size, 900);
        assert_stays(&mut rig, &old, "after a block");
    }
}

/// Somebody protects a sector in the middle of a download: the erase of a sector that is still to come names
/// it, and so does a word in one that was erased before.
#[test]
fn a_sector_that_is_protected_in_mid_download_is_named() {
    let new = image(&STANDARD_1, 1, 5000, 2);
    let base = STANDARD_1.region(1).base;
    let control = block(0, 0, &words(&[5000, 0, PRODUCT_CODE]));
    // Block 1 ends in sector 5, which is erased for it. Block 2 ends there as well, block 3 in sector 6.
    for (sector, sent) in [(5, 1), (6, 2)] {
        let mut rig = Rig::new(&STANDARD_1, 8192);
        rig.clear(1);
        rig.send(1, &control).unwrap();
        let mut blocks = (1..).zip([(0, 1200), (1200, 2000), (2000, 4000)]);
        let mut send = |rig: &mut Rig| {
            let (number, (from, to)) = blocks.next().unwrap();
            let _ = rig.send(1, &block(number, base + from, &new[from as usize..to]));
            rig.settle();
            rig.status(1)
        };
        for _ in 0..sent {
            assert_eq!(send(&mut rig), 0);
        }
        rig.chip.model().protected = vec![sector];
        assert_eq!(send(&mut rig), secured(sector));
    }
}

/// A CLEAR that erases, at once or as the second one, needs all of the region.
#[test]
fn a_clear_that_erases_loses_nothing_either() {
    for (setup, times) in [(&STANDARD_1, 2), (&AT_ONCE_2, 1)] {
        let old = image(setup, 1, 900, 1);
        let last = if times == 2 { LAST } else { 7 };
        for sector in [FIRST, last] {
            let mut rig = Rig::new(setup, 8192);
            rig.install(1, &old);
            rig.chip.model().protected = vec![sector];
            for _ in 0..times {
                rig.clear(1);
            }
            assert_eq!(rig.status(1), secured(sector), "{}", setup.name);
            assert_stays(&mut rig, &old, setup.name);
        }
    }
}

/// A CLEAR in the middle of a download that is acknowledged erases, where the product erases at once.
#[test]
fn a_clear_at_once_erases_in_the_middle_of_a_download() {
    let image = image(&AT_ONCE_2, 1, 3000, 1);
    for steps in [0, 1, 2, 5, 20, 100, 1000] {
        let mut rig = Rig::new(&AT_ONCE_2, 8192);
        rig.clear(1);
        rig.begin(1, Some(3000), &image[..1400]).unwrap();
        rig.steps(steps);
        if rig.command(1, CLEAR) == Err(AbortCode::DEVICE_STATE) {
            panic!("after {steps} steps: CLEAR of the own download is not refused");
        }
        rig.settle();
        assert_eq!(rig.status(1), 0, "after {steps} steps");
        assert!(rig.cells(1).iter().all(|byte| *byte == 0xFF), "after {steps} steps");
        rig.install(1, &image);
        assert_eq!(&rig.cells(1)[..3000], image, "after {steps} steps");
    }
}

/// RM0090 sections 3.9.10 and 3.9.11: nWRP in bits 16 to 27 of each register, 0 protects; with SPRMOD (bit
/// 31 of OPTCR, STM32F42x and F43x, F446) 1 protects.
#[test]
fn the_option_bytes_are_read_as_the_manual_has_them() {
    /// OPTCR and OPTCR1 from the factory.
    const FACTORY: (u32, u32) = (0x0FFF_AAED, 0x0FFF_0000);
    let protects =
        |optcr, optcr1| (0..24).filter(|n| is_write_protected(*n, optcr, optcr1)).collect::<Vec<u8>>();
    assert!(protects(FACTORY.0, FACTORY.1).is_empty());
    for sector in 0..12 {
        assert_eq!(protects(FACTORY.0 & !(1 << (16 + sector)), FACTORY.1), [sector]);
        assert_eq!(protects(FACTORY.0, FACTORY.1 & !(1 << (16 + sector))), [12 + sector]);
        let only = 1 << (16 + sector);
        assert_eq!(protects(0x8000_AAED | only, 0), [sector]);
        assert_eq!(protects(0x8000_AAED, only), [12 + sector]);
    }
}
