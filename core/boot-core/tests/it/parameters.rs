//! The journal: stored values are read back, whenever the power is cut.

use boot_core::bootloader::Config;
use boot_core::control::Sealed;
use boot_core::flash::{run, Flash, FlashFault, Operation};
use boot_core::store::{Journal, Key, NodeParameters, Parameters, ProgramRecord, StoreError, Value};
use canopen::od::{Address, Objects};
use canopen::{BitRate, Instant, NodeId};
use kit::bench::{block, node, program, Bench, CLEAR, CLR_SIGNATURE, CONFIG, CONTROL, DATA, START};
use kit::boot::Boot;
use kit::model::{until_power_cut, Cut, ModelFlash, ONE_PROGRAM};
use kit::renewal::LARGE_JOURNAL;
use shared_abi::geometry::{Geometry, Region, SectorRun};
use shared_abi::layout::stm32f407g_disc1::LAYOUT;
use shared_abi::layout::Layout;

/// A chip with sectors so small that the journal is compacted every few records.
static SMALL: Geometry = Geometry {
    chip: "small",
    flash: Region::new(0x0800_0000, 4 * 256),
    sectors: &[SectorRun { count: 4, size: 256 }],
    ..shared_abi::geometry::STM32F407VG
};
const REGIONS: [Region; 2] = [Region::new(0x0800_0100, 256), Region::new(0x0800_0200, 256)];

fn empty() -> (ModelFlash, Journal) {
    let flash = ModelFlash::new(&SMALL);
    let journal = Journal::open(&flash, REGIONS);
    (flash, journal)
}

fn store(flash: &mut impl Flash, journal: &mut Journal, key: Key, value: Value) -> Result<(), StoreError> {
    journal.store(key, value);
    run(flash, |flash, outcome| journal.next(flash, outcome))
}

