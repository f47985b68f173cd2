//! What can be done to a device, and what is found of it.

use boot_core::flash::FlashFault;
use boot_core::store::{NodeParameters, ProgramRecord, RenewalRecord};
use canopen::AbortCode;
use kit::model::Cut;
use kit::rig::Setup;
use shared_abi::geometry::Region;
use shared_abi::renewal::{Origin, State};
use shared_abi::warm_start::BootRequest;

use crate::files::{Content, Flaw, Part, Sent};

/// What is done to a device.
#[derive(Clone, Copy, Debug)]
pub enum Action {
    /// 1F51h.
    Command { sub: u8, value: u8 },
    /// The password of this sub-index, if the device has one: the right one, or another.
    Password { sub: u8, is_right: bool },
    /// A transfer to 1F50h. With `bytes` so many alone, and the transfer stays open.
    Send { sub: u8, sent: Sent, is_announced: bool, bytes: Option<usize> },
    /// So many more bytes of the open transfer; without a number all of them, and its end.
    GoOn(Option<usize>),
    /// The open transfer is aborted.
    Cancel,
    /// An object is read.
    Read { index: u16, sub: u8 },
    /// A program is read back from 1F50h, if the device permits it.
    Upload { sub: u8 },
    /// LSS: this node-ID is stored.
    Store(u8),
    /// A client asks a sealed device for these rights (2002h), in the name of a key.
    Right(Holder, u32),
    /// This program has brought the device back to the bootloader.
    Return(u8),
    /// So many steps of the bootloader's own work.
    Run(u32),
    /// All of its work.
    Settle,
    /// So many milliseconds go by.
    Wait(u32),
    /// NMT: reset node.
    ResetNode,
    /// A reset by the watchdog.
    Crash,
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
    /// On a bus: so many frames of the device are destroyed from now on.
    Disturb(u64),
    /// On a serial line: bytes of this seed, which are no frame.
    Scramble(u64),
}

impl Action {
    /// A whole transfer without a flaw.
    #[must_use]
    pub fn send(sub: u8, content: Content, part: Part) -> Self {
        Self::Send { sub, sent: Sent { content, part, flaw: Flaw::None }, is_announced: true, bytes: None }
    }
}

/// Whose key signs a request for rights. A root alone may.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Holder {
    Root,
    Release,
    Stranger,
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
    /// None: what was to come does not come.
    None,
}

/// A program as a debug probe finds it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Stored {
    /// It has no record.
    None,
    /// It has this CRC, as its record says.
    Good(u32),
    /// Its record is not true.
    Damaged,
}

/// A program: as a debug probe finds it, and as the device tells it.
#[derive(Clone, Copy, Debug)]
pub struct Program {
    pub stored: Stored,
    /// Its record.
    pub record: Option<ProgramRecord>,
    /// 1F51h.
    pub state: u32,
    /// 1F56h.
    pub crc: u32,
    /// 1F57h.
    pub status: u32,
    /// Whether a part of its flash has the CRC of 1F56h, or none is told.
    pub is_true: bool,
    /// Its lowest security counter.
    pub counter: u32,
    /// After a reset, the download that goes on (2006h).
    pub partial: Option<Partial>,
}

/// A download that goes on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Partial {
    /// The CRC of its control block.
    pub id: u32,
    /// So many bytes are in flash, as the device says; more than the flash of the program has: no
    /// place in it.
    pub len: usize,
    /// The CRC of these bytes in flash.
    pub crc: u32,
}

/// A device as a debug probe finds it, if it were reset now, and as it tells it.
#[derive(Clone, Debug)]
pub struct Observation {
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
    pub programs: Vec<Program>,
    /// The program that starts after a power-on, and whether it is whole and released. (Program 1
    /// alone starts by itself.)
    pub starting: Option<(u8, bool)>,
    /// Why it would stay in the bootloader after a power-on, as it says (2007h/2) and as the boot
    /// stage chooses, if any program may start by itself; 255 if one starts.
    pub stays: [u32; 2],
    /// The released programs, number 1 in bit 0: as it says (2007h/12), and by their records.
    pub released: [u32; 2],
    /// The stored node-ID and bit rate.
    pub node: NodeParameters,
    /// Whether the last values of LSS are stored, as the device says.
    pub is_stored: bool,
    /// What was written or erased since the last look.
    pub touched: Vec<Region>,
    /// For what it left the bootloader since the last look.
    pub request: Option<BootRequest>,
    /// The CRC of what the last action read back.
    pub read_back: Option<u32>,
    /// Whether there was no work at the end of the last action.
    pub is_idle: bool,
    /// Whether the power was cut in the last action.
    pub is_cut: bool,
    /// Whether no bit of the records is between 0 and 1, so that they read the same each time.
    pub is_certain: bool,
}

impl Observation {
    pub fn state(&self) -> State {
        self.record.map_or(State::None, |record| record.state)
    }

    /// The program with this number.
    #[must_use]
    pub fn program(&self, number: u8) -> Option<&Program> {
        self.programs.get(usize::from(number).wrapping_sub(1))
    }
}

/// A device that is attacked.
pub trait Device {
    /// Its product.
    fn setup(&self) -> &'static Setup;
    /// Carries out an action, and the resets that it leads to. (Not [`Action::Renew`], which is several.)
    ///
    /// # Errors
    /// The abort with which the device has refused it; general error if the power was cut in it.
    fn act(&mut self, action: &Action) -> Result<(), AbortCode>;
    /// As a probe finds it. It changes nothing of it.
    fn observe(&mut self) -> Observation;
}
