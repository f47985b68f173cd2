//! A journal over two flash regions that survives a power cut at every operation.
//!
//! A region holds slots of seven words. Slot 0 is the header; every other slot is one record,
//! written once. The value of a key is its latest valid record. When the region is full, the current
//! records are copied to the other region, and its header is written **last**: until then the old
//! region is the valid one, and afterwards the new one, so a power cut always leaves one complete
//! region. Each slot has a CRC, so an incomplete slot counts as absent.
//!
//! A power cut can leave bits between 0 and 1, which may read correctly now and wrongly later: that
//! a slot reads correctly does not prove that it is complete. Its last word proves it. This **mark**
//! is programmed after the words before it were read back, so they are certain if any bit of it is
//! programmed.
//!
//! - A header without its mark is written again before anything is added to its region: stored
//!   values must not be lost with their region.
//! - **A value that is stored already is not written again**: a command that changes nothing must
//!   not wear the flash.
//!
//! Every start reads the journal. So a search reads one word of each slot, its tag, and the rest of a slot
//! only if the tag is the wanted one. Boot stage and callgate must not wait for the erase of a sector: their
//! flash refuses it, and so does a region without a free slot. The RAM image compacts the journal before
//! that ([`Parameters::compact`]).

use shared_abi::geometry::Region;
use shared_abi::journal::{self, first_slot, Key, Slot, Value, FORMAT, HEADER_MAGIC, MARK_WORD, SLOT_SIZE};

use super::parameters::{Parameters, StoreError};
use crate::crc;
use crate::flash::{Flash, FlashFault, Next, Operation, ERASED};
use crate::sequence::{EraseSectors, ProgramWords};

/// How many times a store tries a further slot or region before it gives up.
const ATTEMPTS: u8 = 8;
/// With fewer free slots than these a region [is nearly full](Parameters::is_nearly_full). (A region of a
/// model, smaller than any sector, keeps a 32nd part.)
const KEPT_SLOTS: u32 = 16;

/// The journal. It holds the addresses for reading and writing; the values stay in flash. A slot is
/// identified by its address.
#[derive(Debug)]
pub struct Journal {
    valid: Region,
    /// The region that is not valid.
    other: Region,
    header: Header,
    /// A region has a header of a newer format: storing is refused.
    newer: bool,
    sequence: u32,
    /// A power cut has ended a compaction when only its header was missing: the other region may be the valid one
    /// later. Nothing is added to this one before the other is erased.
    half_valid: bool,
    /// The first slot of the valid region after the last one that is not blank.
    free: u32,
    storing: Storing,
}

/// A value that is being stored.
#[derive(Debug, Default)]
struct Storing {
    step: Step,
    attempts: u8,
    /// The new record. A compaction has none: its tag is that of erased flash.
    record: Slot,
    /// The slot that is being written, and its address.
    slot: Slot,
    words: ProgramWords,
    sectors: EraseSectors,
    /// The next slot of the valid region to copy, and the next free slot of the other region.
    from: u32,
    to: u32,
}

/// The state of the valid region's header.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Header {
    /// No region is valid.
    Absent,
    /// The header has an older format.
    Older,
    /// The header reads correctly, but a power cut may have left bits between 0 and 1.
    Found,
    /// The header is certain.
    Firm,
}

/// The progress of a store.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Step {
    /// Nothing is being stored.
    #[default]
    Idle,
    /// The store has not begun yet.
    Begin,
    /// The header of the valid region is being written again.
    Refresh,
    /// The other region is being erased.
    Erase,
    /// A current record is being copied to the other region.
    Copy,
    /// The header is being written, which makes the other region the valid one.
    Commit,
    /// The new record is being written into the first free slot.
    Append,
}

impl Journal {
    /// Finds the valid region and its end.
    pub fn open<F: Flash>(flash: &F, regions: [Region; 2]) -> Self {
        // While no region is valid, the first one is the next to write.
        let [mut other, mut valid] = regions;
        let (mut header, mut newer, mut sequence) = (Header::Absent, false, 0);
        for region in regions {
            let Some([tag, found, inverted, format, ..]) = sound_slot(flash, region.base) else {
                continue;
            };
            if (tag, inverted) != (HEADER_MAGIC, !found) {
                continue;
            }
            if format > FORMAT {
                newer = true;
                continue;
            }
            if header != Header::Absent && found.wrapping_sub(sequence) as i32 <= 0 {
                continue;
            }
            let marked = flash.read_word(region.base + 4 * MARK_WORD as u32) != ERASED;
            header = match format {
                FORMAT if marked => Header::Firm,
                FORMAT => Header::Found,
                _ => Header::Older,
            };
            sequence = found;
            if region.base == other.base {
                core::mem::swap(&mut valid, &mut other);
            }
        }
        let first = first_slot(&valid);
        let mut free = first;
        if header != Header::Absent {
            free = valid.end() - valid.size % SLOT_SIZE;
            // The tag of a slot is programmed first, and no tag reads as erased flash.
            while free > first && flash.read_word(free - SLOT_SIZE) == ERASED {
                free -= SLOT_SIZE;
            }
        }
        // The second word of a header is its sequence number, which its CRC follows.
        let next = sequence.wrapping_add(1);
        let half_valid = header != Header::Absent && flash.read_word(other.base + 4) == next;
        Self { valid, other, header, newer, sequence, half_valid, free, storing: Storing::default() }
    }

