//! Parameters in a serial EEPROM in place of the flash: the example of `docs/eeprom.md`. It is `no_std` as it stands, and
//! `bootloader/products/eeprom.rs` links it.
//!
//! The journal is the same one; this is its memory. Commands and bits are those that serial EEPROMs have in common
//! (Microchip 25LC256, DS20005715): 03h read, 02h write, 06h write enable, 05h read status; status bit 0 is busy (WIP),
//! bit 1 the write enable latch (WEL).
//!
//! A write of some bytes refreshes all of their page (DS20005715, section 2.3), so a power cut may take the whole page.
//! The journal relies on what is programmed already staying as it is. So each slot has two pages: one for the six words
//! that a reader needs, and one for the mark, which proves them.

use core::cell::RefCell;
use core::task::Poll;

use boot_core::flash::{Flash, FlashFault, Next, Operation};
use boot_core::store::{Journal, Key, Parameters, StoreError, Value};
use shared_abi::geometry::{Region, Sector};
use shared_abi::journal::{MARK_WORD, SLOT_SIZE};

/// The bus of the chip: one transaction with the chip selected.
pub trait Spi {
    /// Sends these bytes, and then reads as many as `answer` takes.
    fn transfer(&mut self, bytes: &[u8], answer: &mut [u8]);
}

pub const READ: u8 = 0x03;
pub const WRITE: u8 = 0x02;
pub const WRITE_ENABLE: u8 = 0x06;
pub const READ_STATUS: u8 = 0x05;
pub const BUSY: u8 = 1 << 0;
pub const WRITE_ENABLED: u8 = 1 << 1;

/// Bytes of a page, 32 at least.
pub const PAGE: u32 = 64;
/// The slots of each of the two regions: 32 KiB in all.
pub const SLOTS: u32 = 128;
/// The regions by the addresses of the journal, which has slots and knows no pages.
pub const REGIONS: [Region; 2] =
    [Region::new(0, SLOTS * SLOT_SIZE), Region::new(SLOTS * SLOT_SIZE, SLOTS * SLOT_SIZE)];
/// The offset of the mark in a slot.
const MARK: u32 = 4 * MARK_WORD as u32;
/// The most polls of a write (5 ms). A chip that is always busy, or is not there, must not stop the bootloader.
const MOST_POLLS: u16 = 5000;

/// The EEPROM as a flash. An operation is one write: a word, or FFh in a part of a slot.
pub struct Eeprom<S> {
    /// Reading needs the bus, too, and the trait reads from `&self`.
    spi: RefCell<S>,
    /// The polls that are left of the operation that runs; 0 for none.
    polls_left: u16,
    /// The last operation has not begun.
    refused: bool,
}

impl<S: Spi> Eeprom<S> {
    /// The part of a slot with this address: the words before the mark, or the mark.
    fn part(address: u32) -> Region {
        let offset = address % SLOT_SIZE;
        match offset < MARK {
            true => Region::new(address - offset, MARK),
            false => Region::new(address - offset + MARK, SLOT_SIZE - MARK),
        }
    }

    /// A command, and the address in the chip.
    fn command(command: u8, address: u32) -> [u8; 3] {
        let part = Self::part(address);
        let page = 2 * (address / SLOT_SIZE) + u32::from(part.base % SLOT_SIZE == MARK);
        let [.., high, low] = (page * PAGE + address - part.base).to_be_bytes();
        [command, high, low]
    }

    fn status(&self) -> u8 {
        let mut status = [0];
        self.spi.borrow_mut().transfer(&[READ_STATUS], &mut status);
        status[0]
    }
}

impl<S: Spi> Flash for Eeprom<S> {
    fn read(&self, mut address: u32, mut buffer: &mut [u8]) {
        while !buffer.is_empty() {
            let size = (Self::part(address).end() - address).min(buffer.len() as u32);
            let (part, rest) = buffer.split_at_mut(size as usize);
            self.spi.borrow_mut().transfer(&Self::command(READ, address), part);
            (buffer, address) = (rest, address + size);
        }
    }

    fn start(&mut self, operation: Operation) -> Result<(), FlashFault> {
        self.spi.borrow_mut().transfer(&[WRITE_ENABLE], &mut []);
        // A chip that is protected, or is not there, does not set the latch.
        if self.status() & (BUSY | WRITE_ENABLED) != WRITE_ENABLED {
            self.refused = true;
            return Err(FlashFault::Protected);
        }
        let mut bytes = [u8::MAX; 3 + MARK as usize];
        let (address, size) = match operation {
            Operation::Erase(sector) => (sector.region.base, sector.region.size),
            Operation::Program { address, word } => {
                bytes[3..7].copy_from_slice(&word.to_le_bytes());
                (address, 4)
            }
        };
        bytes[..3].copy_from_slice(&Self::command(WRITE, address));
        self.spi.borrow_mut().transfer(&bytes[..3 + size as usize], &mut []);
        self.polls_left = MOST_POLLS;
        Ok(())
    }

    fn poll(&mut self) -> Poll<Result<(), FlashFault>> {
        if core::mem::take(&mut self.refused) {
            return Poll::Ready(Err(FlashFault::Protected));
        }
        if self.polls_left == 0 || self.status() & BUSY == 0 {
            self.polls_left = 0;
            return Poll::Ready(Ok(()));
        }
        self.polls_left -= 1;
        match self.polls_left {
            0 => Poll::Ready(Err(FlashFault::Failed)),
            _ => Poll::Pending,
        }
    }

    fn sector_at(&self, address: u32) -> Option<Sector> {
        let is_inside = REGIONS.iter().any(|region| region.contains(address, 1));
        is_inside.then(|| Sector { number: 0, region: Self::part(address) })
    }
}

/// The journal in the EEPROM.
pub struct InEeprom<S> {
    journal: Journal,
    eeprom: Eeprom<S>,
}

impl<S: Spi> InEeprom<S> {
    /// Finds the stored values.
    pub fn open(spi: S) -> Self {
        let eeprom = Eeprom { spi: RefCell::new(spi), polls_left: 0, refused: false };
        Self { journal: Journal::open(&eeprom, REGIONS), eeprom }
    }
}

impl<S: Spi> Parameters for InEeprom<S> {
    fn get<F: Flash>(&self, _: &F, key: Key) -> Option<Value> {
        self.journal.get(&self.eeprom, key)
    }

    fn store(&mut self, key: Key, value: Value) {
        self.journal.store(key, value);
    }

    fn is_nearly_full(&self) -> bool {
        self.journal.is_nearly_full()
    }

    fn compact(&mut self, used: u32) -> bool {
        self.journal.compact(used)
    }

    /// No operation is for the flash: this carries its own ones out, and is called again meanwhile.
    fn next<F: Flash>(&mut self, _: &F, _: Result<(), FlashFault>) -> Next<StoreError> {
        let Poll::Ready(outcome) = self.eeprom.poll() else { return Next::Again };
        match self.journal.next(&self.eeprom, outcome) {
            Next::Start(operation) => {
                // A refusal is the outcome of the next poll.
                let _ = self.eeprom.start(operation);
                Next::Again
            }
            next => next,
        }
    }
}
