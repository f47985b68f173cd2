//! The content of an update: a program, or a sealed image, which is sent unchanged.

use std::borrow::Cow;
use std::sync::Arc;

use canopen::program::FlashError;

use super::new_bootloader::NewBootloader;
use crate::device::error::flash_error_number;
use crate::file::sealed::{Refusal, SealedFile};
use crate::file::{judge, Program, Target};

/// The content of an update.
#[derive(Clone, Copy, Debug)]
pub(super) enum Content<'f> {
    /// A program.
    Program(&'f Program),
    /// A sealed image.
    Sealed(&'f SealedFile),
}

/// The form in which a program goes in one download.
pub(super) type Encoder = fn(&Program) -> Cow<'_, [u8]>;

impl<'f> Content<'f> {
    /// Size of the program in flash in bytes.
    pub(super) fn size(self) -> u32 {
        match self {
            Self::Program(program) => program.size(),
            Self::Sealed(file) => file.head().size(),
        }
    }

    /// The value of 1F56h after the download.
    pub(super) fn crc(self) -> u32 {
        match self {
            Self::Program(program) => program.crc(),
            Self::Sealed(file) => file.head().crc(),
        }
    }

    /// The values that 1F56h may have after the download: a device that computes the CRC by itself
    /// does it with the checksum of its product.
    pub(super) fn crcs(self) -> [u32; 2] {
        match self {
            Self::Program(program) => program.crcs(),
            Self::Sealed(file) => [file.head().crc(); 2],
        }
    }

    /// The data for a device that takes everything in one download: the program in the form of this
    /// encoder, or the sealed image unchanged.
    pub(super) fn encoded(self, encode: Encoder) -> Cow<'f, [u8]> {
        match self {
            Self::Program(program) => encode(program),
            Self::Sealed(file) => Cow::Borrowed(file.bytes()),
        }
    }
}

/// What a device gets in an update, shared by several devices.
#[derive(Clone, Debug)]
pub enum Payload {
    /// A program.
    Program(Arc<Program>),
    /// A sealed image.
    Sealed(Arc<SealedFile>),
    /// A bootloader, which takes the place of that of the device.
    Bootloader(NewBootloader),
}

impl Payload {
    /// The CRC that 1F56h of a device with it reports.
    #[must_use]
    pub fn crc(&self) -> u32 {
        match self {
            Self::Program(program) => program.crc(),
            Self::Sealed(file) => file.head().crc(),
            Self::Bootloader(new) => new.crc(),
        }
    }

    /// The values that 1F56h of a device with it may report: the CRC of its product may be another one
    /// than that of the file.
    #[must_use]
    pub fn crcs(&self) -> [u32; 2] {
        match self {
            Self::Program(program) => program.crcs(),
            Self::Sealed(file) => [file.head().crc(); 2],
            Self::Bootloader(new) => [new.crc(); 2],
        }
    }

    /// Its size in flash in bytes.
    #[must_use]
    pub fn size(&self) -> u32 {
        match self {
            Self::Program(program) => program.size(),
            Self::Sealed(file) => file.head().size(),
            Self::Bootloader(new) => new.size(),
        }
    }

    /// The target device, if it names one.
    #[must_use]
    pub fn target(&self) -> Option<Target> {
        match self {
            Self::Program(program) => program.target(),
            Self::Sealed(file) => Some(file.target()),
            Self::Bootloader(new) => Some(new.target()),
        }
    }

    /// Whether it is a bootloader.
    #[must_use]
    pub const fn is_bootloader(&self) -> bool {
        matches!(self, Self::Bootloader(_))
    }
}

/// The stable error number of a sealed image that is refused without a device: the number that a
/// device with the same keys would cause, or that of a file without a program.
#[must_use]
pub fn refusal_number(refusal: &Refusal) -> u32 {
    match refusal {
        Refusal::NotSealed => judge::Fault::NUMBER,
        refusal => {
            FlashError::from_code(refusal.fault() as u8).map_or(judge::Fault::NUMBER, flash_error_number)
        }
    }
}

impl From<Arc<Program>> for Payload {
    fn from(program: Arc<Program>) -> Self {
        Self::Program(program)
    }
}

impl From<Arc<SealedFile>> for Payload {
    fn from(file: Arc<SealedFile>) -> Self {
        Self::Sealed(file)
    }
}

impl From<NewBootloader> for Payload {
    fn from(new: NewBootloader) -> Self {
        Self::Bootloader(new)
    }
}
