//! Ranges of addresses.

use std::fmt;

use shared_abi::geometry::Region;

/// A range of addresses that includes both ends, so that it can reach the end of the address space.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct AddressRange {
    /// First address.
    pub first: u32,
    /// Last address.
    pub last: u32,
}

impl AddressRange {
    /// Every address.
    pub const ALL: Self = Self { first: 0, last: u32::MAX };

    /// The number of addresses.
    #[must_use]
    pub const fn len(&self) -> u64 {
        (self.last as u64 + 1).saturating_sub(self.first as u64)
    }

    /// Whether it ends before it starts.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.last < self.first
    }

    /// Whether an address lies inside.
    #[must_use]
    pub const fn has(&self, address: u32) -> bool {
        self.first <= address && address <= self.last
    }

    /// Whether both ends of `other` lie inside.
    #[must_use]
    pub const fn contains(&self, other: &Self) -> bool {
        self.first <= other.first && other.last <= self.last
    }
}

impl From<Region> for AddressRange {
    fn from(region: Region) -> Self {
        Self { first: region.base, last: region.base.saturating_add(region.size.saturating_sub(1)) }
    }
}

impl fmt::Display for AddressRange {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:#010x}..={:#010x}", self.first, self.last)
    }
}
