//! The journal: stored values are read back, whenever the power is cut.

mod model;

use boot_core::flash::{run, Flash, FlashFault, Operation};
use boot_core::store::{Journal, Key, Parameters, StoreError, Value};
use model::{quiet_power_cuts, until_power_cut, Cut, ModelFlash};
use shared_abi::geometry::{Geometry, Region, SectorRun};
use shared_abi::layout::stm32f407g_disc1::LAYOUT;

/// A chip with sectors so small that the journal is compacted every few records.
static SMALL: Geometry = Geometry {
    chip: "small",
    flash: Region::new(0x0800_0000, 4 * 256),
    sectors: &[SectorRun { count: 4, size: 256 }],
    ..shared_abi::geometry::STM32F407VG
};
const REGIONS: [Region; 2] = [Region::new(0x0800_0100, 256), Region::new(0x0800_0200, 256)];

fn store(flash: &mut ModelFlash, journal: &mut Journal, key: Key, value: Value) -> Result<(), StoreError> {
    journal.store(key, value);
    run(flash, |flash, outcome| journal.next(flash, outcome))
}

#[test]
fn values_survive_a_restart_and_any_number_of_compactions() {
    let mut flash = ModelFlash::new(&SMALL);
    let mut journal = Journal::open(&flash, REGIONS);
    assert_eq!(journal.get(&flash, Key::CrashCount), None);
    for i in 0..200 {
        store(&mut flash, &mut journal, Key::Program(1 + (i % 3) as u8), [i, !i, i * 7, 0]).unwrap();
        let reopened = Journal::open(&flash, REGIONS);
        for age in 0..3.min(i + 1) {
            let j = i - age;
            for journal in [&journal, &reopened] {
                let value = journal.get(&flash, Key::Program(1 + (j % 3) as u8));
                assert_eq!(value, Some([j, !j, j * 7, 0]));
            }
        }
    }
    let outside =
        flash.touched.iter().find(|touched| !REGIONS.iter().any(|r| r.contains(touched.base, touched.size)));
    assert_eq!(outside, None, "the journal wrote outside its regions");
}

/// Cuts the power at every operation of a long history, in every way, and again in the recovery.
#[test]
fn after_any_cut_the_old_or_the_new_value_is_read_and_the_neighbour_is_untouched() {
    quiet_power_cuts();
    const STORES: u32 = 25;
    let history = |flash: &mut ModelFlash, done: &mut u32| {
        let mut journal = Journal::open(flash, REGIONS);
        store(flash, &mut journal, Key::CrashCount, [0xC0FFEE, 0, 0, 0]).unwrap();
        for i in 1..=STORES {
            store(flash, &mut journal, Key::Program(1), [i, i, i, i]).unwrap();
            *done = i;
        }
    };
    let mut flash = ModelFlash::new(&SMALL);
    let mut done = 0;
    history(&mut flash, &mut done);
    let operations = flash.operations;
    assert!(operations > 200, "the history must contain compactions: {operations}");

    let mut points = 0;
    for operation in 1..=operations {
        for cut in [Cut::Before, Cut::After, Cut::Torn(1), Cut::Torn(2), Cut::Unstable(1), Cut::Unstable(2)] {
            let mut flash = ModelFlash::new(&SMALL);
            flash.cut = Some((operation, cut));
            let mut done = 0;
            assert!(until_power_cut(|| history(&mut flash, &mut done)));
            flash.power_on();
            let at = format!("cut {cut:?} at operation {operation}, {done} stores done");

            let check = |flash: &ModelFlash, newest: u32| {
                let journal = Journal::open(flash, REGIONS);
                let value = journal.get(flash, Key::Program(1));
                let expected = [done, newest].map(|i| (i > 0).then_some([i; 4]));
                assert!(expected.contains(&value), "{at}: {value:?}");
                if done > 0 {
                    assert_eq!(journal.get(flash, Key::CrashCount), Some([0xC0FFEE, 0, 0, 0]), "{at}");
                }
            };
            check(&flash, done + 1);

            // The next store, with a second cut in it.
            for second in 1..=8 {
                flash.cut = Some((second, cut));
                let recovered = until_power_cut(|| {
                    let mut journal = Journal::open(&flash, REGIONS);
                    store(&mut flash, &mut journal, Key::Program(1), [done + 1; 4]).unwrap();
                });
                flash.power_on();
                check(&flash, done + 1);
                points += 1;
                if !recovered {
                    break;
                }
            }
            let mut journal = Journal::open(&flash, REGIONS);
            store(&mut flash, &mut journal, Key::Program(1), [777; 4]).unwrap();
            let journal = Journal::open(&flash, REGIONS);
            assert_eq!(journal.get(&flash, Key::Program(1)), Some([777; 4]), "{at}");
        }
    }
    assert!(points > 1000, "{points}");
}

