//! STM32F429I-DISC1 with a CAN transceiver on PB8 and PB9.
//!
//! Every pin of CAN1 has another use on this board (UM1670): PD0 and PD1 are data lines of the
//! SDRAM; PA11, PA12, PB8 and PB9 go to the display's parallel interface, where they are connected
//! to inputs. So PB8 and PB9 are free as long as the display is not used.

use crate::clock::ClockTree;
use crate::{Facts, Functions, Identity, Pins, Pull, Strap};

/// The facts of this board.
pub const FACTS: Facts = Facts {
    identity: Identity {
        vendor_id: 0,
        product_code: 0x4291_D151,
        revision: 0x0001_0000,
        device_name: "coboot STM32F429I-DISC1",
        hardware_version: "MB1075",
    },
    node_id: 1,
    bit_rate: 125_000,
    // VDD is the "3V" of the board (UM1670), from a regulator of 3.3 V through a diode.
    supply_mv: 2_900,
    // A crystal of 8 MHz on OSC_IN and OSC_OUT (X3). The core runs at 160 MHz instead of 168 MHz (180
    // MHz with over-drive): APB1 at 40 MHz makes each bit rate of CiA 301; 42 MHz and 45 MHz do not
    // make 800 kbit/s.
    clock_tree: ClockTree {
        hse: 8_000_000,
        hse_bypass: false,
        pll_input: 2_000_000,
        pll_n: 160,
        pll_p: 2,
        apb1: 4,
        apb2: 2,
        wait_states: 6,
    },
    // The blue button B1 (UM1670).
    entry_strap: Some(Strap { port: 'A', pin: 0, pressed: true, pull: Pull::None }),
    // LD3, green, high is on.
    led: ('G', 13),
    // AF9 (DS9405, alternate functions; the HAL's table has the same).
    can_pins: Pins { transmit: ('B', 9), receive: ('B', 8) },
    can_standby: None,
    // The ST-LINK makes them a serial port of the host (UM1670).
    uart_pins: Pins { transmit: ('A', 9), receive: ('A', 10) },
    uart_bit_rate: 115_200,
    functions: Functions::NONE,
};

can_controller!(CAN1);
uart!(USART1);
