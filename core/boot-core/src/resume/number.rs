//! The numbers of blocks.

/// The number of a block that is not known: the sequence goes on with any block that begins at most
/// where the existing data end.
pub(crate) const ANY: u32 = 0;
