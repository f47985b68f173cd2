//! The interface between the core and the flash.

use core::task::Poll;

use canopen::program::Supply;
use shared_abi::geometry::{Region, Sector};

use crate::crc;

/// Why a flash operation failed, as the controller reports it (RM0090 section 3.9.5, `FLASH_SR`).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum FlashFault {
    /// The range is write-protected by option bytes.
    Protected,
    /// The operation was refused or failed: sequence, alignment, width or supply.
    Failed,
    /// The word read back differs from the programmed word.
    Verify,
    /// The supply is too low ([`Flash::supply`]): nothing was started.
    Supply,
}

/// One operation of the flash controller.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(C)]
pub enum Operation {
    /// Erase a sector: hundreds of milliseconds.
    Erase(Sector),
    /// Program a word: tens of microseconds.
    Program {
        /// The address, a multiple of 4.
        address: u32,
        /// The word. Programming can only change bits from 1 to 0.
        word: u32,
    },
}

/// The next action of a piece of work on the flash, queried while no operation runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Next<E> {
    /// Start this operation and report its result.
    Start(Operation),
    /// Call again: there is a further bounded computation.
    Again,
    /// The work has ended.
    Done(Result<(), E>),
}

/// A flash that erases sectors and programs words, one operation at a time and without waiting.
///
/// All functions except [`poll`](Self::poll) may only be called while no operation runs, because on
/// the F4 a read from busy flash stalls the core. The programmer ensures this.
pub trait Flash {
    /// Copies `buffer.len()` bytes from `address` on. Addresses outside the flash read FFh.
    fn read(&self, address: u32, buffer: &mut [u8]);

    /// Starts an operation.
    ///
    /// # Errors
    /// The controller's immediate refusal; [`Flash::poll`] reports later faults.
    fn start(&mut self, operation: Operation) -> Result<(), FlashFault>;

    /// The result of the running operation; `Ready(Ok(()))` if none runs.
    fn poll(&mut self) -> Poll<Result<(), FlashFault>>;

    /// The sector that contains this address.
    fn sector_at(&self, address: u32) -> Option<Sector>;

    /// The CRC-32 of earlier data followed by a region; `crc` is the CRC of the earlier data (0 for
    /// none). A chip with a CRC unit overrides this.
    fn crc32(&self, crc: u32, region: Region) -> u32 {
        crc32_by_software(self, crc, region)
    }

    /// Whether all bytes of a region read as erased.
    fn is_blank(&self, region: Region) -> bool {
        fold(self, true, region, |blank, bytes| blank && bytes.iter().all(|byte| *byte == u8::MAX))
    }

    /// Whether the option bytes protect a sector against writing. A register says so: it may be read
    /// at any time.
    fn is_protected(&self, sector: Sector) -> bool {
        let _ = sector;
        false
    }

    /// Whether the supply is good enough to erase and program now. With [`Supply::Low`],
    /// [`start`](Self::start) refuses each operation with [`FlashFault::Supply`].
    fn supply(&self) -> Supply {
        Supply::Unknown
    }

    /// The option bytes as `FLASH_OPTCR` has them; 0 if there are none.
    fn option_bytes(&self) -> u32 {
        0
    }

    /// The word at a word-aligned address.
    fn read_word(&self, address: u32) -> u32 {
        let mut bytes = [0; 4];
        self.read(address, &mut bytes);
        u32::from_le_bytes(bytes)
    }
}

/// Whether a sector is protected against writing, by the option bytes as the chip has them in its
/// registers: `FLASH_OPTCR` for sectors 0 to 11, `FLASH_OPTCR1` for those of a second bank (RM0090
/// sections 3.9.10 and 3.9.11). A bit nWRP that is 0 protects its sector. With SPRMOD, which not all
/// chips have, the bits mean read-out protection, and a 1 protects against reading and writing.
#[must_use]
pub const fn is_write_protected(sector: u8, optcr: u32, optcr1: u32) -> bool {
    const SPRMOD: u32 = 1 << 31;
    const FIRST: u8 = 16;
    const OF_A_BANK: u8 = 12;
    let nwrp = match sector.checked_sub(OF_A_BANK) {
        None => optcr >> (FIRST + sector),
        Some(sector) => optcr1.wrapping_shr((FIRST + sector) as u32),
    } & 1
        != 0;
    nwrp == (optcr & SPRMOD != 0)
}

/// [`Flash::crc32`] for a chip without a CRC unit, and for data that the unit cannot process.
pub fn crc32_by_software<F: Flash + ?Sized>(flash: &F, crc: u32, region: Region) -> u32 {
    fold(flash, crc, region, crc::resume)
}

/// Folds a function over the bytes of a region, 64 bytes at a time.
pub(crate) fn fold<F: Flash + ?Sized, T>(
    flash: &F,
    start: T,
    region: Region,
    f: impl Fn(T, &[u8]) -> T,
) -> T {
    let mut result = start;
    let mut chunk = [0; 64];
    for offset in (0..region.size).step_by(chunk.len()) {
        let bytes = &mut chunk[..(region.size - offset).min(64) as usize];
        flash.read(region.base + offset, bytes);
        result = f(result, bytes);
    }
    result
}

/// Carries out a piece of work and waits for each operation, for callers with no other work. `next`
/// gets the result of the previous operation and returns the next action.
pub fn run<F: Flash, E>(
    flash: &mut F,
    mut next: impl FnMut(&F, Result<(), FlashFault>) -> Next<E>,
) -> Result<(), E> {
    let mut outcome = Ok(());
    loop {
        match next(flash, outcome) {
            Next::Start(operation) => {
                outcome = flash.start(operation);
                while outcome.is_ok() {
                    if let Poll::Ready(ended) = flash.poll() {
                        outcome = ended;
                        break;
                    }
                }
            }
            Next::Again => outcome = Ok(()),
            Next::Done(result) => return result,
        }
    }
}

impl<F: Flash> Flash for &mut F {
    fn read(&self, address: u32, buffer: &mut [u8]) {
        (**self).read(address, buffer);
    }

    fn start(&mut self, operation: Operation) -> Result<(), FlashFault> {
        (**self).start(operation)
    }

    fn poll(&mut self) -> Poll<Result<(), FlashFault>> {
        (**self).poll()
    }

    fn sector_at(&self, address: u32) -> Option<Sector> {
        (**self).sector_at(address)
    }

    fn crc32(&self, crc: u32, region: Region) -> u32 {
        (**self).crc32(crc, region)
    }

    fn is_blank(&self, region: Region) -> bool {
        (**self).is_blank(region)
    }

    fn is_protected(&self, sector: Sector) -> bool {
        (**self).is_protected(sector)
    }

    fn supply(&self) -> Supply {
        (**self).supply()
    }

    fn option_bytes(&self) -> u32 {
        (**self).option_bytes()
    }

    fn read_word(&self, address: u32) -> u32 {
        (**self).read_word(address)
    }
}

/// The value of an erased word.
pub const ERASED: u32 = u32::MAX;
