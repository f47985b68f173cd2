//! STM32F429I-DISC1 with a CAN transceiver on PB8 and PB9.
//!
//! Every pin of CAN1 has another use on this board (UM1670): PD0 and PD1 are data lines of the
//! SDRAM; PA11, PA12, PB8 and PB9 go to the display's parallel interface, where they are connected
//! to inputs. So PB8 and PB9 are free as long as the display is not used.

use crate::clock::ClockTree;
use crate::{Identity, Pull, Strap};

/// The identity that the device reports.
pub const IDENTITY: Identity = Identity {
    vendor_id: 0,
    product_code: 0x4291_D151,
    revision: 0x0001_0000,
    device_name: "coboot STM32F429I-DISC1",
    hardware_version: "MB1075",
};

/// Node-ID of a device that has no other one stored, 1 to 127; 255 for a device that waits for
/// layer setting services (LSS).
pub const NODE_ID: u8 = 1;

/// Bit rate of a device that has no other one stored, in bit/s; 0 for a device that detects it by
/// listening.
pub const BIT_RATE: u32 = 125_000;

/// A crystal of 8 MHz on OSC_IN and OSC_OUT (X3). The core runs at 160 MHz instead of 168 MHz (180
/// MHz with over-drive): APB1 at 40 MHz makes each bit rate of CiA 301; 42 MHz and 45 MHz do not
/// make 800 kbit/s.
pub const CLOCK_TREE: ClockTree = ClockTree {
    hse: 8_000_000,
    hse_bypass: false,
    pll_input: 2_000_000,
    pll_n: 160,
    pll_p: 2,
    apb1: 4,
    apb2: 2,
    wait_states: 5,
}
.checked();

/// The pin that asks for the bootloader after a reset: the blue button B1 on PA0, high when pressed
/// (UM1670).
pub const ENTRY_STRAP: Option<Strap> = Some(Strap { port: 'A', pin: 0, pressed: true, pull: Pull::None });

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

    /// The LED that blinks while the device works: LD3, green, high is on.
    pub type Led = Pin<'G', 13, Output>;

    uart! {
        /// The UART, on PA9 and PA10, which the ST-LINK makes a serial port of the host (UM1670).
        /// It is set up with the feature `uart` alone.
        USART1
    }

    /// Sets the pins up.
    #[must_use]
    pub fn init(rcc: &mut Rcc, can1: pac::CAN1) -> Board {
        let gpiob = take_port!(GPIOB, can1).split(rcc);
        let gpiog = take_port!(GPIOG, can1).split(rcc);
        let led = gpiog.pg13.into_push_pull_output();
        #[cfg(feature = "uart")]
        let gpioa = take_port!(GPIOA, can1).split(rcc);
        #[cfg(feature = "uart")]
        let uart = Port::new(take_port!(USART1, can1), (gpioa.pa9, gpioa.pa10), rcc);
        // AF9: CAN1_RX is PB8, CAN1_TX is PB9 (DS9405, alternate functions; the HAL's table has the
        // same).
        let can = can1.can((gpiob.pb9, gpiob.pb8), rcc);
        Board {
            can,
            led,
            #[cfg(feature = "uart")]
            uart,
        }
    }
}
