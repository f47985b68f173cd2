//! For the tests: its parameters are in an EEPROM at the pins PB12 (select), PB13 (clock), PB14 (data to the chip that this
//! is) and PB15 (data to the EEPROM), and not in the flash (docs/eeprom.md).

use super::*;

#[cfg(target_arch = "arm")]
#[path = "../../tests/drivers/eeprom.rs"]
mod eeprom;
// What the tests on the host have is the choices.
#[cfg(target_arch = "arm")]
pub use pins::*;

/// The choices of this product.
pub const PRODUCT: Product = Product::DEFAULT;

#[cfg(target_arch = "arm")]
mod pins {
    use boot_core::flash::Flash;
    use bsp::pac;

    use super::eeprom;

    /// The store of this product.
    pub type Parameters = eeprom::InEeprom<Pins>;

    /// The parameters of this device.
    pub fn parameters(_: &impl Flash) -> Parameters {
        eeprom::InEeprom::open(Pins)
    }

    /// The four pins, bit by bit in SPI mode 0: boot stage, RAM image and callgate use them, so each transaction sets them
    /// up and leaves them as it found them. A resistor holds the select pin high between two transactions.
    pub struct Pins;

    const SELECT: u32 = 1 << 12;
    const CLOCK: u32 = 1 << 13;
    const IN: u32 = 1 << 14;
    const OUT: u32 = 1 << 15;
    /// The clock of port B in RCC_AHB1ENR (RM0090 section 6.3.10).
    const PORT_B: u32 = 1 << 1;

    impl eeprom::Spi for Pins {
        fn transfer(&mut self, bytes: &[u8], answer: &mut [u8]) {
            // SAFETY: a board with the EEPROM has these pins for it alone, and nothing that interrupts this changes the
            // mode of port B, or the clocks.
            let (rcc, port) = unsafe { (pac::RCC::steal(), pac::GPIOB::steal()) };
            let clocks = rcc.ahb1enr().read().bits();
            // SAFETY: it enables the clock of a port and leaves the others on. Reading back takes the two cycles that the
            // port needs.
            rcc.ahb1enr().write(|w| unsafe { w.bits(clocks | PORT_B) });
            let _ = rcc.ahb1enr().read();
            let (mode, level) = (port.moder().read().bits(), port.odr().read().bits());
            // BSRR: the lower half sets, the upper half resets.
            let set = |pins: u32, high: bool| {
                // SAFETY: the outputs of this bus.
                port.bsrr().write(|w| unsafe { w.bits(if high { pins } else { pins << 16 }) });
            };
            let byte = |sent: u8| {
                (0..8).rev().fold(0, |found: u8, bit| {
                    set(OUT, sent >> bit & 1 != 0);
                    set(CLOCK, true);
                    let read = port.idr().read().bits() & IN != 0;
                    set(CLOCK, false);
                    found << 1 | u8::from(read)
                })
            };
            set(SELECT, true);
            set(CLOCK | OUT, false);
            // SAFETY: 01b is an output and 00b an input (RM0090 section 8.4.1); the other pins stay.
            port.moder().write(|w| unsafe { w.bits(mode & !0xFF00_0000 | 0x4500_0000) });
            set(SELECT, false);
            for sent in bytes {
                byte(*sent);
            }
            for found in answer {
                *found = byte(0);
            }
            set(SELECT, true);
            // SAFETY: the original values.
            port.moder().write(|w| unsafe { w.bits(mode) });
            // SAFETY: as before.
            port.odr().write(|w| unsafe { w.bits(level) });
            // SAFETY: as before.
            rcc.ahb1enr().write(|w| unsafe { w.bits(clocks) });
        }
    }
}
