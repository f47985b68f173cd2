//! The chip's peripherals except CAN, each modelled after its section of RM0090.

pub mod crc;
pub mod exti;
pub mod flash;
pub mod gpio;
pub mod i2c;
pub mod iwdg;
pub mod otg;
pub mod over_drive;
pub mod pwr;
pub mod rcc;
pub mod rtc;
pub mod syscfg;
pub mod tim;
pub mod usart;
pub mod wwdg;
