//! The pins of a board, and the rules that they follow on its chip.

use crate::geometry::{is_debug_pin, CanLine, Geometry, Pin};

/// The pins of a controller with two lines.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Pins {
    /// The line that the chip drives.
    pub transmit: Pin,
    /// The line that the chip reads.
    pub receive: Pin,
}

/// The pins that a board gives to coboot.
#[derive(Clone, Copy, Debug)]
pub struct Wiring {
    /// The CAN controller with the transceiver, 1 or 2.
    pub can_controller: u8,
    /// Its pins.
    pub can: Pins,
    /// The LED.
    pub led: Pin,
    /// The pin that asks for the bootloader after a reset.
    pub strap: Option<Pin>,
    /// The pin that takes the CAN transceiver out of standby.
    pub standby: Option<Pin>,
    /// The UART.
    pub uart: Pins,
    /// Whether OSC_IN has a clock instead of a crystal: OSC_OUT is free then.
    pub hse_bypass: bool,
}

/// A pin that a board chooses exists, and is none of the debugger, of the crystal and of the CAN controller. (A
/// macro: a constant cannot put the name into its message.)
macro_rules! check_free {
    ($wiring:expr, $chip:expr, $pin:expr, $name:literal) => {
        if !$chip.has_pin($pin) {
            return Err(concat!("board: the chip has no such pin as ", $name, " names"));
        }
        if is_debug_pin($pin) {
            return Err(concat!("board: ", $name, " is a pin of the debugger (PA13 to PA15, PB3, PB4)"));
        }
        if $wiring.is_oscillator($pin) {
            return Err(concat!("board: ", $name, " is a pin of the crystal (PH0, PH1)"));
        }
        if is_one_of($pin, &$wiring.can) {
            return Err(concat!("board: ", $name, " is a pin of the CAN controller"));
        }
    };
}

impl Wiring {
    /// Returns the wiring if the chip has these pins for these uses.
    ///
    /// # Panics
    /// At compile time, with the message of the broken rule.
    #[must_use]
    pub const fn checked(self, chip: &Geometry) -> Self {
        match self.check(chip) {
            Ok(()) => self,
            Err(rule) => panic!("{}", rule),
        }
    }

    /// Whether the chip has these pins for these uses.
    ///
    /// # Errors
    /// The broken rule, in words.
    pub const fn check(&self, chip: &Geometry) -> Result<(), &'static str> {
        if !chip.has_pin(self.can.transmit) || !chip.has_pin(self.can.receive) {
            return Err("board: the chip has no such pins as can_pins names");
        }
        match chip.can_line(self.can.transmit) {
            Some((number, CanLine::Transmit)) if number == self.can_controller => {}
            _ => return Err("board: `transmit` of can_pins is no transmit pin of this CAN controller"),
        }
        match chip.can_line(self.can.receive) {
            Some((number, CanLine::Receive)) if number == self.can_controller => {}
            _ => return Err("board: `receive` of can_pins is no receive pin of this CAN controller"),
        }
        if !chip.has_pin(self.uart.transmit) || !chip.has_pin(self.uart.receive) {
            return Err("board: the chip has no such pins as the UART has");
        }
        if is_one_of(self.uart.transmit, &self.can) || is_one_of(self.uart.receive, &self.can) {
            return Err("board: the UART has a pin of the CAN controller");
        }
        check_free!(self, chip, self.led, "led");
        if is_one_of(self.led, &self.uart) {
            return Err("board: led is a pin of the UART");
        }
        if let Some(strap) = self.strap {
            // It is read before the UART is on, and may be one of its pins.
            check_free!(self, chip, strap, "entry_strap");
            if is_same(strap, self.led) {
                return Err("board: entry_strap is the pin of the LED");
            }
        }
        if let Some(standby) = self.standby {
            check_free!(self, chip, standby, "can_standby");
            if is_same(standby, self.led) {
                return Err("board: can_standby is the pin of the LED");
            }
            if let Some(strap) = self.strap {
                if is_same(standby, strap) {
                    return Err("board: can_standby is the pin of entry_strap");
                }
            }
            if is_one_of(standby, &self.uart) {
                return Err("board: can_standby is a pin of the UART");
            }
        }
        Ok(())
    }

    /// Whether OSC_IN or OSC_OUT has this pin (RM0090 section 8.3.14).
    const fn is_oscillator(&self, pin: Pin) -> bool {
        matches!(pin, ('H', 0)) || matches!(pin, ('H', 1)) && !self.hse_bypass
    }
}

