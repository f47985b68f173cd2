//! Dialects: the ways in which different bootloaders use the same objects.
//!
//! This module lists the dialects and detects them from the device type. The commands of each
//! dialect during an update are in [`update::dialect`](crate::update::dialect).

use std::fmt;

use canopen::program::{self, ESACADEMY_DEVICE_TYPE, LIFT_DEVICE_TYPE, LIFT_NODE_ID};
use canopen::NodeId;
use serde::{Serialize, Serializer};

use super::device_type::DeviceType;

/// The dialect of a bootloader.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Dialect {
    /// Block files: the dialect of SYS TEC and of coboot.
    Block,
    /// CiA 302-3 with a binary image.
    Raw,
    /// CiA 302-3 with Intel HEX.
    Hex,
    /// CiA 417, as CiA 814-1 describes it.
    Lift,
    /// ESAcademy's minimal boot loader.
    EsAcademy,
}

impl Dialect {
    /// All dialects.
    pub const ALL: [Self; 5] = [Self::Block, Self::Raw, Self::Hex, Self::Lift, Self::EsAcademy];

    /// The name on the command line.
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

    /// The dialect with this name.
    #[must_use]
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|dialect| dialect.name() == name)
    }

    /// The dialect of a bootloader with this device type at this node-ID; `None` for an application
    /// or an unknown device type.
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
            Self::Block => "block (block files, SYS TEC)",
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
