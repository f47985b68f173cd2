//! A journal over two flash regions that survives a power cut at every operation.
//!
//! A region holds slots of six words. Slot 0 is the header; every other slot is one record, written
//! once. The latest sound record of a key is its value. When the region is full, the living records
//! are copied to the other region, whose header is written **last**: until then the old region is
//! the valid one, afterwards the new one is, and a cut leaves one of the two whole. Each slot
//! carries a CRC, so a torn one reads as absent.
//!
//! A cut can leave bits between 0 and 1, which read well now and badly later. A header that reads
//! well is therefore written once more before anything is added behind it: what was stored must not
//! vanish with its region.

use shared_abi::geometry::Region;

use super::{Key, Parameters, StoreError, Value};
use crate::crc32;
use crate::flash::{Flash, FlashFault, Next, Operation, ERASED};
use crate::sequence::{EraseSectors, ProgramWords};

const SLOT_WORDS: usize = 6;
const SLOT_SIZE: u32 = SLOT_WORDS as u32 * 4;
type Slot = [u32; SLOT_WORDS];
const BLANK: Slot = [ERASED; SLOT_WORDS];

/// Tells a region's header ("CBNV" read as little-endian bytes).
const HEADER_MAGIC: u32 = u32::from_le_bytes(*b"CBNV");
/// Version of the journal's format: what the values of the keys mean. A journal of an older one is
/// read, and moves to this one with the next value that is stored; one of a newer version belongs
/// to a newer bootloader and is left alone.
const FORMAT: u32 = 1;
/// How often a store goes to a further slot or region before it gives up.
const ATTEMPTS: u8 = 8;

/// The journal. Holds where to read and write; the values stay in flash.
#[derive(Debug)]
pub struct Journal {
    regions: [Region; 2],
    active: Option<Active>,
    /// A region has a header of a newer format: nothing is stored.
    newer: bool,
    storing: Option<Storing>,
}

#[derive(Clone, Copy, Debug)]
struct Active {
    region: usize,
    sequence: u32,
    /// The first slot behind the last one that is not blank.
    free: u32,
    /// Of the version that is written today.
    current: bool,
    /// Its header was written, or written once more, since the power came.
    firm: bool,
}

impl Journal {
    /// Finds the valid region and its end.
    pub fn open<F: Flash>(flash: &F, regions: [Region; 2]) -> Self {
        let mut journal = Self { regions, active: None, newer: false, storing: None };
        for (index, region) in regions.iter().enumerate() {
            let header = read_slot(flash, region, 0);
            let [_, sequence, _, format, ..] = header;
            if header != header_slot(sequence, format) {
                continue;
            }
            if format > FORMAT {
                journal.newer = true;
                continue;
            }
            if journal.active.is_some_and(|active| sequence.wrapping_sub(active.sequence) as i32 <= 0) {
                continue;
            }
            let current = format == FORMAT;
            journal.active =
                Some(Active { region: index, sequence, free: end_of(flash, region), current, firm: false });
        }
        journal
    }
}

impl Parameters for Journal {
    fn get<F: Flash>(&self, flash: &F, key: Key) -> Option<Value> {
        let active = self.active?;
        let region = &self.regions[active.region];
        (1..active.free).rev().find_map(|slot| {
            let [_, a, b, c, d, _] = tagged_slot(flash, region, slot, key.tag())?;
            Some([a, b, c, d])
        })
    }

    fn store(&mut self, key: Key, value: Value) {
        let record = record_slot(key.tag(), value);
        self.storing = Some(Storing { record, attempts: 0, state: State::Begin });
    }

    fn next<F: Flash>(&mut self, flash: &F, outcome: Result<(), FlashFault>) -> Next<StoreError> {
        let Some(mut storing) = self.storing.take() else { return Next::Done(Ok(())) };
        match self.advance(&mut storing, flash, outcome) {
            Ok(Some(operation)) => {
                self.storing = Some(storing);
                Next::Start(operation)
            }
            Ok(None) => Next::Done(Ok(())),
            Err(error) => Next::Done(Err(error)),
        }
    }
}

/// A value on its way into the journal.
#[derive(Debug)]
struct Storing {
    record: Slot,
    attempts: u8,
    state: State,
}

