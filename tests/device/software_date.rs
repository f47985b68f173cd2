//! 1F52h (CiA 302-3, verify application software): date and time of the program, in the bootloader, in the
//! application template and in the application in C.

use coboot_tests::bench::{Bench, NODE};
use coboot_tests::firmware;
use coflash_core::file::convert::{program_of, Label, Options};
use coflash_core::file::Program;
use coflash_core::update::{flash, FlashOptions};

/// 2026-11-27 18:30:15 UTC, by GNU date; and the days and milliseconds of a calendar.
const DATE: (u64, [u32; 2]) = (1_795_804_215, [15_671, 66_615_000]);
/// 2000-02-29 12:00.
const LEAP_DAY: (u64, [u32; 2]) = (951_825_600, [5903, 43_200_000]);

/// An application whose block 0 has this date.
fn dated(image: &str, date: u64) -> Program {
    let elf =
        coflash_core::file::read::load(&firmware::dir().join(image), None, None).expect("an ELF of ours");
    let options = Options::default()
        .region(coflash_core::file::convert::Region::Strict(firmware::board().programs[0].into()))
        .label(Label::OfImage { date });
    program_of(elf, &options).expect("it lies in the program's flash").program
}

fn date(bench: &mut Bench) -> [u32; 2] {
    assert_eq!(bench.number(0x1F52, 0), 2);
    [1, 2].map(|sub| bench.number(0x1F52, sub))
}

#[test]
fn every_program_and_its_bootloader_have_the_date_of_the_program() {
    let mut bench = Bench::new().switched_on();
    assert_eq!(date(&mut bench), [0, 0], "no program");
    for (image, (seconds, expected)) in [
        (firmware::APP_V1, DATE),
        (firmware::APP_C, LEAP_DAY),
        // Neither block 0 nor label has one.
        (firmware::APP_V1, (0, [0, 0])),
        (firmware::APP_C, DATE),
    ] {
        let file = dated(image, seconds);
        flash(&mut bench.session(), &file, &FlashOptions::default().force(true), &mut |_| {}).unwrap();
        assert!(!bench.is_bootloader(NODE));
        assert_eq!(date(&mut bench), expected, "{image} runs");
        bench.power_cycle();
        bench.run_ms(500);
        assert!(!bench.is_bootloader(NODE));
        assert_eq!(date(&mut bench), expected, "{image} runs after a power cut");
        bench.call_back();
        assert_eq!(date(&mut bench), expected, "{image} is installed");
    }
    bench.assert_nothing_unmodelled();
}
