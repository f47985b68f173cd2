//! The power controller (RM0090 section 5): the wake-up from Standby, the voltage detector, and the clocks of
//! the sleep mode.

use stm32f4xx_hal::pac;

use crate::supply::{DETECTS, PVD};

/// Switches power controller and voltage detector ([`crate::supply`]) on until [`release`]. Returns whether the chip
/// has woken up from Standby since the last call, and clears the flag. No other clock of APB1 is on.
///
/// The flags of RCC_CSR do not tell: no manual names those of a wake-up, and some chips have none.
#[must_use]
pub fn take(rcc: &pac::RCC) -> bool {
    rcc.apb1enr().write(|w| w.pwren().set_bit());
    // A peripheral needs some cycles after its clock is enabled (errata sheets, "Delay after an RCC peripheral
    // clock enabling").
    rcc.apb1enr().read();
    // SAFETY: nothing else uses the power controller at the same time.
    let pwr = unsafe { pac::PWR::steal() };
    let woke_up = pwr.csr().read().sbf().bit_is_set();
    // SAFETY: a level that the detector has; the other bits stay.
    pwr.cr().modify(|r, w| unsafe { w.bits(r.bits() & !PVD | DETECTS) }.csbf().set_bit());
    woke_up
}

/// Switches voltage detector and power controller off, as after a reset; the regulator keeps its scale.
pub fn release(rcc: &pac::RCC) {
    // SAFETY: nothing else uses the power controller at the same time.
    let pwr = unsafe { pac::PWR::steal() };
    // SAFETY: the detector is off; the other bits stay.
    pwr.cr().modify(|r, w| unsafe { w.bits(r.bits() & !PVD) });
    rcc.apb1enr().reset();
}

/// Gives every peripheral a clock in sleep mode, as after a reset: an application that jumped may have taken
/// it away, and the bootloader sleeps (sections 7.3.15 to 7.3.19).
pub fn keep_clocks_in_sleep(rcc: &pac::RCC) {
    // SAFETY: after a reset every bit that exists is set; the others stay 0.
    unsafe {
        rcc.ahb1lpenr().write(|w| w.bits(u32::MAX));
        rcc.ahb2lpenr().write(|w| w.bits(u32::MAX));
        rcc.ahb3lpenr().write(|w| w.bits(u32::MAX));
        rcc.apb1lpenr().write(|w| w.bits(u32::MAX));
        rcc.apb2lpenr().write(|w| w.bits(u32::MAX));
    }
}