#[derive(Debug)]
enum State {
    /// Nothing was done yet.
    Begin,
    /// Make the other region blank.
    Erase(EraseSectors),
    /// Look for the next living record of the old region, from slot `from` on; `to` is the next
    /// slot of the new one.
    Collect { from: u32, to: u32 },
    /// Write a slot.
    Write { purpose: Purpose, slot: Slot, words: ProgramWords },
}

/// What a slot is written for.
#[derive(Clone, Copy, Debug)]
enum Purpose {
    /// The header of the active region once more.
    Refresh,
    /// A living record of the old region, into slot `to` of the other one.
    Copy { from: u32, to: u32 },
    /// The header, which makes the new region the valid one; `to` is its first free slot.
    Commit { to: u32, sequence: u32 },
    /// The new record, into the first free slot of the active region.
    Append,
}

impl Journal {
    /// The next operation, `None` when the value is stored.
    fn advance<F: Flash>(
        &mut self,
        storing: &mut Storing,
        flash: &F,
        mut outcome: Result<(), FlashFault>,
    ) -> Result<Option<Operation>, StoreError> {
        loop {
            let ended = core::mem::replace(&mut outcome, Ok(()));
            match &mut storing.state {
                State::Begin if self.newer => return Err(StoreError::NewerFormat),
                State::Begin => match self.active {
                    Some(Active { current: true, firm: false, region, sequence, .. }) => {
                        let header = header_slot(sequence, FORMAT);
                        self.write(storing, Purpose::Refresh, region, 0, header);
                    }
                    Some(Active { current: true, .. }) => self.append(storing)?,
                    // A new device: its master shall not wait for an erase that changes nothing.
                    None if flash.is_blank(self.regions[self.other()]) => {
                        storing.state = State::Collect { from: 1, to: 1 };
                    }
                    _ => self.change_over(storing)?,
                },
                State::Erase(sectors) => {
                    let next = ended.and_then(|()| sectors.next(flash)).map_err(StoreError::Flash)?;
                    if next.is_some() {
                        return Ok(next);
                    }
                    storing.state = State::Collect { from: 1, to: 1 };
                }
                State::Collect { from, to } => {
                    let (at, to) = (*from, *to);
                    *from += 1;
                    self.collect(storing, flash, at, to);
                }
                State::Write { purpose, slot, words } => {
                    let purpose = *purpose;
                    let next = ended.and_then(|()| words.next(flash, SLOT_WORDS, |i| slot[i]));
                    match next {
                        Ok(Some(_)) => return next.map_err(StoreError::Flash),
                        Ok(None) => {
                            if self.written(storing, purpose)? {
                                return Ok(None);
                            }
                        }
                        Err(FlashFault::Verify) => self.rejected(storing, purpose)?,
                        Err(fault) => return Err(StoreError::Flash(fault)),
                    }
                }
            }
        }
    }

    /// Copies the record of slot `at`, if it is a living one; behind the last slot the new region
    /// gets its header.
    fn collect<F: Flash>(&self, storing: &mut Storing, flash: &F, at: u32, to: u32) {
        let other = self.other();
        match self.active {
            Some(Active { region, free, .. }) if at < free => {
                if let Some(slot) = living_slot(flash, &self.regions[region], at, free) {
                    self.write(storing, Purpose::Copy { from: at + 1, to }, other, to, slot);
                }
            }
            active => {
                let sequence = active.map_or(1, |active| active.sequence.wrapping_add(1));
                let header = header_slot(sequence, FORMAT);
                self.write(storing, Purpose::Commit { to, sequence }, other, 0, header);
            }
        }
    }

