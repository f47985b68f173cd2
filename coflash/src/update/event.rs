//! What happens during an update, for whoever watches it.

use std::fmt;
use std::time::Duration;

use canopen::{AbortCode, NodeId};

use super::options::Target;
use crate::device::info::Nameplate;
use crate::device::{DeviceType, Dialect};

/// An erasure that is over sooner than this was put off, or had little to do. Erasing a sector of
/// flash takes longer.
pub(super) const PUT_OFF: Duration = Duration::from_millis(100);

/// What happens during an update. `Display` has words for people.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Event {
    /// Step 1: nothing of a bootloader yet, for this reason; it is looked for until it is there.
    Searching(String),
    /// Step 2: this is running on the device.
    Found(DeviceType),
    /// What the device tells of itself.
    Nameplate(Box<Nameplate>),
    /// The NMT mastership was taken over from this node.
    MasterTaken(NodeId),
    /// This node keeps the NMT mastership.
    MasterKept(NodeId),
    /// The NMT mastership was given back; this node has it now, if one says so.
    MasterBack(Option<NodeId>),
    /// It is the device that the file is for.
    TargetRight(Target),
    /// Step 3: the application is asked to go back to the bootloader.
    CallingBack,
    /// Step 3 has worked.
    InBootloader,
    /// The bootloader speaks this dialect.
    Speaks(Dialect),
    /// The password was right.
    Unlocked,
    /// The device goes on under another node-ID.
    Moved(NodeId),
    /// Step 4: the program is being erased.
    Erasing,
    /// Step 5: it is erased.
    Erased {
        /// How long that took.
        took: Duration,
    },
    /// Steps 6 to 9: so far the transfer has come.
    Progress {
        /// Bytes of the block file that are in the device.
        done: usize,
        /// Bytes of the block file.
        total: usize,
    },
    /// A block is sent again.
    Repeating {
        /// Its number.
        block: u32,
        /// How often it has been sent again, this time included.
        repeat: u32,
        /// How often it may be.
        of: u32,
        /// Why.
        why: RepeatReason,
    },
    /// The whole program is sent again.
    Again {
        /// How often it has been sent again, this time included.
        repeat: u32,
        /// How often it may be.
        of: u32,
        /// Why.
        why: RepeatReason,
    },
    /// The bootloader computed the CRC that the file says.
    Verified {
        /// The CRC.
        crc: u32,
    },
    /// Step 10: the program starts for a trial.
    TrialStarting,
    /// Step 13: it ran, and came back when called.
    TrialPassed(DeviceType),
    /// Step 14: the program is signed, so that it starts by itself.
    Signed,
    /// Step 15: the program starts.
    Starting,
    /// It runs.
    Started(DeviceType),
    /// After its end, the procedure's last look: the CRC is still the file's.
    VerifiedAgain {
        /// The CRC.
        crc: u32,
    },
    /// The procedure failed, and leaves the device like this.
    Left(DeviceState),
}

/// In what state a procedure that failed leaves the device, as far as it got.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DeviceState {
    /// Nothing was changed.
    Untouched,
    /// The bootloader was called; the old program is whole.
    Called,
    /// The erasure was begun: there is no program, or an incomplete one.
    Erased,
    /// The new program is in, in a dialect without signatures.
    Written,
    /// The new program is in and right, but not signed.
    Unsigned,
    /// The new program is in and signed.
    Signed,
}

impl DeviceState {
    /// Its name for programs, which stays.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Untouched => "untouched",
            Self::Called => "called",
            Self::Erased => "erased",
            Self::Written => "written",
            Self::Unsigned => "unsigned",
            Self::Signed => "signed",
        }
    }
}

impl fmt::Display for DeviceState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Untouched => "nothing was changed in it",
            Self::Called => {
                "it may be in the bootloader; its old program is whole and starts again after a reset"
            }
            Self::Erased => {
                "it has no complete program and stays in the bootloader, ready for the next attempt"
            }
            Self::Written => "the new program is in it: it starts after a reset",
            Self::Unsigned => {
                "the new program is in it but not signed: after a reset the bootloader waits for the next attempt"
            }
            Self::Signed => "the new program is in it and signed: it starts after a reset",
        })
    }
}

impl fmt::Display for Event {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Searching(why) => write!(f, "searching for the bootloader, Ctrl-C ends it ({why})"),
            Self::Found(running) => write!(f, "found {running}"),
            Self::Nameplate(plate) => write!(f, "device: {plate}"),
            Self::MasterTaken(node) => write!(f, "NMT mastership taken over from node {node}"),
            Self::MasterKept(node) => {
                write!(f, "node {node} keeps the NMT mastership: it may disturb the update")
            }
            Self::MasterBack(Some(node)) => {
                write!(f, "NMT mastership given back: node {node} is the master")
            }
            Self::MasterBack(None) => {
                f.write_str("NMT mastership given back, and nobody has said that it is the master")
            }
            Self::TargetRight(Target { vendor_id, product_code }) => {
                write!(
                    f,
                    "it is the right device: vendor-ID {vendor_id:08X}h, product code {product_code:08X}h"
                )
            }
            Self::CallingBack => f.write_str("calling the application back to the bootloader"),
            Self::InBootloader => f.write_str("the bootloader is running"),
            Self::Speaks(dialect) => write!(f, "its dialect: {dialect}"),
            Self::Unlocked => f.write_str("unlocked"),
            Self::Moved(node) => write!(f, "it answers as node {node} now"),
            Self::Erasing => f.write_str("telling it to erase the old program"),
            Self::Erased { took } if *took < PUT_OFF => {
                f.write_str("it will, with the first block that it finds good")
            }
            Self::Erased { took } => write!(f, "erased in {:.1} s", took.as_secs_f64()),
            Self::Progress { done, total } => write!(f, "{done} of {total} bytes"),
            Self::Repeating { block, repeat, of, why } => {
                write!(f, "sending block {block} again, {repeat} of {of}: {why}")
            }
            Self::Again { repeat, of, why } => {
                write!(f, "sending the program again, {repeat} of {of}: {why}")
            }
            Self::Verified { crc } => write!(f, "verified: CRC {crc:08X}h"),
            Self::TrialStarting => f.write_str("starting the program for a trial"),
            Self::TrialPassed(running) => write!(f, "the trial went well: {running} came up and came back"),
            Self::Signed => f.write_str("signed: the program starts by itself from now on"),
            Self::Starting => f.write_str("starting the program"),
            Self::Started(running) => write!(f, "running: {running}"),
            Self::VerifiedAgain { crc } => write!(f, "verified once more: CRC {crc:08X}h"),
            Self::Left(state) => write!(f, "the device: {state}"),
        }
    }
}

/// Why a block is sent again.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RepeatReason {
    /// The bootloader found its CRC wrong.
    Crc,
    /// The bootloader was still busy with something else.
    Busy,
    /// The transfer was aborted by the device with a code that speaks of lost frames.
    Broken(AbortCode),
    /// The transfer got no answer.
    NoAnswer,
}

impl fmt::Display for RepeatReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Crc => f.write_str("its CRC arrived wrong"),
            Self::Busy => f.write_str("the bootloader was busy"),
            Self::Broken(code) => write!(f, "the transfer broke: {code}"),
            Self::NoAnswer => f.write_str("no answer"),
        }
    }
}
