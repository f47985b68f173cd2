//! What a device keeps of a download of block files, so that it can go on after a cut, and so that
//! a block may come twice.
//!
//! A bootloader with sealed images has no room for it: there, each type is empty.

#[cfg(feature = "sealed")]
mod absent;
mod number;
#[cfg(not(feature = "sealed"))]
mod present;

pub(crate) use number::ANY;

#[cfg(feature = "sealed")]
pub use absent::{LastBlock, Partial};
#[cfg(not(feature = "sealed"))]
pub use present::{LastBlock, Partial};

/// Whether the bootloader has room for downloads that go on, and for the second SDO server.
pub const HAS_ROOM: bool = !cfg!(feature = "sealed");
