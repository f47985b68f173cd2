//! The set-up that is the same for every board; the board file has the numbers and the pins.

use stm32f4xx_hal::gpio::{Output, Pin, PinState};
use stm32f4xx_hal::pac;
use stm32f4xx_hal::prelude::*;
use stm32f4xx_hal::rcc::{Config, Rcc, RccExt};

use crate::can_controllers::Take;
use crate::facts::{
    self, CanController, Facts, Pull, Strap, CAN_CLOCK, CLOCK_TREE, ENTRY_STRAP, FACTS, LAYOUT, SYSCLK,
};
use crate::pll::{raise_voltage, start_crystal};

/// The LED that blinks while the device works.
pub type Led = Pin<{ FACTS.led.0 }, { FACTS.led.1 }, Output>;

/// The board's parts, set up by [`init`].
pub struct Board {
    /// The CAN controller with its pins; its clock is on, and it is not yet configured.
    pub can: CanController,
    /// The LED.
    pub led: Led,
    /// The UART with its pins; it is on, at the board's bit rate.
    #[cfg(feature = "uart")]
    pub uart: crate::uart::Port<facts::UartController>,
}

/// Sets the board's pins up.
#[must_use]
pub fn init(rcc: &mut Rcc, can1: pac::CAN1) -> Board {
    const STANDBY: facts::Pin = match FACTS.can_standby {
        Some((pin, _)) => pin,
        None => FACTS.led,
    };
    let Facts { can_standby, .. } = FACTS;
    reset_ports(rcc);
    let led = pin::<{ FACTS.led.0 }, { FACTS.led.1 }>(&can1).into_push_pull_output();
    if let Some((_, high)) = can_standby {
        let state = if high { PinState::High } else { PinState::Low };
        let _ = pin::<{ STANDBY.0 }, { STANDBY.1 }>(&can1).into_push_pull_output_in_state(state);
    }
    #[cfg(feature = "uart")]
    let uart = {
        // SAFETY: only this function takes the UART, and it takes the only CAN1.
        let uart = unsafe { facts::UartController::steal() };
        let transmit = pin::<{ FACTS.uart_pins.transmit.0 }, { FACTS.uart_pins.transmit.1 }>(&can1);
        let receive = pin::<{ FACTS.uart_pins.receive.0 }, { FACTS.uart_pins.receive.1 }>(&can1);
        crate::uart::Port::new(uart, (transmit, receive), rcc)
    };
    let transmit = pin::<{ FACTS.can_pins.transmit.0 }, { FACTS.can_pins.transmit.1 }>(&can1);
    let receive = pin::<{ FACTS.can_pins.receive.0 }, { FACTS.can_pins.receive.1 }>(&can1);
    let can = CanController::new(Take::take(can1, rcc), (transmit, receive), rcc);
    Board {
        can,
        led,
        #[cfg(feature = "uart")]
        uart,
    }
}

/// A pin of the board in its state after a reset. Only `init` knows which pins it needs, so no caller
/// passes them; the CAN controller, which exists once, proves that it runs once.
fn pin<const PORT: char, const NUMBER: u8>(_: &pac::CAN1) -> Pin<PORT, NUMBER> {
    const { assert!(size_of::<Pin<PORT, NUMBER>>() == 0, "a pin of the HAL has data") };
    // SAFETY: a pin of the HAL is a type without data. Only `init` makes pins, each once.
    unsafe { core::mem::MaybeUninit::uninit().assume_init() }
}

/// Enables and resets the ports of the board's pins; only enables them on a board that sets pins up itself.
fn reset_ports(rcc: &mut Rcc) {
    const fn bit(pin: facts::Pin) -> u32 {
        1 << (pin.0 as u32 - 'A' as u32)
    }
    const fn bits(pins: facts::Pins) -> u32 {
        bit(pins.transmit) | bit(pins.receive)
    }
    const PORTS: u32 = bit(FACTS.led)
        | bits(FACTS.can_pins)
        | if cfg!(feature = "uart") { bits(FACTS.uart_pins) } else { 0 }
        | match FACTS.can_standby {
            Some((pin, _)) => bit(pin),
            None => 0,
        };
    // SAFETY: the bits are those of ports (RCC_AHB1ENR and RCC_AHB1RSTR have the same order); the
    // other bits stay. Only `init` uses the ports.
    rcc.ahb1enr().modify(|r, w| unsafe { w.bits(r.bits() | PORTS) });
    if FACTS.functions.init.is_some() {
        // What it has set up stays, without an interruption.
        return;
    }
    // SAFETY: as above.
    rcc.ahb1rstr().modify(|r, w| unsafe { w.bits(r.bits() | PORTS) });
    // SAFETY: as above.
    rcc.ahb1rstr().modify(|r, w| unsafe { w.bits(r.bits() & !PORTS) });
}

