//! The independent watchdog (RM0090 section 21). Once started, only a reset stops it.

use stm32f4xx_hal::pac;

/// Starts the watchdog: a reset follows unless it is [fed](feed) every `ms` milliseconds, 2 to
/// 8000. The LSI counts them (± 50 %).
pub fn start(registers: &pac::IWDG, ms: u16) {
    // SAFETY: the keys of section 21.4.1.
    let key = |key: u16| registers.kr().write(|w| unsafe { w.bits(key) });
    key(0xCCCC);
    key(0x5555);
    // SAFETY: LSI / 64, 2 ms a count (section 21.4.2).
    registers.pr().write(|w| unsafe { w.bits(4) });
    // SAFETY: a reload value of 12 bits.
    registers.rlr().write(|w| unsafe { w.bits(ms / 2) });
}

/// The prescaler after a reset: LSI / 4.
pub const AFTER_RESET: u16 = 0;
/// The largest prescaler: LSI / 256. With the reload value after a reset it gives 33 s, 22 to 62 by the
/// LSI.
pub const SLOWEST: u16 = 6;

/// Gives a watchdog that runs another prescaler, and restarts its time. It takes effect within five
/// cycles of the LSI (section 21.4.4).
pub fn rescale(registers: &pac::IWDG, prescaler: u16) {
    // SAFETY: the key of section 21.4.1.
    registers.kr().write(|w| unsafe { w.bits(0x5555) });
    // SAFETY: a value of three bits (section 21.4.2).
    registers.pr().write(|w| unsafe { w.bits(prescaler) });
    feed(registers);
}

/// Restarts the watchdog's time.
pub fn feed(registers: &pac::IWDG) {
    // SAFETY: the key that reloads the counter (section 21.4.1).
    registers.kr().write(|w| unsafe { w.bits(0xAAAA) });
}
