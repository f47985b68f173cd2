//! The voltage detector (PVD): whether the supply is good enough for the flash.

use canopen::program::Supply;
use stm32f4xx_hal::pac;

use crate::facts::SUPPLY_MV;
use crate::voltage::detector_level;

/// See [`detector_level`].
const LEVEL: Option<u8> = detector_level(SUPPLY_MV);

/// PVDE and PLS of PWR_CR (RM0090 section 5.4.1).
pub(crate) const PVD: u32 = 0b1111 << 4;
/// Their values on this board.
pub(crate) const DETECTS: u32 = match LEVEL {
    Some(level) => (level as u32) << 5 | 1 << 4,
    None => 0,
};

/// Whether the supply is good enough to erase and program the flash. The power controller must be on
/// ([`low_power::take`](crate::low_power::take)).
#[must_use]
pub fn state() -> Supply {
    if LEVEL.is_none() {
        return Supply::Unknown;
    }
    // SAFETY: reading the register has no effect.
    let is_low = unsafe { pac::PWR::steal() }.csr().read().pvdo().bit_is_set();
    if is_low {
        Supply::Low
    } else {
        Supply::Good
    }
}
