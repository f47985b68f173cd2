//! Programs: the check before a start, and the proof that it was made.

use shared_abi::geometry::Region;
use shared_abi::layout::Layout;
use shared_abi::vectors::{VectorFault, VectorTable};

use crate::crc::CrcKind;
use crate::flash::{fold, Flash};
use crate::keys::is_sealed;
use crate::store::{Parameters, ProgramRecord, Seal};

/// A CRC over flash, computed in steps of limited length.
#[derive(Clone, Copy, Debug)]
pub struct FlashCrc {
    crc: u32,
    rest: Region,
}

impl FlashCrc {
    /// A CRC over this region, which must lie inside the flash.
    #[must_use]
    pub const fn new(region: Region) -> Self {
        Self { crc: 0, rest: region }
    }

    /// Continues over at most `budget` bytes; returns whether the end is reached.
    pub fn step<F: Flash>(&mut self, flash: &F, kind: CrcKind, budget: u32) -> bool {
        let len = self.rest.size.min(budget);
        let next = Region::new(self.rest.base, len);
        self.crc = match kind {
            CrcKind::Crc32 => flash.crc32(self.crc, next),
            CrcKind::Crc16 => fold(flash, self.crc, next, |crc, bytes| kind.resume(crc, bytes)),
        };
        self.rest = Region::new(self.rest.base + len, self.rest.size - len);
        self.rest.size == 0
    }

    /// The CRC so far.
    #[must_use]
    pub const fn value(&self) -> u32 {
        self.crc
    }
}

/// The expected properties of a completely sent program.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Expected {
    /// Size in bytes, from the start of its region.
    pub size: u32,
    /// The CRC; `None` if the flash was already compared with the sent data word by word.
    pub crc: Option<u32>,
}

/// Why a program may not be started.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Invalid {
    /// The layout has no program with this number.
    NoSuchProgram,
    /// No program was downloaded completely.
    Absent,
    /// The stored size exceeds the region: the record belongs to another layout.
    Size,
    /// The contents of the flash differ from the download.
    Crc,
    /// The vector table is implausible.
    Vectors(VectorFault),
}

/// A program that has passed every check of its contents.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct VerifiedProgram<V = VectorTable> {
    /// For the jump: the proof of the checks, by [`verify`]; `()` where it is not started.
    pub vectors: V,
    /// Whether it is released for autostart.
    pub signed: bool,
    /// Whether it has proved that it can return to the bootloader, so that it starts without a
    /// rescue window.
    pub confirmed: bool,
    /// Whether the flash must be locked until the next reset before it starts.
    pub locks_flash: bool,
}

/// Checks the vector table at the start of a program's flash.
///
/// # Errors
/// The broken rule.
pub fn check_vectors<F: Flash>(
    flash: &F,
    region: Region,
    layout: &Layout,
) -> Result<VectorTable, VectorFault> {
    let words = [flash.read_word(region.base), flash.read_word(region.base + 4)];
    VectorTable::check(words, region, layout)
}

/// Checks program `number` from its record to its last byte.
///
/// # Errors
/// The first fault.
pub fn verify<F: Flash>(
    flash: &F,
    parameters: &impl Parameters,
    layout: &Layout,
    kind: CrcKind,
    number: u8,
) -> Result<VerifiedProgram, Invalid> {
    let region = layout.program(number).ok_or(Invalid::NoSuchProgram)?;
    let record = parameters.program(flash, number).ok_or(Invalid::Absent)?;
    if !record.is_sealed() && is_sealed(flash, parameters, layout) {
        return Err(Invalid::Absent);
    }
    if record.size > region.size {
        return Err(Invalid::Size);
    }
    let vectors = check_vectors(flash, region, layout).map_err(Invalid::Vectors)?;
    let mut crc = FlashCrc::new(Region::new(region.base, record.size));
    if !crc.step(flash, kind, record.size) || crc.value() != record.crc {
        return Err(Invalid::Crc);
    }
    let ProgramRecord { signed, confirmed, seal, .. } = record;
    Ok(VerifiedProgram { vectors, signed, confirmed, locks_flash: seal == Some(Seal::Locked) })
}
