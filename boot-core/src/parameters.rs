//! Non-volatile parameters: a journal over two flash regions that survives a power cut at every
//! operation.
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

use core::task::Poll;

use shared_abi::geometry::{Geometry, Region};

use crate::crc32;
use crate::flash::{is_blank, Flash, FlashFault, SectorEraser, WordWriter, ERASED};

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
/// How often a record that does not read back is tried in a further slot.
const ATTEMPTS: u8 = 8;

/// What a record is about.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Key {
    /// Size, CRC and signature of a program (1 to 254).
    Program(u8),
    /// How often in a row the watchdog had to reset a running application.
    CrashCount,
    /// Node-ID and bit rate.
    Node,
}

impl Key {
    /// The first word of the key's records. FFFFFFFFh (erased) and [`HEADER_MAGIC`] are no tags.
    const fn tag(self) -> u32 {
        match self {
            Self::Program(number) => 0x0001_0000 | number as u32,
            Self::CrashCount => 0x0002_0000,
            Self::Node => 0x0003_0000,
        }
    }
}

/// The words of a value; what they mean is the key's.
pub type Value = [u32; 4];

/// Why a value could not be stored. 1F57h says NVDATA.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StoreError {
    /// The flash refused or failed.
    Flash(FlashFault),
    /// No slot took the record: the region is worn out.
    WornOut,
    /// A store outside the flash failed.
    Device,
}

/// Where parameters are kept: the [`Journal`] in flash, or what a board has for them (an EEPROM),
/// which may leave the flash that it is handed alone.
///
/// Whoever implements it owes this: after a power cut at any moment [`get`](Self::get) gives the
/// value from before the store or the new one, of every key; and every store comes to an end, a
/// store that is full or worn out with an error.
pub trait Parameters {
    /// The value of a key, `None` where it was never stored.
    fn get<F: Flash>(&self, flash: &F, key: Key) -> Option<Value>;

    /// Starts to store a value, one at a time; [`poll`](Self::poll) carries it through.
    fn store(&mut self, key: Key, value: Value);

    /// Carries on; `Pending` while the store works. Call again until ready.
    ///
    /// # Errors
    /// Why the value could not be stored; then the old one is still there.
    fn poll<F: Flash>(&mut self, flash: &mut F) -> Poll<Result<(), StoreError>>;
}

/// The journal. Holds where to read and write; the values stay in flash.
#[derive(Debug)]
pub struct Journal {
    chip: &'static Geometry,
    regions: [Region; 2],
    active: Option<Active>,
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
    pub fn open<F: Flash>(flash: &F, chip: &'static Geometry, regions: [Region; 2]) -> Self {
        let header = |region: usize| {
            let slot = read_slot(flash, &regions[region], 0);
            let sequence = slot[1];
            let sound = slot[3] <= FORMAT && slot == header_slot(sequence, slot[3]);
            sound.then_some((region, sequence, slot[3]))
        };
        let newest = match (header(0), header(1)) {
            (Some(a), Some(b)) => Some(if b.1.wrapping_sub(a.1) as i32 > 0 { b } else { a }),
            (a, b) => a.or(b),
        };
        let active = newest.map(|(region, sequence, format)| {
            // Behind the slot of the last word that is not blank; a word at a time, because this is
            // on the way of every start.
            let Region { base, .. } = regions[region];
            let mut words = slots(&regions[region]) * SLOT_WORDS as u32;
            while words > SLOT_WORDS as u32 && flash.read_word(base + 4 * (words - 1)) == ERASED {
                words -= 1;
            }
            Active {
                region,
                sequence,
                free: words.div_ceil(SLOT_WORDS as u32),
                current: format == FORMAT,
                firm: false,
            }
        });
        Self { chip, regions, active, storing: None }
    }
}

impl Parameters for Journal {
    fn get<F: Flash>(&self, flash: &F, key: Key) -> Option<Value> {
        let active = self.active?;
        let region = &self.regions[active.region];
        (1..active.free).rev().find_map(|slot| {
            let slot = tagged_slot(flash, region, slot, key.tag())?;
            let [_, a, b, c, d, _] = slot;
            Some([a, b, c, d])
        })
    }

    fn store(&mut self, key: Key, value: Value) {
        let mut storing = Storing { record: record_slot(key.tag(), value), attempts: 0, state: State::Begin };
        match self.active {
            Some(Active { current: true, firm: false, region, sequence, .. }) => {
                self.write(&mut storing, What::Firm, region, 0, header_slot(sequence, FORMAT));
            }
            Some(Active { current: true, .. }) => self.append(&mut storing),
            None => {}
            Some(_) => self.change_over(&mut storing),
        }
        self.storing = Some(storing);
    }

