//! Mistakes in a bootloader that the rules must find.

use std::task::Poll;

use boot_core::bootloader::Everything;
use boot_core::flash::{Flash, FlashFault, Next, Operation};
use boot_core::store::{Journal, Key, NodeParameters, Parameters, ProgramRecord, StoreError, Value};
use kit::boot::Boot;
use kit::model::Chip;
use kit::rig::{crc32, Owned, Rig, Setup, AT_ONCE_2, BOARD_NODE, STANDARD_2};
use shared_abi::geometry::Sector;
use shared_abi::layout::Layout;

use crate::files::{file, NEW};

/// A mistake, in a device with two programs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mistake {
    /// The record of the new program is stored and released before its data are complete.
    SignatureBeforeData,
    /// The sectors are erased while the record is still valid.
    EraseBeforeInvalidating,
    /// The program is erased before the target of the new one is known.
    EraseBeforeCheck,
    /// Records carry no CRC.
    JournalWithoutCrc,
    /// A full journal is erased first and then written again.
    CompactionInPlace,
    /// A sector whose first bytes are blank is taken for erased.
    BlankAtFirstSight,
    /// Half erased sectors are not recorded.
    TouchedForgotten,
    /// Each record of a program says that it is released.
    ReleasedByItself,
    /// The security counter of a sealed program is not stored.
    CounterForgotten,
}

impl Mistake {
    /// The product that the device is in truth.
    pub(crate) fn setup(self, setup: &'static Setup) -> &'static Setup {
        if self == Self::EraseBeforeCheck {
            &AT_ONCE_2
        } else {
            setup
        }
    }

    /// The bootloader with the mistake.
    pub(crate) fn node(self, rig: &Rig) -> Option<Owned> {
        if self == Self::EraseBeforeCheck {
            return None;
        }
        let chip = rig.chip.clone();
        let store = Store::open(&chip, rig.setup.layout, Some(self));
        let node = NodeParameters::load(&store, &chip, BOARD_NODE, |_| true);
        let flash = Hasty { chip, is_hasty: self == Self::BlankAtFirstSight };
        let boot = Boot::new(&rig.setup.config, node);
        Some(Owned::new(2048, rig.setup.takes_sealed, |buffer, sealed| {
            Box::new(boot.with::<_, _, 2, Everything>(store, flash, buffer, sealed))
        }))
    }
}

/// A flash that may take a sector for erased.
struct Hasty {
    chip: Chip,
    is_hasty: bool,
}

impl Flash for Hasty {
    fn read(&self, address: u32, buffer: &mut [u8]) {
        self.chip.read(address, buffer);
    }

    fn start(&mut self, operation: Operation) -> Result<(), FlashFault> {
        match operation {
            Operation::Erase(sector)
                if self.is_hasty && self.chip.read_word(sector.region.base) == u32::MAX =>
            {
                Ok(())
            }
            _ => self.chip.start(operation),
        }
    }

    fn sector_at(&self, address: u32) -> Option<Sector> {
        self.chip.sector_at(address)
    }

