//! A driver for a serial flash beside the internal one: the example of `docs/flash-driver.md`. It is
//! `no_std` as it stands; only the model of the chip, below, is for the tests.
//!
//! Commands and bits are those that serial NOR flashes have in common (JEDEC JESD216, basic commands):
//! 03h read, 06h write enable, 02h page program, 20h erase 4 KiB, 05h read status; status bit 0 is busy
//! (WIP), bit 1 the write enable latch (WEL).

use core::cell::RefCell;
use core::task::Poll;

use boot_core::flash::{Flash, FlashFault, Operation};
use shared_abi::geometry::{Region, Sector};

/// The bus of the chip: one transaction with the chip selected.
pub trait Spi {
    /// Sends these bytes, and then reads as many as `answer` takes.
    fn transfer(&mut self, bytes: &[u8], answer: &mut [u8]);
}

const READ: u8 = 0x03;
const WRITE_ENABLE: u8 = 0x06;
const PAGE_PROGRAM: u8 = 0x02;
const SECTOR_ERASE: u8 = 0x20;
const READ_STATUS: u8 = 0x05;
const BUSY: u8 = 1 << 0;
const WRITE_ENABLED: u8 = 1 << 1;

/// The sector that can be erased.
pub const SECTOR: u32 = 4096;

/// A serial flash at addresses of its own.
pub struct SerialFlash<S> {
    /// Reading needs the bus, too, and the trait reads from `&self`.
    spi: RefCell<S>,
    /// The addresses that the bootloader knows it by: no other memory has them.
    region: Region,
    /// The number of its first sector: the internal flash has those below.
    first: u8,
    /// The most polls of an operation. A chip that is always busy, or is not there (a bus without a
    /// chip reads FFh), must not stop the bootloader.
    most_polls: u32,
    running: Option<Running>,
}

struct Running {
    operation: Operation,
    polls_left: u32,
}

impl<S: Spi> SerialFlash<S> {
    pub const fn new(spi: S, region: Region, first: u8, most_polls: u32) -> Self {
        Self { spi: RefCell::new(spi), region, first, most_polls, running: None }
    }

    pub fn has(&self, address: u32) -> bool {
        self.region.contains(address, 1)
    }

    fn status(&self) -> u8 {
        let mut status = [0];
        self.spi.borrow_mut().transfer(&[READ_STATUS], &mut status);
        status[0]
    }

    /// A command and the 24 bits of an address in the chip.
    fn command(&self, command: u8, address: u32) -> [u8; 4] {
        let [_, high, middle, low] = (address - self.region.base).to_be_bytes();
        [command, high, middle, low]
    }
}

impl<S: Spi> Flash for SerialFlash<S> {
    fn read(&self, address: u32, buffer: &mut [u8]) {
        // What is outside reads FFh.
        buffer.fill(u8::MAX);
        let Region { base, .. } = self.region;
        let end = u64::from(address) + buffer.len() as u64;
        let (from, to) = (address.max(base), end.min(u64::from(base) + u64::from(self.region.size)));
        if u64::from(from) < to {
            let inside = (from - address) as usize..(to - u64::from(address)) as usize;
            self.spi.borrow_mut().transfer(&self.command(READ, from), &mut buffer[inside]);
        }
    }

    fn start(&mut self, operation: Operation) -> Result<(), FlashFault> {
        let is_here = match operation {
            Operation::Erase(sector) => self.sector_at(sector.region.base) == Some(sector),
            // A word that is aligned crosses no border of a page.
            Operation::Program { address, .. } => {
                address.is_multiple_of(4) && self.region.contains(address, 4)
            }
        };
        if !is_here || self.running.is_some() || self.status() & BUSY != 0 {
            return Err(FlashFault::Failed);
        }
        self.spi.borrow_mut().transfer(&[WRITE_ENABLE], &mut []);
        // A chip that is protected, or is not there, does not set the latch.
        if self.status() & (BUSY | WRITE_ENABLED) != WRITE_ENABLED {
            return Err(FlashFault::Protected);
        }
        match operation {
            Operation::Erase(sector) => {
                let bytes = self.command(SECTOR_ERASE, sector.region.base);
                self.spi.borrow_mut().transfer(&bytes, &mut []);
            }
            Operation::Program { address, word } => {
                let mut bytes = [0; 8];
                bytes[..4].copy_from_slice(&self.command(PAGE_PROGRAM, address));
                bytes[4..].copy_from_slice(&word.to_le_bytes());
                self.spi.borrow_mut().transfer(&bytes, &mut []);
            }
        }
        self.running = Some(Running { operation, polls_left: self.most_polls });
        Ok(())
    }

    fn poll(&mut self) -> Poll<Result<(), FlashFault>> {
        let is_busy = self.running.is_some() && self.status() & BUSY != 0;
        let Some(running) = &mut self.running else { return Poll::Ready(Ok(())) };
        if is_busy {
            running.polls_left = running.polls_left.saturating_sub(1);
            if running.polls_left > 0 {
                return Poll::Pending;
            }
            self.running = None;
            return Poll::Ready(Err(FlashFault::Failed));
        }
        let operation = running.operation;
        self.running = None;
        Poll::Ready(match operation {
            Operation::Program { address, word } if self.read_word(address) != word => {
                Err(FlashFault::Verify)
            }
            _ => Ok(()),
        })
    }

    fn sector_at(&self, address: u32) -> Option<Sector> {
        let offset = address.checked_sub(self.region.base).filter(|offset| *offset < self.region.size)?;
        let number = u8::try_from(u32::from(self.first) + offset / SECTOR).ok()?;
        Some(Sector { number, region: Region::new(address - offset % SECTOR, SECTOR) })
    }
}