#[test]
fn noise_in_both_regions_is_an_empty_journal() {
    let mut flash = ModelFlash::new(&SMALL);
    for (region, byte) in REGIONS.iter().zip([0x00, 0xA5]) {
        flash.poke(region.base, &[byte; 256]);
    }
    let mut journal = Journal::open(&flash, REGIONS);
    assert_eq!(journal.get(&flash, Key::Program(1)), None);
    store(&mut flash, &mut journal, Key::Program(1), [5; 4]).unwrap();
    assert_eq!(Journal::open(&flash, REGIONS).get(&flash, Key::Program(1)), Some([5; 4]));
}

#[test]
fn errors_of_the_flash_are_told_and_the_old_value_stays() {
    for operation in 1..=6 {
        let mut flash = ModelFlash::new(&SMALL);
        let mut journal = Journal::open(&flash, REGIONS);
        store(&mut flash, &mut journal, Key::Program(1), [1; 4]).unwrap();
        flash.fail = Some((flash.operations + operation, FlashFault::Protected));
        let outcome = store(&mut flash, &mut journal, Key::Program(1), [2; 4]);
        assert_eq!(outcome, Err(StoreError::Flash(FlashFault::Protected)));
        assert_eq!(Journal::open(&flash, REGIONS).get(&flash, Key::Program(1)), Some([1; 4]));
    }
}

#[test]
fn the_real_regions_hold_hundreds_of_records_between_two_erases() {
    let slots = LAYOUT.parameters[0].size / 24;
    assert!(slots > 600, "{slots}");
}

/// A slot as in docs/adr/0004: five words and their CRC.
fn slot(words: [u32; 5]) -> Vec<u8> {
    let mut bytes: Vec<u8> = words.iter().flat_map(|word| word.to_le_bytes()).collect();
    bytes.extend(boot_core::crc32(&bytes).to_le_bytes());
    bytes
}

#[test]
fn a_journal_of_an_older_version_is_read_and_moves_to_this_one_and_a_newer_one_is_not_read() {
    for (version, known) in [(0, true), (1, true), (2, false)] {
        let mut flash = ModelFlash::new(&SMALL);
        let magic = u32::from_le_bytes(*b"CBNV");
        flash.poke(REGIONS[0].base, &slot([magic, 7, !7, version, u32::MAX]));
        flash.poke(REGIONS[0].base + 24, &slot([0x0001_0002, 1, 2, 3, 4]));
        let mut journal = Journal::open(&flash, REGIONS);
        assert_eq!(journal.get(&flash, Key::Program(2)), known.then_some([1, 2, 3, 4]), "version {version}");
        if version == 0 {
            store(&mut flash, &mut journal, Key::CrashCount, [9, 0, 0, 0]).unwrap();
            let reopened = Journal::open(&flash, REGIONS);
            assert_eq!(reopened.get(&flash, Key::Program(2)), Some([1, 2, 3, 4]));
            assert_eq!(reopened.get(&flash, Key::CrashCount), Some([9, 0, 0, 0]));
            // The other region, the next sequence number, today's version.
            assert_eq!(flash.cells(REGIONS[1])[..24], slot([magic, 8, !8, 1, u32::MAX]));
        }
    }
}

/// The journal belongs to a newer bootloader, which may return: every store is refused, and no bit
/// changes. This holds for each region of the newer journal, and any contents of the other region.
#[test]
fn a_journal_of_a_newer_version_refuses_every_store_and_stays_as_it_is() {
    let header = |sequence: u32, version| {
        let magic = u32::from_le_bytes(*b"CBNV");
        slot([magic, sequence, !sequence, version, u32::MAX])
    };
    let others = [None, Some(header(6, 0)), Some(header(6, 1)), Some(vec![0xA5; 24])];
    for (newer, other) in [0, 1].into_iter().flat_map(|newer| others.clone().map(|other| (newer, other))) {
        let mut flash = ModelFlash::new(&SMALL);
        flash.poke(REGIONS[newer].base, &header(7, 0xFF));
        flash.poke(REGIONS[newer].base + 24, &slot([0x0001_0002, 1, 2, 3, 4]));
        if let Some(other) = &other {
            flash.poke(REGIONS[1 - newer].base, other);
        }
        let before = flash.cells(SMALL.flash).to_vec();
        for key in [Key::CrashCount, Key::Node, Key::Program(1)] {
            let mut journal = Journal::open(&flash, REGIONS);
            let outcome = store(&mut flash, &mut journal, key, [9, 0, 0, 0]);
            let what = format!("{key:?}, newer in region {newer}, {other:?} in the other one");
            assert!(outcome.is_err(), "{what}");
            assert!(flash.cells(SMALL.flash) == before, "{what}: the flash was changed");
        }
    }
}

/// On the chip the core would stall, and every interrupt with it: the model does not allow this
/// call, so that every test detects it.
#[test]
#[should_panic(expected = "flash was read while it is busy")]
fn a_store_that_is_asked_while_the_flash_works_is_caught() {
    let mut flash = ModelFlash::new(&SMALL);
    let mut journal = Journal::open(&flash, REGIONS);
    store(&mut flash, &mut journal, Key::CrashCount, [1; 4]).unwrap();
    flash.start(Operation::Program { address: 0x0800_0300, word: 0 }).unwrap();
    let _ = journal.get(&flash, Key::CrashCount);
}
