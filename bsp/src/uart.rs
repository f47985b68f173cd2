//! What every board does with its UART, if its firmware uses it (feature `uart`): eight bits, no
//! parity, one stop bit (RM0090 section 30).

/// What goes into `USART_BRR` to make `bit_rate` (bit/s) out of `clock` (Hz), 16 samples a bit
/// (section 30.3.4); `None` where that is more than 2 % off, half of what the two ends may differ
/// by.
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
    use core::cell::Cell;

    use cortex_m::interrupt::{self, Mutex};
    use cortex_m::peripheral::NVIC;
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

        /// Whether all that was sent is on the line.
        #[must_use]
        pub fn is_silent(&self) -> bool {
            self.usart.sr().read().tc().bit_is_set()
        }

        /// Sends a byte. To be called only when there is room; the byte before would be lost.
        pub fn send(&mut self, byte: u8) {
            self.usart.dr().write(|w| w.dr().set(byte.into()));
        }

        /// What has come: nothing, a byte, or one that cannot be read.
        pub fn receive(&mut self) -> Option<Received> {
            let status = self.usart.sr().read();
            if status.rxne().bit_is_clear() && status.ore().bit_is_clear() {
                return None;
            }
            // Behind the status, this clears the flags of errors, too (section 30.6.1).
            let byte = self.usart.dr().read().dr().bits() as u8;
            let readable =
                status.rxne().bit_is_set() && status.fe().bit_is_clear() && status.nf().bit_is_clear();
            Some(Received { byte: readable.then_some(byte), overrun: status.ore().bit_is_set() })
        }

        /// Has the interrupt come when there is room.
        pub fn call_for_more(&mut self) {
            // It switches that off by itself, and may come in between.
            interrupt::free(|_| self.usart.cr1().modify(|_, w| w.txeie().enabled()));
        }

        /// Has it come no more for that. From the interrupt itself.
        pub fn stop_calling(&mut self) {
            self.usart.cr1().modify(|_, w| w.txeie().disabled());
        }

        /// Has the interrupt come when a byte has come.
        pub fn call_for_bytes(&mut self) {
            interrupt::free(|_| self.usart.cr1().modify(|_, w| w.rxneie().enabled()));
        }
    }

    /// Something that has come.
    #[derive(Clone, Copy, Debug, PartialEq, Eq)]
    pub struct Received {
        /// The byte; `None` for one that cannot be read.
        pub byte: Option<u8>,
        /// Behind it, others were lost.
        pub overrun: bool,
    }

    type Handler = Option<fn()>;
    /// Who does what there is to do.
    static HANDLER: Mutex<Cell<Handler>> = Mutex::new(Cell::new(None));

    /// Lets the interrupt of the board's UART come, before all others, and has a function do what
    /// there is to do.
    pub fn on_interrupt(handler: fn()) {
        interrupt::free(|cs| HANDLER.borrow(cs).set(Some(handler)));
        // SAFETY: nothing is masked in order to be alone with what the handler works with.
        unsafe { NVIC::unmask(<crate::UartController as Controller>::INTERRUPT) };
    }

    /// What the UART's vector points to.
    pub fn interrupted() {
        if let Some(handler) = interrupt::free(|cs| HANDLER.borrow(cs).get()) {
            handler();
        }
    }
}
