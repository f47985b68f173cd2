//! What a product may choose about downloads.

use canopen::program::FlashError;
use shared_abi::block_file::Control;

use crate::crc::CrcKind;

/// When CLEAR erases.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Erase {
    /// With the first block that is for this device: until then the old program stays, and can be
    /// started. Sectors are erased as the data need them. A second CLEAR, with no block in between,
    /// erases all at once.
    #[default]
    WithFirstBlock,
    /// All sectors of the program, before anything else.
    AtOnce,
}

/// What the integrator's own check says of a program that is about to be downloaded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// Nothing: vendor-ID and product code decide.
    Standard,
    /// It is for this device.
    Accept,
    /// It is not.
    Refuse(FlashError),
}

/// What can be chosen about the download.
#[derive(Clone, Copy, Debug)]
pub struct Policy {
    /// Vendor-ID and product code of the device. A control block that tells others is refused; 0 in
    /// it stands for any.
    pub identity: Option<(u32, u32)>,
    /// The integrator's own check, with all that the control block tells (`TgtProcessAppInfoData`
    /// of the manual).
    pub check: fn(program: u8, control: &Control) -> Verdict,
    /// Whether programs may be changed now; where not, the status is `NO_ACCESS`.
    pub allowed: fn() -> bool,
    /// When CLEAR of a program erases (`TgtCheckEraseApp` of the manual).
    pub erase: fn(program: u8) -> Erase,
    /// Whether a complete raw image or Intel HEX download is valid without the signature (83h) that
    /// those who send it know nothing of.
    pub valid_without_signature: bool,
    /// Whether 1F51h = 2 always starts the program, as CiA 302-3 has it; otherwise it does so right
    /// behind a raw image or Intel HEX, and resets the status in all other cases.
    pub reset_starts: bool,
    /// Whether a valid raw image or Intel HEX starts by itself when it is complete.
    pub starts_by_itself: bool,
    /// Whether a program has to carry a label (`shared_abi::label`). A label that it
    /// carries has to fit in any case.
    pub wants_label: bool,
    /// The number of a program that is none, but data of the application: any bytes, never started.
    pub data: Option<u8>,
    /// Whether 1F50h takes nothing before a password has come.
    pub locked: bool,
    /// Whether 1F50h gives back what was stored.
    pub read_back: bool,
    /// Whether a download takes the place of what is there, without CLEAR.
    pub replaces: bool,
    /// Which CRC blocks and programs carry.
    pub crc: CrcKind,
    /// Bytes of flash that one step of a CRC covers: the longest that other work of the same
    /// priority is kept waiting.
    pub crc_step: u32,
    /// What a sealed image is judged by.
    #[cfg(feature = "sealed")]
    pub seal: SealPolicy,
}

/// What a sealed image is judged by, beside the keys in the device.
#[cfg(feature = "sealed")]
#[derive(Clone, Copy, Debug)]
pub struct SealPolicy {
    /// Vendor-ID of the device (1018h/1).
    pub vendor_id: u32,
    /// Its product code (1018h/2).
    pub product_code: u32,
    /// Its revision number (1018h/3); the five lowest bits are the hardware revision.
    pub revision: u32,
    /// The number of the program that is data of the application.
    pub data: Option<u8>,
    /// The 96-bit unique ID of the chip.
    pub unique_id: fn() -> [u8; 12],
    /// A number that nobody can foresee to the last bit, such as that of the clock cycles when it is
    /// asked for.
    pub cycles: fn() -> u32,
    /// The lowest security counter, whatever is stored.
    pub counter: u32,
    /// Whether the counter is raised when a program is confirmed, and not when it is installed: until
    /// then the device takes older ones.
    pub counter_with_confirmation: bool,
}

#[cfg(feature = "sealed")]
impl SealPolicy {
    /// For no device.
    pub const NONE: Self = Self {
        vendor_id: 0,
        product_code: 0,
        revision: 0,
        data: None,
        unique_id: || [0; 12],
        cycles: || 0,
        counter: 0,
        counter_with_confirmation: false,
    };
}

impl Policy {
    /// Anybody's programs at any time; steps of 1 KiB.
    pub const DEFAULT: Self = Self {
        identity: None,
        check: |_, _| Verdict::Standard,
        allowed: || true,
        erase: |_| Erase::WithFirstBlock,
        valid_without_signature: true,
        reset_starts: false,
        starts_by_itself: false,
        wants_label: false,
        data: None,
        locked: false,
        read_back: false,
        replaces: false,
        crc: CrcKind::Crc32,
        crc_step: 1024,
        #[cfg(feature = "sealed")]
        seal: SealPolicy::NONE,
    };
}
