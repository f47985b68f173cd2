//! The time limits of a session, and the form of its downloads.

use std::time::Duration;

use serde::Serialize;

options! {
    /// The time limits of a session.
    #[derive(Clone, Copy, Debug, PartialEq, Eq)]
    pub struct Timing {
        /// How long the answer to one SDO request may take. The default is the manual's.
        pub sdo: Duration = Duration::from_millis(500),
        /// How many times a read, or a write that may be repeated, is tried if no answer comes.
        pub attempts: u32 = 3,
        /// How long a command (erase, program, check) may take: how long 1F57h may read busy.
        pub command: Duration = Duration::from_secs(60),
        /// How long a device may be silent while it carries out a command. Devices of other
        /// manufacturers may be unable to answer while they erase a sector, at most 2 s on an
        /// STM32F4. Devices that erase all sectors before they answer get three times as long.
        pub silent: Duration = Duration::from_secs(10),
        /// How long a restart may take until the device answers again.
        pub boot: Duration = Duration::from_secs(5),
        /// The first pause between two status requests to a busy device. It doubles after each
        /// request …
        pub poll_first: Duration = Duration::from_millis(10),
        /// … up to this one, which limits the load on the bus.
        pub poll_most: Duration = Duration::from_millis(250),
    }
}

impl Timing {
    /// The time limits for a device that may erase all of its flash before it answers.
    pub(crate) fn erasing(&self) -> Self {
        Self { sdo: self.sdo.max((3 * self.silent).min(self.command)), ..*self }
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
