//! The time limits of a session, and the form of its downloads.

use std::time::Duration;

use serde::Serialize;

/// The time limits of a session.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Timing {
    /// How long the answer to one SDO request may take. The default is the manual's.
    pub sdo: Duration,
    /// How many times a read, or a write that may be repeated, is tried if no answer comes.
    pub attempts: u32,
    /// How long a command (erase, program, check) may take: how long 1F57h may read busy.
    pub command: Duration,
    /// How long a device may be silent while it carries out a command. Devices of other
    /// manufacturers may be unable to answer while they erase a sector, at most 2 s on an STM32F4.
    /// Devices that erase all sectors before they answer get three times as long.
    pub silent: Duration,
    /// How long a restart may take until the device answers again.
    pub boot: Duration,
    /// The first pause between two status requests to a busy device. It doubles after each request
    /// …
    pub poll_first: Duration,
    /// … up to this one, which limits the load on the bus.
    pub poll_most: Duration,
}

impl Timing {
    setters! {
        sdo: Duration,
        attempts: u32,
        command: Duration,
        silent: Duration,
        boot: Duration,
        poll_first: Duration,
        poll_most: Duration,
    }

    /// The time limits for a device that may erase all of its flash before it answers.
    pub(crate) fn erasing(&self) -> Self {
        Self { sdo: self.sdo.max((3 * self.silent).min(self.command)), ..*self }
    }
}

impl Default for Timing {
    fn default() -> Self {
        Self {
            sdo: Duration::from_millis(500),
            attempts: 3,
            command: Duration::from_secs(60),
            silent: Duration::from_secs(10),
            boot: Duration::from_secs(5),
            poll_first: Duration::from_millis(10),
            poll_most: Duration::from_millis(250),
        }
    }
}

/// The form of downloads of more than four bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Transfers {
    /// By block transfer, the fast form, until the device refuses it; from then on in segments.
    #[default]
    Blocks,
    /// In segments, which every device supports: one answer for seven bytes.
    Segments,
}
