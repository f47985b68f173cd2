//! The content of an update: a program in blocks, or a sealed image, which is sent unchanged.

use std::borrow::Cow;
use std::sync::Arc;

use canopen::program::FlashError;

use super::new_bootloader::NewBootloader;
use super::options::Target;
use crate::device::error::flash_error_number;
use crate::file::sealed::{Refusal, SealedFile};
use crate::file::{judge, BlockFile};

/// The content of an update.
#[derive(Clone, Copy, Debug)]
pub(super) enum Content<'f> {
    /// A program in blocks.
    Blocks(&'f BlockFile),
    /// A sealed image.
    Sealed(&'f SealedFile),
}

impl<'f> Content<'f> {
    /// Size of the program in flash in bytes.
    pub(super) fn program_size(self) -> u32 {
        match self {
            Self::Blocks(file) => file.program_size(),
            Self::Sealed(file) => file.head().size(),
        }
    }

    /// The value of 1F56h after the download.
    pub(super) fn program_crc(self) -> u32 {
        match self {
            Self::Blocks(file) => file.program_crc(),
            Self::Sealed(file) => file.head().crc(),
        }
    }

    /// The values that 1F56h may have after the download: a device that computes the CRC by itself
    /// does it with the checksum of its product.
    pub(super) fn program_crcs(self) -> [u32; 2] {
        match self {
            Self::Blocks(file) => file.program_crcs(),
            Self::Sealed(file) => [file.head().crc(); 2],
        }
    }

    /// The data for a device that takes everything in one download: the result of `of_blocks`, or
    /// the sealed image unchanged.
    pub(super) fn stream(self, of_blocks: impl FnOnce(&BlockFile) -> Vec<u8>) -> Cow<'f, [u8]> {
        match self {
            Self::Blocks(file) => Cow::Owned(of_blocks(file)),
            Self::Sealed(file) => Cow::Borrowed(file.bytes()),
        }
    }
}

/// The content of an update, shared by several devices.
#[derive(Clone, Debug)]
pub enum Program {
    /// A program in blocks.
    Blocks(Arc<BlockFile>),
    /// A sealed image.
    Sealed(Arc<SealedFile>),
    /// A bootloader, which takes the place of that of the device.
    Bootloader(NewBootloader),
}

impl Program {
    /// The CRC that 1F56h of a device with this program reports.
    #[must_use]
    pub fn program_crc(&self) -> u32 {
        self.program_crcs()[0]
    }

    /// The values that 1F56h of a device with this program may report: the CRC of its product may be
    /// another one than that of the file.
    #[must_use]
    pub fn program_crcs(&self) -> [u32; 2] {
        match self {
            Self::Blocks(file) => Content::Blocks(file).program_crcs(),
            Self::Sealed(file) => Content::Sealed(file).program_crcs(),
            Self::Bootloader(new) => [new.crc(); 2],
        }
    }

    /// Size of the program in flash in bytes.
    #[must_use]
    pub fn program_size(&self) -> u32 {
        match self {
            Self::Blocks(file) => Content::Blocks(file).program_size(),
            Self::Sealed(file) => Content::Sealed(file).program_size(),
            Self::Bootloader(new) => new.size(),
        }
    }

    /// The target device, if the content names one.
    #[must_use]
    pub fn target(&self) -> Option<Target> {
        match self {
            Self::Blocks(file) => Target::of(file),
            Self::Sealed(file) => Some(Target::of_sealed(file)),
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

impl From<Arc<BlockFile>> for Program {
    fn from(file: Arc<BlockFile>) -> Self {
        Self::Blocks(file)
    }
}

impl From<Arc<SealedFile>> for Program {
    fn from(file: Arc<SealedFile>) -> Self {
        Self::Sealed(file)
    }
}

impl From<NewBootloader> for Program {
    fn from(new: NewBootloader) -> Self {
        Self::Bootloader(new)
    }
}
