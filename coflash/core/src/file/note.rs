//! What is odd about a file that can be used all the same.

use std::fmt;

use super::fault::Place;
use super::range::AddressRange;

/// A warning about a firmware file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Note {
    /// The file has the same bytes for the same addresses more than once.
    Twice {
        /// The first address with data that are there twice.
        address: u32,
        /// The place of the second data.
        place: Place,
        /// The place of the first data.
        with: Place,
        /// The number of records or segments that repeat data.
        count: usize,
    },
    /// Data that run in RAM, of an ELF file without load addresses: nothing says where in the flash
    /// they are.
    NoLoadAddress(AddressRange),
}

impl fmt::Display for Note {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Twice { address, place, with, count } => {
                write!(f, "{place}: the data at {address:#010x} are those of {with} once more")?;
                match count {
                    1 => Ok(()),
                    count => write!(f, ", the first of {count} repetitions"),
                }
            }
            Self::NoLoadAddress(range) => write!(
                f,
                "the data at {range} were left out: they are for the RAM, and no segment has a load address in the \
                 flash; if the program needs these initial values, link it with load addresses (AT > FLASH)"
            ),
        }
    }
}
