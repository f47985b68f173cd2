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

/// Gives a watchdog that runs its longest time from now on: 33 s, 22 to 62 by the LSI.
pub fn prolong(registers: &pac::IWDG) {
    // SAFETY: the key of section 21.4.1.
    registers.kr().write(|w| unsafe { w.bits(0x5555) });
    // SAFETY: LSI / 256.
    registers.pr().write(|w| unsafe { w.bits(6) });
    // SAFETY: the largest reload value.
    registers.rlr().write(|w| unsafe { w.bits(0xFFF) });
    // Both arrive within five cycles of the LSI (section 21.4.4), 0.3 ms at 17 kHz, after its start. The
    // bound is a few times that at 168 MHz.
    for _ in 0..50_000 {
        if registers.sr().read().bits() == 0 {
            break;
        }
    }
    feed(registers);
}

/// Restarts the watchdog's time.
pub fn feed(registers: &pac::IWDG) {
    // SAFETY: the key that reloads the counter (section 21.4.1).
    registers.kr().write(|w| unsafe { w.bits(0xAAAA) });
}
