//! Registers of the clocks after a reset (RM0090 sections 6.3 and 7.3, RM0390 section 6.3): the
//! same on every chip of [`geometry`](crate::geometry). For those who give the chip on as a reset
//! would.

/// RCC_CR, but for the calibration, which is the chip's: HSI on, trimmed to the middle.
pub const RCC_CR: u32 = 0x83;
/// RCC_PLLCFGR.
pub const RCC_PLLCFGR: u32 = 0x2400_3010;
/// RCC_AHB1ENR: the clock of the CCM RAM, a bit that is set where there is none, too.
pub const RCC_AHB1ENR: u32 = 1 << 20;
