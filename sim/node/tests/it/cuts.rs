//! An update that is cut at a random point goes on where it stopped: `coflash` as a library against
//! `boot-core` with the real SDO server, in virtual time.

use std::collections::BTreeMap;
use std::time::Duration;

use boot_core::canopen::NodeId;
use boot_core::crc::CrcKind;
use boot_core::program::verify;
use boot_core::store::Journal;
use coflash_core::device::{Dialect, Session, Timing, Transfers};
use coflash_core::file::block_file;
use coflash_core::update::event::{Phase, Warning};
use coflash_core::update::{flash, Event, FlashOptions, Report};
use coflash_core::Error;

use crate::cut::{CutBus, Way};
use kit::bench::{self, block, block_file, crc32, LAYOUT, PROGRAM};
use kit::model::{Cut, ModelFlash, CHIP};
use kit::random::Random;

/// Data of a block.
const CHUNK: usize = 256;
/// The bytes of the program: the step in which a device stores its progress is 1 KiB.
const SIZE: usize = 0x3B00;
const UPDATES: u64 = 1000;

/// A program whose code comes after the vector table of each STM32F4, as the tool wants it: the chip of
/// the model has a shorter one.
fn program(len: usize, seed: u8) -> Vec<u8> {
    let mut bytes = bench::program(len, seed);
    bytes[4..8].copy_from_slice(&(PROGRAM.base + 0x201).to_le_bytes());
    bytes
}

/// A block file with size and identity in block 0.
fn named(image: &[u8]) -> Vec<u8> {
    let mut file = block_file(image, CHUNK);
    // Size, vendor-ID, product code (manual L-1112d_10, figure 13).
    let words: Vec<u8> = [image.len() as u32, 0, 0].into_iter().flat_map(u32::to_le_bytes).collect();
    file[0] = block(0, 0, &words);
    file.concat()
}

/// What an update came to.
struct Ended {
    result: Result<Report, Error>,
    events: Vec<Event>,
}

impl Ended {
    /// The bytes with which it went on.
    fn went_on(&self) -> Option<usize> {
        self.events.iter().find_map(|event| match event {
            Event::Phase(Phase::GoingOn { done, .. }) => Some(*done),
            _ => None,
        })
    }

    fn began_again(&self) -> bool {
        self.events.iter().any(|event| matches!(event, Event::Warning(Warning::BeginsAgain { .. })))
    }

    fn verified(&self) -> Option<u32> {
        self.events.iter().find_map(|event| match event {
            Event::Phase(Phase::Verified { crc }) => Some(*crc),
            _ => None,
        })
    }
}

fn update(bus: &mut CutBus, file: &[u8], transfers: Transfers, options: &FlashOptions) -> Ended {
    let file = block_file::read(file).expect("a block file");
    let mut events = Vec::new();
    let mut session = Session::new(bus, NodeId::new(5).expect("a node-ID"), Timing::default());
    session.transfer_by(transfers);
    let result = flash(&mut session, &file, options, &mut |event| events.push(event));
    Ended { result, events }
}

/// As with `--no-start`: nothing could run the program here.
fn options() -> FlashOptions {
    FlashOptions::default().start(false)
}

/// What a reset would find.
fn is_installed(flash: &mut ModelFlash, image: &[u8]) -> bool {
    flash.power_on();
    let journal = Journal::open(&&mut *flash, LAYOUT.parameters);
    verify(&&mut *flash, &journal, &LAYOUT, CrcKind::Crc32, 1).is_ok()
        && flash.cells(PROGRAM)[..image.len()] == *image
}

fn old_and_new() -> (ModelFlash, Vec<u8>) {
    let mut bus = CutBus::new(ModelFlash::new(&CHIP), None);
    let old = program(0x2A00, 0x11);
    let ended = update(&mut bus, &named(&old), Transfers::Blocks, &options());
    ended.result.expect("the old program is installed");
    let flash = bus.flash().clone();
    (flash, program(SIZE, 0x22))
}

/// Counts of one way.
#[derive(Debug, Default)]
struct Counts {
    updates: usize,
    /// Before the first block of data was sent as a whole.
    before_data: usize,
    /// After all data were sent.
    after_data: usize,
    /// The bytes that were sent twice, in all and at most, in tenths of a percent.
    sum: usize,
    worst: usize,
}

