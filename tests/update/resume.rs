//! Updates of the real firmware whose power is cut: the next one goes on where they stopped.
//! `sim/node/tests/it/cuts.rs` cuts in all ways, on the model of the flash, many more times.

use canopen::program::PROGRAM_ID;
use canopen::{Address, BitRate};
use coboot_tests::bench::{Bench, NODE};
use coboot_tests::firmware;
use coboot_tests::fleet::file;
use coflash_core::update::event::{Phase, Warning};
use coflash_core::update::{flash, Event, FlashOptions};
use emulator::machine::{Cut, FlashCut};

/// The data of a block of the file.
const BLOCK: usize = 1008;

/// Files that are longer than what comes while the first sector, of 128 KiB, is erased, on a fast bus;
/// and a slow one, on which nearly nothing waits for the flash.
#[test]
fn an_update_of_a_board_whose_power_is_cut_goes_on() {
    for (rate, kib) in [(BitRate::K1000, 160), (BitRate::K125, 96)] {
        let file = file(kib);
        let size = file.size() as usize;
        let cuts = [Cut::Before, Cut::After, Cut::Torn { seed: 1 }, Cut::Torn { seed: 2 }];
        for (part, when) in (1..).zip(cuts) {
            let mut bench = Bench::at_rate(rate);
            bench.install(firmware::APP_V2);
            let update = |bench: &mut Bench| {
                let mut events = Vec::new();
                let options = FlashOptions::default();
                let result = flash(&mut bench.session(), &*file, &options, &mut |event| events.push(event));
                (result, events)
            };
            let cut = FlashCut { operation: u64::from(file.size()) / 4 * part / 6, when };
            bench.machine().cut_power_at(Some(cut));
            let (result, events) = update(&mut bench);
            assert!(result.is_err(), "{cut:?}: {events:?}");
            let arrived = events.iter().filter_map(|event| match event {
                Event::Progress { done, .. } => Some(*done),
                _ => None,
            });
            let arrived = arrived.max().unwrap_or(0);
            let program = &bench.machine().flash()[firmware::program_offset()..];
            let both = program.iter().zip(file.flash_image().into_owned());
            let in_flash = both.take_while(|(cell, byte)| **cell == *byte).count();
            bench.machine().cut_power_at(None);
            bench.power_on();
            bench.run_ms(500);

            let (result, events) = update(&mut bench);
            result.unwrap_or_else(|error| panic!("{error}, {cut:?}: {events:?}"));
            let began_again = |event: &Event| matches!(event, Event::Warning(Warning::BeginsAgain { .. }));
            assert!(!events.iter().any(began_again), "{cut:?}: {events:?}");
            let went_on = events.iter().find_map(|event| match event {
                Event::Phase(Phase::GoingOn { done, .. }) => Some(*done),
                _ => None,
            });
            let done = went_on.unwrap_or_else(|| panic!("from the start, {cut:?}: {events:?}"));
            // The device stores its progress in steps of this many bytes, at the end of a block.
            let step = BLOCK + (size / 16).max(1024);
            println!(
                "{rate:?}, {cut:?}: {arrived} bytes had arrived, {in_flash} were in flash, {done} count"
            );
            assert!(done + step >= in_flash.min(arrived), "{cut:?}: {done}");
            // With the power the device loses what waits in RAM for the flash.
            let waited = arrived.saturating_sub(in_flash);
            assert!(arrived.saturating_sub(done) <= size / 10 + waited, "{cut:?}: {done} of {arrived}");
            assert!(!bench.is_bootloader(NODE), "{cut:?}");
            let crc = bench.session().read_number(Address::new(PROGRAM_ID, 1)).unwrap();
            assert_eq!(crc, file.crc(), "{cut:?}");
            bench.assert_nothing_unmodelled();
        }
    }
}
