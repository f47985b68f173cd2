//! What is odd about a file that can be used all the same.

use std::fmt;

use shared_abi::layout::{Layout, BOARDS};

use super::fault::Place;
use super::range::AddressRange;
use crate::advice::Advice;

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
    /// The program covers flash from this address on that a new bootloader needs.
    CoversStaging(u32),
    /// The same, for a board of this name: the board of the device is not known.
    CoversStagingOf(&'static str, u32),
}

impl Note {
    /// The note about a program from `first` to `last`, for this board, or for the first one with such a program.
    #[must_use]
    pub fn of_staging(AddressRange { first, last }: AddressRange, board: Option<&Layout>) -> Option<Self> {
        let covered = |board: &Layout| {
            let staging = board.staging.filter(|staging| AddressRange::from(*staging).has(last))?;
            board.programs.iter().any(|region| AddressRange::from(*region).has(first)).then_some(staging.base)
        };
        match board {
            Some(board) => covered(board).map(Self::CoversStaging),
            None => BOARDS.iter().find_map(|board| Some(Self::CoversStagingOf(board.board, covered(board)?))),
        }
    }
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
            Self::CoversStaging(first) => write!(
                f,
                "the program reaches into staging, from {first:08X}h on, where a new bootloader waits: before the \
                 bootloader can be renewed, the program has to be erased; {}",
                Advice::EndBeforeStaging
            ),
            Self::CoversStagingOf(board, first) => write!(f, "on {board} {}", Self::CoversStaging(*first)),
            Self::NoLoadAddress(range) => write!(
                f,
                "the data at {range} were left out: they are for the RAM, and no segment has a load address in the \
                 flash; if the program needs these initial values, link it with load addresses (AT > FLASH)"
            ),
        }
    }
}
