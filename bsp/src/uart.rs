//! The UART driver for all boards, if the firmware uses it (feature `uart`): eight bits, no parity,
//! one stop bit (RM0090 section 30).

/// The value of `USART_BRR` for `bit_rate` (bit/s) from `clock` (Hz) with 16 samples a bit (section
/// 30.3.4). `None` if the error is more than 2 %: that is half of the difference that the two ends
/// may have.
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

/// Selects the board's USART; its interrupt has the same name.
macro_rules! uart {
    ($usart:ident) => {
        /// The name of the UART.
        pub const UART: &str = stringify!($usart);

        /// The UART. It is set up with the feature `uart` alone.
        #[cfg(target_arch = "arm")]
        pub type UartController = stm32f4xx_hal::pac::$usart;

        #[cfg(all(target_arch = "arm", feature = "uart"))]
        #[no_mangle]
        #[allow(non_snake_case)]
        extern "C" fn $usart() {
            crate::uart::interrupted();
        }
    };
}

#[cfg(all(target_arch = "arm", feature = "uart"))]
pub use drivers::*;

#[cfg(all(target_arch = "arm", feature = "uart"))]
mod drivers {
    use core::cell::Cell;

    use cortex_m::interrupt::{self, Mutex};
    use cortex_m::peripheral::NVIC;
    use stm32f4xx_hal::gpio::PushPull;
    use stm32f4xx_hal::pac::{self, usart1};
    use stm32f4xx_hal::rcc::Rcc;
    use stm32f4xx_hal::serial::Instance;

    use crate::clock::ClockTree;
    use crate::facts::{UartController, CLOCK_TREE, FACTS};

    /// A USART that a board may choose.
    pub trait Controller: Instance<RB = usart1::RegisterBlock> {
        /// Its interrupt.
        const INTERRUPT: pac::Interrupt;
        /// Whether its clock is APB2 instead of APB1 (RM0090 section 2.3, table 1).
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

    /// The divider of the board's UART.
    const DIVIDER: u16 = match crate::uart::divider(clock::<UartController>(&CLOCK_TREE), FACTS.uart_bit_rate)
    {
        Some(divider) => divider,
        None => panic!("board: the clock of the UART cannot make uart_bit_rate"),
    };

    /// A USART with its pins.
    pub struct Port<U: Controller> {
        usart: U,
    }

    impl<U: Controller> Port<U> {
        /// Sets the UART up for the board's bit rate and switches it on. Its interrupts are off.
        pub fn new(
            usart: U,
            (tx, rx): (impl Into<U::Tx<PushPull>>, impl Into<U::Rx<PushPull>>),
            rcc: &mut Rcc,
        ) -> Self {
            U::enable(rcc);
            // The pins keep their function, so the values are not needed any more.
            let _: (U::Tx<PushPull>, U::Rx<PushPull>) = (tx.into(), rx.into());
            // SAFETY: any divider may be written; it is at least 16, which makes a bit rate.
            usart.brr().write(|w| unsafe { w.bits(DIVIDER) });
            usart.cr1().write(|w| w.ue().enabled().te().enabled().re().enabled());
            Self { usart }
        }

        /// The port again, after `new` has set it up.
        ///
        /// # Safety
        /// Nothing else uses it until this value is dropped.
        #[must_use]
        pub unsafe fn steal() -> Self {
            // SAFETY: the caller guarantees it.
            Self { usart: unsafe { U::steal() } }
        }

        /// Whether a byte can be sent.
        #[must_use]
        pub fn has_room(&self) -> bool {
            self.usart.sr().read().txe().bit_is_set()
        }

        /// Whether all bytes have been sent on the line.
        #[must_use]
        pub fn is_silent(&self) -> bool {
            self.usart.sr().read().tc().bit_is_set()
        }

        /// Sends a byte. Call it only when there is room; otherwise the previous byte would be
        /// lost.
        pub fn send(&mut self, byte: u8) {
            self.usart.dr().write(|w| w.dr().set(byte.into()));
        }

        /// Takes what was received: nothing, a byte, or an unreadable byte.
        pub fn receive(&mut self) -> Option<Received> {
            let status = self.usart.sr().read();
            if status.rxne().bit_is_clear() && status.ore().bit_is_clear() {
                return None;
            }
            // After a read of the status, this also clears the error flags (section 30.6.1).
            let byte = self.usart.dr().read().dr().bits() as u8;
            let readable =
                status.rxne().bit_is_set() && status.fe().bit_is_clear() && status.nf().bit_is_clear();
            Some(Received { byte: readable.then_some(byte), overrun: status.ore().bit_is_set() })
        }

        /// Enables the interrupt for a free transmit register.
        pub fn call_for_more(&mut self) {
            // The interrupt disables itself, and may come in between.
            interrupt::free(|_| self.usart.cr1().modify(|_, w| w.txeie().enabled()));
        }

        /// Disables that interrupt. To be called from the interrupt itself.
        pub fn stop_calling(&mut self) {
            self.usart.cr1().modify(|_, w| w.txeie().disabled());
        }

        /// Enables the interrupt for a received byte.
        pub fn call_for_bytes(&mut self) {
            interrupt::free(|_| self.usart.cr1().modify(|_, w| w.rxneie().enabled()));
        }
    }

    /// A received byte.
    #[derive(Clone, Copy, Debug, PartialEq, Eq)]
    pub struct Received {
        /// The byte; `None` if it is unreadable.
        pub byte: Option<u8>,
        /// Other bytes were lost after this one.
        pub overrun: bool,
    }

    type Handler = Option<fn()>;
    /// The function that serves the interrupt.
    static HANDLER: Mutex<Cell<Handler>> = Mutex::new(Cell::new(None));

    /// Enables the interrupt of the board's UART, with the highest priority, and sets the function
    /// that serves it.
    pub fn on_interrupt(handler: fn()) {
        interrupt::free(|cs| HANDLER.borrow(cs).set(Some(handler)));
        // SAFETY: no code masks this interrupt to protect data that the handler uses.
        unsafe { NVIC::unmask(<UartController as Controller>::INTERRUPT) };
    }

    /// The handler in the UART's vector.
    pub fn interrupted() {
        if let Some(handler) = interrupt::free(|cs| HANDLER.borrow(cs).get()) {
            handler();
        }
    }
}
