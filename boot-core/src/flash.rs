//! The seam to the flash: what the engine asks of it, and nothing of how it is done.

use core::task::Poll;

use shared_abi::geometry::{Region, Sector};

use crate::crc;

/// Why a flash operation failed, as the controller tells it (RM0090 section 3.8.4, `FLASH_SR`).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FlashFault {
    /// The range is write-protected by option bytes.
    Protected,
    /// The operation was refused or failed: sequence, alignment, width or supply.
    Failed,
    /// The word reads back differently from what was programmed.
    Verify,
}

/// A flash that erases by sectors and programs by words, one operation at a time and without
/// waiting for it.
///
/// `read` and the starts may only be called while no operation runs: the engine of this crate sees
/// to it, because on the F4 a read from busy flash stalls the core.
pub trait Flash {
    /// Copies `buffer.len()` bytes from `address` on. Addresses outside the flash read FFh.
    fn read(&self, address: u32, buffer: &mut [u8]);

    /// Starts to erase one sector.
    ///
    /// # Errors
    /// What the controller says at once; later faults come from [`Flash::poll`].
    fn start_erase(&mut self, sector: Sector) -> Result<(), FlashFault>;

    /// Starts to program one word at a word-aligned address.
    ///
    /// # Errors
    /// What the controller says at once; later faults come from [`Flash::poll`].
    fn start_program(&mut self, address: u32, word: u32) -> Result<(), FlashFault>;

    /// The outcome of the running operation, `Ready(Ok(()))` when none runs.
    fn poll(&mut self) -> Poll<Result<(), FlashFault>>;

    /// The CRC-32 of a region behind data whose CRC is `crc` (0 for none). A chip that has a unit
    /// for it overrides this.
    fn crc32(&self, crc: u32, region: Region) -> u32 {
        crc32_by_software(self, crc, region)
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

impl<F: Flash> Flash for &mut F {
    fn read(&self, address: u32, buffer: &mut [u8]) {
        (**self).read(address, buffer);
    }

    fn start_erase(&mut self, sector: Sector) -> Result<(), FlashFault> {
        (**self).start_erase(sector)
    }

    fn start_program(&mut self, address: u32, word: u32) -> Result<(), FlashFault> {
        (**self).start_program(address, word)
    }

    fn poll(&mut self) -> Poll<Result<(), FlashFault>> {
        (**self).poll()
    }

    fn crc32(&self, crc: u32, region: Region) -> u32 {
        (**self).crc32(crc, region)
    }

    fn read_word(&self, address: u32) -> u32 {
        (**self).read_word(address)
    }
}

/// What an erased word reads as.
pub const ERASED: u32 = u32::MAX;

/// A row of words being programmed one after the other, each read back.
#[derive(Clone, Copy, Debug)]
pub(crate) struct WordWriter {
    address: u32,
    written: usize,
    running: bool,
}

impl WordWriter {
    pub(crate) const fn new(address: u32) -> Self {
        Self { address, written: 0, running: false }
    }

    /// Carries on. `word(i)` gives the i-th of `count` words. `Pending` while the flash works.
    pub(crate) fn poll<F: Flash>(
        &mut self,
        flash: &mut F,
        count: usize,
        word: impl Fn(usize) -> u32,
    ) -> Poll<Result<(), FlashFault>> {
        loop {
            match flash.poll() {
                Poll::Pending => return Poll::Pending,
                Poll::Ready(Err(error)) => return Poll::Ready(Err(error)),
                Poll::Ready(Ok(())) => {}
            }
            let address = self.address + 4 * self.written as u32;
            if self.running {
                self.running = false;
                if flash.read_word(address) != word(self.written) {
                    return Poll::Ready(Err(FlashFault::Verify));
                }
                self.written += 1;
            } else if self.written == count {
                return Poll::Ready(Ok(()));
            } else {
                if let Err(error) = flash.start_program(address, word(self.written)) {
                    return Poll::Ready(Err(error));
                }
                self.running = true;
            }
        }
    }
}

/// A row of whole sectors being erased one after the other.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SectorEraser {
    next: u32,
    end: u32,
}

impl SectorEraser {
    pub(crate) const fn new(region: shared_abi::geometry::Region) -> Self {
        Self { next: region.base, end: region.end() }
    }

    /// Carries on. `Pending` while the flash works.
    pub(crate) fn poll<F: Flash>(
        &mut self,
        flash: &mut F,
        chip: &shared_abi::geometry::Geometry,
    ) -> Poll<Result<(), FlashFault>> {
        loop {
            match flash.poll() {
                Poll::Pending => return Poll::Pending,
                Poll::Ready(Err(error)) => return Poll::Ready(Err(error)),
                Poll::Ready(Ok(())) => {}
            }
            if self.next >= self.end {
                return Poll::Ready(Ok(()));
            }
            // A checked layout ends at sector borders; a region outside the flash is refused, not
            // looped over.
            let Some(sector) = chip.sector_at(self.next) else {
                return Poll::Ready(Err(FlashFault::Failed));
            };
            self.next = sector.region.end();
            if let Err(error) = flash.start_erase(sector) {
                return Poll::Ready(Err(error));
            }
        }
    }
}

/// Whether all bytes read as erased.
pub fn is_blank<F: Flash>(flash: &F, region: Region) -> bool {
    fold(flash, true, region, |blank, bytes| blank && bytes.iter().all(|byte| *byte == u8::MAX))
}
