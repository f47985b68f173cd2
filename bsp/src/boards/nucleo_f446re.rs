//! NUCLEO-F446RE with a CAN transceiver on PB8 and PB9 (D15 and D14 of the Arduino connector).

use crate::clock::ClockTree;
use crate::{Facts, Functions, Identity, Pins, Pull, Strap};

/// The facts of this board.
pub const FACTS: Facts = Facts {
    identity: Identity {
        vendor_id: 0,
        product_code: 0x446E_0064,
        revision: 0x0001_0000,
        device_name: "coboot NUCLEO-F446RE",
        hardware_version: "MB1136",
    },
    node_id: 1,
    bit_rate: 125_000,
    // A regulator of 3.3 V, LD39050PU33R (UM1724), to 3 %.
    supply_mv: 3_200,
    // 8 MHz from the ST-LINK on OSC_IN (MCO; UM1724: as delivered). If the ST-LINK has been broken off
    // and no crystal X3 is fitted, the bootloader runs from HSI, whose error is too large for CAN at any
    // bit rate: it only listens (`crystal_failure` of the product).
    //
    // The core runs at 160 MHz instead of the 180 MHz that the chip reaches with over-drive: APB1 at
    // 40 MHz makes each bit rate of CiA 301; 45 MHz and 42 MHz do not make 800 kbit/s.
    clock_tree: ClockTree {
        hse: 8_000_000,
        hse_bypass: true,
        pll_input: 2_000_000,
        pll_n: 160,
        pll_p: 2,
        apb1: 4,
        apb2: 2,
        wait_states: 5,
    },
    // The blue button B1; the board pulls it up (UM1724).
    entry_strap: Some(Strap { port: 'C', pin: 13, pressed: false, pull: Pull::None }),
    // LD2, green, high is on.
    led: ('A', 5),
    // AF9 (DS10693, alternate functions; the HAL's table has the same).
    can_pins: Pins { transmit: ('B', 9), receive: ('B', 8) },
    can_standby: None,
    // The ST-LINK makes them a serial port of the host (UM1724).
    uart_pins: Pins { transmit: ('A', 2), receive: ('A', 3) },
    uart_bit_rate: 115_200,
    functions: Functions::NONE,
};

can_controller!(CAN1);
uart!(USART2);
