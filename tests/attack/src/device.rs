//! What can be done to a device, and what is found of it.

use boot_core::flash::FlashFault;
use boot_core::store::RenewalRecord;
use kit::model::Cut;
use kit::rig::Setup;
use shared_abi::renewal::{Origin, State};

use crate::files::Content;

/// What is done to a device.
#[derive(Clone, Copy, Debug)]
pub enum Action {
    /// 1F51h.
    Command { sub: u8, value: u8 },
    /// The right password of this sub-index, if the device has one.
    Password { sub: u8 },
    /// A transfer to 1F50h: one block of a block file, or all of it as a stream; with `bytes` so many alone, and the
    /// transfer stays open.
    Send { sub: u8, content: Content, block: Option<usize>, bytes: Option<usize> },
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
    /// So many flash operations later there is trouble.
    Flash(u32, Trouble),
    /// The supply is good again.
    Supply,
    /// Bits of a byte of an image decay without power, where another image is certain.
    Rot(usize, u8),
    /// What a tool does next so that this image becomes the bootloader: data, START or 83h.
    Renew(Content),
}

/// What happens in a flash operation.
#[derive(Clone, Copy, Debug)]
pub enum Trouble {
    /// The power goes, and returns.
    Cut(Cut),
    /// The supply is too low from this one on.
    Dip,
    /// It fails.
    Fail(FlashFault),
    /// It does a part, drawn by this seed, and says nothing.
    Weak(u64),
}

/// A program as a debug probe finds it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stored {
    /// It has no record.
    None,
    /// It has this CRC, as its record says.
    Good(u32),
    /// Its record is not true.
    Damaged,
}

/// A device as a debug probe finds it, if it were reset now.
#[derive(Clone, Debug)]
pub struct Seen {
    /// The resets so far.
    pub starts: u32,
    /// Where the running bootloader was loaded from.
    pub origin: Origin,
    /// The CRC of the bootloader that is loaded after a reset, if one can be loaded.
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

impl Seen {
    pub fn state(&self) -> State {
        self.record.map_or(State::None, |record| record.state)
    }
}

/// A device that is attacked.
pub trait Device {
    /// Its product.
    fn setup(&self) -> &'static Setup;
    /// Carries out an action, and the resets that it leads to; whether the device has acknowledged it. (Not
    /// [`Action::Renew`], which is several.)
    fn act(&mut self, action: &Action) -> bool;
    /// As a probe finds it. It changes nothing.
    fn look(&mut self) -> Seen;
}
