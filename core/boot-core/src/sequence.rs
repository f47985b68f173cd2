//! Sequences of flash operations: sectors to erase, words to program. A sequence returns its next
//! operation when the previous one has ended.

use shared_abi::geometry::Region;

use crate::flash::{Flash, FlashFault, Operation};

/// Words that are programmed one after another and read back.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct ProgramWords {
    address: u32,
    written: usize,
    running: bool,
}

impl ProgramWords {
    pub(crate) const fn new(address: u32) -> Self {
        Self { address, written: 0, running: false }
    }

    /// The next operation, `None` after all words. `word(i)` returns word i of `count`.
    pub(crate) fn next<F: Flash>(
        &mut self,
        flash: &F,
        count: usize,
        word: impl Fn(usize) -> u32,
    ) -> Result<Option<Operation>, FlashFault> {
        if self.running {
            self.running = false;
            if flash.read_word(self.at()) != word(self.written) {
                return Err(FlashFault::Verify);
            }
            self.written += 1;
        }
        if self.written == count {
            return Ok(None);
        }
        self.running = true;
        Ok(Some(Operation::Program { address: self.at(), word: word(self.written) }))
    }

    /// The number of words that are programmed and were read back.
    pub(crate) const fn written(&self) -> usize {
        self.written
    }

    /// The address of the word whose turn it is.
    pub(crate) const fn at(&self) -> u32 {
        self.address + 4 * self.written as u32
    }
}

/// Whole sectors that are erased one after another.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct EraseSectors {
    next: u32,
    end: u32,
}

impl EraseSectors {
    pub(crate) const fn new(region: Region) -> Self {
        Self { next: region.base, end: region.end() }
    }

    /// An address in the sector whose erase began last.
    pub(crate) const fn at(&self) -> u32 {
        self.next.wrapping_sub(1)
    }

    /// The next operation, `None` after all sectors.
    pub(crate) fn next<F: Flash>(&mut self, flash: &F) -> Result<Option<Operation>, FlashFault> {
        if self.next >= self.end {
            return Ok(None);
        }
        // A checked layout ends at a sector border; a region outside the flash is refused.
        let sector = flash.sector_at(self.next).ok_or(FlashFault::Failed)?;
        self.next = sector.region.end();
        Ok(Some(Operation::Erase(sector)))
    }
}
