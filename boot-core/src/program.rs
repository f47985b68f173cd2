//! Programs: what is known of one, and the proof that one may be started.

use shared_abi::geometry::Region;
use shared_abi::layout::Layout;
use shared_abi::vectors::{VectorFault, VectorTable};

use crate::crc;
use crate::flash::{fold, Flash};
use crate::parameters::{Key, Parameters, Value};

/// The word that stands for "signed" in a program's record.
pub const SIGNATURE: u32 = u32::from_le_bytes(*b"APP1");

/// What the parameters tell of a program that was downloaded completely and whose CRC was right
/// then.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ProgramRecord {
    /// Bytes from the start of its region on.
    pub size: u32,
    /// CRC-32 over them.
    pub crc: u32,
    /// Whether 1F51h = 83h has marked it valid for the autostart.
    pub signed: bool,
    /// The version that its control block told, 0 for none.
    pub version: u32,
}

impl ProgramRecord {
    /// The stored form of "no program".
    pub const NONE: Value = [0; 4];

    /// From the parameters; `None` where there is no program.
    pub fn load<F: Flash>(parameters: &impl Parameters, flash: &F, number: u8) -> Option<Self> {
        let [size, crc, signature, version] = parameters.get(flash, Key::Program(number))?;
        (size > 0).then_some(Self { size, crc, signed: signature == SIGNATURE, version })
    }

    /// The stored form.
    #[must_use]
    pub const fn value(&self) -> Value {
        [self.size, self.crc, if self.signed { SIGNATURE } else { 0 }, self.version]
    }
}

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

    /// Goes on over at most `budget` bytes; the CRC once the end is reached.
    pub fn step<F: Flash>(&mut self, flash: &F, budget: u32) -> Option<u32> {
        let len = self.rest.size.min(budget);
        let next = Region::new(self.rest.base, len);
        self.crc = if cfg!(feature = "crc-16") {
            fold(flash, self.crc, next, crc::block)
        } else {
            flash.crc32(self.crc, next)
        };
        self.rest = Region::new(self.rest.base + len, self.rest.size - len);
        (self.rest.size == 0).then_some(self.crc)
    }
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
    signed: bool,
    vectors: VectorTable,
}

impl VerifiedProgram {
    /// 1 to 254.
    #[must_use]
    pub const fn number(&self) -> u8 {
        self.number
    }

    /// Whether it carries the signature.
    #[must_use]
    pub const fn signed(&self) -> bool {
        self.signed
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
    number: u8,
) -> Result<VerifiedProgram, Invalid> {
    let region = layout.program(number).ok_or(Invalid::NoSuchProgram)?;
    let record = ProgramRecord::load(parameters, flash, number).ok_or(Invalid::Absent)?;
    if record.size > region.size {
        return Err(Invalid::Size);
    }
    let vectors = check_vectors(flash, region, layout).map_err(Invalid::Vectors)?;
    let mut crc = FlashCrc::new(Region::new(region.base, record.size));
    if crc.step(flash, record.size) != Some(record.crc) {
        return Err(Invalid::Crc);
    }
    Ok(VerifiedProgram { number, signed: record.signed, vectors })
}
