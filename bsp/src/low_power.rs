//! Low-power modes (RM0090 section 5): the wake-up from Standby.

use stm32f4xx_hal::pac;

/// Whether the chip has woken up from Standby since the last call. It clears the flag, and leaves no clock of
/// APB1 on, as after a reset.
///
/// The flags of RCC_CSR do not tell: no manual names those of a wake-up, and some chips have none.
#[must_use]
pub fn woke_up(rcc: &pac::RCC) -> bool {
    rcc.apb1enr().write(|w| w.pwren().set_bit());
    // A peripheral needs some cycles after its clock is enabled (errata sheets, "Delay after an RCC peripheral
    // clock enabling").
    rcc.apb1enr().read();
    // SAFETY: nothing else uses the power controller at the same time.
    let pwr = unsafe { pac::PWR::steal() };
    let woke_up = pwr.csr().read().sbf().bit_is_set();
    pwr.cr().modify(|_, w| w.csbf().set_bit());
    rcc.apb1enr().reset();
    woke_up
}
