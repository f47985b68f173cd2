//! Dialects: what different tools expect of a bootloader where their expectations contradict each
//! other (docs/dialects.md).
//!
//! Where they agree, or where the bootloader can distinguish them, one binary serves all of them:
//! [`STANDARD`](Profile::STANDARD).

use canopen::program::{
    BOOTLOADER_DEVICE_TYPE, ESACADEMY_DEVICE_TYPE, ESACADEMY_NODE_ID, LIFT_DEVICE_TYPE, LIFT_NODE_ID,
};
use canopen::{AbortCode, BitRate, NodeId};
use shared_abi::LIFT_PASSWORD;

use crate::choices::{Extras, PasswordObject};
use crate::policy::Policy;

/// A dialect.
#[derive(Clone, Copy, Debug)]
pub struct Profile {
    /// 1000h.
    pub device_type: u32,
    /// The node-ID while the bootloader runs; `None` for the device's stored node-ID.
    pub node_id: Option<NodeId>,
    /// Node-ID and bit rate of a device without stored values, in place of the board's.
    pub default_node: Option<(NodeId, BitRate)>,
    /// The additional objects.
    pub extras: Extras,
    /// The password that unlocks 1F50h, if the dialect has one.
    pub password: &'static [u8],
    /// The abort for an unknown SDO request.
    pub unknown_request: AbortCode,
    /// The choices about downloads.
    pub download: Policy,
}

impl Profile {
    /// All dialects: the name on a command line, and a line of help.
    pub const ALL: [(&'static str, &'static str, Self); 4] = [
        ("standard", "Block files, raw images and Intel HEX: the default of the firmware", Self::STANDARD),
        ("paulus", "port's Paulus", Self::PAULUS),
        ("esacademy", "The boot loader of ESAcademy: 7F50h unlocks 1F50h", Self::ESACADEMY),
        ("lift", "CiA 417 lifts: 6005h unlocks 1F50h, node-ID 126", Self::LIFT),
    ];

    /// SYS TEC block files, CiA 302-3 masters and their raw images, Intel HEX.
    pub const STANDARD: Self = Self {
        device_type: BOOTLOADER_DEVICE_TYPE,
        node_id: None,
        default_node: None,
        extras: Extras::STANDARD,
        password: b"",
        unknown_request: AbortCode::COMMAND,
        download: Policy::DEFAULT,
    };

    /// port's Paulus: another abort for unknown requests (table 3).
    pub const PAULUS: Self = Self { unknown_request: AbortCode::GENERAL, ..Self::STANDARD };

    /// The boot loader of ESAcademy: node-ID 64 at 125 kbit/s; the password makes the old program
    /// invalid and unlocks 1F50h; the program starts by itself.
    pub const ESACADEMY: Self = Self {
        device_type: ESACADEMY_DEVICE_TYPE,
        default_node: match NodeId::new(ESACADEMY_NODE_ID) {
            Some(id) => Some((id, BitRate::K125)),
            None => None,
        },
        extras: Extras { password: PasswordObject::EnableFlash, ..Extras::STANDARD },
        password: &Self::INIT.to_le_bytes(),
        download: Policy { locked: true, reset_starts: true, starts_by_itself: true, ..Policy::DEFAULT },
        ..Self::STANDARD
    };
    /// The default password of ESAcademy's boot loader, "INIT".
    pub const INIT: u32 = 0x494E_4954;

    /// The lift bootloader (CiA 417, CiA 814-1): node-ID 126, a password, and reading of programs;
    /// program 2 is a set of parameters.
    pub const LIFT: Self = Self {
        device_type: LIFT_DEVICE_TYPE,
        node_id: NodeId::new(LIFT_NODE_ID),
        extras: Extras { password: PasswordObject::Unlock, read_back: true, ..Extras::STANDARD },
        password: LIFT_PASSWORD,
        download: Policy {
            locked: true,
            reset_starts: true,
            wants_label: true,
            data: Some(2),
            read_back: true,
            replaces: true,
            ..Policy::DEFAULT
        },
        ..Self::STANDARD
    };
}
