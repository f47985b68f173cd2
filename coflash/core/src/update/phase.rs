//! The phases of an update, and the information found on the way.

use std::fmt;
use std::time::Duration;

use canopen::NodeId;
use coboot_can::Losses;
use serde::Serialize;

use crate::advice::{Advice, OfProgram};
use crate::device::info::Nameplate;
use crate::device::session::Silence;
use crate::device::{DeviceType, Dialect};
use crate::file::checksum::Checksum;
use crate::file::{self, Target};
use crate::json;
use shared_abi::ram_image::Version;

/// The phase of an update.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(tag = "phase", rename_all = "snake_case")]
#[non_exhaustive]
pub enum Phase {
    /// Step 1: the bootloader does not answer yet; the tool searches for it.
    Searching {
        /// Why it does not answer yet.
        reason: String,
    },
    /// Step 3: the application gets the call to return to the bootloader.
    CallingBack,
    /// Step 3 was successful.
    InBootloader,
    /// Step 4: the program is being erased.
    Erasing,
    /// Step 5: the command to erase is carried out.
    Erased {
        /// How long it took.
        #[serde(rename = "seconds", serialize_with = "json::seconds")]
        took: Duration,
        /// Whether the device still has its program, as 1F56h says: it has postponed the erase until the first good
        /// block. `None` from a device without 1F56h.
        postponed: Option<bool>,
    },
    /// Instead of steps 4 and 5: the device has a part of this file from a download that was cut
    /// off.
    GoingOn {
        /// The bytes of the program that it has, and all.
        done: usize,
        /// See `done`.
        total: usize,
    },
    /// The CRC computed by the bootloader matches the file's.
    Verified {
        /// The CRC.
        crc: u32,
    },
    /// Step 10: the program starts for a trial.
    TrialStarting,
    /// Step 13: the program ran, and returned when it was called.
    TrialPassed(DeviceType),
    /// Step 14: the program is released for autostart (83h).
    Released,
    /// The program is not released for autostart, because it is not to be started.
    NotReleased {
        /// Its number.
        program: u8,
    },
    /// Step 15: the program starts.
    Starting,
    /// The update does not take place: the program that was called back starts again.
    StartingAgain,
    /// The program runs.
    Started(DeviceType),
    /// The bootloader itself is renewed.
    Renewing {
        /// Its program number.
        number: u8,
        /// The version that runs, as 1018h/3 has it.
        from: u32,
        /// The new version.
        to: u32,
    },
    /// The new bootloader is complete in the device, and starts for its trial.
    Staged,
    /// The new bootloader answers: it gets the confirmation (83h), and installs itself.
    OnTrial,
    /// The new bootloader is installed.
    Installed {
        /// Its version.
        version: u32,
    },
    /// After the end of the procedure, the CRC still matches the file's.
    VerifiedAgain {
        /// The CRC.
        crc: u32,
    },
}

/// Useful information about the device.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(tag = "note", rename_all = "snake_case")]
#[non_exhaustive]
pub enum Note {
    /// The device's name, versions and identity.
    Nameplate(Box<Nameplate>),
    /// The device is the target of the file.
    TargetRight(Target),
    /// The bootloader speaks this dialect.
    Dialect {
        /// The dialect.
        dialect: Dialect,
    },
    /// The device checks with another CRC than that of the file: the blocks are sent with this one.
    OtherCrc {
        /// The CRC of the device.
        #[serde(serialize_with = "json::words")]
        crc: Checksum,
    },
    /// The password was accepted.
    Unlocked,
    /// The device now has another node-ID.
    Moved {
        /// The new node-ID.
        #[serde(rename = "to", serialize_with = "json::node")]
        node: NodeId,
    },
    /// The data go to so many devices at once. Reported once.
    Together {
        /// The number of devices.
        devices: usize,
    },
    /// The NMT mastership was taken over.
    MasterTaken {
        /// The previous master.
        #[serde(rename = "master", serialize_with = "json::node")]
        node: NodeId,
    },
    /// The NMT mastership was given back.
    MasterBack {
        /// The new master.
        #[serde(rename = "master", serialize_with = "json::node")]
        node: NodeId,
    },
    /// What the device says of the program that was released for autostart.
    Autostart {
        /// The program's number.
        number: u8,
        /// It in words.
        says: String,
    },
}

