//! The errors of a machine.

use shared_abi::geometry::Geometry;

/// An error in setting up a machine.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The CPU emulation refused.
    #[error("{doing}: {error}")]
    Engine {
        /// The action that failed.
        doing: &'static str,
        /// The error of the CPU emulation.
        error: String,
    },
    /// The image cannot be used.
    #[error("{0}")]
    Image(String),
    /// Bytes of an image lie outside the flash of the chip.
    #[error(
        "{len} bytes at {address:08X}h are not all in the flash of the {}, which has {} KiB from {:08X}h on",
        .chip.chip.to_uppercase(), .chip.flash.size / 1024, .chip.flash.base
    )]
    Flash {
        /// First address.
        address: u32,
        /// Length.
        len: usize,
        /// The chip.
        chip: &'static Geometry,
    },
    /// An address lies outside the required memory.
    #[error("{len} bytes at {address:08X}h are not all in {wanted}")]
    Address {
        /// First address.
        address: u32,
        /// Length.
        len: usize,
        /// The memory that they must be in.
        wanted: &'static str,
    },
}
