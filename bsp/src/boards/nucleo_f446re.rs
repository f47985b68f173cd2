//! NUCLEO-F446RE with a CAN transceiver on PB8 and PB9 (D15 and D14 of the Arduino connector).

use crate::clock::ClockTree;
use crate::{Identity, Pull, Strap};

/// The identity that the device reports.
pub const IDENTITY: Identity = Identity {
    vendor_id: 0,
    product_code: 0x446E_0064,
    revision: 0x0001_0000,
    device_name: "coboot NUCLEO-F446RE",
    hardware_version: "MB1136",
};

/// Node-ID of a device that has no other one stored, 1 to 127; 255 for a device that waits for
/// layer setting services (LSS).
pub const NODE_ID: u8 = 1;

/// Bit rate of a device that has no other one stored, in bit/s; 0 for a device that detects it by
/// listening.
pub const BIT_RATE: u32 = 125_000;

/// 8 MHz from the ST-LINK on OSC_IN (MCO; UM1724: as delivered). HSI alone would be enough for the
/// core, but its error of 1 % is too large for CAN above 125 kbit/s. If the ST-LINK has been broken
/// off and no crystal X3 is fitted, the bootloader falls back to HSI.
///
/// The core runs at 160 MHz instead of the 180 MHz that the chip reaches with over-drive: APB1 at
/// 40 MHz makes each bit rate of CiA 301; 45 MHz and 42 MHz do not make 800 kbit/s.
pub const CLOCK_TREE: ClockTree = ClockTree {
    hse: 8_000_000,
    hse_bypass: true,
    pll_input: 2_000_000,
    pll_n: 160,
    pll_p: 2,
    apb1: 4,
    apb2: 2,
    wait_states: 5,
}
.checked();

/// The pin that asks for the bootloader after a reset: the blue button B1 on PC13, low when
/// pressed; the board pulls it up (UM1724).
pub const ENTRY_STRAP: Option<Strap> = Some(Strap { port: 'C', pin: 13, pressed: false, pull: Pull::None });

/// Bit rate of the UART, in bit/s.
pub const UART_BIT_RATE: u32 = 115_200;

can_controller!(CAN1);

#[cfg(target_arch = "arm")]
pub use pins::*;

/// LED, CAN controller and UART, by the types that the HAL has for pins.
#[cfg(target_arch = "arm")]
mod pins {
    use stm32f4xx_hal::can::CanExt;
    use stm32f4xx_hal::gpio::{GpioExt, Output, Pin};
    use stm32f4xx_hal::pac;
    use stm32f4xx_hal::rcc::Rcc;

    #[cfg(feature = "uart")]
    use crate::uart::Port;
    use crate::Board;

    /// The LED that blinks while the device works: LD2, green, high is on.
    pub type Led = Pin<'A', 5, Output>;

    uart! {
        /// The UART, on PA2 and PA3, which the ST-LINK makes a serial port of the host (UM1724).
        /// It is set up with the feature `uart` alone.
        USART2
    }

    /// Sets the pins up.
    #[must_use]
    pub fn init(rcc: &mut Rcc, can1: pac::CAN1) -> Board {
        let gpioa = take_port!(GPIOA, can1).split(rcc);
        let gpiob = take_port!(GPIOB, can1).split(rcc);
        let led = gpioa.pa5.into_push_pull_output();
        #[cfg(feature = "uart")]
        let uart = Port::new(take_port!(USART2, can1), (gpioa.pa2, gpioa.pa3), rcc);
        // AF9: CAN1_RX is PB8, CAN1_TX is PB9 (DS10693, alternate functions; the HAL's table has
        // the same).
        let can = can1.can((gpiob.pb9, gpiob.pb8), rcc);
        Board {
            can,
            led,
            #[cfg(feature = "uart")]
            uart,
        }
    }
}
