//! The independent watchdog (RM0090 section 21). Once started, only a reset stops it.

use stm32f4xx_hal::pac;

/// How often the status is read before an update is given up: 0.1 s at 168 MHz and 8 cycles a read, 1 s from HSI.
const PATIENCE: u32 = 1 << 21;

/// Starts the watchdog: a reset follows unless it is [fed](feed) every `ms` milliseconds, 2 to
/// 8000. The LSI counts them (17 to 47 kHz for 32).
pub fn start(registers: &pac::IWDG, ms: u16) {
    // LSI / 64, 2 ms a count (section 21.4.2).
    run(registers, 4, ms / 2);
}

/// The prescaler after a reset: LSI / 4.
pub const AFTER_RESET: u16 = 0;
/// The largest prescaler: LSI / 256. With the reload value after a reset it gives 33 s, 22 to 62 by the
/// LSI.
pub const SLOWEST: u16 = 6;

/// Gives a watchdog that runs another prescaler and the reload value after a reset, and restarts its time.
pub fn rescale(registers: &pac::IWDG, prescaler: u16) {
    run(registers, prescaler, 0xFFF);
}

/// Lets the watchdog run with these values. It waits for the LSI, which has 17 to 47 kHz.
///
/// A watchdog starts with 4096 counts, and only AAAAh loads the reload value. Both values take up to five
/// cycles of the LSI to get to the counter, and meanwhile no others may be written (section 21.4.4). ST's HAL waits
/// for five cycles behind the prescaler: then it is up to 75 ms at LSI / 256, and 1.2 ms at LSI / 4.
fn run(registers: &pac::IWDG, prescaler: u16, reload: u16) {
    // SAFETY: the keys that start the counter and permit the two writes (section 21.4.1).
    let key = |key: u16| registers.kr().write(|w| unsafe { w.bits(key) });
    key(0xCCCC);
    key(0x5555);
    // SAFETY: a value of three bits (section 21.4.2).
    registers.pr().write(|w| unsafe { w.bits(prescaler) });
    // SAFETY: a value of 12 bits (section 21.4.3).
    registers.rlr().write(|w| unsafe { w.bits(reload) });
    // If they never get there, the counter is loaded with what it has.
    (0..PATIENCE).any(|_| registers.sr().read().bits() == 0);
    feed(registers);
}

/// Restarts the watchdog's time.
pub fn feed(registers: &pac::IWDG) {
    // SAFETY: the key that reloads the counter (section 21.4.1).
    registers.kr().write(|w| unsafe { w.bits(0xAAAA) });
}