const fn is_same(a: Pin, b: Pin) -> bool {
    a.0 == b.0 && a.1 == b.1
}

const fn is_one_of(pin: Pin, pins: &Pins) -> bool {
    is_same(pin, pins.transmit) || is_same(pin, pins.receive)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{STM32F405RG, STM32F407VG};

    const GOOD: Wiring = Wiring {
        can_controller: 1,
        can: Pins { transmit: ('D', 1), receive: ('D', 0) },
        led: ('D', 12),
        strap: Some(('A', 0)),
        standby: Some(('C', 6)),
        uart: Pins { transmit: ('A', 2), receive: ('A', 3) },
        hse_bypass: false,
    };

    #[test]
    fn each_wrong_pin_is_named() {
        let free = Wiring { hse_bypass: true, led: ('H', 1), ..GOOD };
        // A strap on the UART is read before the UART is on.
        for right in [GOOD, free, Wiring { strap: Some(('A', 3)), ..GOOD }] {
            assert_eq!(right.check(&STM32F407VG), Ok(()), "{right:?}");
        }
        for (wrong, says) in [
            (Wiring { led: ('F', 0), ..GOOD }, "no such pin as led"),
            (Wiring { led: ('B', 3), ..GOOD }, "led is a pin of the debugger"),
            (Wiring { led: ('H', 1), ..GOOD }, "led is a pin of the crystal"),
            (Wiring { led: ('D', 0), ..GOOD }, "led is a pin of the CAN controller"),
            (Wiring { led: ('A', 2), ..GOOD }, "led is a pin of the UART"),
            (Wiring { strap: Some(('D', 16)), ..GOOD }, "no such pin as entry_strap"),
            (Wiring { strap: Some(('A', 13)), ..GOOD }, "entry_strap is a pin of the debugger"),
            (Wiring { strap: Some(('H', 0)), ..GOOD }, "entry_strap is a pin of the crystal"),
            (Wiring { strap: Some(('D', 1)), ..GOOD }, "entry_strap is a pin of the CAN controller"),
            (Wiring { strap: Some(('D', 12)), ..GOOD }, "entry_strap is the pin of the LED"),
            (Wiring { standby: Some(('I', 0)), ..GOOD }, "no such pin as can_standby"),
            (Wiring { standby: Some(('A', 15)), ..GOOD }, "can_standby is a pin of the debugger"),
            (Wiring { standby: Some(('H', 1)), ..GOOD }, "can_standby is a pin of the crystal"),
            (Wiring { standby: Some(('D', 1)), ..GOOD }, "can_standby is a pin of the CAN controller"),
            (Wiring { standby: Some(('D', 12)), ..GOOD }, "can_standby is the pin of the LED"),
            (Wiring { standby: Some(('A', 3)), ..GOOD }, "can_standby is a pin of the UART"),
            (Wiring { standby: Some(('A', 0)), ..GOOD }, "can_standby is the pin of entry_strap"),
            (
                Wiring { uart: Pins { transmit: ('F', 6), receive: ('A', 3) }, ..GOOD },
                "no such pins as the UART has",
            ),
            (
                Wiring { uart: Pins { transmit: ('A', 2), receive: ('D', 0) }, ..GOOD },
                "the UART has a pin of the CAN controller",
            ),
            (
                Wiring { uart: Pins { transmit: ('D', 1), receive: ('A', 3) }, ..GOOD },
                "the UART has a pin of the CAN controller",
            ),
            (Wiring { can_controller: 2, ..GOOD }, "no transmit pin of this CAN controller"),
            (
                Wiring { can: Pins { transmit: ('D', 0), receive: ('D', 1) }, ..GOOD },
                "no transmit pin of this CAN controller",
            ),
            (
                Wiring { can: Pins { receive: ('B', 12), ..GOOD.can }, ..GOOD },
                "no receive pin of this CAN controller",
            ),
            (Wiring { can: Pins { receive: ('I', 9), ..GOOD.can }, ..GOOD }, "no such pins as can_pins"),
        ] {
            let said = wrong.check(&STM32F407VG).unwrap_err();
            assert!(said.contains(says), "{says}: {said}");
        }
        assert!(GOOD.check(&STM32F405RG).unwrap_err().contains("no such pins as can_pins"));
    }
}
