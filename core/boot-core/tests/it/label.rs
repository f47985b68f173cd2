//! The label of a program in a block file: the program of another product is refused before
//! anything is lost if the label is in the first block, and never becomes valid if it is in a later
//! one.

use boot_core::control::{AppInfo, Policy, Verdict};
use boot_core::store::{Journal, Parameters as _};
use canopen::od::{Address, Objects};
use canopen::program::FlashError;
use canopen::AbortCode;
use kit::bench::{
    autostart, block, block_file, new_flash, program, Bench, CLEAR, IDENTIFICATION, LAYOUT, SET_SIGNATURE,
    START,
};
use kit::model::{until_power_cut, Cut, ModelFlash, CHIP};
use shared_abi::block_file::Control;
use shared_abi::label::{self, Label};
use shared_abi::warm_start::BootRequest;

const DEVICE: (u32, u32) = (0x0102_0304, 0x0A0B_0C0D);
const POLICY: Policy = Policy { identity: Some(DEVICE), ..Policy::DEFAULT };
const UNFIT: AbortCode = AbortCode(0x0800_0020);
const OLD: u8 = 0xA0;
const NEW: u8 = 0xB0;

/// A program of 700 bytes with this label.
fn labelled(seed: u8, label: &Label) -> Vec<u8> {
    let mut bytes = program(700, seed);
    let at = label::OFFSET as usize;
    bytes[at..at + label::SIZE].copy_from_slice(&label.emit());
    bytes
}

/// A device with a queue for large blocks, and the old program in flash.
fn updated(flash: &mut ModelFlash) -> Bench<'_> {
    let mut bench = Bench::with_buffer(flash, POLICY, 2048);
    bench.release(&program(200, OLD));
    bench.node.flash().touched.clear();
    bench
}

/// The programs of other products, and the value of 1F57h for them.
fn others() -> [(Vec<u8>, u32); 2] {
    [
        (labelled(NEW, &Label::new(DEVICE.0 ^ 1, DEVICE.1, 7)), 0x80),
        (labelled(NEW, &Label::new(DEVICE.0, DEVICE.1 ^ 1, 7)), 0x82),
    ]
}

#[test]
fn a_label_in_the_first_block_is_judged_before_anything_is_lost() {
    let mut flash = ModelFlash::new(&CHIP);
    let mut bench = updated(&mut flash);
    for (other, status) in others() {
        // The data in block 0 do not help, not even the size that may be erased ahead.
        for control in [vec![0; 8], [700, DEVICE.0, DEVICE.1].map(u32::to_le_bytes).concat()] {
            assert_eq!(bench.command(CLEAR), 0);
            bench.good(&block(0, 0, &control));
            assert_eq!(bench.block(&block_file(&other, 512)[1]), (Err(UNFIT), status));
            assert_eq!(bench.node.flash().touched, [], "nothing is lost");
            // The next block is refused, too: there is no way around the first.
            assert_eq!(bench.block(&block_file(&other, 512)[2]).0, Err(AbortCode(0x0800_0022)));
            assert_eq!(bench.command(START), 0);
            assert_eq!(bench.node.take_boot_request(), Some(BootRequest::Start(1)));
        }
    }
    assert_eq!(autostart(&flash), Ok(OLD));
}

#[test]
fn a_label_in_a_later_block_keeps_the_program_from_becoming_one() {
    // The label lies in one block, across two, and across many.
    for chunk in [240, 484, 20] {
        for (other, status) in others() {
            let mut flash = ModelFlash::new(&CHIP);
            let mut bench = updated(&mut flash);
            assert_eq!(bench.command(CLEAR), 0);
            let blocks = block_file(&other, chunk);
            let (end, data) = blocks.split_last().unwrap();
            data.iter().for_each(|block| bench.good(block));
            assert_eq!(bench.block(end), (Ok(()), status), "blocks of {chunk}");
            assert_eq!(bench.read_state(), 3, "no program");
            assert_eq!(bench.command(SET_SIGNATURE), 0x02, "NOVALPROG");
            assert_eq!(bench.command(START), 0x02);
            assert_eq!(bench.node.take_boot_request(), None);
            assert!(autostart(&flash).is_err());
            let mut bench = Bench::with_buffer(&mut flash, POLICY, 2048);
            assert_eq!((bench.read_state(), bench.word(IDENTIFICATION)), (3, 0), "nor after a reset");
            bench.install(&program(200, OLD));
        }
    }
}

