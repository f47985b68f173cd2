//! The demonstration passes a good driver, and names what a bad one does wrong.

use std::cell::Cell;
use std::task::Poll;

use boot_core::flash::{Flash, FlashFault, Operation};
use kit::driver::{demonstrate, Fault, Place};
use kit::model::{until_power_cut, Chip, Cut, ModelFlash, CHIP};
use shared_abi::geometry::{Region, Sector, STM32F407VG};

use crate::serial_flash::chip::{Lie, Serial, REGION};
use crate::serial_flash::{Both, SerialFlash, SECTOR};

/// More than the model needs (2), and few enough to be seen.
pub const POLLS: u32 = 10;
/// The serial flash has its sectors after those of the internal one.
pub const FIRST: u8 = 12;

/// A driver of the model of the internal flash. The model itself ends the test where the core asks for a
/// place that is not there.
#[derive(Clone)]
pub struct Internal(pub Chip);

impl Internal {
    pub fn new() -> Self {
        Self(Chip::new(ModelFlash::new(&CHIP)))
    }
}

impl Flash for Internal {
    fn read(&self, address: u32, buffer: &mut [u8]) {
        self.0.read(address, buffer);
    }

    fn start(&mut self, operation: Operation) -> Result<(), FlashFault> {
        match operation {
            Operation::Program { address, .. } if !CHIP.flash.contains(address, 4) => Err(FlashFault::Failed),
            operation => self.0.start(operation),
        }
    }

    fn poll(&mut self) -> Poll<Result<(), FlashFault>> {
        self.0.poll()
    }

    fn sector_at(&self, address: u32) -> Option<Sector> {
        self.0.sector_at(address)
    }
}

pub fn both(internal: &Internal, serial: &Serial) -> Both<Internal, Serial> {
    Both::new(internal.clone(), SerialFlash::new(serial.clone(), REGION, FIRST, POLLS))
}

/// A sector of the internal flash, with the sectors before it around.
fn inside() -> Place {
    let sector = CHIP.sector(5).unwrap();
    let around = Region::new(CHIP.flash.base, sector.region.base - CHIP.flash.base);
    Place { sector, around, foreign: 0x2000_0000, polls: POLLS }
}

/// A sector of the serial flash, with those before it around.
fn outside() -> Place {
    let region = Region::new(REGION.base + 6 * SECTOR, SECTOR);
    let around = Region::new(REGION.base, 6 * SECTOR);
    let sector = Sector { number: FIRST + 6, region };
    Place { sector, around, foreign: REGION.end(), polls: POLLS }
}

/// Fills everything, so that nothing is erased by luck.
fn fill(internal: &Internal, serial: &Serial) {
    for (cells, region) in [(&internal.0, CHIP.flash), (&serial.cells, REGION)] {
        cells.model().poke(region.base, &vec![0x5A; region.size as usize]);
    }
}

#[test]
fn a_serial_flash_beside_the_internal_one_passes() {
    let (internal, serial) = (Internal::new(), Serial::new(Lie::None));
    fill(&internal, &serial);
    let mut flash = both(&internal, &serial);
    assert_eq!(demonstrate(&mut flash, &inside()), Ok(()));
    assert_eq!(demonstrate(&mut flash, &outside()), Ok(()));
    // Nothing else was touched, in either.
    for (cells, place) in [(&internal.0, inside()), (&serial.cells, outside())] {
        let mut model = cells.model();
        let touched = std::mem::take(&mut model.touched);
        assert!(
            !touched.is_empty()
                && touched.iter().all(|region| { place.sector.region.contains(region.base, region.size) })
        );
    }
}

/// The power is cut at every operation of the demonstration. With power again, the same sector passes.
#[test]
fn after_a_power_cut_at_any_operation_it_passes() {
    let mut cuts = 0;
    for cut in [Cut::Before, Cut::Torn(1), Cut::Torn(2), Cut::Unstable(3), Cut::Unstable(4), Cut::After] {
        for place in [inside(), outside()] {
            for number in 1.. {
                let (internal, serial) = (Internal::new(), Serial::new(Lie::None));
                fill(&internal, &serial);
                let cells = if place.sector.number < FIRST { &internal.0 } else { &serial.cells };
                cells.model().cut = Some((number, cut));
                if !until_power_cut(|| {
                    let _ = demonstrate(&mut both(&internal, &serial), &place);
                }) {
                    break;
                }
                cuts += 1;
                internal.0.model().power_on();
                let again = demonstrate(&mut both(&internal, &serial.switched_on()), &place);
                assert_eq!(again, Ok(()), "{cut:?} in operation {number} of {place:?}");
            }
        }
    }
    // Two erases, four words, and the first word twice more.
    assert_eq!(cuts, 6 * 2 * (2 + 4 + 2));
}