    /// A slot was written. Whether it was the new record, the last thing to do.
    fn written(&mut self, storing: &mut Storing, purpose: Purpose) -> Result<bool, StoreError> {
        match purpose {
            Purpose::Refresh => {
                if let Some(active) = &mut self.active {
                    active.firm = true;
                }
                self.append(storing)?;
            }
            Purpose::Copy { from, to } => storing.state = State::Collect { from, to: to + 1 },
            Purpose::Commit { to, sequence } => {
                let region = self.other();
                self.active = Some(Active { region, sequence, free: to, current: true, firm: true });
                self.append(storing)?;
            }
            Purpose::Append => {
                self.use_slot();
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// A slot does not read back: left between 0 and 1 by a power cut, or worn. Another slot,
    /// another region, or this one erased.
    fn rejected(&mut self, storing: &mut Storing, purpose: Purpose) -> Result<(), StoreError> {
        if let Purpose::Append = purpose {
            self.use_slot();
            storing.attempt()?;
            self.append(storing)
        } else {
            self.change_over(storing)
        }
    }

    /// The first free slot is one no more, whatever became of it.
    fn use_slot(&mut self) {
        if let Some(active) = &mut self.active {
            active.free += 1;
        }
    }

    /// To the first free slot, or to a region that has some.
    fn append(&self, storing: &mut Storing) -> Result<(), StoreError> {
        match self.active {
            Some(Active { region, free, .. }) if free < slots(&self.regions[region]) => {
                self.write(storing, Purpose::Append, region, free, storing.record);
                Ok(())
            }
            _ => self.change_over(storing),
        }
    }

    /// To the other region.
    fn change_over(&self, storing: &mut Storing) -> Result<(), StoreError> {
        storing.attempt()?;
        storing.state = State::Erase(EraseSectors::new(self.regions[self.other()]));
        Ok(())
    }

    /// The region that is not the active one.
    fn other(&self) -> usize {
        self.active.map_or(0, |active| 1 - active.region)
    }

    fn write(&self, storing: &mut Storing, purpose: Purpose, region: usize, number: u32, slot: Slot) {
        let words = ProgramWords::new(slot_address(&self.regions[region], number));
        storing.state = State::Write { purpose, slot, words };
    }
}

impl Storing {
    /// Counts the tries of one store, so that it comes to an end.
    fn attempt(&mut self) -> Result<(), StoreError> {
        self.attempts += 1;
        if self.attempts > ATTEMPTS {
            return Err(StoreError::WornOut);
        }
        Ok(())
    }
}

/// The slot behind the last word that is not blank; a word at a time, because this is on the way of
/// every start.
fn end_of<F: Flash>(flash: &F, region: &Region) -> u32 {
    let mut words = slots(region) * SLOT_WORDS as u32;
    while words > SLOT_WORDS as u32 && flash.read_word(region.base + 4 * (words - 1)) == ERASED {
        words -= 1;
    }
    words.div_ceil(SLOT_WORDS as u32)
}

const fn slots(region: &Region) -> u32 {
    region.size / SLOT_SIZE
}

const fn slot_address(region: &Region, slot: u32) -> u32 {
    region.base + slot * SLOT_SIZE
}

fn read_slot<F: Flash>(flash: &F, region: &Region, slot: u32) -> Slot {
    let mut bytes = [0; SLOT_SIZE as usize];
    flash.read(slot_address(region, slot), &mut bytes);
    let mut words = BLANK;
    for (word, chunk) in words.iter_mut().zip(bytes.chunks_exact(4)) {
        *word = u32::from_le_bytes([chunk[0], chunk[1], chunk[2], chunk[3]]);
    }
    words
}

/// The slot, if it is a sound record of this tag.
fn tagged_slot<F: Flash>(flash: &F, region: &Region, slot: u32, tag: u32) -> Option<Slot> {
    let found = read_slot(flash, region, slot);
    let [found_tag, a, b, c, d, _] = found;
    (found_tag == tag && found == record_slot(tag, [a, b, c, d])).then_some(found)
}

/// The slot, if it is the latest sound record of its tag.
fn living_slot<F: Flash>(flash: &F, region: &Region, slot: u32, free: u32) -> Option<Slot> {
    let [tag, ..] = read_slot(flash, region, slot);
    let record = tagged_slot(flash, region, slot, tag)?;
    let superseded = (slot + 1..free).any(|later| tagged_slot(flash, region, later, tag).is_some());
    (!superseded).then_some(record)
}

fn record_slot(tag: u32, [a, b, c, d]: Value) -> Slot {
    let words = [tag, a, b, c, d];
    let mut bytes = [0; 20];
    for (chunk, word) in bytes.chunks_exact_mut(4).zip(words) {
        chunk.copy_from_slice(&word.to_le_bytes());
    }
    [tag, a, b, c, d, crc32(&bytes)]
}

fn header_slot(sequence: u32, format: u32) -> Slot {
    record_slot(HEADER_MAGIC, [sequence, !sequence, format, ERASED])
}
