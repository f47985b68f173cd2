//! The state of a program's download: from one transfer to the next, and from one block to the next.

/// The number of a block that is not known: the sequence goes on with any block that begins at most
/// where the existing data end.
pub(crate) const ANY: u32 = 0;

/// The state of a program's download. It continues from one SDO transfer to the next.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Session {
    /// No block was accepted yet.
    Idle,
    /// CLEAR was acknowledged; nothing is lost yet. `just`: no block has arrived since.
    Cleared { just: bool },
    /// Blocks are being accepted; `next` is the number of the next one, [`ANY`] for a download
    /// that goes on.
    Open { next: u32 },
    /// The flash contains an incomplete program: only CLEAR allows a new download.
    Failed,
}

/// The last block of data that was accepted.
#[derive(Clone, Copy, Debug)]
pub(crate) struct LastBlock {
    crc: u32,
    number: u32,
    /// The address after its data.
    end: u32,
}

impl LastBlock {
    /// No block yet; the data so far end at this address.
    pub(crate) const fn none(end: u32) -> Self {
        Self { crc: 0, number: ANY, end }
    }

    /// The address up to which the blocks have come.
    pub(crate) const fn end(&self) -> u32 {
        self.end
    }

    /// Whether a block may come when number `next` is expected: the next one, the last one again,
    /// or any that joins the existing data.
    pub(crate) const fn may_follow(&self, next: u32, number: u32, address: u32) -> bool {
        number == next || self.number == number || next == ANY && address <= self.end
    }

    /// Whether a block that [may come](Self::may_follow) is the last one again.
    pub(crate) const fn is_again(&self, next: u32, number: u32) -> bool {
        self.number == number && number != next
    }

    /// Whether it had this CRC.
    pub(crate) const fn has_crc(&self, crc: u32) -> bool {
        self.crc == crc
    }

    /// Replaces it, and returns the number of the next one.
    pub(crate) const fn replace(&mut self, number: u32, crc: u32, end: u32) {
        *self = Self { crc, number, end };
    }

    /// The number of the block after it.
    pub(crate) const fn next(&self) -> u32 {
        self.number.wrapping_add(1)
    }
}