#[test]
fn values_survive_a_restart_and_any_number_of_compactions() {
    let (mut flash, mut journal) = empty();
    assert_eq!(journal.get(&flash, Key::CRASH_COUNT), None);
    for i in 0..200 {
        store(&mut flash, &mut journal, Key::program(1 + (i % 3) as u8), [i, !i, i * 7, 0]).unwrap();
        let reopened = Journal::open(&flash, REGIONS);
        for age in 0..3.min(i + 1) {
            let j = i - age;
            for journal in [&journal, &reopened] {
                let value = journal.get(&flash, Key::program(1 + (j % 3) as u8));
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
    const STORES: u32 = 25;
    let history = |flash: &mut ModelFlash, done: &mut u32| {
        let mut journal = Journal::open(flash, REGIONS);
        store(flash, &mut journal, Key::CRASH_COUNT, [0xC0FFEE, 0, 0, 0]).unwrap();
        for i in 1..=STORES {
            // The RAM image compacts it when it is idle; the next value comes after it, or in the middle.
            if i % 4 == 0 && journal.compact(1) && i % 8 == 0 {
                run(flash, |flash, outcome| journal.next(flash, outcome)).unwrap();
            }
            store(flash, &mut journal, Key::program(1), [i, i, i, i]).unwrap();
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
                let value = journal.get(flash, Key::program(1));
                let expected = [done, newest].map(|i| (i > 0).then_some([i; 4]));
                assert!(expected.contains(&value), "{at}: {value:?}");
                if done > 0 {
                    assert_eq!(journal.get(flash, Key::CRASH_COUNT), Some([0xC0FFEE, 0, 0, 0]), "{at}");
                }
            };
            check(&flash, done + 1);

            // The next store, with a second cut in it.
            for second in 1..=16 {
                flash.cut = Some((second, cut));
                let recovered = until_power_cut(|| {
                    let mut journal = Journal::open(&flash, REGIONS);
                    store(&mut flash, &mut journal, Key::program(1), [done + 1; 4]).unwrap();
                });
                flash.power_on();
                check(&flash, done + 1);
                points += 1;
                if !recovered {
                    break;
                }
            }
            let mut journal = Journal::open(&flash, REGIONS);
            store(&mut flash, &mut journal, Key::program(1), [777; 4]).unwrap();
            let journal = Journal::open(&flash, REGIONS);
            assert_eq!(journal.get(&flash, Key::program(1)), Some([777; 4]), "{at}");
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
    assert_eq!(journal.get(&flash, Key::program(1)), None);
    store(&mut flash, &mut journal, Key::program(1), [5; 4]).unwrap();
    assert_eq!(Journal::open(&flash, REGIONS).get(&flash, Key::program(1)), Some([5; 4]));
}

#[test]
fn errors_of_the_flash_are_told_and_the_old_value_stays() {
    for operation in 1..=7 {
        let (mut flash, mut journal) = empty();
        store(&mut flash, &mut journal, Key::program(1), [1; 4]).unwrap();
        flash.fail = Some((flash.operations + operation, FlashFault::Protected));
        let outcome = store(&mut flash, &mut journal, Key::program(1), [2; 4]);
        // The last word is the mark, which no reader needs.
        let (expected, value) = match operation {
            7 => (Ok(()), [2; 4]),
            _ => (Err(StoreError::Flash(FlashFault::Protected)), [1; 4]),
        };
        assert_eq!(outcome, expected, "operation {operation}");
        assert_eq!(Journal::open(&flash, REGIONS).get(&flash, Key::program(1)), Some(value));
    }
}

#[test]
fn a_journal_of_an_older_version_is_read_and_moves_to_this_one_and_a_newer_one_is_not_read() {
    for (version, known) in [(0, true), (1, true), (2, false)] {
        let mut flash = ModelFlash::new(&SMALL);
        flash.poke(REGIONS[0].base, &header_of(7, version));
        flash.poke(REGIONS[0].base + SLOT, &slot([0x0001_0002, 1, 2, 3, 4]));
        let mut journal = Journal::open(&flash, REGIONS);
        assert_eq!(journal.get(&flash, Key::program(2)), known.then_some([1, 2, 3, 4]), "version {version}");
        if version == 0 {
            store(&mut flash, &mut journal, Key::CRASH_COUNT, [9, 0, 0, 0]).unwrap();
            let reopened = Journal::open(&flash, REGIONS);
            assert_eq!(reopened.get(&flash, Key::program(2)), Some([1, 2, 3, 4]));
            assert_eq!(reopened.get(&flash, Key::CRASH_COUNT), Some([9, 0, 0, 0]));
            // The other region, the next sequence number, today's version.
            assert_eq!(flash.cells(REGIONS[1])[..SLOT as usize], header(8));
        }
    }
}

/// The journal belongs to a newer bootloader, which may return: every store is refused, and no bit
/// changes. This holds for each region of the newer journal, and any contents of the other region.
#[test]
fn a_journal_of_a_newer_version_refuses_every_store_and_stays_as_it_is() {
    let others = [None, Some(header_of(6, 0)), Some(header_of(6, 1)), Some(vec![0xA5; 24])];
    for (newer, other) in [0, 1].into_iter().flat_map(|newer| others.clone().map(|other| (newer, other))) {
        let mut flash = ModelFlash::new(&SMALL);
        flash.poke(REGIONS[newer].base, &header_of(7, 0xFF));
        flash.poke(REGIONS[newer].base + SLOT, &slot([0x0001_0002, 1, 2, 3, 4]));
        if let Some(other) = &other {
            flash.poke(REGIONS[1 - newer].base, other);
        }
        let before = flash.cells(SMALL.flash).to_vec();
        for key in [Key::CRASH_COUNT, Key::NODE, Key::program(1)] {
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
    let (mut flash, mut journal) = empty();
    store(&mut flash, &mut journal, Key::CRASH_COUNT, [1; 4]).unwrap();
    flash.start(Operation::Program { address: 0x0800_0300, word: 0 }).unwrap();
    let _ = journal.get(&flash, Key::CRASH_COUNT);
}

// --- the bytes

const MAGIC: u32 = u32::from_le_bytes(*b"CBNV");
const SLOT: u32 = 28;

/// A slot as in docs/adr/0004: five words, their CRC, and the mark.
pub(super) fn slot(words: [u32; 5]) -> Vec<u8> {
    let mut bytes = words.map(u32::to_le_bytes).concat();
    bytes.extend(boot_core::crc32(&bytes).to_le_bytes());
    bytes.extend([0; 4]);
    bytes
}

pub(super) fn header_of(sequence: u32, version: u32) -> Vec<u8> {
    slot([MAGIC, sequence, !sequence, version, u32::MAX])
}

fn header(sequence: u32) -> Vec<u8> {
    header_of(sequence, 1)
}

fn record(key: Key, [a, b, c, d]: Value) -> Vec<u8> {
    slot([key.0, a, b, c, d])
}

/// The used slots of a region, one after another; everything after them is blank.
fn used(flash: &ModelFlash, region: Region, slots: usize) -> &[u8] {
    let (used, rest) = flash.cells(region).split_at(slots * SLOT as usize);
    assert!(rest.iter().all(|byte| *byte == 0xFF), "there is more than {slots} slots");
    used
}

/// docs/adr/0004: a device in the field is read by every later bootloader.
#[test]
fn the_first_values_stand_behind_a_header_in_the_first_region() {
    let (mut flash, mut journal) = empty();
    store(&mut flash, &mut journal, Key::NODE, [5, 1, 0, 0]).unwrap();
    store(&mut flash, &mut journal, Key::CRASH_COUNT, [2, 0, 0, 0]).unwrap();
    let expected = [header(1), record(Key::NODE, [5, 1, 0, 0]), record(Key::CRASH_COUNT, [2, 0, 0, 0])];
    assert_eq!(used(&flash, REGIONS[0], 3), expected.concat());
    used(&flash, REGIONS[1], 0);
    assert!(flash.touched.iter().all(|touched| touched.size == 4), "a new device needs no erase");
}

#[test]
fn the_tags_are_those_of_devices_in_the_field() {
    let tags = [Key::program(1), Key::program(254), Key::CRASH_COUNT, Key::NODE].map(|key| key.0);
    assert_eq!(tags, [0x0001_0001, 0x0001_00FE, 0x0002_0000, 0x0003_0000]);
    let tags = [Key::counter(1), Key::counter(254), Key::event(7), Key::GRANTS].map(|key| key.0);
    assert_eq!(tags, [0x0004_0001, 0x0004_00FE, 0x0005_0007, 0x0006_0000]);
}

/// A newer RAM image stores under keys that this resident part does not know: they survive each
/// change of the region.
#[test]
fn an_unknown_key_is_as_good_as_any_other() {
    let (mut flash, mut journal) = empty();
    let unknown = [Key(0x0077_0001), Key(0xFFFF_FFFE), Key(0)];
    for (number, key) in (1..).zip(unknown) {
        store(&mut flash, &mut journal, key, [number; 4]).unwrap();
    }
    for count in 0..50 {
        store(&mut flash, &mut journal, Key::CRASH_COUNT, [count, 0, 0, 0]).unwrap();
        let again = Journal::open(&flash, REGIONS);
        for (number, key) in (1..).zip(unknown) {
            assert_eq!(again.get(&flash, key), Some([number; 4]), "{key:?} after {count}");
        }
    }
    assert!(flash.touched.iter().any(|touched| touched.size > 4), "a region was erased");
}

/// 256 bytes are nine slots: a header and eight records. The ninth record needs the other region.
#[test]
fn a_compaction_copies_the_latest_value_of_each_key_once_and_nothing_else() {
    let (mut flash, mut journal) = empty();
    let stores = [
        (Key::NODE, [5, 1, 0, 0]),
        (Key::program(1), [1; 4]),
        (Key::CRASH_COUNT, [1, 0, 0, 0]),
        (Key::program(1), [2; 4]),
        (Key::program(2), [3; 4]),
        (Key::CRASH_COUNT, [2, 0, 0, 0]),
        (Key::program(1), [4; 4]),
        (Key::program(2), [5; 4]),
    ];
    for (key, value) in stores {
        store(&mut flash, &mut journal, key, value).unwrap();
    }
    used(&flash, REGIONS[1], 0);
    flash.touched.clear();
    store(&mut flash, &mut journal, Key::NODE, [6, 2, 0, 0]).unwrap();
    let expected = [
        header(2),
        record(Key::NODE, [5, 1, 0, 0]),
        record(Key::program(1), [4; 4]),
        record(Key::CRASH_COUNT, [2, 0, 0, 0]),
        record(Key::program(2), [5; 4]),
        record(Key::NODE, [6, 2, 0, 0]),
    ];
    assert_eq!(used(&flash, REGIONS[1], 6), expected.concat());
    // The header comes after the copies, and the new record after the header.
    let sectors: Vec<u32> = flash.touched.iter().filter(|at| at.size > 4).map(|at| at.base).collect();
    assert_eq!(sectors, [REGIONS[1].base]);
    let slots: Vec<u32> =
        flash.touched[1..].chunks(7).map(|words| (words[0].base - REGIONS[1].base) / SLOT).collect();
    assert_eq!(slots, [1, 2, 3, 4, 0, 5]);
    // The next ones follow, and the next compaction goes back to the first region.
    for count in 4..9 {
        store(&mut flash, &mut journal, Key::CRASH_COUNT, [count, 0, 0, 0]).unwrap();
    }
    assert_eq!(flash.cells(REGIONS[0])[..SLOT as usize], header(3));
    let journal = Journal::open(&flash, REGIONS);
    assert_eq!(journal.get(&flash, Key::NODE), Some([6, 2, 0, 0]));
    assert_eq!(journal.get(&flash, Key::CRASH_COUNT), Some([8, 0, 0, 0]));
}

/// What is in a region without a header is not a value: neither at once, nor when the region
/// gets a header.
#[test]
fn what_was_left_in_a_region_never_becomes_a_value() {
    let leftover = record(Key::program(1), [9; 4]);
    for slots_before in 1..9 {
        let mut flash = ModelFlash::new(&SMALL);
        flash.poke(REGIONS[0].base + slots_before * SLOT, &leftover);
        let mut journal = Journal::open(&flash, REGIONS);
        assert_eq!(journal.get(&flash, Key::program(1)), None);
        store(&mut flash, &mut journal, Key::NODE, [5, 1, 0, 0]).unwrap();
        for journal in [journal, Journal::open(&flash, REGIONS)] {
            assert_eq!(journal.get(&flash, Key::program(1)), None, "slot {slots_before}");
            assert_eq!(journal.get(&flash, Key::NODE), Some([5, 1, 0, 0]), "slot {slots_before}");
        }
    }
    // The same in the region that a compaction goes to: power failed before its header was written.
    let mut flash = ModelFlash::new(&SMALL);
    flash.poke(REGIONS[0].base, &header(7));
    for n in 1..9 {
        flash.poke(REGIONS[0].base + n * SLOT, &record(Key::CRASH_COUNT, [n, 0, 0, 0]));
    }
    flash.poke(REGIONS[1].base + 4 * SLOT, &leftover);
    let mut journal = Journal::open(&flash, REGIONS);
    store(&mut flash, &mut journal, Key::NODE, [5, 1, 0, 0]).unwrap();
    let journal = Journal::open(&flash, REGIONS);
    assert_eq!(journal.get(&flash, Key::program(1)), None);
    assert_eq!(journal.get(&flash, Key::CRASH_COUNT), Some([8, 0, 0, 0]));
    assert_eq!(journal.get(&flash, Key::NODE), Some([5, 1, 0, 0]));
}

#[test]
fn the_region_with_the_later_sequence_number_counts_also_across_its_wrap() {
    for (first, second, latest) in [
        (7, 8, 1),
        (8, 7, 0),
        (u32::MAX, 0, 1),
        (0, u32::MAX, 0),
        (0x7FFF_FFFF, 0x8000_0000, 1),
        (1, 1, 0),
        (0, 0, 0),
    ] {
        let mut flash = ModelFlash::new(&SMALL);
        for (n, (region, sequence)) in (0..).zip(REGIONS.into_iter().zip([first, second])) {
            flash.poke(region.base, &header(sequence));
            flash.poke(region.base + SLOT, &record(Key::NODE, [10 + n, 0, 0, 0]));
        }
        let journal = Journal::open(&flash, REGIONS);
        let what = format!("{first:#x}, {second:#x}");
        assert_eq!(journal.get(&flash, Key::NODE), Some([10 + latest, 0, 0, 0]), "{what}");
        // The next region to be valid gets the next number.
        let mut journal = journal;
        for n in 0..10 {
            store(&mut flash, &mut journal, Key::CRASH_COUNT, [n, 0, 0, 0]).unwrap();
        }
        let next = if latest == 0 { first } else { second }.wrapping_add(1);
        assert_eq!(flash.cells(REGIONS[1 - latest as usize])[..SLOT as usize], header(next), "{what}");
    }
}

/// A header counts if its CRC and its inverted sequence number are right; a record if its CRC is. A
/// reader does not need the mark.
#[test]
fn a_header_or_a_record_with_any_wrong_bit_does_not_count() {
    let mut good = header(7);
    good.extend(record(Key::NODE, [5, 1, 0, 0]));
    let read = |bytes: &[u8]| {
        let mut flash = ModelFlash::new(&SMALL);
        flash.poke(REGIONS[1].base, bytes);
        Journal::open(&flash, REGIONS).get(&flash, Key::NODE)
    };
    assert_eq!(read(&good), Some([5, 1, 0, 0]));
    for bit in 0..good.len() * 8 {
        let mut bad = good.clone();
        bad[bit / 8] ^= 1 << (bit % 8);
        let is_mark = bit / 8 % SLOT as usize >= 24;
        assert_eq!(read(&bad), is_mark.then_some([5, 1, 0, 0]), "bit {bit}");
    }
    let sound_but_wrong = slot([MAGIC, 7, !8, 1, u32::MAX]);
    assert_eq!(read(&[&sound_but_wrong[..], &good[SLOT as usize..]].concat()), None);
}

/// A power cut may have left bits of a header without its mark between 0 and 1: the first store after
/// a start writes it again, and only that one. The record goes to the first free slot, however full
/// the region is.
#[test]
fn a_header_without_its_mark_is_written_again_before_anything_is_added() {
    for (full, marked) in (1..8).flat_map(|full| [(full, false), (full, true)]) {
        let (mut flash, mut journal) = empty();
        for n in 0..full {
            store(&mut flash, &mut journal, Key::NODE, [n, 1, 0, 0]).unwrap();
        }
        if !marked {
            flash.poke(REGIONS[0].base + SLOT - 4, &[0xFF; 4]);
        }
        let mut journal = Journal::open(&flash, REGIONS);
        let mut written = |count| {
            flash.touched.clear();
            store(&mut flash, &mut journal, Key::CRASH_COUNT, [count, 0, 0, 0]).unwrap();
            let slots = flash.touched.chunks(7).map(|words| (words[0].base - REGIONS[0].base) / SLOT);
            slots.collect::<Vec<_>>()
        };
        let expected = if marked { vec![full + 1] } else { vec![0, full + 1] };
        assert_eq!(written(1), expected, "{full} records, marked: {marked}");
        if full < 7 {
            assert_eq!(written(2), [full + 2]);
        }
    }
}

// --- what is stored already

/// A value that is stored already costs no operation: neither at once nor after any number of starts,
/// also behind values of other keys, and with a full region. Another value is stored.
#[test]
fn a_value_that_is_stored_already_is_not_written_again() {
    for others in 0..12 {
        let (mut flash, mut journal) = empty();
        store(&mut flash, &mut journal, Key::NODE, [5, 1, 0, 0]).unwrap();
        for n in 0..others {
            store(&mut flash, &mut journal, Key::CRASH_COUNT, [n, 0, 0, 0]).unwrap();
        }
        flash.touched.clear();
        for start in 0..50 {
            store(&mut flash, &mut journal, Key::NODE, [5, 1, 0, 0]).unwrap();
            assert_eq!(flash.touched, [], "start {start}, behind {others} others");
            journal = Journal::open(&flash, REGIONS);
        }
        store(&mut flash, &mut journal, Key::NODE, [6, 1, 0, 0]).unwrap();
        store(&mut flash, &mut journal, Key::NODE, [5, 1, 0, 0]).unwrap();
        assert!(flash.touched.len() >= 14, "two values are two slots");
        assert_eq!(Journal::open(&flash, REGIONS).get(&flash, Key::NODE), Some([5, 1, 0, 0]));
    }
}

/// After a power cut a value may read one way now and another way later. A store that reports success
/// has made it certain, whichever of the two values it was asked for, and by however few operations.
#[test]
fn a_store_after_a_power_cut_makes_its_value_certain() {
    let (old, new) = ([1; 4], [2; 4]);
    let key = Key::program(1);
    let mut idle = 0;
    // The change is the last slot of a region, or the first one behind a compaction.
    for full in 1..8 {
        let before = || {
            let (mut flash, mut journal) = empty();
            for n in 0..full {
                store(&mut flash, &mut journal, Key::CRASH_COUNT, [n, 0, 0, 0]).unwrap();
            }
            store(&mut flash, &mut journal, key, old).unwrap();
            flash.power_on();
            flash
        };
        let change = |flash: &mut ModelFlash| {
            let mut journal = Journal::open(flash, REGIONS);
            store(flash, &mut journal, key, new).unwrap();
        };
        let mut flash = before();
        change(&mut flash);
        let operations = flash.operations;
        for (operation, seed) in (1..=operations).flat_map(|at| (0..12).map(move |seed| (at, seed))) {
            for wanted in [old, new] {
                let mut flash = before();
                flash.cut = Some((operation, Cut::Unstable(seed)));
                assert!(until_power_cut(|| change(&mut flash)));
                flash.power_on();
                let what = format!("{full} records, cut at {operation}, seed {seed}, {wanted:?}");
                let mut journal = Journal::open(&flash, REGIONS);
                store(&mut flash, &mut journal, key, wanted).unwrap();
                idle += u32::from(flash.operations == 0);
                for _ in 0..40 {
                    assert_eq!(journal.get(&flash, key), Some(wanted), "{what}");
                    let again = Journal::open(&flash, REGIONS);
                    assert_eq!(again.get(&flash, key), Some(wanted), "{what}: the next start");
                }
            }
        }
    }
    assert!(idle > 0, "nothing was found to be certain");
}

/// A region that was damaged: after its header and a record there is nothing but slots that are no records. A
/// store copies the record, and looks at each slot a few times, not at all of them for each.
#[test]
fn a_store_in_a_region_full_of_what_is_no_record_looks_at_each_slot_a_few_times() {
    let region = LAYOUT.parameters[0];
    for damage in [0x00, 0x55, 0xFE] {
        let mut flash = ModelFlash::new(LAYOUT.chip);
        flash.poke(region.base, &vec![damage; region.size as usize]);
        flash.poke(region.base, &header(1));
        flash.poke(region.base + SLOT, &record(Key::NODE, [1, 2, 3, 4]));
        let mut journal = Journal::open(&flash, LAYOUT.parameters);
        flash.bytes_read.set(0);
        store(&mut flash, &mut journal, Key::CRASH_COUNT, [7; 4]).unwrap();
        let looks = flash.bytes_read.get() / region.size as usize;
        assert!(looks < 8, "{damage:02X}h: {looks} times");
        let again = Journal::open(&flash, LAYOUT.parameters);
        for (key, value) in [(Key::NODE, [1, 2, 3, 4]), (Key::CRASH_COUNT, [7; 4])] {
            assert_eq!(again.get(&flash, key), Some(value), "{damage:02X}h");
        }
    }
}

// --- who compacts it

/// The regions of a real journal.
const JOURNAL: [Region; 2] = LARGE_JOURNAL.parameters;
static DEVICE: Layout = Layout { chip: LARGE_JOURNAL.chip, parameters: JOURNAL, ..ONE_PROGRAM }.checked();
static DEVICE_CONFIG: Config = Config { layout: &DEVICE, ..CONFIG };

/// The bootloader after the program has called it back, at a time in ms after its start.
fn called_back(flash: &mut ModelFlash, at_ms: u32) -> Bench<'_> {
    let mut node = Boot::new(&DEVICE_CONFIG, node()).on(flash, vec![0; 256].leak(), Sealed::NONE);
    node.confirm(1);
    node.set_time(Instant::from_millis(at_ms));
    Bench { node }
}

/// Erases of the two regions since the last time.
fn erases(flash: &mut ModelFlash) -> [usize; 2] {
    let touched = std::mem::take(&mut flash.touched);
    JOURNAL.map(|region| touched.iter().filter(|at| **at == region).count())
}

/// A journal with so many used slots, the last of them two values.
fn used_slots(used: u32) -> ModelFlash {
    let mut flash = ModelFlash::new(DEVICE.chip);
    let mut journal = Journal::open(&flash, JOURNAL);
    for n in 3..used {
        store(&mut flash, &mut journal, Key::CRASH_COUNT, [n, 0, 0, 0]).unwrap();
    }
    store(&mut flash, &mut journal, Key::NODE, [5, 4, 0, 0]).unwrap();
    let confirmed = u32::from_le_bytes(*b"RUN1");
    store(&mut flash, &mut journal, Key::program(1), [64, 0, confirmed, 0]).unwrap();
    erases(&mut flash);
    flash
}

/// The words of the journal that a start reads, with 7300 updates: the tag of each of the 585 slots, and for a value
/// those of some 100 more, by a master that leaves the device a second; of 300, by one that never does. A sector of the
/// chip takes 10 000 erases (datasheet DS8626, table 42).
#[test]
fn after_two_updates_a_day_for_ten_years_a_start_takes_as_long_as_at_first() {
    const KEYS: [Key; 5] = [Key::CRASH_COUNT, Key::NODE, Key::program(1), Key::program(255), Key::date(1)];
    for (rests, most_words, most_erases) in [(true, 100, 2_500), (false, 300, 500)] {
        let mut flash = ModelFlash::new(DEVICE.chip);
        let (mut most, mut erased) = (0, [0; 2]);
        for n in 0..7_300 {
            let mut bench = called_back(&mut flash, if rests { 1_500 } else { 0 });
            bench.settle();
            bench.node.set_time(Instant::from_millis(if rests { 3_000 } else { 0 }));
            bench.settle();
            bench.release(&program(200, n as u8));
            assert_eq!(bench.node.write(Address::new(0x1F51, 1), &[START]), Ok(()));
            flash.bytes_read.set(0);
            let journal = Journal::open(&flash, JOURNAL);
            assert!(KEYS.iter().filter(|key| journal.get(&flash, **key).is_some()).count() >= 1);
            assert!(!journal.is_nearly_full(), "update {n}");
            most = most.max(flash.bytes_read.get() / 4);
            erases(&mut flash).iter().zip(&mut erased).for_each(|(more, erased)| *erased += more);
        }
        println!("rests {rests}: at most {most} words; erases of A and B {erased:?}");
        assert!(most <= 640 + most_words * KEYS.len() && erased.iter().all(|count| *count <= most_erases));
    }
}

/// A start keeps 16 slots free for what an application stores.
#[test]
fn a_region_is_nearly_full_with_fewer_than_16_free_slots() {
    let slots = JOURNAL[0].size / 28;
    for (free, is_nearly_full) in [(17, false), (16, false), (15, true), (14, true)] {
        let flash = used_slots(slots - free);
        assert_eq!(Journal::open(&flash, JOURNAL).is_nearly_full(), is_nearly_full, "{free} free slots");
    }
}

/// From 64 used slots on when a second has passed without work on the flash, from 256 on at once; and once. A reset
/// waits meanwhile, and a command does not.
#[test]
fn an_idle_bootloader_compacts_its_journal_and_takes_commands_meanwhile() {
    for (used, at_ms, compacts) in
        [(63, 60_000, false), (64, 999, false), (64, 1_000, true), (255, 0, false), (256, 0, true)]
    {
        let mut flash = used_slots(used);
        let mut bench = called_back(&mut flash, at_ms);
        bench.node.step();
        assert_eq!(
            (bench.node.is_compacting(), bench.node.is_finishing()),
            (compacts, compacts),
            "{used}, {at_ms} ms"
        );
        // In the middle of it.
        assert_eq!(if compacts { bench.command(CLR_SIGNATURE) } else { 0 }, 0);
        // Afterwards it rests.
        for later in 1..if compacts { 300 } else { 1 } {
            bench.node.set_time(Instant::from_millis(at_ms + 10 * later));
            bench.settle();
        }
        let erased = erases(&mut flash).iter().sum::<usize>();
        assert_eq!(erased, usize::from(compacts), "{used} used slots, {at_ms} ms");
        let journal = Journal::open(&flash, JOURNAL);
        assert_eq!(journal.get(&flash, Key::CRASH_COUNT), Some([used - 1, 0, 0, 0]));
        let record = journal.program(&flash, 1).unwrap();
        assert_eq!(record.signed, !compacts, "{used} used slots, {at_ms} ms");
    }
}

/// A compaction waits for a transfer and a download that are open, and for the end of a device that leaves.
#[test]
fn a_compaction_waits_for_what_is_open() {
    type Act = fn(&mut Bench<'_>);
    let open: [(&str, Act, Act); 3] = [
        (
            "transfer",
            |bench| bench.node.download_start(DATA, None).unwrap(),
            |bench| bench.node.download_cancel(DATA),
        ),
        (
            "download",
            |bench| bench.transfer(&block(0, 0, &[0; 8])).unwrap(),
            |bench| bench.node.write(CONTROL, &[CLEAR]).unwrap(),
        ),
        (
            "start",
            |bench| bench.node.write(CONTROL, &[START]).unwrap(),
            |bench| assert!(bench.node.take_boot_request().is_some()),
        ),
    ];
    for (what, begin, end) in open {
        let mut flash = used_slots(300);
        let mut bench = called_back(&mut flash, 60_000);
        bench.node.write(CONTROL, &[CLEAR]).unwrap();
        begin(&mut bench);
        for _ in 0..5 {
            bench.node.step();
            assert!(!bench.node.is_compacting(), "{what}");
        }
        end(&mut bench);
        bench.node.step();
        assert!(bench.node.is_compacting(), "{what} is over");
    }
}

/// A sector that cannot be erased any more costs its erase, and no value as long as there is room.
#[test]
fn a_value_that_comes_during_a_compaction_which_fails_is_stored() {
    for used in [256, 584, 585] {
        let mut flash = used_slots(used);
        let erase = flash.operations + 1;
        flash.fail = Some((erase, FlashFault::Failed));
        let mut bench = called_back(&mut flash, 0);
        bench.node.step();
        assert!(bench.node.is_compacting());
        let room = used < 585;
        assert_eq!(bench.command(CLR_SIGNATURE) == 0, room, "{used} used slots");
        assert_eq!(Journal::open(&flash, JOURNAL).program(&flash, 1).unwrap().signed, !room);
    }
}

// --- flash that does not take everything

/// A flash of which some places lose a bit of each word that is programmed.
struct Worn {
    flash: ModelFlash,
    places: Vec<Region>,
}

impl Flash for Worn {
    fn read(&self, address: u32, buffer: &mut [u8]) {
        self.flash.read(address, buffer);
    }

    fn start(&mut self, operation: Operation) -> Result<(), FlashFault> {
        self.flash.start(match operation {
            Operation::Program { address, word } if self.places.iter().any(|at| at.contains(address, 4)) => {
                // The lowest 1 becomes 0; a word without one is programmed as it is.
                Operation::Program { address, word: word & word.wrapping_sub(1) }
            }
            other => other,
        })
    }

    fn poll(&mut self) -> std::task::Poll<Result<(), FlashFault>> {
        self.flash.poll()
    }

    fn sector_at(&self, address: u32) -> Option<shared_abi::geometry::Sector> {
        self.flash.sector_at(address)
    }
}

/// A place that does not hold a record is passed over. (Where the header and the copies of a
/// compaction belong, there is no other place: then the store fails, and the value before it stays.)
#[test]
fn a_worn_out_slot_costs_a_slot_and_no_value() {
    for slot in 0..9 {
        let flash = ModelFlash::new(&SMALL);
        let mut journal = Journal::open(&flash, REGIONS);
        let mut worn = Worn { flash, places: vec![Region::new(REGIONS[1].base + slot * SLOT, SLOT)] };
        let mut stored = None;
        for n in 1..40 {
            let outcome = store(&mut worn, &mut journal, Key::NODE, [n; 4]);
            if slot > 1 {
                assert_eq!(outcome, Ok(()), "slot {slot}, value {n}");
            }
            match outcome {
                Ok(()) => stored = Some([n; 4]),
                Err(error) => assert_eq!(error, StoreError::WornOut),
            }
            for journal in [&journal, &Journal::open(&worn, REGIONS)] {
                assert_eq!(journal.get(&worn, Key::NODE), stored, "slot {slot}, value {n}");
            }
        }
    }
}

/// Eight places in a row may be bad; after the ninth the device gives up.
#[test]
fn a_store_tries_nine_places() {
    // With room for them in one region.
    static LARGER: Geometry = Geometry {
        chip: "larger",
        flash: Region::new(0x0800_0000, 4 * 512),
        sectors: &[SectorRun { count: 4, size: 512 }],
        ..shared_abi::geometry::STM32F407VG
    };
    let regions = [Region::new(0x0800_0200, 512), Region::new(0x0800_0400, 512)];
    for (bad, outcome) in [(8, Ok(())), (9, Err(StoreError::WornOut))] {
        let flash = ModelFlash::new(&LARGER);
        let mut journal = Journal::open(&flash, regions);
        let mut worn = Worn { flash, places: vec![Region::new(regions[0].base + SLOT, bad * SLOT)] };
        assert_eq!(store(&mut worn, &mut journal, Key::NODE, [7; 4]), outcome, "{bad} bad places");
    }
}

/// A store ends, whatever the flash does, and the value before it stays.
#[test]
fn a_store_in_worn_out_flash_ends_and_the_old_value_stays() {
    let (mut flash, mut journal) = empty();
    store(&mut flash, &mut journal, Key::NODE, [1; 4]).unwrap();
    let before = flash.operations;
    // After the header and the first record, and all of the other region.
    let rest = Region::new(REGIONS[0].base + 2 * SLOT, 256 - 2 * SLOT);
    let mut worn = Worn { flash, places: vec![rest, REGIONS[1]] };
    for attempt in 1..4 {
        assert_eq!(store(&mut worn, &mut journal, Key::NODE, [7; 4]), Err(StoreError::WornOut), "{attempt}");
        for journal in [&journal, &Journal::open(&worn, REGIONS)] {
            assert_eq!(journal.get(&worn, Key::NODE), Some([1; 4]), "{attempt}");
        }
        // Eight attempts, each with a word that does not read back, and an erase for those that
        // change the region; the ninth gives up.
        assert!(worn.flash.operations - before <= attempt * 9 * 2, "{}", worn.flash.operations - before);
    }
}

/// The first region is worn out from the start: a refusal is reported, and nothing is believed.
#[test]
fn a_device_whose_regions_are_worn_out_stores_nothing_and_says_so() {
    for places in [vec![REGIONS[0]], REGIONS.to_vec()] {
        let flash = ModelFlash::new(&SMALL);
        let mut journal = Journal::open(&flash, REGIONS);
        let mut worn = Worn { flash, places };
        assert_eq!(store(&mut worn, &mut journal, Key::NODE, [7; 4]), Err(StoreError::WornOut));
        assert_eq!(Journal::open(&worn, REGIONS).get(&worn, Key::NODE), None);
    }
}

// --- the stored forms

#[test]
fn node_id_and_bit_rate_are_read_if_the_firmware_knows_them() {
    let board = NodeParameters { id: NodeId::new(42), bit_rate: BitRate::K500 };
    let load = |value: Option<Value>, supports: fn(BitRate) -> bool| {
        let (mut flash, mut journal) = empty();
        if let Some(value) = value {
            store(&mut flash, &mut journal, Key::NODE, value).unwrap();
        }
        NodeParameters::load(&journal, &flash, board, supports)
    };
    let node = |id, bit_rate| NodeParameters { id, bit_rate };
    assert_eq!(load(None, |_| true), board);
    for id in [1, 2, 126, 127] {
        // CiA 305: index 4 is 125 kbit/s.
        assert_eq!(load(Some([id, 4, 0, 0]), |_| true), node(NodeId::new(id as u8), BitRate::K125), "{id}");
    }
    assert_eq!(load(Some([0xFF, 0, 0, 0]), |_| true), node(None, BitRate::K1000));
    for id in [0, 128, 254, 256, 257, u32::MAX] {
        assert_eq!(load(Some([id, 4, 0, 0]), |_| true), board, "{id}");
    }
    for rate in [10, 255, 256, 260, u32::MAX] {
        assert_eq!(load(Some([5, rate, 0, 0]), |_| true), board, "{rate}");
    }
    assert_eq!(load(Some([5, 4, 0, 0]), |rate| rate != BitRate::K125), board, "not supported");
    let values = [node(None, BitRate::K1000), node(NodeId::new(127), BitRate::K125)].map(|node| node.value());
    assert_eq!(values, [[0xFF, 0, 0, 0], [127, 4, 0, 0]]);
}

/// A record's words: size with the flag of a half erased program above it, CRC, flags, version.
#[test]
fn the_record_of_a_program_has_its_words() {
    let flags = |word: &[u8; 4]| u32::from_le_bytes(*word);
    for (signed, confirmed, word) in [
        (false, false, 0),
        (true, false, flags(b"APP1")),
        (false, true, flags(b"RUN0")),
        (true, true, flags(b"RUN1")),
    ] {
        for (half_erased, first) in [(false, 0x0000_1234), (true, 0x8000_1234)] {
            let record = ProgramRecord::released(0x1234, 0xCAFE_F00D);
            let record = ProgramRecord { signed, confirmed, version: 77, half_erased, ..record };
            assert_eq!(record.value(), [first, 0xCAFE_F00D, word, 77]);
            assert_eq!(ProgramRecord::from_value(record.value()), Some(record));
        }
    }
    // Nearly a flag is no flag; no size is no program.
    for word in [1, flags(b"APP0"), flags(b"RUN2"), u32::MAX] {
        let record = ProgramRecord::from_value([64, 0, word, 0]).unwrap();
        assert!(!record.signed && !record.confirmed, "{word:#x}");
    }
    for first in [0, 0x8000_0000] {
        assert_eq!(ProgramRecord::from_value([first, 1, flags(b"APP1"), 1]), None);
    }
}

/// A withdrawn program: bit 28 of the first word. Whatever a program stores by the callgate of this
/// record, it is not released.
#[test]
fn a_withdrawn_program_is_not_released_by_its_flags() {
    use boot_core::store::Seal;

    let seal = Some(Seal::Locked);
    let record = ProgramRecord { confirmed: true, version: 7, seal, ..ProgramRecord::released(0x1234, 1) };
    let record = ProgramRecord { signed: false, withdrawn: true, ..record };
    let confirmed = u32::from_le_bytes(*b"RUN0");
    assert_eq!(record.value(), [0x5000_1234, 1, confirmed, 7]);
    assert_eq!(ProgramRecord::from_value(record.value()), Some(record));
    let told = ProgramRecord { signed: true, ..record };
    assert_eq!(ProgramRecord::from_value(told.value()), Some(record), "the confirmation stays");
    let released = ProgramRecord { signed: true, withdrawn: false, ..record };
    assert!(ProgramRecord::from_value(released.value()).is_some_and(|record| record.signed));
}