/// A problem that may make the update, or a later step, fail.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(tag = "warning", rename_all = "snake_case")]
#[non_exhaustive]
pub enum Warning {
    /// Another node keeps the NMT mastership.
    MasterKept {
        /// The node.
        #[serde(rename = "master", serialize_with = "json::node")]
        node: NodeId,
    },
    /// The NMT mastership was given back, but no node has announced that it is the master.
    MasterMissing,
    /// Somebody else uses a COB-ID of the group: the devices are updated one by one.
    GroupDisturbed,
    /// The update in the group has failed: the device is updated once more, without the others.
    Apart {
        /// What happened.
        why: String,
    },
    /// The device has a newer version of the program.
    Older {
        /// The version of the device.
        has: String,
        /// The version of the file.
        gets: String,
    },
    /// The part that the device had does not fit the file: everything is sent again.
    BeginsAgain {
        /// What the device found.
        why: String,
    },
    /// The program covers the flash that a new bootloader needs.
    CoversStaging {
        /// First address of that flash.
        #[serde(serialize_with = "json::hex")]
        first: u32,
    },
    /// The device has not answered for a while, and the tool waits for it.
    Silent(Silence),
    /// What did not go through the adapter.
    Adapter(Losses),
}

impl fmt::Display for Phase {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Searching { reason } => {
                write!(f, "searching for the bootloader, Ctrl-C ends the search ({reason})")
            }
            Self::CallingBack => f.write_str("calling the application back to the bootloader"),
            Self::InBootloader => f.write_str("the bootloader is running"),
            Self::Erasing => f.write_str("commanding the device to erase the old program"),
            Self::Erased { postponed: Some(true), .. } => {
                f.write_str("the device has postponed the erase until the first good block")
            }
            Self::Erased { took, postponed: Some(false) } => {
                write!(f, "erased in {:.1} s", took.as_secs_f64())
            }
            Self::Erased { took, postponed: None } => {
                write!(f, "the device has acknowledged the erase after {:.1} s", took.as_secs_f64())
            }
            Self::GoingOn { done, total } => {
                write!(f, "going on with a download that was cut off: the device has {done} of {total} bytes")
            }
            Self::Verified { crc } => write!(f, "verified: CRC {crc:08X}h"),
            Self::TrialStarting => f.write_str("starting the program for a trial"),
            Self::TrialPassed(running) => {
                write!(f, "the trial was successful: {running} started and returned to the bootloader")
            }
            Self::Released => f.write_str("released for autostart (83h)"),
            Self::NotReleased { program } => {
                let advice = Advice::ReleaseIt { program: OfProgram(*program) };
                write!(f, "not released for autostart; {advice}")
            }
            Self::Starting => f.write_str("starting the program"),
            Self::StartingAgain => {
                f.write_str("nothing was changed: starting the program again that was called back")
            }
            Self::Started(running) => write!(f, "running: {running}"),
            Self::Renewing { number, from, to } => write!(
                f,
                "renewing the bootloader (program {number}): version {} -> {}; the program stays",
                Version(*from),
                Version(*to)
            ),
            Self::Staged => f.write_str("the new bootloader is staged: starting it for its trial"),
            Self::OnTrial => {
                f.write_str("the new bootloader answers: confirming it (83h), it installs itself")
            }
            Self::Installed { version } => write!(f, "installed: bootloader {}", Version(*version)),
            Self::VerifiedAgain { crc } => write!(f, "verified again: CRC {crc:08X}h"),
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
                    "the device matches the file: vendor-ID {vendor_id:08X}h, product code {product_code:08X}h"
                )
            }
            Self::Dialect { dialect } => write!(f, "dialect: {dialect}"),
            Self::OtherCrc { crc } => write!(f, "the device checks with {crc}: sending the blocks with it"),
            Self::Unlocked => f.write_str("unlocked"),
            Self::Together { devices } => write!(f, "receiving the program together: {devices} devices"),
            Self::Moved { node } => write!(f, "the device now answers as node {node}"),
            Self::MasterTaken { node } => write!(f, "NMT mastership taken over from node {node}"),
            Self::MasterBack { node } => {
                write!(f, "NMT mastership given back: node {node} is the master")
            }
            Self::Autostart { number, says } => write!(f, "program {number}: {says}"),
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
                f.write_str("NMT mastership given back, but no node has announced that it is the master")
            }
            Self::GroupDisturbed => {
                f.write_str("another node uses a COB-ID of the group: the devices are updated one by one")
            }
            Self::Apart { why } => {
                write!(f, "it did not get through with the others ({why}): updating it alone")
            }
            Self::Older { has, gets } => {
                write!(f, "the device has version {has}, and the file is older: {gets}")
            }
            Self::BeginsAgain { why } => {
                write!(f, "what the device had of this program is not usable ({why}): sending everything")
            }
            Self::CoversStaging { first } => file::Note::CoversStaging(*first).fmt(f),
            Self::Silent(silence) => silence.fmt(f),
            Self::Adapter(losses) => losses.fmt(f),
        }
    }
}
