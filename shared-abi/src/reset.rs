//! Values of the clock registers after a reset (RM0090 sections 6.3 and 7.3, RM0390 section 6.3).
//! They are the same on every chip of [`geometry`](crate::geometry). For code that restores the
//! state after a reset.

/// RCC_CR without the calibration bits, which differ between chips: HSI on, trimmed to the middle.
pub const RCC_CR: u32 = 0x83;
/// RCC_PLLCFGR.
pub const RCC_PLLCFGR: u32 = 0x2400_3010;
/// RCC_AHB1ENR: the clock of the CCM RAM; the bit is also set on chips without CCM RAM.
pub const RCC_AHB1ENR: u32 = 1 << 20;
