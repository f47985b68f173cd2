//! What a bootloader has: the one owner of it, from the object dictionary down to the programmer.

use canopen::program::ProgramStart;
use shared_abi::layout;

use crate::decision::Policy;

/// What a bootloader has, all of it: for what it has not, the compiler leaves out the code. The same values make
/// its dictionary ([`entries`](crate::bootloader::entries)), so no object is without its code.
pub trait Choices {
    /// The objects of its dictionary.
    const EXTRAS: Extras = Extras {
        password: PasswordObject::Unlock,
        read_back: true,
        sealed: true,
        second_server: true,
        resume: true,
        program_date: true,
        bootloader: None,
        rom_loader: true,
    };
    /// Whether programs are taken in Intel HEX.
    const INTEL_HEX: bool = true;
    /// Whether objects can be written by SDO block download.
    const BLOCK_DOWNLOAD: bool = true;
    /// Whether objects can be read by SDO block upload.
    const BLOCK_UPLOAD: bool = true;
    /// Whether it has layer setting services.
    const LSS: bool = true;
    /// Whether a master finds it by ranges of its address (identify remote slave), too.
    const LSS_IDENTIFY: bool = true;
    /// Whether layer setting services may store node-ID and bit rate.
    const LSS_STORE: bool = true;
    /// What its boot stage decides by.
    const DECISION: &'static Policy = &Policy::plain(layout::DEFAULT, &[1, 2]);
    /// Whether it may detect the bit rate of its bus by listening.
    const DETECTS_BIT_RATE: bool = true;
    /// 2007h/10.
    const PROGRAM_START: ProgramStart = ProgramStart::NONE;

    /// Whether the entry strap asks for the bootloader now; `was` is whether it did at the last reset.
    #[must_use]
    fn entry_strap(was: bool) -> bool {
        was
    }
}

/// A bootloader with everything.
pub struct Everything;

impl Choices for Everything {}

/// What follows from the [`Choices`], and is no second choice. A branch on a constant is gone before the compiler
/// optimises; a branch on a field of a constant is optimised with all that it leads to, which costs 240 bytes of
/// the compact map.
pub(crate) trait Has: Choices {
    /// A download that was cut off goes on where it stopped.
    const RESUMES: bool = Self::EXTRAS.resume;
    /// The bootloader can be renewed (docs/renewal.md): it is one more program of the
    /// [`Downloader`](crate::control::Downloader).
    const RENEWS: bool = Self::EXTRAS.bootloader.is_some();
    /// The dates of programs are kept.
    const DATES: bool = Self::EXTRAS.program_date;
    /// Sealed images are taken.
    const SEALED: bool = Self::EXTRAS.sealed;
    /// Programs can be read.
    const READS_BACK: bool = Self::EXTRAS.read_back;
    /// There is a second SDO server.
    const SECOND_SERVER: bool = Self::EXTRAS.second_server;
    /// A command starts the loader in the ROM of the chip.
    const ROM_LOADER: bool = Self::EXTRAS.rom_loader;
    /// An object takes a password.
    const PASSWORD: bool = !matches!(Self::EXTRAS.password, PasswordObject::None);
}

impl<C: Choices> Has for C {}

/// The objects that a dialect adds to the object dictionary.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Extras {
    /// The object for the password that unlocks 1F50h.
    pub password: PasswordObject,
    /// Whether 1F50h can be read.
    pub read_back: bool,
    /// Whether 2002h and 2003h exist, which belong to devices with sealed images.
    pub sealed: bool,
    /// Whether 1201h exists, the second SDO server.
    pub second_server: bool,
    /// Whether 2006h exists, which says where a download goes on.
    pub resume: bool,
    /// Whether 1F52h exists, date and time of the program.
    pub program_date: bool,
    /// The program number of the bootloader itself, if it can be renewed.
    pub bootloader: Option<u8>,
    /// Whether 2008h exists, which starts the loader in the ROM of the chip.
    pub rom_loader: bool,
}

impl Extras {
    /// The objects of the standard dialect.
    pub const STANDARD: Self = Self {
        password: PasswordObject::None,
        read_back: false,
        sealed: false,
        second_server: true,
        resume: true,
        program_date: true,
        bootloader: None,
        rom_loader: false,
    };
}

/// The object for a password.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PasswordObject {
    /// The device has no password.
    None,
    /// 7F50h of a program, 32 bits: the password makes the program invalid and unlocks its 1F50h
    /// (ESAcademy).
    EnableFlash,
    /// 6005h/1, a text: the password unlocks 1F50h of all programs (lifts; CiA 814-1 clause 6.3).
    Unlock,
}