    fn poll(&mut self) -> Poll<Result<(), FlashFault>> {
        self.chip.poll()
    }
}

/// What is stored in place of a value; `None` for nothing.
type Change = fn(Key, Value) -> Option<Value>;

/// Whether this removes the record of program 1.
fn removes(key: Key, value: Value) -> bool {
    key == Key::program(1) && ProgramRecord::from_value(value).is_none()
}

/// The record of the new program, released.
fn new_record() -> Value {
    let new = file(&STANDARD_2, NEW);
    ProgramRecord::released(new.plain.len() as u32, new.crc).value()
}

/// The same record, released.
fn released(key: Key, value: Value) -> Value {
    let record = ProgramRecord::from_value(value).filter(|_| [1, 2].map(Key::program).contains(&key));
    record.map_or(value, |record| ProgramRecord { signed: true, ..record }.value())
}

/// The journal, or a faulty replacement of it.
pub enum Store {
    Journal(Journal),
    /// Stores something else, or nothing.
    Changed(Journal, Change),
    /// Forgets which sectors may be half erased.
    Forgetful(Journal),
    /// One region with consecutive records; a word before each record identifies it. `checked`: a
    /// CRC follows.
    Naive {
        checked: bool,
        work: Vec<(u32, u32)>,
    },
}

impl Store {
    pub(crate) fn open(flash: &impl Flash, layout: &'static Layout, mistake: Option<Mistake>) -> Self {
        let journal = Journal::open(flash, layout.parameters);
        match mistake {
            Some(Mistake::JournalWithoutCrc) => Self::Naive { checked: false, work: Vec::new() },
            Some(Mistake::CompactionInPlace) => Self::Naive { checked: true, work: Vec::new() },
            Some(Mistake::TouchedForgotten) => Self::Forgetful(journal),
            Some(Mistake::EraseBeforeInvalidating) => {
                Self::Changed(journal, |key, value| (!removes(key, value)).then_some(value))
            }
            Some(Mistake::SignatureBeforeData) => Self::Changed(journal, |key, value| {
                Some(if removes(key, value) { new_record() } else { value })
            }),
            Some(Mistake::ReleasedByItself) => {
                Self::Changed(journal, |key, value| Some(released(key, value)))
            }
            Some(Mistake::CounterForgotten) => Self::Changed(journal, |key, value| {
                (![1, 2].map(Key::counter).contains(&key)).then_some(value)
            }),
            _ => Self::Journal(journal),
        }
    }
}

/// The words of a naive record: its key, four words of value, its CRC.
const NAIVE: usize = 6;

/// Another number for the key, in the lower half of the word.
fn naive_key(Key(key): Key) -> u32 {
    (key >> 16) << 8 | key & 0xFF
}

fn naive_crc(words: &[u32]) -> u32 {
    crc32(&words.iter().flat_map(|word| word.to_le_bytes()).collect::<Vec<_>>())
}

/// The records of the naive store, and the place of the next one.
fn naive_records<F: Flash>(flash: &F, checked: bool) -> (Vec<[u32; NAIVE]>, u32) {
    let region = STANDARD_2.layout.parameters[0];
    let mut records = Vec::new();
    for base in (region.base..region.end()).step_by(4 * NAIVE) {
        let record: [u32; NAIVE] = core::array::from_fn(|i| flash.read_word(base + 4 * i as u32));
        if record == [u32::MAX; NAIVE] || base + 4 * NAIVE as u32 > region.end() {
            return (records, base);
        }
        if !checked || naive_crc(&record[..NAIVE - 1]) == record[NAIVE - 1] {
            records.push(record);
        }
    }
    (records, region.end())
}

impl Parameters for Store {
    fn get<F: Flash>(&self, flash: &F, key: Key) -> Option<Value> {
        match self {
            Self::Journal(journal) | Self::Changed(journal, _) => journal.get(flash, key),
            Self::Forgetful(journal) => {
                let [first, rest @ ..] = journal.get(flash, key)?;
                let [a, b, c] = rest;
                // Above the size.
                Some([
                    if key.0 >> 16 == Key::program(0).0 >> 16 { first & 0x00FF_FFFF } else { first },
                    a,
                    b,
                    c,
                ])
            }
            Self::Naive { checked, .. } => {
                let (records, _) = naive_records(flash, *checked);
                let found = records.iter().rev().find(|record| record[0] == naive_key(key))?;
                Some([found[1], found[2], found[3], found[4]])
            }
        }
    }

    fn store(&mut self, key: Key, value: Value) {
        match self {
            Self::Changed(journal, change) => {
                if let Some(value) = change(key, value) {
                    journal.store(key, value);
                }
            }
            Self::Journal(journal) | Self::Forgetful(journal) => journal.store(key, value),
            Self::Naive { work, .. } => {
                let mut record = vec![naive_key(key), value[0], value[1], value[2], value[3]];
                record.push(naive_crc(&record));
                // The address is determined when the flash can be read.
                *work = record.into_iter().map(|word| (u32::MAX, word)).collect();
            }
        }
    }

    fn next<F: Flash>(&mut self, flash: &F, outcome: Result<(), FlashFault>) -> Next<StoreError> {
        let Self::Naive { checked, work } = self else {
            let (Self::Journal(journal) | Self::Changed(journal, _) | Self::Forgetful(journal)) = self else {
                unreachable!()
            };
            return journal.next(flash, outcome);
        };
        if let Err(fault) = outcome {
            return Next::Done(Err(StoreError::Flash(fault)));
        }
        let region = STANDARD_2.layout.parameters[0];
        if let Some(&(u32::MAX, key)) = work.first() {
            let (mut records, mut end) = naive_records(flash, *checked);
            if end + 4 * NAIVE as u32 > region.end() {
                // The bug: until everything is written again, the region is empty.
                let new: Vec<u32> = work.iter().map(|(_, word)| *word).collect();
                records.retain(|record| record[0] != key);
                let mut latest: Vec<[u32; NAIVE]> = Vec::new();
                for record in records {
                    latest.retain(|other| other[0] != record[0]);
                    latest.push(record);
                }
                let words = latest.into_iter().flatten().chain(new);
                *work = (region.base..).step_by(4).zip(words).collect();
                let Some(sector) = STANDARD_2.layout.chip.sector_at(region.base) else { unreachable!() };
                return Next::Start(Operation::Erase(sector));
            }
            for (address, _) in work.iter_mut() {
                *address = end;
                end += 4;
            }
        }
        if work.is_empty() {
            return Next::Done(Ok(()));
        }
        let (address, word) = work.remove(0);
        Next::Start(Operation::Program { address, word })
    }
}