#[test]
fn what_a_serial_chip_does_wrong_is_named() {
    let place = outside();
    let erase = Operation::Erase(place.sector);
    // The first word that is programmed, in the middle of the sector.
    let address = place.sector.region.base + SECTOR / 2;
    for (lie, expected) in [
        (Lie::NeverEnds, Fault::Failed(erase, FlashFault::Failed)),
        (Lie::Absent, Fault::Refused(erase, FlashFault::Failed)),
        (Lie::Protected, Fault::Refused(erase, FlashFault::Protected)),
        (Lie::StuckBit, Fault::Failed(Operation::Program { address, word: 0 }, FlashFault::Verify)),
        (Lie::ErasesNothing, Fault::NotErased(place.sector.region.base, 0x5A)),
        // Sector 6 of 8 is sector 2, too.
        (Lie::Folded, Fault::Disturbed { address: REGION.base + 2 * SECTOR, was: 0x5A, is: 0xFF }),
    ] {
        let (internal, serial) = (Internal::new(), Serial::new(lie));
        fill(&internal, &serial);
        let found = match demonstrate(&mut both(&internal, &serial), &place).unwrap_err() {
            // Which word does not matter.
            Fault::Failed(Operation::Program { address, .. }, fault) => {
                Fault::Failed(Operation::Program { address, word: 0 }, fault)
            }
            found => found,
        };
        assert_eq!(found, expected, "{lie:?}: {found}");
    }
}

/// A driver that lies, over a flash that is good.
struct Liar {
    flash: Internal,
    lie: DriverLie,
    reads: Cell<u32>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum DriverLie {
    /// Each read begins with another byte than the one before.
    ReadsOtherBytes,
    /// `poll` never says that an operation is over.
    NeverEnds,
    /// A word is programmed at the address after it.
    WrongPlace,
    /// The sector of an address is that before it.
    WrongSector,
    /// Every place is its own.
    TakesAll,
    /// RAM reads as flash.
    ReadsAll,
    /// Its CRC is that of nothing.
    WrongCrc,
    /// All is blank.
    AllBlank,
    /// Nothing is blank.
    NeverBlank,
}

impl Flash for Liar {
    fn read(&self, address: u32, buffer: &mut [u8]) {
        self.flash.read(address, buffer);
        self.reads.set(self.reads.get() + 1);
        match self.lie {
            DriverLie::ReadsOtherBytes => buffer[0] ^= self.reads.get() as u8,
            DriverLie::ReadsAll if !CHIP.flash.contains(address, 1) => buffer.fill(0),
            _ => {}
        }
    }

    fn start(&mut self, operation: Operation) -> Result<(), FlashFault> {
        match operation {
            Operation::Program { address, word } if self.lie == DriverLie::WrongPlace => {
                self.flash.start(Operation::Program { address: address ^ 4, word })
            }
            Operation::Program { address, .. }
                if self.lie == DriverLie::TakesAll && !CHIP.flash.contains(address, 4) =>
            {
                Ok(())
            }
            operation => self.flash.start(operation),
        }
    }

    fn poll(&mut self) -> Poll<Result<(), FlashFault>> {
        match self.lie {
            DriverLie::NeverEnds => Poll::Pending,
            _ => self.flash.poll(),
        }
    }

    fn sector_at(&self, address: u32) -> Option<Sector> {
        match self.lie {
            DriverLie::WrongSector => CHIP.sector(self.flash.sector_at(address)?.number - 1),
            _ => self.flash.sector_at(address),
        }
    }

    fn crc32(&self, crc: u32, region: Region) -> u32 {
        match self.lie {
            DriverLie::WrongCrc => crc,
            _ => self.flash.crc32(crc, region),
        }
    }

    fn is_blank(&self, region: Region) -> bool {
        match self.lie {
            DriverLie::AllBlank => true,
            DriverLie::NeverBlank => false,
            _ => self.flash.is_blank(region),
        }
    }
}

#[test]
fn what_a_driver_does_wrong_is_named() {
    let place = inside();
    let Region { base, .. } = place.sector.region;
    for (lie, words) in [
        (DriverLie::ReadsOtherBytes, "outside the flash and reads"),
        (DriverLie::NeverEnds, "is not over after 10 polls"),
        (DriverLie::WrongPlace, "and must read"),
        (DriverLie::WrongSector, &format!("sector_at({base:08X}h) gives Some(")),
        (DriverLie::TakesAll, "outside the flash"),
        (DriverLie::ReadsAll, "20000000h is outside the flash and reads 00h"),
        (DriverLie::WrongCrc, "is not that of its bytes"),
        (DriverLie::AllBlank, "is_blank of"),
        (DriverLie::NeverBlank, "is_blank of"),
    ] {
        let flash = Internal::new();
        fill(&flash, &Serial::new(Lie::None));
        let mut liar = Liar { flash, lie, reads: Cell::new(0) };
        let found = demonstrate(&mut liar, &place).unwrap_err().to_string();
        assert!(found.contains(words), "{lie:?}: {found}");
    }
    assert_eq!(
        STM32F407VG.sectors().count(),
        usize::from(FIRST),
        "the numbers of the two flashes do not meet"
    );
}
