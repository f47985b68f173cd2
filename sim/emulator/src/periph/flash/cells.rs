//! The cells of the array, and what an operation does to them, as a whole or in part.

use std::collections::BTreeMap;

use shared_abi::geometry::{Geometry, Sector};

use crate::noise::Noise;

/// The cells between 0 and 1 that an erase leaves which the power failure found in the middle. On
/// the chip it is as many as the sector has; here a few, all over the sector.
const BETWEEN: usize = 16;

/// The effect of an operation on the array when it ends.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Operation {
    /// These bytes are programmed at this offset of the array.
    Program {
        /// Offset from the start of the flash.
        offset: u32,
        /// What was written; bits that are 0 in the array stay 0.
        bytes: Vec<u8>,
    },
    /// These sectors are erased; one, or all of them.
    Erase {
        /// In address order.
        sectors: Vec<Sector>,
    },
    /// The option bytes are programmed.
    Options {
        /// The value of OPTCR without its lock and start bits.
        optcr: u32,
    },
}

/// The point within an operation at which the power fails.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cut {
    /// Before it changed anything.
    Before,
    /// When it was complete.
    After,
    /// In the middle: some bits of a word are programmed, some bytes of a sector erased; which ones
    /// follows from the seed.
    Torn {
        /// Chooses the bits.
        seed: u64,
    },
    /// In the middle, and some bits are left between 0 and 1: they read differently each time, until
    /// they are programmed to 0 or erased again.
    Unstable {
        /// Chooses the bits.
        seed: u64,
    },
}

/// What the array holds without power.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Cells {
    /// The bytes, each bit as it would read.
    pub bytes: Vec<u8>,
    /// The bits between 0 and 1, by the offset of their byte.
    pub unstable: BTreeMap<u32, u8>,
}

impl Cells {
    /// Carries an operation out up to this point; option bytes are no part of the array.
    pub fn apply(&mut self, operation: &Operation, geometry: &Geometry, until: Cut) {
        carry_out(operation, geometry, until, &mut self.bytes, &mut self.unstable);
    }
}

/// The ranges of the array that a sector's erase concerns, as offset and length.
fn place(geometry: &Geometry, sector: &Sector) -> (u32, u32) {
    (sector.region.base - geometry.flash.base, sector.region.size)
}

/// Carries an operation out up to this point. Returns the ranges of the array that it concerns, as
/// offset and length.
pub(super) fn carry_out(
    operation: &Operation,
    geometry: &Geometry,
    until: Cut,
    array: &mut [u8],
    unstable: &mut BTreeMap<u32, u8>,
) -> Vec<(u32, u32)> {
    let seed = match until {
        Cut::Before => return Vec::new(),
        Cut::After => None,
        Cut::Torn { seed } | Cut::Unstable { seed } => Some(seed),
    };
    let leaves_between = matches!(until, Cut::Unstable { .. });
    let mut noise = Noise(seed.unwrap_or(0));
    match operation {
        Operation::Program { offset, bytes } => {
            for (at, byte) in (*offset..).zip(bytes) {
                let cell = &mut array[at as usize];
                let between = *cell & !byte;
                // Each bit that should become 0 does so or not.
                *cell &= if seed.is_some() { byte | noise.byte() } else { *byte };
                if seed.is_none() {
                    // A bit that is programmed to 0 is certain.
                    if let Some(bits) = unstable.get_mut(&at) {
                        *bits &= byte;
                    }
                } else if leaves_between {
                    *unstable.entry(at).or_default() |= between & noise.byte();
                }
            }
            unstable.retain(|_, bits| *bits != 0);
            vec![(*offset, u32::try_from(bytes.len()).unwrap_or(u32::MAX))]
        }
        Operation::Erase { sectors } => {
            for sector in sectors {
                let (start, len) = place(geometry, sector);
                let cells = &mut array[start as usize..(start + len) as usize];
                let programmed: Vec<_> = match leaves_between {
                    true => {
                        (start..).zip(&*cells).filter(|(_, cell)| **cell != 0xFF).map(|(at, _)| at).collect()
                    }
                    false => Vec::new(),
                };
                // A cell on its way to 1 reads as what it was, as 1, or as either.
                for cell in cells {
                    *cell |= if seed.is_some() { noise.byte() } else { 0xFF };
                }
                if seed.is_none() {
                    unstable.retain(|at, _| !(start..start + len).contains(at));
                }
                for _ in 0..BETWEEN.min(programmed.len()) {
                    let at = programmed[noise.word() as usize % programmed.len()];
                    *unstable.entry(at).or_default() |= 1 << (noise.word() % 8);
                }
            }
            sectors.iter().map(|sector| place(geometry, sector)).collect()
        }
        Operation::Options { .. } => Vec::new(),
    }
}

/// The bits that an operation with too little voltage changes and that do not last: some of each byte that is
/// programmed, and some cells of a sector that is erased. With the offset of their byte.
pub(super) fn weak_bits(
    operation: &Operation,
    geometry: &Geometry,
    array: &[u8],
    noise: &mut Noise,
) -> Vec<(u32, u8)> {
    match operation {
        Operation::Program { offset, bytes } => {
            let bits = |(at, byte): (u32, &u8)| (at, array[at as usize] & !byte & noise.byte());
            (*offset..).zip(bytes).map(bits).filter(|(_, bits)| *bits != 0).collect()
        }
        Operation::Erase { sectors } => {
            let of_sector = |(start, len): (u32, u32)| {
                let programmed = (start..start + len).filter(|at| array[*at as usize] != 0xFF);
                programmed.step_by(len as usize / BETWEEN).map(|at| (at, !array[at as usize]))
            };
            sectors.iter().flat_map(|sector| of_sector(place(geometry, sector))).collect()
        }
        Operation::Options { .. } => Vec::new(),
    }
}