/// The bytes that count are those of all downloads to 1F50h, with the heads of the blocks, in both
/// runs; the limit is 110 % of the file.
#[test]
fn an_update_that_is_cut_anywhere_goes_on() {
    let (installed, new) = old_and_new();
    let file = named(&new);
    let mut uncut = BTreeMap::new();
    for (key, transfers) in [Transfers::Blocks, Transfers::Segments].into_iter().enumerate() {
        let mut bus = CutBus::new(installed.clone(), None);
        update(&mut bus, &file, transfers, &options()).result.expect("it works without a cut");
        assert_eq!(bus.data, file.len(), "what is counted is the file");
        uncut.insert(key, (bus.frames, bus.flash().operations));
    }
    let mut counts: BTreeMap<&str, Counts> = BTreeMap::new();
    for seed in 0..UPDATES {
        let random = &mut Random(seed.wrapping_mul(0x5851_F42D_4C95_7F2D));
        let key = random.below(2);
        let transfers = [Transfers::Blocks, Transfers::Segments][key];
        let (frames, operations) = uncut[&key];
        let frame = random.below(frames as usize) as u32;
        let (name, way) = match random.below(3) {
            0 => ("host", Way::Host(frame)),
            1 => ("bus", Way::Bus(frame)),
            _ => {
                let at = 1 + random.below(operations as usize) as u32;
                let cut = match random.below(4) {
                    0 => Cut::Before,
                    1 => Cut::After,
                    2 => Cut::Torn(random.next()),
                    _ => Cut::Unstable(random.next()),
                };
                ("power", Way::Power(at, cut))
            }
        };
        let mut bus = CutBus::new(installed.clone(), Some(way));
        let first = update(&mut bus, &file, transfers, &options());
        let sent = bus.data;
        bus.repair(Duration::from_millis(random.below(3000) as u64));
        let second = update(&mut bus, &file, transfers, &options());
        let told = format!("update {seed}, {way:?}, {transfers:?}: {:?}", second.events);
        second.result.as_ref().unwrap_or_else(|error| panic!("{error}, {told}"));
        assert_eq!(second.verified(), Some(crc32(&new)), "{told}");
        assert!(is_installed(&mut bus.flash(), &new), "{told}");
        assert!(!second.began_again(), "{told}");

        let count = counts.entry(name).or_default();
        count.updates += 1;
        let head = 28 + CHUNK + 16;
        if sent < head {
            count.before_data += 1;
        } else if sent >= file.len() - 24 {
            count.after_data += 1;
            continue;
        } else {
            assert!(first.result.is_err(), "{told}");
        }
        let twice = (sent + bus.data).saturating_sub(file.len()) * 1000 / file.len();
        assert!(twice <= 100, "{twice} of 1000 came twice, {told}");
        count.sum += twice;
        count.worst = count.worst.max(twice);
    }
    for (name, count) in &counts {
        println!("{name}: {count:?}");
        assert!(count.updates > 250 && count.updates > 2 * (count.before_data + count.after_data));
    }
}

/// Files that the device refuses, each flashed twice with `--force`, before and after a power-off, and sometimes that of
/// the old program: it stays and is complete.
#[test]
fn a_refused_file_costs_nothing_however_often_it_is_flashed() {
    let (mut flash, _) = old_and_new();
    let old = program(0x2A00, 0x11);
    let file = |at: usize, word: u32, base: u32| {
        let mut image = program(0x2000, 0x22);
        image[at..at + 4].copy_from_slice(&word.to_le_bytes());
        let data = (1..).zip(image.chunks(CHUNK));
        let data = data.map(|(n, data)| block(n, base + (n - 1) * CHUNK as u32, data));
        let control = block(0, 0, &kit::rig::words(&[0x2000, 0, 0]));
        std::iter::once(control).chain(data).chain([bench::last(&image)]).flatten().collect::<Vec<u8>>()
    };
    let start = PROGRAM.base;
    // Two reset vectors and a stack that are none; the middle of the program, the bootloader, outside the flash.
    let vectors = [(4, 0x0800_0101, start), (4, start + 0x200, start), (0, 0x3000_0000, start)];
    let places = [start + 0x400, 0x0800_0000, 0x0900_0000].map(|base| (4, base + 0x201, base));
    let blocks = vectors.into_iter().chain(places).map(|wrong| (Dialect::Block, wrong));
    let whole = vectors.into_iter().flat_map(|wrong| [(Dialect::Raw, wrong), (Dialect::Hex, wrong)]);
    let kinds = blocks.chain(whole).chain([(Dialect::Hex, places[1])]);
    for (kind, (dialect, (at, word, base))) in kinds.enumerate() {
        let refused = options().force(true).dialect(Some(dialect));
        for attempt in 0..2 {
            let mut bus = CutBus::new(flash, None);
            for _ in 0..2 {
                let ended = update(&mut bus, &file(at, word, base), Transfers::Blocks, &refused);
                let is_there = is_installed(&mut bus.flash().clone(), &old);
                assert!(ended.result.is_err() && is_there, "{kind}, {attempt}: {:?}", ended.events);
            }
            if kind % 4 == attempt {
                let ended = update(&mut bus, &named(&old), Transfers::Blocks, &options());
                ended.result.unwrap_or_else(|error| panic!("{kind}: {error}"));
            }
            flash = bus.flash().clone();
        }
        assert!(is_installed(&mut flash, &old), "{kind}");
    }
}

