//! The results of an update, and of the renewal of a bootloader.

use std::fmt;
use std::time::Duration;

use serde::{Serialize, Serializer};
use shared_abi::ram_image::Version;

use crate::device::{DeviceType, Dialect, Transfers};
use crate::json;

/// The results of an update.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct Report {
    /// Size of the program in bytes, from the start of its region.
    #[serde(rename = "size")]
    pub program_size: u32,
    /// The CRC-32 of the program.
    #[serde(rename = "crc")]
    pub program_crc: u32,
    /// The CRC that the device has reported of it (1F56h), which may be a CRC-16; `None` if it was not asked.
    #[serde(skip)]
    pub device_crc: Option<u32>,
    /// Whether the program has passed its trial run.
    #[serde(skip)]
    pub tried: bool,
    /// Blocks that had to be sent again.
    #[serde(rename = "blocks_repeated")]
    pub repeats: u32,
    /// The total time, on the bus's clock.
    #[serde(rename = "seconds", serialize_with = "json::seconds")]
    pub took: Duration,
    /// The time for the blocks.
    #[serde(rename = "transfer_seconds", serialize_with = "json::seconds")]
    pub transfer: Duration,
    /// The form of downloads at the end.
    #[serde(rename = "transfer")]
    pub transfers: Transfers,
    /// The device type of what runs now, if the program was started.
    #[serde(serialize_with = "device_type")]
    pub running: Option<DeviceType>,
    /// How long the program was watched after its start, if it was started; 0 for not at all.
    #[serde(rename = "watched_seconds", serialize_with = "watched_seconds")]
    pub watched: Option<Duration>,
    /// Whether the program is released for autostart (83h); `None` in a dialect without a release.
    pub released: Option<bool>,
    /// The dialect of the device.
    pub dialect: Dialect,
    /// The results of a renewal, if the file is a bootloader.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub renewal: Option<Renewal>,
}

/// Only the device type: it is known that an application runs.
fn device_type<S: Serializer>(running: &Option<DeviceType>, serializer: S) -> Result<S::Ok, S::Error> {
    running.map(|running| running.0).serialize(serializer)
}

fn watched_seconds<S: Serializer>(watched: &Option<Duration>, serializer: S) -> Result<S::Ok, S::Error> {
    watched.map(|watched| watched.as_secs_f64()).serialize(serializer)
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(renewal) = &self.renewal {
            return renewal.fmt(f);
        }
        write!(f, "done in {:.1} s", self.took.as_secs_f64())?;
        match self.repeats {
            0 => {}
            1 => f.write_str(", 1 block sent again")?,
            blocks => write!(f, ", {blocks} blocks sent again")?,
        }
        match self.watched {
            None => Ok(()),
            Some(Duration::ZERO) => f.write_str("; the program was not watched"),
            Some(time) => write!(f, "; the program was watched for {:.1} s", time.as_secs_f64()),
        }
    }
}

/// The results of a renewal.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct Renewal {
    /// The program number of the bootloader.
    pub number: u8,
    /// The version that ran before.
    #[serde(serialize_with = "number_of")]
    pub from: Version,
    /// The version that runs now.
    #[serde(serialize_with = "number_of")]
    pub to: Version,
    /// Whether the device had this bootloader already: nothing was changed.
    pub unchanged: bool,
    /// How many times it had to be sent again.
    pub repeats: u32,
    /// The time for the download.
    #[serde(rename = "transfer_seconds", serialize_with = "json::seconds")]
    pub transfer: Duration,
    /// The total time, on the bus's clock.
    #[serde(rename = "seconds", serialize_with = "json::seconds")]
    pub took: Duration,
    /// The device type of the program, if one ran before and was started again.
    #[serde(serialize_with = "device_type")]
    pub running: Option<DeviceType>,
}

fn number_of<S: Serializer>(version: &Version, serializer: S) -> Result<S::Ok, S::Error> {
    version.0.serialize(serializer)
}

impl fmt::Display for Renewal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { from, to, .. } = self;
        if self.unchanged {
            return write!(f, "nothing to do: the device has this bootloader (version {to})");
        }
        write!(f, "done in {:.1} s: bootloader {from} -> {to}, installed", self.took.as_secs_f64())
    }
}
