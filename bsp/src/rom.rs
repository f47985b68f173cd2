//! The loader that ST has put into the system memory, the ROM of the chip (AN2606; RM0090 section 2.4).

use shared_abi::geometry::SYSTEM_MEMORY;
use stm32f4xx_hal::pac;

/// The first two words of its vector table.
#[must_use]
pub fn words() -> [u32; 2] {
    // SAFETY: every chip has this memory, and it may be read at any time.
    unsafe { (SYSTEM_MEMORY.base as *const [u32; 2]).read_volatile() }
}

/// Maps the system memory to address 0, as the pin BOOT0 does, until the next reset (RM0090 section 9.2.1). The clock of
/// the register is then off again.
pub fn map(rcc: &pac::RCC) {
    rcc.apb2enr().write(|w| w.syscfgen().set_bit());
    // A peripheral needs some cycles after its clock is enabled (errata sheets).
    rcc.apb2enr().read();
    // SAFETY: nothing else uses SYSCFG; 1 is the system memory. No code runs from address 0.
    unsafe { pac::SYSCFG::steal().memrmp().write(|w| w.bits(1)) };
    rcc.apb2enr().reset();
}
