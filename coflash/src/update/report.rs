//! What an update did.

use std::fmt;
use std::time::Duration;

use serde::{Serialize, Serializer};

use crate::device::{DeviceType, Dialect, Transfers};
use crate::json;

/// What an update did.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct Report {
    /// Bytes of the program, from its region's start on.
    #[serde(rename = "size")]
    pub program_size: u32,
    /// CRC of the program in the device: what 1F56h reads.
    #[serde(rename = "crc")]
    pub program_crc: u32,
    /// Blocks that had to be sent again.
    #[serde(rename = "blocks_repeated")]
    pub repeats: u32,
    /// How long all of it took, on the bus's clock.
    #[serde(rename = "seconds", serialize_with = "json::seconds")]
    pub took: Duration,
    /// How long the blocks took.
    #[serde(rename = "transfer_seconds", serialize_with = "json::seconds")]
    pub transfer: Duration,
    /// How the blocks were written at the end.
    #[serde(rename = "transfer")]
    pub transfers: Transfers,
    /// What runs now, if the program was started.
    #[serde(serialize_with = "running")]
    pub running: Option<DeviceType>,
    /// Whether the program is released for autostart (83h); `None` in a dialect that knows no release.
    pub released: Option<bool>,
    /// The dialect that the device speaks.
    pub dialect: Dialect,
}

/// The device type alone: that an application runs is known.
fn running<S: Serializer>(running: &Option<DeviceType>, serializer: S) -> Result<S::Ok, S::Error> {
    running.map(|running| running.0).serialize(serializer)
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "done in {:.1} s", self.took.as_secs_f64())?;
        match self.repeats {
            0 => Ok(()),
            1 => f.write_str(", 1 block sent again"),
            blocks => write!(f, ", {blocks} blocks sent again"),
        }
    }
}
