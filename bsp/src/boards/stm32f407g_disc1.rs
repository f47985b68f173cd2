//! STM32F407G-DISC1 with a CAN transceiver on PD0 and PD1.

use crate::clock::ClockTree;
use crate::{Facts, Functions, Identity, Pins, Pull, Strap};

/// The facts of this board.
pub const FACTS: Facts = Facts {
    identity: Identity {
        vendor_id: 0,
        product_code: 0x4007_D151,
        revision: 0x0001_0000,
        device_name: "coboot STM32F407G-DISC1",
        hardware_version: "MB997",
    },
    node_id: 1,
    bit_rate: 125_000,
    // VDD comes from a regulator of 3.3 V through a diode (UM1472, "3V"): boards have 2.9 to 3.0 V.
    supply_mv: 2_900,
    // A crystal of 8 MHz on OSC_IN and OSC_OUT; the fastest clocks that the chip allows at 3.3 V
    // (datasheet DS8626, table 14).
    clock_tree: ClockTree {
        hse: 8_000_000,
        hse_bypass: false,
        pll_input: 2_000_000,
        pll_n: 168,
        pll_p: 2,
        apb1: 4,
        apb2: 2,
        wait_states: 6,
    },
    // The blue button B1 (UM1472 section 6.4).
    entry_strap: Some(Strap { port: 'A', pin: 0, pressed: true, pull: Pull::None }),
    // LD4, green, high is on.
    led: ('D', 12),
    can_pins: Pins { transmit: ('D', 1), receive: ('D', 0) },
    can_standby: None,
    // They are free on this board (UM1472).
    uart_pins: Pins { transmit: ('A', 2), receive: ('A', 3) },
    uart_bit_rate: 115_200,
    functions: Functions::NONE,
};

can_controller!(CAN1);
uart!(USART2);
