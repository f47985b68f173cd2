//! STM32F407G-DISC1 with a CAN transceiver on PB12 and PB13: CAN2 instead of CAN1.

use crate::clock::ClockTree;
use crate::{Identity, Pull, Strap};

/// The identity that the device reports.
pub const IDENTITY: Identity = Identity {
    vendor_id: 0,
    product_code: 0x4007_D151,
    revision: 0x0001_0000,
    device_name: "coboot STM32F407G-DISC1",
    hardware_version: "MB997",
};

/// Node-ID of a device that has no other one stored, 1 to 127; 255 for a device that waits for
/// layer setting services (LSS).
pub const NODE_ID: u8 = 1;

/// Bit rate of a device that has no other one stored, in bit/s; 0 for a device that detects it by
/// listening.
pub const BIT_RATE: u32 = 125_000;

/// A crystal of 8 MHz on OSC_IN and OSC_OUT; the fastest clocks that the chip allows at 3.3 V
/// (datasheet DS8626, table 14).
pub const CLOCK_TREE: ClockTree = ClockTree {
    hse: 8_000_000,
    hse_bypass: false,
    pll_input: 2_000_000,
    pll_n: 168,
    pll_p: 2,
    apb1: 4,
    apb2: 2,
    wait_states: 5,
}
.checked();

/// The pin that asks for the bootloader after a reset: the blue button B1 on PA0, high when pressed
/// (UM1472 section 6.4).
pub const ENTRY_STRAP: Option<Strap> = Some(Strap { port: 'A', pin: 0, pressed: true, pull: Pull::None });

/// Bit rate of the UART, in bit/s.
pub const UART_BIT_RATE: u32 = 115_200;

can_controller!(CAN2);

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
    use crate::{can_controllers, Board};

    /// The LED that blinks while the device works: LD4, green, high is on.
    pub type Led = Pin<'D', 12, Output>;

    uart! {
        /// The UART, on PA2 and PA3, which are free on this board (UM1472). It is set up with the
        /// feature `uart` alone.
        USART2
    }

    /// Sets the pins up.
    #[must_use]
    pub fn init(rcc: &mut Rcc, can1: pac::CAN1) -> Board {
        let gpiob = take_port!(GPIOB, can1).split(rcc);
        let gpiod = take_port!(GPIOD, can1).split(rcc);
        let led = gpiod.pd12.into_push_pull_output();
        #[cfg(feature = "uart")]
        let gpioa = take_port!(GPIOA, can1).split(rcc);
        #[cfg(feature = "uart")]
        let uart = Port::new(take_port!(USART2, can1), (gpioa.pa2, gpioa.pa3), rcc);
        let can2 = can_controllers::take_can2(can1, rcc);
        // AF9: CAN2_RX is PB12, CAN2_TX is PB13 (DS8626, alternate functions; the HAL's table has
        // the same). Both are free on this board (UM1472).
        let can = can2.can((gpiob.pb13, gpiob.pb12), rcc);
        Board {
            can,
            led,
            #[cfg(feature = "uart")]
            uart,
        }
    }
}