/// The clocks in the HAL's types, for the HAL's drivers. The clocks must be in their reset state. `None` if the
/// crystal does not start, for which the HAL would wait without a bound.
#[must_use]
pub fn clocks(rcc: pac::RCC) -> Option<Rcc> {
    if !start_crystal(&rcc) {
        return None;
    }
    raise_voltage(&rcc);
    let hse = Config::hse(CLOCK_TREE.hse.Hz());
    let hse = if CLOCK_TREE.hse_bypass { hse.bypass_hse_oscillator() } else { hse };
    Some(rcc.freeze(hse.sysclk(SYSCLK.Hz()).pclk1(CAN_CLOCK.Hz())))
}

/// Whether the entry strap ([`ENTRY_STRAP`]) asks for the bootloader; always false on a board
/// without a strap. `core` is the clock of the core in Hz, at most. Leaves its port as it was.
#[must_use]
pub fn entry_strap(core: u32) -> bool {
    let Some(Strap { port, pin, pressed, pull }) = ENTRY_STRAP else { return false };
    let is_pressed = || (0..Strap::SAMPLES).all(|_| (inputs(port) & 1 << pin != 0) == pressed);
    match pull {
        Pull::None => is_pressed(),
        Pull::Up => pulled(port, pin, 0b01, core, is_pressed),
        Pull::Down => pulled(port, pin, 0b10, core, is_pressed),
    }
}

/// Runs a function while a resistor of the chip is on at a pin, after the time to charge the wire.
fn pulled<T>(port: char, pin: u8, resistor: u32, core: u32, action: impl FnOnce() -> T) -> T {
    /// 40 kΩ and 1 nF are 40 µs; this is five times that: its part of a second.
    const SETTLED: u32 = 5_000;
    let pupdr = (0x4002_000C + 0x400 * (port as u32 - 'A' as u32)) as *mut u32;
    // SAFETY: nothing that interrupts this uses the register; all that changes here is restored.
    let rcc = unsafe { pac::RCC::steal() };
    let clocks = rcc.ahb1enr();
    let before = clocks.read().bits();
    // SAFETY: it enables the clock of the port and leaves the others on.
    clocks.write(|w| unsafe { w.bits(before | 1 << (port as u32 - 'A' as u32)) });
    let _ = clocks.read();
    // SAFETY: the register belongs to a port of the chip (`Wiring::check`), and the port has
    // its clock.
    let resistors = unsafe { pupdr.read_volatile() };
    let at = 2 * u32::from(pin);
    // SAFETY: as above; the other pins keep their resistors.
    unsafe { pupdr.write_volatile(resistors & !(0b11 << at) | resistor << at) };
    cortex_m::asm::delay(core / SETTLED);
    let done = action();
    // SAFETY: the original value.
    unsafe { pupdr.write_volatile(resistors) };
    // SAFETY: the original value.
    clocks.write(|w| unsafe { w.bits(before) });
    done
}

/// Makes a pin an output with this level, for a board's [`Functions`](crate::Functions): a push-pull one without a
/// resistor, by its registers, since functions have no place for the HAL's pin. Its port keeps its clock.
pub fn drive(pin: facts::Pin, high: bool) {
    // SAFETY: nothing that interrupts this uses the register; the other bits stay.
    let clocks = unsafe { pac::RCC::steal() };
    // SAFETY: it enables the clock of a port.
    clocks.ahb1enr().modify(|r, w| unsafe { w.bits(r.bits() | 1 << (pin.0 as u32 - 'A' as u32)) });
    // The port needs two cycles before the first access: reading back takes that long.
    let _ = clocks.ahb1enr().read();
    set(pin, high);
    let moder = port(pin) as *mut u32;
    let at = 2 * u32::from(pin.1);
    // SAFETY: the registers of a port with a clock; the other pins stay. The level is set before the pin
    // becomes an output.
    unsafe { moder.write_volatile(moder.read_volatile() & !(0b11 << at) | 0b01 << at) };
}

/// Gives an output ([`drive`]) its other level. It may be interrupted by other uses of the port.
pub fn toggle(pin: facts::Pin) {
    // SAFETY: it reads a register of a port, which has no effect.
    let odr = unsafe { ((port(pin) + 0x14) as *const u32).read_volatile() };
    set(pin, odr & 1 << pin.1 == 0);
}

/// The registers of a pin's port.
const fn port(pin: facts::Pin) -> u32 {
    0x4002_0000 + 0x400 * (pin.0 as u32 - 'A' as u32)
}

fn set(pin: facts::Pin, high: bool) {
    let bsrr = (port(pin) + 0x18) as *mut u32;
    // SAFETY: it sets or clears the level of one pin, and has no effect on the others (RM0090 section 8.4.7).
    unsafe { bsrr.write_volatile(1 << (u32::from(pin.1) + if high { 0 } else { 16 })) };
}

/// The levels of the 16 pins of a port, `'A'` and on; all low for a port that the chip does not
/// have. No pin is set up for it, and the port keeps its state.
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
    // SAFETY: nothing that interrupts this uses the register; the changed clock is restored.
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
