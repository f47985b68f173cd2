//! The file of a new bootloader: a RAM image, plain or sealed.

use std::sync::Arc;

use seal::wire::BOOTLOADER;
use shared_abi::ram_image::Version;

use crate::file::ram_image::{Fault, RamImage};
use crate::file::read::{read, Firmware, Format};
use crate::file::sealed::SealedFile;
use crate::file::Target;

/// A new bootloader.
#[derive(Clone, Debug)]
pub enum NewBootloader {
    /// A RAM image.
    Plain(Arc<RamImage>),
    /// A sealed one.
    Sealed(Arc<SealedFile>),
}

impl NewBootloader {
    /// The bootloader in a file of this format; `None` for any other file, also for one that cannot be read.
    ///
    /// # Errors
    /// A [`Fault`] of its RAM image.
    pub fn in_file(bytes: &[u8], format: Option<Format>) -> Result<Option<Self>, Fault> {
        if format == Some(Format::Sealed) {
            return Ok(Self::of_sealed(bytes));
        }
        read(bytes, format, Some(0)).map_or(Ok(None), |firmware| Self::of(&firmware))
    }

    /// The bootloader in firmware that was read; `None` for a program.
    ///
    /// # Errors
    /// A [`Fault`] of its RAM image.
    pub fn of(firmware: &Firmware) -> Result<Option<Self>, Fault> {
        let Some(image) = RamImage::of(firmware) else { return Ok(None) };
        image.check()?;
        Ok(Some(Self::Plain(Arc::new(image))))
    }

    /// The bootloader in a sealed image; `None` for a program, and for a file that is no sealed image.
    #[must_use]
    pub fn of_sealed(bytes: &[u8]) -> Option<Self> {
        let file = SealedFile::parse(bytes.to_vec()).ok()?;
        (file.head().program() == BOOTLOADER).then(|| Self::Sealed(Arc::new(file)))
    }

    /// The value of 1F56h of a device with this bootloader. That of a sealed image is not known before it is
    /// opened; its manifest has the CRC of what is written.
    #[must_use]
    pub fn crc(&self) -> u32 {
        match self {
            Self::Plain(image) => image.header().crc,
            Self::Sealed(file) => file.head().crc(),
        }
    }

    /// Size of header and image in bytes.
    #[must_use]
    pub fn size(&self) -> u32 {
        match self {
            Self::Plain(image) => image.header().total(),
            Self::Sealed(file) => file.head().size(),
        }
    }

    /// The device that it is for.
    #[must_use]
    pub fn target(&self) -> Target {
        match self {
            Self::Plain(image) => {
                Target { vendor_id: image.header().vendor, product_code: image.header().product }
            }
            Self::Sealed(file) => file.target(),
        }
    }

    /// The bytes for 1F50h.
    #[must_use]
    pub fn bytes(&self) -> &[u8] {
        match self {
            Self::Plain(image) => image.bytes(),
            Self::Sealed(file) => file.bytes(),
        }
    }

    /// Its version.
    #[must_use]
    pub fn version(&self) -> Version {
        match self {
            Self::Plain(image) => Version(image.header().version),
            Self::Sealed(file) => Version(file.head().version()),
        }
    }
}
