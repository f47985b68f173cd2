//! What an update brings into a device: blocks that a program was cut into, or a sealed image, which is
//! sent as it is.

use std::borrow::Cow;
use std::sync::Arc;

use crate::file::sealed::SealedFile;
use crate::file::BlockFile;

/// What an update brings into a device.
#[derive(Clone, Copy, Debug)]
pub(super) enum Content<'f> {
    /// A program in blocks.
    Blocks(&'f BlockFile),
    /// A sealed image.
    Sealed(&'f SealedFile),
}

impl<'f> Content<'f> {
    /// Bytes of the program as it lies in flash.
    pub(super) fn program_size(self) -> u32 {
        match self {
            Self::Blocks(file) => file.program_size(),
            Self::Sealed(file) => file.head().size(),
        }
    }

    /// What 1F56h reads when the program is in the device.
    pub(super) fn program_crc(self) -> u32 {
        match self {
            Self::Blocks(file) => file.program_crc(),
            Self::Sealed(file) => file.head().crc(),
        }
    }

    /// What a device gets that takes all of it with one download: what this makes of blocks, or a sealed
    /// image as it is.
    pub(super) fn stream(self, of_blocks: impl FnOnce(&BlockFile) -> Vec<u8>) -> Cow<'f, [u8]> {
        match self {
            Self::Blocks(file) => Cow::Owned(of_blocks(file)),
            Self::Sealed(file) => Cow::Borrowed(file.bytes()),
        }
    }
}

/// The same, shared by the devices that get it.
#[derive(Clone, Debug)]
pub enum Program {
    /// A program in blocks.
    Blocks(Arc<BlockFile>),
    /// A sealed image.
    Sealed(Arc<SealedFile>),
}

impl Program {
    pub(super) fn content(&self) -> Content<'_> {
        match self {
            Self::Blocks(file) => Content::Blocks(file),
            Self::Sealed(file) => Content::Sealed(file),
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
