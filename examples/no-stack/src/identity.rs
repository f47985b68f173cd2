//! The identity of the device, 1008h and 1018h/1 to 3: that of its bootloader, which refuses a program
//! with another vendor-ID or product code in its label.

pub const NAME: &str = "coboot STM32F407G-DISC1";
pub const VENDOR_ID: u32 = 0x0;
pub const PRODUCT_CODE: u32 = 0x4007D151;
pub const REVISION: u32 = 0x0001_0000;
