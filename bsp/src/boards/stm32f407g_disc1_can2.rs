//! The STM32F407G-DISC1 with a CAN transceiver on PB12 and PB13: CAN2 instead of CAN1.

use crate::{Facts, Pins};

#[path = "stm32f407g_disc1.rs"]
#[allow(dead_code, reason = "its CAN controller is not used here")]
mod same;

pub use same::*;

/// The facts of this board.
pub const FACTS: Facts = Facts {
    // AF9 (DS8626, alternate functions; the HAL's table has the same). Both are free on this board
    // (UM1472).
    can_pins: Pins { transmit: ('B', 13), receive: ('B', 12) },
    ..same::FACTS
};

can_controller!(CAN2);
