//! What is done to every board in the same way; the board file has the numbers and the pins.

use stm32f4xx_hal::pac;
use stm32f4xx_hal::prelude::*;
use stm32f4xx_hal::rcc::{Config, Rcc, RccExt};

use crate::clock::raise_voltage;
use crate::{CanController, Led, Pull, Strap, CAN_CLOCK, CLOCK_TREE, ENTRY_STRAP, LAYOUT, SYSCLK};

/// The board's parts, set up by its `init`.
pub struct Board {
    /// The CAN controller with its pins; clocked, not yet configured.
    pub can: CanController,
    /// The LED.
    pub led: Led,
    /// The UART with its pins; on, at `UART_BIT_RATE`.
    #[cfg(feature = "uart")]
    pub uart: crate::uart::Port<crate::UartController>,
}

/// The clocks as the HAL knows them, for the HAL's drivers. From the state after a reset.
#[must_use]
pub fn clocks(rcc: pac::RCC) -> Rcc {
    raise_voltage(&rcc);
    let hse = Config::hse(CLOCK_TREE.hse.Hz());
    let hse = if CLOCK_TREE.hse_bypass { hse.bypass_hse_oscillator() } else { hse };
    rcc.freeze(hse.sysclk(SYSCLK.Hz()).pclk1(CAN_CLOCK.Hz()))
}

/// Whether the entry strap ([`ENTRY_STRAP`]) asks for the bootloader; never on a board without one.
/// Leaves its port as after a reset.
#[must_use]
pub fn entry_strap() -> bool {
    let Some(Strap { port, pin, pressed, pull }) = ENTRY_STRAP else { return false };
    let is_pressed = || (0..Strap::SAMPLES).all(|_| (inputs(port) & 1 << pin != 0) == pressed);
    match pull {
        Pull::None => is_pressed(),
        Pull::Up => pulled(port, pin, 0b01, is_pressed),
        Pull::Down => pulled(port, pin, 0b10, is_pressed),
    }
}

/// Does something while a resistor of the chip is on at a pin, and has had the time to charge the
/// wire.
fn pulled<T>(port: char, pin: u8, resistor: u32, action: impl FnOnce() -> T) -> T {
    /// 40 kΩ and 1 nF are 40 µs; five times that, at 16 MHz and after a reset.
    const SETTLED: u32 = 3_200;
    let pupdr = (0x4002_000C + 0x400 * (port as u32 - 'A' as u32)) as *mut u32;
    // SAFETY: the boot stage runs alone; what is changed here is put back.
    let rcc = unsafe { pac::RCC::steal() };
    let clocks = rcc.ahb1enr();
    let before = clocks.read().bits();
    // SAFETY: the clock of the port in addition to those that are on.
    clocks.write(|w| unsafe { w.bits(before | 1 << (port as u32 - 'A' as u32)) });
    let _ = clocks.read();
    // SAFETY: the register of a port that the chip has (`Strap::is_possible`), which has its clock.
    let resistors = unsafe { pupdr.read_volatile() };
    let at = 2 * u32::from(pin);
    // SAFETY: as above; the other pins keep theirs.
    unsafe { pupdr.write_volatile(resistors & !(0b11 << at) | resistor << at) };
    cortex_m::asm::delay(SETTLED);
    let done = action();
    // SAFETY: what it was.
    unsafe { pupdr.write_volatile(resistors) };
    // SAFETY: what it was.
    clocks.write(|w| unsafe { w.bits(before) });
    done
}

/// The levels of the 16 pins of a port, `'A'` and on; of a port that the chip has not, all low. For
/// the boot stage: no pin was set up since the reset, and the port is left as it was. What has to be
/// pulled up or down is so on the board.
#[must_use]
pub fn inputs(port: char) -> u16 {
    let port = (port as u32).wrapping_sub('A' as u32);
    if port >= LAYOUT.chip.ports.into() {
        return 0;
    }
    // The ports lie behind one another (RM0090 and RM0390, register boundary addresses), and the
    // switches of their clocks in the same order (RCC_AHB1ENR).
    let idr = (0x4002_0010 + 0x400 * port) as *const u32;
    // SAFETY: the boot stage runs alone; a clock is switched, and what it was is put back.
    let rcc = unsafe { pac::RCC::steal() };
    let clocks = rcc.ahb1enr();
    let before = clocks.read().bits();
    // SAFETY: the clock of a port in addition to those that are on.
    clocks.write(|w| unsafe { w.bits(before | 1 << port) });
    // It needs two cycles before the first access: reading back waits that long.
    let _ = clocks.read();
    // SAFETY: the inputs of a port that the chip has are read, and nothing is changed.
    let inputs = unsafe { idr.read_volatile() };
    // SAFETY: what it was.
    clocks.write(|w| unsafe { w.bits(before) });
    inputs as u16
}
