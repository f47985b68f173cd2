//! The results of a renewal of a device's bootloader.

use std::fmt;
use std::time::Duration;

use serde::Serialize;
use shared_abi::ram_image::Version;

use crate::device::DeviceType;
use crate::json;

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

fn number_of<S: serde::Serializer>(version: &Version, serializer: S) -> Result<S::Ok, S::Error> {
    version.0.serialize(serializer)
}

fn device_type<S: serde::Serializer>(running: &Option<DeviceType>, serializer: S) -> Result<S::Ok, S::Error> {
    running.map(|running| running.0).serialize(serializer)
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
