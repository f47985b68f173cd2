//! How long to wait for what, and how to write.

use std::time::Duration;

use serde::Serialize;

/// How long to wait for what.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Timing {
    /// The answer to one SDO request. The manual's default.
    pub sdo: Duration,
    /// How often a read, or a write that may be repeated, is tried when no answer comes.
    pub attempts: u32,
    /// A command's execution (erase, program, check): how long 1F57h may read busy.
    pub command: Duration,
    /// How long a device may be silent while it carries out a command. Devices of other makers may be
    /// unable to answer while they erase a sector, 2 s at worst on an STM32F4; those that erase all of
    /// it before they answer have three times as long.
    pub silent: Duration,
    /// A restart: how long a device may take until it answers again.
    pub boot: Duration,
    /// The first pause between two looks at a device that is at work. It doubles from look to look
    /// …
    pub poll_first: Duration,
    /// … up to this one, so that the bus is not flooded.
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

    /// Patience with a device that may erase all of its flash before it answers.
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

/// How values of more than four bytes are written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Transfers {
    /// As blocks, the fast way, until the device says that it does not know them; from then on in
    /// segments.
    #[default]
    Blocks,
    /// In segments, which every device knows: one answer for seven bytes.
    Segments,
}