    fn poll<F: Flash>(&mut self, flash: &mut F) -> Poll<Result<(), StoreError>> {
        let Some(mut storing) = self.storing.take() else { return Poll::Ready(Ok(())) };
        let outcome = self.carry_on(&mut storing, flash);
        if outcome.is_pending() {
            self.storing = Some(storing);
        }
        outcome
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
    /// No region is valid yet.
    Begin,
    /// Make the other region blank.
    Erase { eraser: SectorEraser },
    /// Look for the next living record of the old region, from slot `from` on; `to` is the next
    /// slot of the new one.
    Collect { from: u32, to: u32 },
    /// Write a slot.
    Write { what: What, slot: Slot, writer: WordWriter },
}

/// What a slot is written for.
#[derive(Clone, Copy, Debug)]
enum What {
    /// The header of the active region once more.
    Firm,
    /// The new record, into the first free slot of the active region.
    Append,
    /// A living record of the old region, into slot `to` of the other one.
    Copy { from: u32, to: u32 },
    /// The new record behind them.
    Add { to: u32 },
    /// The header, which makes the new region the valid one.
    Commit { to: u32, sequence: u32 },
}

impl Journal {
    /// To the first free slot, or to a region that has some.
    fn append(&self, storing: &mut Storing) {
        match self.active {
            Some(Active { region, free, .. }) if free < slots(&self.regions[region]) => {
                self.write(storing, What::Append, region, free, storing.record);
            }
            _ => self.change_over(storing),
        }
    }

    /// To the other region.
    fn change_over(&self, storing: &mut Storing) {
        storing.state = State::Erase { eraser: SectorEraser::new(self.regions[self.other()]) };
    }

    /// The region that is not the active one.
    fn other(&self) -> usize {
        self.active.map_or(0, |active| 1 - active.region)
    }

    fn write(&self, storing: &mut Storing, what: What, region: usize, number: u32, slot: Slot) {
        let writer = WordWriter::new(slot_address(&self.regions[region], number));
        storing.state = State::Write { what, slot, writer };
    }

    fn carry_on<F: Flash>(&mut self, storing: &mut Storing, flash: &mut F) -> Poll<Result<(), StoreError>> {
        loop {
            let other = self.other();
            match &mut storing.state {
                // A new device: its master shall not wait for an erase that changes nothing.
                State::Begin if is_blank(flash, self.regions[other]) => {
                    storing.state = State::Collect { from: 1, to: 1 };
                }
                State::Begin => self.change_over(storing),
                State::Erase { eraser } => match eraser.poll(flash, self.chip) {
                    Poll::Pending => return Poll::Pending,
                    Poll::Ready(Err(error)) => return Poll::Ready(Err(StoreError::Flash(error))),
                    Poll::Ready(Ok(())) => storing.state = State::Collect { from: 1, to: 1 },
                },
                State::Collect { from, to } => {
                    let (at, to) = (*from, *to);
                    *from += 1;
                    match self.active {
                        Some(Active { region, free, .. }) if at < free => {
                            if let Some(slot) =
                                living_slot(flash, &self.regions[region], at, free, storing.record[0])
                            {
                                self.write(storing, What::Copy { from: at + 1, to }, other, to, slot);
                            }
                        }
                        _ => self.write(storing, What::Add { to }, other, to, storing.record),
                    }
                }
                State::Write { what, slot, writer } => {
                    let what = *what;
                    let Poll::Ready(outcome) = writer.poll(flash, SLOT_WORDS, |i| slot[i]) else {
                        return Poll::Pending;
                    };
                    if let Poll::Ready(end) = self.written(what, outcome, storing) {
                        return Poll::Ready(end);
                    }
                }
            }
        }
    }

    /// What follows when a slot was written or could not be; ready when all is done.
    fn written(
        &mut self,
        what: What,
        outcome: Result<(), FlashFault>,
        storing: &mut Storing,
    ) -> Poll<Result<(), StoreError>> {
        if let (What::Append, Some(active)) = (what, &mut self.active) {
            active.free += 1;
        }
        match outcome {
            Ok(()) => {}
            Err(FlashFault::Verify) if storing.attempts == ATTEMPTS => {
                return Poll::Ready(Err(StoreError::WornOut));
            }
            // Left half-charged by a power cut, or worn: another slot, another region, or this one
            // erased.
            Err(FlashFault::Verify) => {
                storing.attempts += 1;
                match what {
                    What::Append => self.append(storing),
                    _ => self.change_over(storing),
                }
                return Poll::Pending;
            }
            Err(error) => return Poll::Ready(Err(StoreError::Flash(error))),
        }
        let other = self.other();
        match what {
            What::Firm => {
                if let Some(active) = &mut self.active {
                    active.firm = true;
                }
                self.append(storing);
            }
            What::Append => return Poll::Ready(Ok(())),
            What::Copy { from, to } => storing.state = State::Collect { from, to: to + 1 },
            What::Add { to } => {
                let sequence = self.active.map_or(1, |active| active.sequence.wrapping_add(1));
                let header = header_slot(sequence, FORMAT);
                self.write(storing, What::Commit { to: to + 1, sequence }, other, 0, header);
            }
            What::Commit { to, sequence } => {
                self.active = Some(Active { region: other, sequence, free: to, current: true, firm: true });
                return Poll::Ready(Ok(()));
            }
        }
        Poll::Pending
    }
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

/// The slot, if it is the latest sound record of its tag and not about to be replaced.
fn living_slot<F: Flash>(flash: &F, region: &Region, slot: u32, free: u32, replaced: u32) -> Option<Slot> {
    let [tag, ..] = read_slot(flash, region, slot);
    let record = tagged_slot(flash, region, slot, tag)?;
    let superseded =
        tag == replaced || (slot + 1..free).any(|later| tagged_slot(flash, region, later, tag).is_some());
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
