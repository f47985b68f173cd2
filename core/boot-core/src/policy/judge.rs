//! The rules for all formats: the permitted addresses, and the target device of a program.

use canopen::program::FlashError;
use shared_abi::block_file::{fits, Control, Difference, Identity};
use shared_abi::geometry::Region;
use shared_abi::label::{self, Label};
use shared_abi::layout::Layout;
use shared_abi::renewal::BOOTLOADER;
use shared_abi::vectors::VectorTable;

use super::choices::{AppInfo, Policy, Verdict};
use crate::keys::Images;
use crate::refusal::Refusal;
use crate::resume::Partial;
use crate::session::Session;

/// Checks the data for one program.
#[derive(Clone, Copy)]
pub(crate) struct Judge<'a> {
    /// The memory layout: the owner of each address.
    pub layout: &'a Layout,
    /// The product's choices.
    pub policy: &'a Policy,
    /// The program, 1 to 254.
    pub program: u8,
    /// The program's flash.
    pub region: Region,
    /// The state of its download.
    pub session: Session,
    /// Whether a program is installed.
    pub installed: bool,
    /// Whether STOP was written since the last download began.
    pub stopped: bool,
    /// The images that the device takes.
    pub images: Images,
    /// The download that can go on, or is going on.
    pub partial: Partial,
}

impl Judge<'_> {
    /// Whether the program number is for data of the application.
    pub(crate) fn is_data(&self) -> bool {
        self.policy.data == Some(self.program)
    }

    /// Whether the image is a new one for the bootloader.
    pub(crate) fn is_bootloader(&self) -> bool {
        self.program == BOOTLOADER
    }

    /// Whether the download has begun: from then on the old program is given up.
    pub(crate) fn has_begun(&self) -> bool {
        matches!(self.session, Session::Open { .. })
    }

    /// Whether a download may begin; `is_stream`: it is a whole program in one transfer, for which STOP
    /// counts as CLEAR.
    pub(crate) fn may_begin(&self, is_stream: bool) -> Result<(), Refusal> {
        let replaces = self.policy.replaces || is_stream && self.stopped;
        match self.session {
            Session::Idle if self.installed && !replaces => Err(Refusal::untimely(FlashError::NotCleared)),
            Session::Failed if !replaces => Err(Refusal::untimely(FlashError::Sequence)),
            Session::Open { .. } => Err(Refusal::untimely(FlashError::Sequence)),
            _ => self.is_allowed(),
        }
    }

    /// Whether programs may be changed now.
    pub(crate) fn is_allowed(&self) -> Result<(), Refusal> {
        if (self.policy.allowed)() {
            Ok(())
        } else {
            Err(Refusal::untimely(FlashError::NoAccess))
        }
    }

    /// The refusal of first bytes in no known format.
    pub(crate) fn unknown_format(&self) -> Refusal {
        if self.has_begun() {
            Refusal::untimely(FlashError::Sequence)
        } else {
            Refusal::unfit(FlashError::Format)
        }
    }

    /// Whether data of this program may have this address.
    pub(crate) fn check_place(&self, place: Region) -> Result<(), Refusal> {
        if self.region.contains(place.base, place.size) {
            return Ok(());
        }
        let Layout { bootloader, home, parameters: [first, second], data, .. } = self.layout;
        let secured = [Some(bootloader), home.as_ref(), Some(first), Some(second), data.as_ref()];
        let touches = |region: &&Region| {
            // Written without a sum: an address near the end of the address space must not wrap.
            place.base < region.end() && (place.base >= region.base || region.base - place.base < place.size)
        };
        let secured = secured.iter().flatten().any(touches);
        Err(Refusal::unfit(if secured { FlashError::Secured } else { FlashError::Address }))
    }

    /// Whether the first two vectors are valid for a program in this region.
    pub(crate) fn check_vectors(&self, words: [u32; 2]) -> Result<(), Refusal> {
        VectorTable::check(words, self.region, self.layout)
            .map(drop)
            .map_err(|_| Refusal::unfit(FlashError::Format))
    }

    /// Whether a program is for this device, from its control block or its label.
    pub(crate) fn check_identity(&self, info: &AppInfo<'_>) -> Result<(), Refusal> {
        let verdict = (self.policy.check)(self.program, info);
        if verdict == Verdict::Standard && info.control.is_none() {
            return Err(Refusal::unfit(FlashError::Format));
        }
        let identity = match &info.control {
            None | Some(Control::Plain) => None,
            Some(Control::Identity(identity) | Control::Dated { identity, .. }) => Some(identity),
        };
        match (verdict, identity, self.policy.identity) {
            (Verdict::Refuse(error), ..) => Err(Refusal::unfit(error)),
            (Verdict::Standard, Some(image), Some(device)) => {
                fits((image.vendor_id, image.product_code), device).map_err(|difference| {
                    Refusal::unfit(match difference {
                        Difference::VendorId => FlashError::WrongVendorId,
                        Difference::ProductCode => FlashError::WrongProductId,
                    })
                })
            }
            _ => Ok(()),
        }
    }

    /// Whether a program is for this device, from its label; returns its version, 0 without a
    /// label.
    pub(crate) fn check_label(&self, bytes: &[u8; label::SIZE]) -> Result<u32, Refusal> {
        let Some(label) = Label::parse(bytes) else {
            return if self.policy.wants_label { Err(Refusal::unfit(FlashError::Format)) } else { Ok(0) };
        };
        let Label { vendor_id, product_code, version, date, .. } = label;
        let identity = Identity { app_size: 0, vendor_id, product_code };
        self.check_identity(&AppInfo::of_label(Control::Dated { identity, version, date: date.into() }))?;
        Ok(version)
    }
}
