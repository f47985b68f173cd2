//! The choices of a product, in one place; resident part and tasks share them.
#![allow(dead_code, reason = "each of the two programs uses some of it")]

use core::ops::RangeInclusive;

use boot_core::canopen::{BitRate, NodeId};
use boot_core::decision::Policy;
use boot_core::node::NodeParameters;
use boot_core::parameters::Journal;
use boot_core::profile::Profile;
use bsp::can::BitTiming;
use bsp::{BIT_RATE, CAN_CLOCK, LAYOUT, NODE_ID};
use shared_abi::warm_start::Cell;

use crate::flash::FlashController;

/// Which dialect it speaks where they contradict each other.
pub const PROFILE: Profile = if cfg!(feature = "profile-paulus") {
    Profile::PAULUS
} else if cfg!(feature = "profile-esacademy") {
    Profile::ESACADEMY
} else if cfg!(feature = "profile-lift") {
    Profile::LIFT
} else {
    Profile::STANDARD
};

/// Version of the bootloader: major in the upper half, minor in the lower.
pub const VERSION: u32 = 0x0000_0001;

/// What this product does after a reset.
pub const POLICY: Policy = Policy { autostart: Some(1), max_crash_resets: 3, node_ids: NODE_IDS };
/// Node-IDs with which programs may be started.
const NODE_IDS: RangeInclusive<u8> = 1..=127;
/// How long a program that would start by itself is held back, in ms, so that a master can catch
/// the device: an SDO request to it, or any layer setting service, keeps it in the bootloader.
/// `None` for a program that starts at once. Shorter than the heartbeat.
pub const RESCUE_WINDOW_MS: Option<u16> = if cfg!(feature = "rescue-window") { Some(500) } else { None };
/// A program that is started has to feed the independent watchdog within this time, in ms, from its
/// first instruction on; `None` for a program that is started without one.
pub const PROGRAM_WATCHDOG_MS: Option<u16> = None;

/// Where this product keeps its parameters. One with an EEPROM puts its own
/// [`boot_core::parameters::Parameters`] here.
pub type Parameters = Journal;

/// The parameters of this device.
pub fn parameters(flash: &FlashController) -> Parameters {
    Journal::open(flash, LAYOUT.chip, LAYOUT.parameters)
}

/// Node-ID and bit rate of a device that was never told others.
const BOARD_NODE: NodeParameters = NodeParameters {
    id: match NODE_ID {
        NO_NODE_ID => None,
        id => match NodeId::new(id) {
            Some(id) => Some(id),
            None => panic!("board: the node-ID must be 1 to 127, or 255 for none"),
        },
    },
    bit_rate: match BitRate::from_bits_per_second(BIT_RATE) {
        Some(rate) => {
            assert!(
                supports(rate),
                "board: the clock of the CAN controller cannot make the bit rate, or nothing can find it out"
            );
            rate
        }
        None => panic!("board: the bit rate must be one of CANopen's, or 0 to find it out"),
    },
};
/// Stands for no node-ID (CiA 305).
pub const NO_NODE_ID: u8 = 255;

/// Node-ID and bit rate in force from this reset on.
pub fn node_parameters(parameters: &Parameters, flash: &FlashController) -> NodeParameters {
    let default = PROFILE.default_node.map(|(id, bit_rate)| NodeParameters { id: Some(id), bit_rate });
    NodeParameters::load(parameters, flash, default.unwrap_or(BOARD_NODE), supports)
}

/// Whether the board's CAN controller can run at this bit rate.
pub const fn supports(rate: BitRate) -> bool {
    match rate {
        BitRate::Auto => cfg!(feature = "auto-bit-rate"),
        rate => TIMINGS[rate as usize].is_some(),
    }
}

/// How the board's CAN controller makes each bit rate.
pub const TIMINGS: [Option<BitTiming>; 9] = BitTiming::table(CAN_CLOCK, BitRate::TABLE);

/// The warm-start cell of this board.
pub fn warm_start_cell() -> Cell {
    // SAFETY: the layout's warm-start region, checked to be RAM of that size that the linker keeps
    // out of every image.
    unsafe { Cell::at(LAYOUT.warm_start.base as *mut _) }
}