#[test]
fn a_label_that_fits_is_taken_and_tells_the_version() {
    let mut damaged = labelled(NEW, &Label::new(DEVICE.0 ^ 1, DEVICE.1, 7));
    damaged[label::OFFSET as usize + 20] ^= 1;
    let dated = |version: u32| [700, DEVICE.0, DEVICE.1, version, 0, 0].map(u32::to_le_bytes).concat();
    for (image, control, version) in [
        (labelled(NEW, &Label::new(DEVICE.0, DEVICE.1, 7)), vec![0; 8], 7),
        (labelled(NEW, &Label::new(0, 0, 7)), vec![0; 8], 7),
        (labelled(NEW, &Label::new(0, DEVICE.1, 7)), dated(9), 9),
        // A damaged label counts as missing.
        (damaged, vec![0; 8], 0),
        (program(700, NEW), dated(9), 9),
        // Data after the end of a program are not its label, whatever was left there.
        (program(200, NEW), vec![0; 8], 0),
    ] {
        for chunk in [512, 96] {
            let mut flash = ModelFlash::new(&CHIP);
            let mut bench = updated(&mut flash);
            assert_eq!(bench.command(CLEAR), 0);
            bench.good(&block(0, 0, &control));
            block_file(&image, chunk)[1..].iter().for_each(|block| bench.good(block));
            assert_eq!(bench.command(SET_SIGNATURE), 0);
            let journal = Journal::open(&flash, LAYOUT.parameters);
            assert_eq!(journal.program(&flash, 1).unwrap().version, version);
            assert_eq!(autostart(&flash), Ok(NEW));
        }
    }
}

/// 1F52h.
fn date(bench: &mut Bench<'_>) -> [u32; 2] {
    [1, 2].map(|sub| bench.word(Address::new(0x1F52, sub)))
}

/// 2000-02-29 12:00 and 2026-11-27 18:30:15, by GNU date.
const LEAP_DAY: u32 = 951_825_600;
const TODAY: u32 = 1_795_804_215;

/// Block 0 with this date and version 1.
fn control(date: u64) -> Vec<u8> {
    let words = [700, DEVICE.0, DEVICE.1, 1, date as u32, (date >> 32) as u32];
    block(0, 0, &words.map(u32::to_le_bytes).concat())
}

/// The date of block 0 precedes that of the label, as its version does. (Days and milliseconds are those of a calendar.)
#[test]
fn date_and_time_are_those_of_block_0_or_of_the_label() {
    let label = |date| Label::dated(DEVICE.0, DEVICE.1, 1, date);
    let mut flash = ModelFlash::new(&CHIP);
    assert_eq!(date(&mut Bench::with_buffer(&mut flash, POLICY, 2048)), [0, 0], "no program");
    let leap_day = [5903, 43_200_000];
    let today = [15_671, 66_615_000];
    for (image, reported, expected) in [
        (labelled(NEW, &label(LEAP_DAY)), 0, leap_day),
        (labelled(NEW, &label(LEAP_DAY)), TODAY.into(), today),
        (labelled(NEW, &label(0)), TODAY.into(), today),
        // The same program again, and another one: what was stored for the first is not its date.
        (labelled(NEW, &label(0)), LEAP_DAY.into(), leap_day),
        (labelled(NEW, &label(0)), 0, leap_day),
        (labelled(OLD, &label(0)), 0, [0, 0]),
        (program(700, NEW), TODAY.into(), today),
        (program(200, NEW), 0, [0, 0]),
        // Dates that 1F52h cannot show.
        (program(700, OLD), u64::from(TODAY) | 1 << 32, [0, 0]),
        (program(700, OLD), 1, [0, 0]),
    ] {
        let mut bench = Bench::with_buffer(&mut flash, POLICY, 2048);
        assert_eq!(bench.command(CLEAR), 0);
        bench.good(&control(reported));
        block_file(&image, 512)[1..].iter().for_each(|block| bench.good(block));
        assert_eq!(date(&mut bench), expected, "{reported}");
        assert_eq!(bench.command(SET_SIGNATURE), 0);
        assert_eq!(date(&mut bench), expected, "{reported}: released");
        let mut bench = Bench::with_buffer(&mut flash, POLICY, 2048);
        assert_eq!(date(&mut bench), expected, "{reported}: after a reset");
        assert_eq!(bench.node.write(Address::new(0x1F52, 1), &[0; 4]), Err(AbortCode(0x0601_0000)));
    }
    let mut bench = Bench::with_buffer(&mut flash, POLICY, 2048);
    bench.command(CLEAR);
    bench.command(CLEAR);
    assert_eq!(date(&mut bench), [0, 0], "erased");
}

