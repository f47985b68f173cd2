//! The seam to the flash: what the core asks of it, and nothing of how it is done.

use core::task::Poll;

use shared_abi::geometry::{Region, Sector};

use crate::crc;

/// Why a flash operation failed, as the controller tells it (RM0090 section 3.8.4, `FLASH_SR`).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum FlashFault {
    /// The range is write-protected by option bytes.
    Protected,
    /// The operation was refused or failed: sequence, alignment, width or supply.
    Failed,
    /// The word reads back differently from what was programmed.
    Verify,
}

/// One operation of the flash controller.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(C)]
pub enum Operation {
    /// Erase a sector: hundreds of milliseconds.
    Erase(Sector),
    /// Program a word: tens of microseconds.
    Program {
        /// Where; word-aligned.
        address: u32,
        /// What. Bits can only go from 1 to 0.
        word: u32,
    },
}

/// What a piece of work on the flash does next, told while no operation runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Next<E> {
    /// This operation; its outcome is to be told.
    Start(Operation),
    /// A further bounded computation.
    Again,
    /// Nothing: the work is over.
    Done(Result<(), E>),
}

/// A flash that erases by sectors and programs by words, one operation at a time and without
/// waiting for it.
///
/// Everything but [`poll`](Self::poll) may only be called while no operation runs, because on the
/// F4 a read from busy flash stalls the core. The programmer sees to it.
pub trait Flash {
    /// Copies `buffer.len()` bytes from `address` on. Addresses outside the flash read FFh.
    fn read(&self, address: u32, buffer: &mut [u8]);

    /// Starts an operation.
    ///
    /// # Errors
    /// What the controller says at once; later faults come from [`Flash::poll`].
    fn start(&mut self, operation: Operation) -> Result<(), FlashFault>;

    /// The outcome of the running operation, `Ready(Ok(()))` when none runs.
    fn poll(&mut self) -> Poll<Result<(), FlashFault>>;

    /// The sector that holds this address.
    fn sector_at(&self, address: u32) -> Option<Sector>;

    /// The CRC-32 of a region behind data whose CRC is `crc` (0 for none). A chip that has a unit
    /// for it overrides this.
    fn crc32(&self, crc: u32, region: Region) -> u32 {
        crc32_by_software(self, crc, region)
    }

    /// Whether all bytes of a region read as erased.
    fn is_blank(&self, region: Region) -> bool {
        fold(self, true, region, |blank, bytes| blank && bytes.iter().all(|byte| *byte == u8::MAX))
    }

    /// The word at a word-aligned address.
    fn read_word(&self, address: u32) -> u32 {
        let mut bytes = [0; 4];
        self.read(address, &mut bytes);
        u32::from_le_bytes(bytes)
    }
}

/// [`Flash::crc32`] for a chip without a unit, and for what its unit does not take.
pub fn crc32_by_software<F: Flash + ?Sized>(flash: &F, crc: u32, region: Region) -> u32 {
    fold(flash, crc, region, crc::resume)
}

/// A function over the bytes of a region, 64 at a time.
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

/// Carries a piece of work through and waits for each operation, for those who have nothing else to
/// do: `next` tells what follows on the outcome of the operation before.
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

    fn read_word(&self, address: u32) -> u32 {
        (**self).read_word(address)
    }
}

/// What an erased word reads as.
pub const ERASED: u32 = u32::MAX;
