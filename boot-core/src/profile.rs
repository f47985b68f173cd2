//! Dialects: what the tools of different worlds expect of a bootloader where they contradict each
//! other (docs/dialects.md).
//!
//! Where they agree, or where a bootloader can tell them apart, one binary serves all; that is in
//! [`STANDARD`](Profile::STANDARD).

use canopen::program::{
    BOOTLOADER_DEVICE_TYPE, ESACADEMY_DEVICE_TYPE, ESACADEMY_NODE_ID, LIFT_DEVICE_TYPE, LIFT_NODE_ID,
};
use canopen::{AbortCode, BitRate, NodeId};
use shared_abi::LIFT_PASSWORD;

use crate::bootloader::{Extras, PasswordObject};
use crate::policy::Policy;

/// A dialect.
#[derive(Clone, Copy, Debug)]
pub struct Profile {
    /// 1000h.
    pub device_type: u32,
    /// The node-ID while the bootloader runs; `None` for the device's own.
    pub node_id: Option<NodeId>,
    /// Node-ID and bit rate of a device that was never told others, in place of the board's.
    pub default_node: Option<(NodeId, BitRate)>,
    /// The objects that it adds.
    pub extras: Extras,
    /// What opens 1F50h, where something has to.
    pub password: &'static [u8],
    /// The abort for an SDO request that is not known.
    pub unknown_request: AbortCode,
    /// How programs are downloaded.
    pub download: Policy,
}

impl Profile {
    /// SYS TEC block files, CiA 302-3 masters and their raw images, Intel HEX.
    pub const STANDARD: Self = Self {
        device_type: BOOTLOADER_DEVICE_TYPE,
        node_id: None,
        default_node: None,
        extras: Extras::NONE,
        password: b"",
        unknown_request: AbortCode::COMMAND,
        download: Policy::DEFAULT,
    };

    /// port's Paulus: another abort for what it does not know (table 3).
    pub const PAULUS: Self = Self { unknown_request: AbortCode::GENERAL, ..Self::STANDARD };

    /// The boot loader of ESAcademy: node-ID 64 at 125 kbit/s, a password that voids the program
    /// and opens 1F50h, and the program starts by itself.
    pub const ESACADEMY: Self = Self {
        device_type: ESACADEMY_DEVICE_TYPE,
        default_node: match NodeId::new(ESACADEMY_NODE_ID) {
            Some(id) => Some((id, BitRate::K125)),
            None => None,
        },
        extras: Extras { password: PasswordObject::EnableFlash, ..Extras::NONE },
        password: &Self::INIT.to_le_bytes(),
        download: Policy { locked: true, reset_starts: true, starts_by_itself: true, ..Policy::DEFAULT },
        ..Self::STANDARD
    };
    /// The default password of ESAcademy's boot loader, "INIT".
    pub const INIT: u32 = 0x494E_4954;

    /// The lift bootloader (CiA 417, CiA 814-1): node-ID 126, a password, reading back, and program
    /// 2 is a set of parameters.
    pub const LIFT: Self = Self {
        device_type: LIFT_DEVICE_TYPE,
        node_id: NodeId::new(LIFT_NODE_ID),
        extras: Extras { password: PasswordObject::Unlock, read_back: true, ..Extras::NONE },
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
