//! Where an update has come to, and what it has learned on the way.

use std::fmt;
use std::time::Duration;

use canopen::NodeId;
use serde::Serialize;

use super::options::Target;
use crate::device::info::Nameplate;
use crate::device::{DeviceType, Dialect, Doing};
use crate::json;

/// An erasure that is over sooner than this was put off, or had little to do. Erasing a sector of
/// flash takes longer.
pub(super) const PUT_OFF: Duration = Duration::from_millis(100);

/// Where an update has come to.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(tag = "phase", rename_all = "snake_case")]
#[non_exhaustive]
pub enum Phase {
    /// Step 1: nothing of a bootloader yet; it is looked for until it is there.
    Searching {
        /// Why it is not there yet.
        reason: String,
    },
    /// Step 3: the application is asked to go back to the bootloader.
    CallingBack,
    /// Step 3 has worked.
    InBootloader,
    /// Step 4: the program is being erased.
    Erasing,
    /// Step 5: it is erased.
    Erased {
        /// How long that took.
        #[serde(rename = "seconds", serialize_with = "json::seconds")]
        took: Duration,
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
    /// Step 14: the program is released for autostart (83h).
    Released,
    /// The program is left as it is, not released for autostart, because it is not to be started.
    NotReleased,
    /// Step 15: the program starts.
    Starting,
    /// It runs.
    Started(DeviceType),
    /// After its end, the procedure's last look: the CRC is still the file's.
    VerifiedAgain {
        /// The CRC.
        crc: u32,
    },
}

/// Something about the device that is good to know.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(tag = "note", rename_all = "snake_case")]
#[non_exhaustive]
pub enum Note {
    /// What the device tells of itself.
    Nameplate(Box<Nameplate>),
    /// It is the device that the file is for.
    TargetRight(Target),
    /// The bootloader speaks this dialect.
    Dialect {
        /// Which one.
        dialect: Dialect,
    },
    /// The password was right.
    Unlocked,
    /// The device goes on under another node-ID.
    Moved {
        /// This one.
        #[serde(rename = "to", serialize_with = "json::node")]
        node: NodeId,
    },
    /// The NMT mastership was taken over.
    MasterTaken {
        /// From this node.
        #[serde(rename = "master", serialize_with = "json::node")]
        node: NodeId,
    },
    /// The NMT mastership was given back.
    MasterBack {
        /// This node has it now.
        #[serde(rename = "master", serialize_with = "json::node")]
        node: NodeId,
    },
}

/// Something because of which the update, or what comes behind it, may go wrong.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(tag = "warning", rename_all = "snake_case")]
#[non_exhaustive]
pub enum Warning {
    /// Another node keeps the NMT mastership.
    MasterKept {
        /// This one.
        #[serde(rename = "master", serialize_with = "json::node")]
        node: NodeId,
    },
    /// The NMT mastership was given back, and no node says that it has it.
    MasterMissing,
    /// The device has not answered for a while, and is waited for.
    Silent {
        /// What it was told.
        #[serde(serialize_with = "json::words")]
        doing: Doing,
        /// How long nothing has been heard of it.
        #[serde(rename = "seconds", serialize_with = "json::seconds")]
        silent: Duration,
        /// How long it is waited for in all.
        #[serde(rename = "limit_seconds", serialize_with = "json::seconds")]
        limit: Duration,
    },
}

impl fmt::Display for Phase {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Searching { reason } => {
                write!(f, "searching for the bootloader, Ctrl-C ends it ({reason})")
            }
            Self::CallingBack => f.write_str("calling the application back to the bootloader"),
            Self::InBootloader => f.write_str("the bootloader is running"),
            Self::Erasing => f.write_str("telling it to erase the old program"),
            Self::Erased { took } if *took < PUT_OFF => {
                f.write_str("it will, with the first block that it finds good")
            }
            Self::Erased { took } => write!(f, "erased in {:.1} s", took.as_secs_f64()),
            Self::Verified { crc } => write!(f, "verified: CRC {crc:08X}h"),
            Self::TrialStarting => f.write_str("starting the program for a trial"),
            Self::TrialPassed(running) => write!(f, "the trial went well: {running} came up and came back"),
            Self::Released => {
                f.write_str("released for autostart (83h): the program starts by itself from now on")
            }
            Self::NotReleased => f.write_str(
                "not released for autostart: the device stays in the bootloader; coflash start tries the \
                 program, coflash release releases it",
            ),
            Self::Starting => f.write_str("starting the program"),
            Self::Started(running) => write!(f, "running: {running}"),
            Self::VerifiedAgain { crc } => write!(f, "verified once more: CRC {crc:08X}h"),
        }
    }
}

impl fmt::Display for Note {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Nameplate(plate) => write!(f, "device: {plate}"),
            Self::TargetRight(Target { vendor_id, product_code }) => {
                write!(
                    f,
                    "it is the right device: vendor-ID {vendor_id:08X}h, product code {product_code:08X}h"
                )
            }
            Self::Dialect { dialect } => write!(f, "its dialect: {dialect}"),
            Self::Unlocked => f.write_str("unlocked"),
            Self::Moved { node } => write!(f, "it answers as node {node} now"),
            Self::MasterTaken { node } => write!(f, "NMT mastership taken over from node {node}"),
            Self::MasterBack { node } => {
                write!(f, "NMT mastership given back: node {node} is the master")
            }
        }
    }
}

impl fmt::Display for Warning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::MasterKept { node } => {
                write!(f, "node {node} keeps the NMT mastership: it may disturb the update")
            }
            Self::MasterMissing => {
                f.write_str("NMT mastership given back, and nobody has said that it is the master")
            }
            Self::Silent { doing, silent, limit } => write!(
                f,
                "no answer for {:.0} s ({doing}), waiting up to {:.0} s",
                silent.as_secs_f64(),
                limit.as_secs_f64()
            ),
        }
    }
}
