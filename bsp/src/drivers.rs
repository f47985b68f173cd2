//! The set-up that is the same for every board; the board file has the numbers and the pins.

use stm32f4xx_hal::pac;
use stm32f4xx_hal::prelude::*;
use stm32f4xx_hal::rcc::{Config, Rcc, RccExt};

use crate::clock::raise_voltage;
use crate::{CanController, Led, Pull, Strap, CAN_CLOCK, CLOCK_TREE, ENTRY_STRAP, LAYOUT, SYSCLK};

/// The board's parts, set up by its `init`.
pub struct Board {
    /// The CAN controller with its pins; its clock is on, and it is not yet configured.
    pub can: CanController,
    /// The LED.
    pub led: Led,
    /// The UART with its pins; it is on, at `UART_BIT_RATE`.
    #[cfg(feature = "uart")]
    pub uart: crate::uart::Port<crate::UartController>,
}

/// The clocks in the HAL's types, for the HAL's drivers. The clocks must be in their reset state.
#[must_use]
pub fn clocks(rcc: pac::RCC) -> Rcc {
    raise_voltage(&rcc);
    let hse = Config::hse(CLOCK_TREE.hse.Hz());
    let hse = if CLOCK_TREE.hse_bypass { hse.bypass_hse_oscillator() } else { hse };
    rcc.freeze(hse.sysclk(SYSCLK.Hz()).pclk1(CAN_CLOCK.Hz()))
}

/// Whether the entry strap ([`ENTRY_STRAP`]) asks for the bootloader; always false on a board
/// without a strap. Leaves its port in the reset state.
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

/// Runs a function while a resistor of the chip is on at a pin, after the time to charge the wire.
fn pulled<T>(port: char, pin: u8, resistor: u32, action: impl FnOnce() -> T) -> T {
    /// 40 kΩ and 1 nF are 40 µs; this is five times that, in cycles of the 16 MHz after a reset.
    const SETTLED: u32 = 3_200;
    let pupdr = (0x4002_000C + 0x400 * (port as u32 - 'A' as u32)) as *mut u32;
    // SAFETY: only the boot stage runs; all that changes here is restored.
    let rcc = unsafe { pac::RCC::steal() };
    let clocks = rcc.ahb1enr();
    let before = clocks.read().bits();
    // SAFETY: it enables the clock of the port and leaves the others on.
    clocks.write(|w| unsafe { w.bits(before | 1 << (port as u32 - 'A' as u32)) });
    let _ = clocks.read();
    // SAFETY: the register belongs to a port of the chip (`Strap::is_possible`), and the port has
    // its clock.
    let resistors = unsafe { pupdr.read_volatile() };
    let at = 2 * u32::from(pin);
    // SAFETY: as above; the other pins keep their resistors.
    unsafe { pupdr.write_volatile(resistors & !(0b11 << at) | resistor << at) };
    cortex_m::asm::delay(SETTLED);
    let done = action();
    // SAFETY: the original value.
    unsafe { pupdr.write_volatile(resistors) };
    // SAFETY: the original value.
    clocks.write(|w| unsafe { w.bits(before) });
    done
}

/// The levels of the 16 pins of a port, `'A'` and on; all low for a port that the chip does not
/// have. It is for the boot stage: no pin was set up since the reset, and the port keeps its state.
/// The board must have the pull-up and pull-down resistors that the pins need.
#[must_use]
pub fn inputs(port: char) -> u16 {
    let port = (port as u32).wrapping_sub('A' as u32);
    if port >= LAYOUT.chip.ports.into() {
        return 0;
    }
    // The addresses of the ports follow one another (RM0090 and RM0390, register boundary
    // addresses), and their clock bits are in the same order (RCC_AHB1ENR).
    let idr = (0x4002_0010 + 0x400 * port) as *const u32;
    // SAFETY: only the boot stage runs; the changed clock is restored.
    let rcc = unsafe { pac::RCC::steal() };
    let clocks = rcc.ahb1enr();
    let before = clocks.read().bits();
    // SAFETY: it enables the clock of a port and leaves the others on.
    clocks.write(|w| unsafe { w.bits(before | 1 << port) });
    // The port needs two cycles before the first access: reading back takes that long.
    let _ = clocks.read();
    // SAFETY: it reads the inputs of a port of the chip, and changes nothing.
    let inputs = unsafe { idr.read_volatile() };
    // SAFETY: the original value.
    clocks.write(|w| unsafe { w.bits(before) });
    inputs as u16
}
