//! The empty types.

/// The progress of a download: it always begins at its start.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Partial;

impl Partial {
    /// No download.
    pub const NONE: Self = Self;

    /// A download.
    #[must_use]
    pub const fn begin(_id: u32, _base: u32) -> Self {
        Self
    }

    /// From its stored form.
    #[must_use]
    pub const fn of_words(_words: [u32; 2]) -> Self {
        Self
    }

    /// The stored form.
    #[must_use]
    pub const fn words(self) -> [u32; 2] {
        [0; 2]
    }

    pub(crate) const fn is_same(self, _other: Self) -> bool {
        false
    }

    pub(crate) const fn disown(&mut self) -> bool {
        false
    }

    pub(crate) const fn is_resumed(self) -> bool {
        false
    }

    pub(crate) const fn start(self, base: u32) -> u32 {
        base
    }

    pub(crate) const fn note(&mut self, _end: u32, _size: u32) -> bool {
        false
    }
}

/// The last block of data: each block comes once, in order.
#[derive(Clone, Copy, Debug)]
pub struct LastBlock;

impl LastBlock {
    /// No block yet.
    #[must_use]
    pub const fn none(_end: u32) -> Self {
        Self
    }

    pub(crate) const fn end(&self) -> u32 {
        0
    }

    pub(crate) const fn may_follow(&self, next: u32, number: u32, _address: u32) -> bool {
        number == next
    }

    pub(crate) const fn is_again(&self, _next: u32, _number: u32) -> bool {
        false
    }

    pub(crate) const fn has_crc(&self, _crc: u32) -> bool {
        false
    }

    pub(crate) const fn replace(&mut self, _number: u32, _crc: u32, _end: u32) {}

    pub(crate) const fn next(&self, next: u32) -> u32 {
        next.wrapping_add(1)
    }
}
