//! What a device gets in an update: a program, a sealed image, or a bootloader.

use std::borrow::Cow;
use std::sync::Arc;

use canopen::program::FlashError;
use seal::wire::BOOTLOADER;
use shared_abi::ram_image::Version;

use crate::device::error::flash_error_number;
use crate::device::Form;
use crate::file::ram_image::{Fault, RamImage};
use crate::file::read::{read, Format};
use crate::file::sealed::{Refusal, SealedFile};
use crate::file::{ihex, judge, Program, Target};

/// What a device gets in an update, shared by several devices.
#[derive(Clone, Debug)]
pub enum Payload {
    /// A program.
    Program(Arc<Program>),
    /// A sealed image, of a program or of a bootloader: it is sent unchanged.
    Sealed(Arc<SealedFile>),
    /// The RAM image of a bootloader, which takes the place of that of the device.
    Bootloader(Arc<RamImage>),
}

impl Payload {
    /// The bootloader in a file of this format, plain or sealed; `None` for any other file, also for one
    /// that cannot be read.
    ///
    /// # Errors
    /// A [`Fault`] of its RAM image.
    pub fn bootloader_in(bytes: &[u8], format: Option<Format>) -> Result<Option<Self>, Fault> {
        if format == Some(Format::Sealed) {
            let file = SealedFile::parse(bytes.to_vec()).ok().map(Self::from);
            return Ok(file.filter(Self::is_bootloader));
        }
        let Ok(firmware) = read(bytes, format, Some(0)) else { return Ok(None) };
        let Some(image) = RamImage::of(&firmware) else { return Ok(None) };
        image.check()?;
        Ok(Some(image.into()))
    }

    /// The CRC that 1F56h of a device with it reports. That of a sealed bootloader is not known before it is
    /// opened; its manifest has the CRC of what is written.
    #[must_use]
    pub fn crc(&self) -> u32 {
        match self {
            Self::Program(program) => program.crc(),
            other => other.crcs()[0],
        }
    }

    /// The values that 1F56h of a device with it may report: the CRC of its product may be another one
    /// than that of the file.
    #[must_use]
    pub fn crcs(&self) -> [u32; 2] {
        match self {
            Self::Program(program) => program.crcs(),
            Self::Sealed(file) => [file.head().crc(); 2],
            Self::Bootloader(image) => [image.header().crc; 2],
        }
    }

    /// Its size in flash in bytes.
    #[must_use]
    pub fn size(&self) -> u32 {
        match self {
            Self::Program(program) => program.size(),
            Self::Sealed(file) => file.head().size(),
            Self::Bootloader(image) => image.header().total(),
        }
    }

    /// The target device, if it names one.
    #[must_use]
    pub fn target(&self) -> Option<Target> {
        match self {
            Self::Program(program) => program.target(),
            Self::Sealed(file) => Some(file.target()),
            Self::Bootloader(image) => {
                let header = image.header();
                Some(Target { vendor_id: header.vendor, product_code: header.product })
            }
        }
    }

    /// The version of a bootloader; `None` for a program.
    #[must_use]
    pub fn bootloader(&self) -> Option<Version> {
        match self {
            Self::Program(_) => None,
            Self::Sealed(file) => {
                (file.head().program() == BOOTLOADER).then(|| Version(file.head().version()))
            }
            Self::Bootloader(image) => Some(Version(image.header().version)),
        }
    }

    /// Whether it is a bootloader.
    #[must_use]
    pub fn is_bootloader(&self) -> bool {
        self.bootloader().is_some()
    }

    /// The data for a device that takes everything in one download: a program in this form, from its start
    /// on, all else unchanged.
    pub(super) fn encoded(&self, form: Form) -> Cow<'_, [u8]> {
        match self {
            Self::Program(program) if form == Form::Hex => ihex::emit(program.image()).into_bytes().into(),
            Self::Program(program) => program.flash_image(),
            Self::Sealed(file) => Cow::Borrowed(file.bytes()),
            Self::Bootloader(image) => Cow::Borrowed(image.bytes()),
        }
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

/// A payload of each form in which what it has is at hand.
macro_rules! payload_from {
    ($($variant:ident($content:ty))*) => {$(
        impl From<Arc<$content>> for Payload {
            fn from(content: Arc<$content>) -> Self {
                Self::$variant(content)
            }
        }

        impl From<$content> for Payload {
            fn from(content: $content) -> Self {
                Arc::new(content).into()
            }
        }

        impl From<&$content> for Payload {
            fn from(content: &$content) -> Self {
                content.clone().into()
            }
        }
    )*};
}

payload_from! {
    Program(Program)
    Sealed(SealedFile)
    Bootloader(RamImage)
}

impl From<&Self> for Payload {
    fn from(payload: &Self) -> Self {
        payload.clone()
    }
}