/// Cuts the power at each operation of an update of this flash, in each way. `look` gets what is
/// left, and the cut in words.
fn cut_at_each_operation(
    mut installed: ModelFlash,
    update: impl Fn(&mut ModelFlash),
    mut look: impl FnMut(&mut ModelFlash, &str),
) {
    installed.power_on();
    let mut whole = installed.clone();
    update(&mut whole);
    for operation in 1..=whole.operations {
        for cut in [Cut::Before, Cut::After, Cut::Torn(7), Cut::Torn(8)] {
            let mut flash = installed.clone();
            flash.cut = Some((operation, cut));
            assert!(until_power_cut(|| update(&mut flash)));
            flash.power_on();
            look(&mut flash, &format!("cut {cut:?} at operation {operation}"));
        }
    }
    look(&mut whole, "without a cut");
}

/// A program is never seen with the date of another one, wherever the power fails.
#[test]
fn the_date_belongs_to_its_program_after_every_power_cut() {
    let send = |flash: &mut ModelFlash, seed: u8, date: u32| {
        let mut bench = Bench::with_buffer(flash, POLICY, 2048);
        bench.command(CLEAR);
        bench.good(&control(date.into()));
        block_file(&program(700, seed), 512)[1..].iter().for_each(|block| bench.good(block));
        assert_eq!(bench.command(SET_SIGNATURE), 0);
    };
    let mut installed = ModelFlash::new(&CHIP);
    send(&mut installed, OLD, LEAP_DAY);
    let mut seen = [0; 3];
    cut_at_each_operation(
        installed,
        |flash| send(flash, NEW, TODAY),
        |flash, cut| {
            let (place, expected) = match autostart(flash) {
                Ok(OLD) => (0, [5903, 43_200_000]),
                Ok(_) => (1, [15_671, 66_615_000]),
                Err(_) => (2, [0, 0]),
            };
            let mut bench = Bench::with_buffer(flash, POLICY, 2048);
            // A program that is not released has a date, too; the new one alone can be so.
            let expected =
                if place == 2 && bench.read_state() != 3 { [15_671, 66_615_000] } else { expected };
            assert_eq!(date(&mut bench), expected, "{cut}");
            seen[place] += 1;
        },
    );
    assert!(seen.iter().all(|count| *count > 0), "old, new, none: {seen:?}");
}

/// The product's own check also gets the label: block 0 cannot claim another version.
#[test]
fn a_products_own_check_sees_the_label() {
    fn no_downgrade(_: u8, info: &AppInfo<'_>) -> Verdict {
        match info.control {
            // The label's date comes with its version.
            Some(Control::Dated { date, .. }) if date != u64::from(TODAY) => {
                Verdict::Refuse(FlashError::Format)
            }
            Some(Control::Dated { version: 0..=7, .. }) => Verdict::Refuse(FlashError::Unspecified),
            _ => Verdict::Standard,
        }
    }
    let mut bench = Bench::with_buffer(new_flash(), Policy { check: no_downgrade, ..POLICY }, 2048);
    for (version, outcome) in [(7, (Err(UNFIT), 0x7E)), (8, (Ok(()), 0))] {
        let image = labelled(NEW, &Label::dated(DEVICE.0, DEVICE.1, version, TODAY));
        assert_eq!(bench.command(CLEAR), 0);
        let control = block(0, 0, &[700, DEVICE.0, DEVICE.1].map(u32::to_le_bytes).concat());
        bench.good(&control);
        let file = block_file(&image, 512);
        assert_eq!(bench.block(&file[1]), outcome);
        // Nothing goes on after a refusal.
        if outcome.0.is_err() {
            bench.good(&control);
            assert!(bench.transfer(&file[2]).is_err());
            assert_eq!(bench.node.flash().touched, []);
        }
    }
}

/// An update to the program of another product in small blocks, cut at every operation: the old
/// program starts, or none.
#[test]
fn no_power_cut_makes_a_program_of_another_products() {
    let (other, _) = &others()[1];
    let mut installed = ModelFlash::new(&CHIP);
    updated(&mut installed);
    let update = |flash: &mut ModelFlash| {
        let mut bench = Bench::with(flash, POLICY);
        bench.command(CLEAR);
        for block in block_file(other, 96) {
            bench.block(&block).0.unwrap();
        }
        bench.command(SET_SIGNATURE);
    };
    let mut seen = [0; 2];
    cut_at_each_operation(installed, update, |flash, cut| match autostart(flash) {
        Ok(OLD) => seen[0] += 1,
        Err(_) => seen[1] += 1,
        other => panic!("{cut}: {other:?} would start"),
    });
    assert!(seen[0] + seen[1] > 600 && seen.iter().all(|count| *count > 0), "{seen:?}");
}