/// The internal flash and a serial one, as one flash. One operation runs at a time, in either.
pub struct Both<I, S> {
    internal: I,
    serial: SerialFlash<S>,
}

impl<I: Flash, S: Spi> Both<I, S> {
    pub const fn new(internal: I, serial: SerialFlash<S>) -> Self {
        Self { internal, serial }
    }
}

impl<I: Flash, S: Spi> Flash for Both<I, S> {
    fn read(&self, address: u32, buffer: &mut [u8]) {
        // No region reaches from one into the other.
        if self.serial.has(address) {
            self.serial.read(address, buffer);
        } else {
            self.internal.read(address, buffer);
        }
    }

    fn start(&mut self, operation: Operation) -> Result<(), FlashFault> {
        let (Operation::Erase(Sector { region: Region { base: address, .. }, .. })
        | Operation::Program { address, .. }) = operation;
        if self.serial.has(address) {
            self.serial.start(operation)
        } else {
            self.internal.start(operation)
        }
    }

    fn poll(&mut self) -> Poll<Result<(), FlashFault>> {
        match self.serial.running {
            Some(_) => self.serial.poll(),
            None => self.internal.poll(),
        }
    }

    fn sector_at(&self, address: u32) -> Option<Sector> {
        self.serial.sector_at(address).or_else(|| self.internal.sector_at(address))
    }

    /// Each flash has protection of its own. A driver with a CRC unit for the internal flash passes
    /// [`Flash::crc32`] on in the same way.
    fn is_protected(&self, sector: Sector) -> bool {
        !self.serial.has(sector.region.base) && self.internal.is_protected(sector)
    }
}

// --- the chip, for the tests

/// A serial flash chip that takes nothing that a real one would ignore: a command while it is busy, and
/// an operation without the latch, end the test. Its cells are the strict model, with its power cuts.
pub mod chip {
    use core::task::Poll;

    use boot_core::flash::{Flash as _, Operation};
    use kit::model::{Chip, ModelFlash};
    use shared_abi::geometry::{Geometry, Region, SectorRun, STM32F407VG};

    use super::{
        Spi, BUSY, PAGE_PROGRAM, READ, READ_STATUS, SECTOR, SECTOR_ERASE, WRITE_ENABLE, WRITE_ENABLED,
    };

    /// Where it is: in the addresses of an external memory (PM0214, figure 10).
    pub const REGION: Region = Region::new(0x9000_0000, 8 * SECTOR);
    /// Its sectors, for the model.
    static GEOMETRY: Geometry = Geometry {
        chip: "serial flash",
        flash: REGION,
        sectors: &[SectorRun { count: 8, size: SECTOR }],
        ..STM32F407VG
    };

    /// What a chip may do wrong.
    #[derive(Clone, Copy, Debug, PartialEq, Eq)]
    pub enum Lie {
        /// Nothing.
        None,
        /// It is always busy after a command.
        NeverEnds,
        /// It is not there: the bus reads FFh.
        Absent,
        /// It never sets the latch.
        Protected,
        /// Bit 0 of each byte reads 1.
        StuckBit,
        /// An erase does nothing.
        ErasesNothing,
        /// Addresses have one bit less: the upper half is the lower one.
        Folded,
    }

    #[derive(Clone)]
    pub struct Serial {
        pub cells: Chip,
        pub lie: Lie,
        latch: bool,
        busy: bool,
    }

    impl Serial {
        pub fn new(lie: Lie) -> Self {
            Self { cells: Chip::new(ModelFlash::new(&GEOMETRY)), lie, latch: false, busy: false }
        }

        /// The same chip after its power was off.
        pub fn switched_on(&self) -> Self {
            self.cells.model().power_on();
            Self { latch: false, busy: false, ..self.clone() }
        }

        fn address(&self, bytes: &[u8]) -> u32 {
            let offset = u32::from_be_bytes([0, bytes[1], bytes[2], bytes[3]]);
            let folded = if self.lie == Lie::Folded { offset % (REGION.size / 2) } else { offset };
            REGION.base + folded
        }

        fn begin(&mut self, operation: Operation) {
            assert!(core::mem::take(&mut self.latch), "without the write enable latch the chip ignores it");
            self.busy = true;
            if !(self.lie == Lie::ErasesNothing && matches!(operation, Operation::Erase(_))) {
                self.cells.start(operation).unwrap();
            }
        }
    }

    impl Spi for Serial {
        fn transfer(&mut self, bytes: &[u8], answer: &mut [u8]) {
            if self.lie == Lie::Absent {
                return answer.fill(0xFF);
            }
            assert!(!self.busy || bytes == [READ_STATUS], "a busy chip ignores all other commands");
            match bytes {
                [READ_STATUS] => {
                    self.busy &= self.lie == Lie::NeverEnds || self.cells.poll() == Poll::Pending;
                    let latch = if self.latch { WRITE_ENABLED } else { 0 };
                    answer[0] = latch | if self.busy { BUSY } else { 0 };
                }
                [READ, _, _, _] => {
                    self.cells.read(self.address(bytes), answer);
                    if self.lie == Lie::StuckBit {
                        answer.iter_mut().for_each(|byte| *byte |= 1);
                    }
                }
                [WRITE_ENABLE] => self.latch = self.lie != Lie::Protected,
                [SECTOR_ERASE, _, _, _] => {
                    let sector = self.cells.sector_at(self.address(bytes)).unwrap();
                    self.begin(Operation::Erase(sector));
                }
                [PAGE_PROGRAM, _, _, _, word @ ..] => {
                    let word = u32::from_le_bytes(word.try_into().expect("the driver programs words"));
                    self.begin(Operation::Program { address: self.address(bytes), word });
                }
                other => panic!("the chip does not know {other:02X?}"),
            }
        }
    }
}
