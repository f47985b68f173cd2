//! Dialects: what different bootloaders make of the same objects.
//!
//! Here is which there are, and how their bootloaders say so; what each of them is told in an update
//! is in [`update::dialect`](crate::update::dialect).

use std::fmt;

use canopen::program::{self, ESACADEMY_DEVICE_TYPE, LIFT_DEVICE_TYPE, LIFT_NODE_ID};
use canopen::NodeId;
use serde::{Serialize, Serializer};

use super::device_type::DeviceType;

/// Which dialect a bootloader speaks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Dialect {
    /// SYS TEC, and coboot's own.
    Block,
    /// CiA 302-3, an image.
    Raw,
    /// CiA 302-3, Intel HEX.
    Hex,
    /// CiA 417, as CiA 814-1 describes it.
    Lift,
    /// ESAcademy's minimal boot loader.
    EsAcademy,
}

impl Dialect {
    /// All of them.
    pub const ALL: [Self; 5] = [Self::Block, Self::Raw, Self::Hex, Self::Lift, Self::EsAcademy];

    /// Its name on the command line.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Block => "block",
            Self::Raw => "raw",
            Self::Hex => "hex",
            Self::Lift => "lift",
            Self::EsAcademy => "esacademy",
        }
    }

    /// What a bootloader with this device type speaks, at this node-ID; `None` for what is an
    /// application or unknown.
    #[must_use]
    pub fn of_bootloader(running: DeviceType, node: NodeId) -> Option<Self> {
        match running.0 {
            program::BOOTLOADER_DEVICE_TYPE => Some(Self::Block),
            LIFT_DEVICE_TYPE => Some(Self::Lift),
            ESACADEMY_DEVICE_TYPE if node.get() == LIFT_NODE_ID => Some(Self::Lift),
            ESACADEMY_DEVICE_TYPE => Some(Self::EsAcademy),
            _ => None,
        }
    }
}

impl fmt::Display for Dialect {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Block => "block (block files, as SYS TEC has it)",
            Self::Raw => "raw (CiA 302-3, an image)",
            Self::Hex => "hex (CiA 302-3, Intel HEX)",
            Self::Lift => "lift (CiA 417)",
            Self::EsAcademy => "esacademy (Intel HEX behind a password)",
        })
    }
}

impl Serialize for Dialect {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name())
    }
}