    /// The latest valid record of a tag.
    fn latest<F: Flash>(&self, flash: &F, tag: u32) -> Option<Slot> {
        let first = first_slot(&self.valid);
        let mut at = self.free;
        while at > first {
            at -= SLOT_SIZE;
            let record = record_of(flash, at, tag);
            if record.is_some() {
                return record;
            }
        }
        None
    }
}

impl Parameters for Journal {
    fn get<F: Flash>(&self, flash: &F, key: Key) -> Option<Value> {
        let [_, a, b, c, d, ..] = self.latest(flash, key.0)?;
        Some([a, b, c, d])
    }

    fn store(&mut self, key: Key, value: Value) {
        // A compaction goes on, and ends with the new record.
        if self.storing.step == Step::Idle || self.storing.record[0] != ERASED {
            self.storing.attempts = 0;
            self.storing.step = Step::Begin;
        }
        self.storing.record = slot(key.0, value);
    }

    fn is_nearly_full(&self) -> bool {
        let kept = (KEPT_SLOTS * SLOT_SIZE).min(self.valid.size / 32);
        self.half_valid || self.header != Header::Absent && self.valid.end() - self.free < kept
    }

    fn compact(&mut self, used: u32) -> bool {
        // Without a valid region, the slot of the header alone is used.
        if self.newer || self.free - self.valid.base < used * SLOT_SIZE && !self.half_valid {
            return false;
        }
        self.storing.record[0] = ERASED;
        self.storing.attempts = 0;
        self.change_over().is_ok()
    }

    fn next<F: Flash>(&mut self, flash: &F, outcome: Result<(), FlashFault>) -> Next<StoreError> {
        let next = self.advance(flash, outcome);
        if let Ok(Some(operation)) = next {
            return Next::Start(operation);
        }
        self.storing.step = Step::Idle;
        Next::Done(next.map(|_| ()))
    }
}

impl Journal {
    /// The next operation, `None` when the value is stored.
    fn advance<F: Flash>(
        &mut self,
        flash: &F,
        mut outcome: Result<(), FlashFault>,
    ) -> Result<Option<Operation>, StoreError> {
        loop {
            let next = match (outcome, self.storing.step) {
                (Err(fault), _) => Err(fault),
                (_, Step::Idle | Step::Begin) => Ok(None),
                (_, Step::Erase) => self.storing.sectors.next(flash),
                _ => self.storing.words.next(flash, self.storing.slot.len(), |i| self.storing.slot[i]),
            };
            outcome = Ok(());
            // Without its mark a slot is as good for a reader.
            let is_sound = self.storing.step != Step::Erase && self.storing.words.written() == MARK_WORD;
            let next = next.or_else(|fault| if is_sound { Ok(None) } else { Err(fault) });
            match (next, self.storing.step) {
                (Ok(Some(_)), _) | (Ok(None), Step::Idle) => return next.map_err(StoreError::Flash),
                (Ok(None), Step::Begin) => self.begin(flash)?,
                (Ok(None), Step::Erase) => self.collect(flash),
                (Ok(None), Step::Copy) => {
                    self.storing.to += SLOT_SIZE;
                    self.collect(flash);
                }
                (Ok(None), Step::Commit) => {
                    core::mem::swap(&mut self.valid, &mut self.other);
                    self.sequence = self.sequence.wrapping_add(1);
                    self.free = self.storing.to;
                    self.half_valid = false;
                    self.header = Header::Firm;
                    self.storing.step = Step::Begin;
                }
                (Ok(None), Step::Refresh) => {
                    self.header = Header::Firm;
                    self.storing.step = Step::Begin;
                }
                (Ok(None), Step::Append) => {
                    self.free += SLOT_SIZE;
                    self.storing.step = Step::Idle;
                }
                // A slot does not read back correctly: a power cut left it between 0 and 1, or it
                // is worn out. Try another slot, the other region, or erase this region.
                (Err(FlashFault::Verify), Step::Append) => {
                    self.free += SLOT_SIZE;
                    self.attempt()?;
                    self.append()?;
                }
                (Err(FlashFault::Verify), _) => self.change_over()?,
                // A compaction that fails is no reason to lose a record that came meanwhile.
                (Err(_), Step::Erase | Step::Copy) if self.has_room() && self.storing.record[0] != ERASED => {
                    self.storing.step = Step::Begin;
                }
                (Err(fault), _) => return Err(StoreError::Flash(fault)),
            }
        }
    }

