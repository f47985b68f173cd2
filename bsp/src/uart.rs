//! What every board does with its UART, if its firmware uses it (feature `uart`): eight bits, no parity, one stop bit (RM0090
//! section 30).

/// What goes into `USART_BRR` to make `bit_rate` (bit/s) out of `clock` (Hz), 16 samples a bit (section 30.3.4); `None` where that
/// is more than 2 % off, half of what the two ends may differ by.
#[must_use]
pub const fn divider(clock: u32, bit_rate: u32) -> Option<u16> {
    if bit_rate == 0 {
        return None;
    }
    let divider = (clock + bit_rate / 2) / bit_rate;
    let off = (divider * bit_rate).abs_diff(clock);
    if divider < 16 || divider > 0xFFFF || off > clock / 50 {
        return None;
    }
    Some(divider as u16)
}

#[cfg(all(target_arch = "arm", feature = "uart"))]
pub use drivers::*;

#[cfg(all(target_arch = "arm", feature = "uart"))]
mod drivers {
    use stm32f4xx_hal::gpio::PushPull;
    use stm32f4xx_hal::pac::{self, usart1};
    use stm32f4xx_hal::rcc::Rcc;
    use stm32f4xx_hal::serial::Instance;

    use crate::clock::ClockTree;
    use crate::{CLOCK_TREE, UART_BIT_RATE};

    /// A USART that a board may choose.
    pub trait Controller: Instance<RB = usart1::RegisterBlock> {
        /// Its interrupt.
        const INTERRUPT: pac::Interrupt;
        /// Whether APB2 clocks it, and not APB1 (RM0090 section 2.3, table 1).
        const APB2: bool;
    }

    impl Controller for pac::USART1 {
        const INTERRUPT: pac::Interrupt = pac::Interrupt::USART1;
        const APB2: bool = true;
    }
    impl Controller for pac::USART2 {
        const INTERRUPT: pac::Interrupt = pac::Interrupt::USART2;
        const APB2: bool = false;
    }
    impl Controller for pac::USART3 {
        const INTERRUPT: pac::Interrupt = pac::Interrupt::USART3;
        const APB2: bool = false;
    }
    impl Controller for pac::USART6 {
        const INTERRUPT: pac::Interrupt = pac::Interrupt::USART6;
        const APB2: bool = true;
    }

    /// Clock of a USART in Hz, on a board with these clocks.
    #[must_use]
    pub const fn clock<U: Controller>(tree: &ClockTree) -> u32 {
        tree.sysclk() / if U::APB2 { tree.apb2 } else { tree.apb1 }
    }

    /// What goes into the divider of the board's UART.
    const DIVIDER: u16 = match super::divider(clock::<crate::UartController>(&CLOCK_TREE), UART_BIT_RATE) {
        Some(divider) => divider,
        None => panic!("board: the clock of the UART cannot make UART_BIT_RATE"),
    };

    /// A USART with its pins.
    pub struct Port<U: Controller> {
        usart: U,
    }

    impl<U: Controller> Port<U> {
        /// Sets it up for `UART_BIT_RATE` and switches it on. Interrupts are off.
        pub fn new(
            usart: U,
            (tx, rx): (impl Into<U::Tx<PushPull>>, impl Into<U::Rx<PushPull>>),
            rcc: &mut Rcc,
        ) -> Self {
            U::enable(rcc);
            // The pins keep what they were made; they need not be kept.
            let _: (U::Tx<PushPull>, U::Rx<PushPull>) = (tx.into(), rx.into());
            // SAFETY: any divider may be written; 16 at least, it makes a bit rate.
            usart.brr().write(|w| unsafe { w.bits(DIVIDER) });
            usart.cr1().write(|w| w.ue().enabled().te().enabled().re().enabled());
            Self { usart }
        }

        /// The port again, where `new` has set it up.
        ///
        /// # Safety
        /// Nobody else uses it until this is dropped.
        #[must_use]
        pub unsafe fn steal() -> Self {
            // SAFETY: the caller vouches for it.
            Self { usart: unsafe { U::steal() } }
        }

        /// Whether a byte can be sent.
        #[must_use]
        pub fn has_room(&self) -> bool {
            self.usart.sr().read().txe().bit_is_set()
        }

        /// Sends a byte. To be called only when there is room; the byte before would be lost.
        pub fn send(&mut self, byte: u8) {
            self.usart.dr().write(|w| w.dr().set(byte.into()));
        }

        /// Has the interrupt come when there is room, or not.
        pub fn call_for_more(&mut self, wanted: bool) {
            self.usart.cr1().modify(|_, w| w.txeie().bit(wanted));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::divider;

    /// RM0090 table 142 (42 MHz, 16 samples a bit): USARTDIV 22.8125 for 115.2 kbit/s, 273.4375 for 9.6, 2.875 for 921.6 (0.93 % off).
    #[test]
    fn dividers_of_the_manual() {
        assert_eq!(divider(42_000_000, 115_200), Some(365));
        assert_eq!(divider(42_000_000, 9_600), Some(4375));
        assert_eq!(divider(42_000_000, 921_600), Some(46));
        assert_eq!(divider(16_000_000, 1_000_000), Some(16));
        // 15 cycles a bit are too few, 2.8 % are too far off, 65 536 do not fit.
        for (clock, rate) in
            [(15_000_000, 1_000_000), (1_750_000, 100_000), (42_000_000, 600), (42_000_000, 0)]
        {
            assert_eq!(divider(clock, rate), None, "{clock} {rate}");
        }
    }
}