/// A device in which the update was cut when half of the frames were sent, without power.
fn half(installed: &ModelFlash, file: &[u8]) -> ModelFlash {
    let mut uncut = CutBus::new(installed.clone(), None);
    update(&mut uncut, file, Transfers::Blocks, &options()).result.expect("it works without a cut");
    let mut bus = CutBus::new(installed.clone(), Some(Way::Host(uncut.frames / 2)));
    assert!(update(&mut bus, file, Transfers::Blocks, &options()).result.is_err());
    let flash = bus.flash().clone();
    flash
}

/// Flashes a file into a device with this flash; it must end with this program. Returns what was
/// reported, and the data bytes that were sent.
fn recover(flash: ModelFlash, image: &[u8], file: &[u8], options: &FlashOptions) -> (Ended, usize) {
    let mut bus = CutBus::new(flash, None);
    let ended = update(&mut bus, file, Transfers::Blocks, options);
    assert!(ended.result.is_ok(), "{:?}", ended.events);
    assert_eq!(ended.verified(), Some(crc32(image)));
    assert!(is_installed(&mut bus.flash(), image));
    let data = bus.data;
    (ended, data)
}

/// Block 0 is the same, and a byte differs in a block that the device has, or does not have.
#[test]
fn a_file_that_differs_in_one_byte_is_sent_as_a_whole() {
    let (installed, image) = old_and_new();
    let file = named(&image);
    let half = half(&installed, &file);
    let mut other = image.clone();
    other[1000] ^= 0x10;
    let (ended, data) = recover(half.clone(), &other, &named(&other), &options());
    assert!(ended.went_on().is_some() && ended.began_again(), "{:?}", ended.events);
    assert!(data > file.len(), "{data}");

    // The byte is in the part that is missing: it is this other file that is complete.
    let mut other = image.clone();
    other[SIZE - 100] ^= 0x10;
    let (ended, data) = recover(half.clone(), &other, &named(&other), &options());
    assert!(ended.went_on().is_some() && !ended.began_again(), "{:?}", ended.events);
    assert!(data < file.len() * 6 / 10, "{data}");

    // Another block 0.
    let other = program(SIZE - 256, 0x33);
    let (ended, data) = recover(half.clone(), &other, &named(&other), &options());
    assert!(ended.went_on().is_none() && !ended.began_again(), "{:?}", ended.events);
    assert_eq!(data, named(&other).len());

    let (ended, data) = recover(half, &image, &file, &options().from_start(true));
    assert!(ended.went_on().is_none(), "{:?}", ended.events);
    assert_eq!(data, file.len());
}

/// Flash at rest: a byte that was programmed, and single bits.
#[test]
fn a_half_program_that_was_altered_is_sent_as_a_whole() {
    let (installed, image) = old_and_new();
    let file = named(&image);
    let half = half(&installed, &file);
    let random = &mut Random(7);
    for _ in 0..50 {
        let mut flash = half.clone();
        let at = random.below(0x1400) as u32;
        let byte = flash.cells(PROGRAM)[at as usize];
        flash.poke(PROGRAM.base + at, &[byte ^ 1 << random.below(8)]);
        let (ended, data) = recover(flash, &image, &file, &options());
        assert!(ended.went_on().is_some() && ended.began_again(), "{at:#x}: {:?}", ended.events);
        assert!(data > file.len(), "{data}");
    }
}

/// Another program was begun between, or CLEAR was sent.
#[test]
fn what_was_given_up_does_not_go_on() {
    let (installed, image) = old_and_new();
    let file = named(&image);
    let first = half(&installed, &file);
    let other = program(0x3000, 0x44);
    let second = half(&first, &named(&other));
    let (ended, data) = recover(second, &image, &file, &options());
    assert!(ended.went_on().is_none(), "{:?}", ended.events);
    assert_eq!(data, file.len());

    // CLEAR postpones the erase: a power cut after one CLEAR has lost nothing, and the second in a
    // row erases.
    let mut cleared = first;
    cleared.power_on();
    assert_eq!(kit::bench::Bench::new(&mut cleared).command(kit::bench::CLEAR), 0);
    let (ended, _) = recover(cleared.clone(), &image, &file, &options());
    assert!(ended.went_on().is_some() && !ended.began_again(), "{:?}", ended.events);
    cleared.power_on();
    {
        let mut bench = kit::bench::Bench::new(&mut cleared);
        assert_eq!((bench.command(kit::bench::CLEAR), bench.command(kit::bench::CLEAR)), (0, 0));
    }
    let (ended, data) = recover(cleared, &image, &file, &options());
    assert!(ended.went_on().is_none(), "{:?}", ended.events);
    assert_eq!(data, file.len());
}
