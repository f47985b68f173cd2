//! Programs: what is known of one, and the proof that one may be started.

use shared_abi::geometry::Region;
use shared_abi::layout::Layout;
use shared_abi::vectors::{VectorFault, VectorTable};

use crate::crc::CrcKind;
use crate::flash::{fold, Flash};
use crate::keys::is_sealed;
use crate::store::{Parameters, ProgramRecord};

/// A CRC over flash, computed in steps that the caller bounds.
#[derive(Clone, Copy, Debug)]
pub struct FlashCrc {
    crc: u32,
    rest: Region,
}

impl FlashCrc {
    /// Over this region, which must be inside the flash.
    #[must_use]
    pub const fn new(region: Region) -> Self {
        Self { crc: 0, rest: region }
    }

    /// Goes on over at most `budget` bytes; whether the end is reached.
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

/// What a program has to be that was sent completely.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Expected {
    /// Bytes from the start of its region on.
    pub size: u32,
    /// `None`: what is in flash, word for word what was sent.
    pub crc: Option<u32>,
}

/// Why a program may not be started.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Invalid {
    /// There is no such program in the layout.
    NoSuchProgram,
    /// Nothing was downloaded, or not completely.
    Absent,
    /// The stored size exceeds the region: the record cannot be of this layout.
    Size,
    /// The flash does not hold what was downloaded.
    Crc,
    /// The vector table is implausible.
    Vectors(VectorFault),
}

/// A program that has passed every check of its contents. Only [`verify`] makes one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct VerifiedProgram {
    number: u8,
    record: ProgramRecord,
    vectors: VectorTable,
}

impl VerifiedProgram {
    /// 1 to 254.
    #[must_use]
    pub const fn number(&self) -> u8 {
        self.number
    }

    /// Whether it is released for autostart.
    #[must_use]
    pub const fn signed(&self) -> bool {
        self.record.signed
    }

    /// Whether it has proved that the bootloader can be reached from it, so that it starts without
    /// a rescue window.
    #[must_use]
    pub const fn confirmed(&self) -> bool {
        self.record.confirmed
    }

    /// Whether the flash is locked in front of it until the next reset.
    #[cfg(feature = "sealed")]
    #[must_use]
    pub fn locks_flash(&self) -> bool {
        self.record.seal == Some(crate::store::record::Seal::Locked)
    }

    /// What to jump to.
    #[must_use]
    pub const fn vectors(&self) -> VectorTable {
        self.vectors
    }
}

/// Checks the vector table at the start of a program's flash.
///
/// # Errors
/// The rule that it breaks.
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
/// The first thing that is wrong with it.
pub fn verify<F: Flash>(
    flash: &F,
    parameters: &impl Parameters,
    layout: &Layout,
    kind: CrcKind,
    number: u8,
) -> Result<VerifiedProgram, Invalid> {
    let region = layout.program(number).ok_or(Invalid::NoSuchProgram)?;
    let record = ProgramRecord::load(parameters, flash, number).ok_or(Invalid::Absent)?;
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
    Ok(VerifiedProgram { number, record, vectors })
}