    fn begin<F: Flash>(&mut self, flash: &F) -> Result<(), StoreError> {
        if self.newer {
            return Err(StoreError::NewerFormat);
        }
        if self.storing.record[0] == ERASED || self.is_stored(flash) {
            self.storing.step = Step::Idle;
            return Ok(());
        }
        match self.header {
            Header::Firm => return self.append(),
            Header::Found => {
                let header = header_slot(self.sequence);
                self.write(Step::Refresh, self.valid.base, header);
            }
            // A new device: its master must not wait for an unnecessary erase.
            Header::Absent if flash.is_blank(self.other) => {
                self.rewind();
                self.collect(flash);
            }
            Header::Absent | Header::Older => return self.change_over(),
        }
        Ok(())
    }

    /// Whether the new record is stored already, and certain. A slot without the mark behind the
    /// latest record may be a record of the same key, which reads as invalid only now.
    fn is_stored<F: Flash>(&self, flash: &F) -> bool {
        if self.header != Header::Firm {
            return false;
        }
        let first = first_slot(&self.valid);
        let mut at = self.free;
        while at > first {
            at -= SLOT_SIZE;
            if flash.read_word(at + 4 * MARK_WORD as u32) == ERASED {
                return false;
            }
            if flash.read_word(at) == self.storing.record[0] {
                return read_slot(flash, at)[..MARK_WORD] == self.storing.record[..MARK_WORD];
            }
        }
        false
    }

    /// Copies the next current record; after the last one, writes the header of the other region.
    ///
    /// Whether a tag has a copy is decided from the copies, which were just written and read back.
    /// A slot with bits between 0 and 1 after a power cut may read as the latest of its tag the
    /// first time and as invalid the next time: if places were compared, neither this slot nor the
    /// previous one might be copied.
    fn collect<F: Flash>(&mut self, flash: &F) {
        while self.storing.from < self.free {
            let at = self.storing.from;
            let tag = flash.read_word(at);
            self.storing.from += SLOT_SIZE;
            let mut copy = first_slot(&self.other);
            while copy < self.storing.to && flash.read_word(copy) != tag {
                copy += SLOT_SIZE;
            }
            // A slot that is no record is no reason to look for one: with many of them, as in a damaged
            // region, a store would take minutes.
            if copy < self.storing.to || record_of(flash, at, tag).is_none() {
                continue;
            }
            if let Some(slot) = self.latest(flash, tag) {
                return self.write(Step::Copy, self.storing.to, slot);
            }
        }
        let header = header_slot(self.sequence.wrapping_add(1));
        self.write(Step::Commit, self.other.base, header);
    }

    /// Continues with the first free slot, or with a region that has free slots.
    fn append(&mut self) -> Result<(), StoreError> {
        if !self.has_room() {
            return self.change_over();
        }
        self.write(Step::Append, self.free, self.storing.record);
        Ok(())
    }

    /// Whether a record may be added to the valid region.
    fn has_room(&self) -> bool {
        !self.half_valid
            && matches!(self.header, Header::Found | Header::Firm)
            && self.free + SLOT_SIZE <= self.valid.end()
    }

    /// Continues with the other region.
    fn change_over(&mut self) -> Result<(), StoreError> {
        self.attempt()?;
        self.rewind();
        self.storing.sectors = EraseSectors::new(self.other);
        self.storing.step = Step::Erase;
        Ok(())
    }

    /// Goes to the first record that may have to be copied.
    fn rewind(&mut self) {
        self.storing.from = first_slot(&self.valid);
        self.storing.to = first_slot(&self.other);
    }

    fn write(&mut self, step: Step, address: u32, slot: Slot) {
        self.storing.step = step;
        self.storing.words = ProgramWords::new(address);
        self.storing.slot = slot;
    }

    /// Counts the attempts of one store, so that it ends.
    fn attempt(&mut self) -> Result<(), StoreError> {
        self.storing.attempts += 1;
        if self.storing.attempts > ATTEMPTS {
            return Err(StoreError::WornOut);
        }
        Ok(())
    }
}

/// The words at an address.
fn read_slot<F: Flash>(flash: &F, at: u32) -> Slot {
    let mut found = Slot::default();
    for (word, address) in found.iter_mut().zip((at..).step_by(4)) {
        *word = flash.read_word(address);
    }
    found
}

/// The slot at an address, if it is a valid record of a tag. Most are of another one: the tag is read first.
fn record_of<F: Flash>(flash: &F, at: u32, tag: u32) -> Option<Slot> {
    if flash.read_word(at) != tag {
        return None;
    }
    sound_slot(flash, at).filter(|slot| slot[0] == tag)
}

/// The slot at an address, if it is a valid record. It is read once: bits left between 0 and 1 by a
/// power cut may read differently the next time.
fn sound_slot<F: Flash>(flash: &F, at: u32) -> Option<Slot> {
    let found = read_slot(flash, at);
    let [tag, a, b, c, d, ..] = found;
    let sound = slot(tag, [a, b, c, d]);
    (found[..MARK_WORD] == sound[..MARK_WORD]).then_some(sound)
}

fn slot(tag: u32, value: Value) -> Slot {
    journal::slot(tag, value, |bytes| crc::resume(0, bytes))
}

fn header_slot(sequence: u32) -> Slot {
    slot(HEADER_MAGIC, journal::header(sequence))
}
