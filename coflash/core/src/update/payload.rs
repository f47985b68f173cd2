//! What a device gets in an update: a program, a sealed image, or a bootloader.

use std::borrow::Cow;
use std::sync::Arc;

use canopen::program::{FlashError, ProgramState, PROGRAM_CONTROL, PROGRAM_DATE};
use canopen::Address;
use seal::wire::BOOTLOADER;
use shared_abi::block_file::{fits, Difference, ProgramVersion};
use shared_abi::date;
use shared_abi::ram_image::Version;

use crate::device::error::{flash_error_number, reported, Error, IdentityPart};
use crate::device::info::{program_info, Identity, ProgramInfo};
use crate::device::{Form, Session};
use crate::file::checksum::is_of_self_checked;
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

    /// The part of an identity (1018h) in which the device is not the one that the file names: its device's value
    /// and that of the file. A value that the device does not report (`None`) cannot differ.
    #[must_use]
    pub fn misfit(&self, [vendor, product, ..]: Identity) -> Option<(IdentityPart, u32, u32)> {
        let targets = match self {
            Self::Program(program) => program.targets(),
            Self::Sealed(file) => [Some(file.target()), None],
            // The device itself judges whether it can be its bootloader.
            Self::Bootloader(_) => [None; 2],
        };
        targets.into_iter().flatten().find_map(|Target { vendor_id, product_code }| {
            let file = (vendor_id, product_code);
            let device = (vendor.unwrap_or(vendor_id), product.unwrap_or(product_code));
            let difference = match self {
                // In a manifest, 0 is a normal value.
                Self::Sealed(_) if file.0 != device.0 => Some(Difference::VendorId),
                Self::Sealed(_) => (file != device).then_some(Difference::ProductCode),
                _ => fits(file, device).err(),
            };
            Some(match difference? {
                Difference::VendorId => (IdentityPart::VendorId, device.0, file.0),
                Difference::ProductCode => (IdentityPart::ProductCode, device.1, file.1),
            })
        })
    }

    /// The version of a program, if its file or its label names one; `None` for a bootloader.
    #[must_use]
    pub fn version(&self) -> Option<ProgramVersion> {
        let versions = match self {
            Self::Program(program) => {
                [program.release().map(|release| release.version.0), program.label().map(|it| it.version)]
            }
            Self::Sealed(file) if !self.is_bootloader() => [Some(file.head().version()), None],
            Self::Sealed(_) | Self::Bootloader(_) => [None; 2],
        };
        versions.into_iter().flatten().find(|version| *version != 0).map(ProgramVersion)
    }

    /// When it was made, in seconds since 1970 (UTC), if its file or its label says so.
    #[must_use]
    pub fn date(&self) -> Option<u64> {
        let dates = match self {
            Self::Program(program) => {
                [program.release().map(|it| it.date), program.label().map(|it| it.date.into())]
            }
            Self::Sealed(file) => [Some(file.head().created()), None],
            Self::Bootloader(_) => [None; 2],
        };
        dates.into_iter().flatten().find(|date| *date != 0)
    }

    /// What a device reports that has this program.
    #[must_use]
    pub fn marks(&self) -> Marks {
        let tells_nothing = match self {
            Self::Program(program) => program.has_own_crc(),
            Self::Sealed(file) => is_of_self_checked(file.head().crc()),
            Self::Bootloader(_) => false,
        };
        let date = self.date().map_or([0; 2], |date| date::days_and_milliseconds(date::of_control(date)));
        Marks { crcs: self.crcs(), tells_nothing, version: self.version(), date }
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

/// What a device reports that has a program, for the comparison with many devices. One value is never enough where
/// another one is known on both sides.
#[derive(Clone, Copy, Debug)]
pub struct Marks {
    crcs: [u32; 2],
    /// Whether the CRC is the same for each version of the program.
    tells_nothing: bool,
    version: Option<ProgramVersion>,
    /// The elements of 1F52h; zeros for none.
    date: [u32; 2],
}

/// What a device's values say about whether it has a program.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Installed {
    /// It has another one, or none.
    Other,
    /// It has this one.
    This,
    /// It reports its CRC, which is that of each of its versions: nobody knows.
    Unknown,
}

impl Marks {
    /// Compares CRC and version.
    #[must_use]
    pub fn compare(&self, has: &ProgramInfo) -> Installed {
        let crc = has.crc.filter(|crc| *crc != 0);
        let is_other_version = self.version.zip(has.release()).is_some_and(|(file, device)| file != device);
        match crc.is_some_and(|crc| self.crcs.contains(&crc)) && !is_other_version {
            false => Installed::Other,
            true if self.tells_nothing => Installed::Unknown,
            true => Installed::This,
        }
    }

    /// Whether the device runs the program, by its own account.
    ///
    /// # Errors
    /// Those of [`program_info`].
    pub fn is_running(&self, session: &mut Session<'_>, number: u8) -> Result<bool, Error> {
        let has = program_info(session, number)?;
        let is_this = has.state() == Some(ProgramState::Running) && self.compare(&has) == Installed::This;
        Ok(is_this && !self.is_of_other_date(session, number)?)
    }

    /// Whether the program that runs, with the right CRC, was made at another time: 1F52h has its
    /// date, and zeros for none.
    pub(crate) fn is_of_other_date(&self, session: &mut Session<'_>, number: u8) -> Result<bool, Error> {
        let mut read = |index, sub| reported(session.read_number(Address::new(index, sub)));
        let has_none = self.date == [0; 2];
        if has_none || read(PROGRAM_CONTROL, number)? != Some(ProgramState::Running as u32) {
            return Ok(false);
        }
        let date = [read(PROGRAM_DATE, 1)?, read(PROGRAM_DATE, 2)?].map(Option::unwrap_or_default);
        Ok(date != [0; 2] && date != self.date)
    }

    /// Whether the program is older than what the device has, where both versions are known.
    #[must_use]
    pub fn is_older(&self, has: &ProgramInfo) -> bool {
        self.version.zip(has.release()).is_some_and(|(file, device)| file.is_before(device))
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
