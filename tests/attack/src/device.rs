//! What can be done to a device, and what is found of it.

use boot_core::flash::FlashFault;
use boot_core::store::RenewalRecord;
use kit::model::Cut;
use kit::rig::Setup;
use shared_abi::renewal::Origin;

use crate::files::Content;

/// What is done to a device. Numbers of operations count from the present one.
#[derive(Clone, Copy, Debug)]
pub enum Action {
    /// 1F51h.
    Command {
        /// The sub-index.
        sub: u8,
        /// The command.
        value: u8,
    },
    /// The right password of this sub-index, if the device has one.
    Password {
        /// The sub-index.
        sub: u8,
    },
    /// A transfer to 1F50h.
    Send {
        /// The sub-index.
        sub: u8,
        /// What is sent.
        content: Content,
        /// One block of its block file; `None` for all of it in one transfer.
        block: Option<usize>,
        /// Only so many bytes: the transfer stays open.
        bytes: Option<usize>,
    },
    /// The open transfer is aborted.
    Cancel,
    /// LSS: this node-ID is stored.
    Store(u8),
    /// So many steps of the bootloader's own work.
    Run(u32),
    /// All of its work.
    Settle,
    /// So many milliseconds go by.
    Wait(u32),
    /// NMT: reset node.
    ResetNode,
    /// The power goes, and returns.
    PowerOff,
    /// The power goes in a flash operation.
    Cut(u32, Cut),
    /// The supply is too low from a flash operation on.
    Dip(u32),
    /// The supply is good again.
    Supply,
    /// A flash operation fails.
    Fail(u32, FlashFault),
    /// A flash operation does a part, and says nothing.
    Weak(u32, u64),
    /// Bits of a byte of an image decay without power, where another image is certain.
    Rot(usize, u8),
    /// What a tool does next so that this image becomes the bootloader: data, START or 83h.
    Renew(Content),
}

/// How a device has answered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Answer {
    /// It has acknowledged the request.
    Acknowledged,
    /// It has refused it.
    Refused,
    /// There was nothing to answer, or the power went.
    Nothing,
}

/// A program as a debug probe finds it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stored {
    /// It has no record.
    None,
    /// It has a record, and this CRC as the record says.
    Good(u32),
    /// It has a record that is not true.
    Damaged,
}

/// A device as a debug probe finds it, if it were reset now.
#[derive(Clone, Debug)]
pub struct Seen {
    /// The resets so far.
    pub starts: u32,
    /// Where the running bootloader was loaded from.
    pub origin: Origin,
    /// The CRC of the bootloader that is loaded after a reset; `None` if none can be loaded.
    pub loads: Option<u32>,
    /// The CRC of a good image at home.
    pub home: Option<u32>,
    /// The record of the image in staging.
    pub record: Option<RenewalRecord>,
    /// Whether the whole image of this record is in staging.
    pub is_staged: bool,
    /// The programs, number 1 first.
    pub programs: Vec<Stored>,
    /// Whether no bit of the records is between 0 and 1, so that they read the same each time.
    pub is_certain: bool,
}

/// A device that is attacked.
pub trait Device {
    /// Its product.
    fn setup(&self) -> &'static Setup;
    /// Carries out an action; the resets that it leads to as well. (Not [`Action::Renew`].)
    fn act(&mut self, action: &Action) -> Answer;
    /// As a probe finds it. It changes nothing.
    fn look(&mut self) -> Seen;
}
