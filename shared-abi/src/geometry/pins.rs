//! Which pins a chip has, and which of them lead to a CAN controller.

use super::chip::Geometry;
use super::line::Line::{self, *};

/// A pin of a chip: its port, `'A'` and on, and its number in the port, 0 to 15.
pub type Pin = (char, u8);

/// A line of a CAN controller.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CanLine {
    /// The chip drives it.
    Transmit,
    /// The chip reads it.
    Receive,
}

/// Every pin of a port.
const ALL: u16 = 0xFFFF;

/// The pins of each port from A on, a bit for each, of a package of a line: "pin and ball definitions" of
/// the datasheets, as ST's pin data for STM32CubeMX have them. Where a letter stands for several packages,
/// the pins are those that one of them has.
const fn pins(line: Line, package: u8) -> [u16; 11] {
    match (package, line) {
        (b'C', _) => [ALL, 0xF7FF, 0xE000, 0, 0, 0, 0, 3, 0, 0, 0],
        (b'R', F405 | F415) => [ALL, ALL, ALL, 4, 0, 0, 0, 3, 0, 0, 0],
        (b'R', _) => [ALL, 0xF7FF, ALL, 4, 0, 0, 0, 3, 0, 0, 0],
        (b'M', F446) => [ALL, 0xF7FF, 0xFFDD, 0x38D7, 0x079C, 0, 0, 3, 0, 0, 0],
        (b'M', _) => [ALL, 0xF7FF, ALL, 0x0605, 0xFE00, 0, 0, 3, 0, 0, 0],
        (b'O', _) => [ALL, ALL, 0xFFCD, 0xDFF7, 0xFF80, 0, 0, 3, 3, 0, 0],
        (b'V', F446) => [ALL, 0xF7FF, ALL, ALL, ALL, 0, 0, 3, 0, 0, 0],
        (b'V', F469 | F479) => [ALL, ALL, 0xFFCF, 0xC7FF, 0xFF84, 0, 0, 3, 0, 0, 0],
        (b'V', _) => [ALL, ALL, ALL, ALL, ALL, 0, 0, 3, 0, 0, 0],
        (b'Z', F469 | F479) => [ALL, ALL, ALL, 0xDF7F, ALL, 0xFC3F, 0x9FFF, 3, 0, 0, 0],
        (b'Z', _) => [ALL, ALL, ALL, ALL, ALL, ALL, ALL, 3, 0, 0, 0],
        (b'A', F469 | F479) => [ALL, ALL, 0xFFC3, ALL, ALL, 0xFC3F, 0xBFFF, 0xFF3F, 0x0EFF, 0, 0],
        (b'A', _) => [ALL, ALL, ALL, ALL, ALL, 0xFC3F, 0x9DF7, ALL, 0x06FF, 0, 0],
        (b'I', F469 | F479) => [ALL, ALL, ALL, ALL, ALL, ALL, ALL, 0x00FF, 0x0FFB, 0, 0],
        (b'I', _) => [ALL, ALL, ALL, ALL, ALL, ALL, ALL, ALL, 0x0FFF, 0, 0],
        (_, F469 | F479) => [ALL, ALL, ALL, ALL, ALL, ALL, ALL, ALL, ALL, 0xF03F, 0x00F8],
        _ => [ALL, ALL, ALL, ALL, ALL, ALL, ALL, ALL, ALL, ALL, 0x00FF],
    }
}

impl Geometry {
    /// Whether the chip's package has this pin.
    #[must_use]
    pub const fn has_pin(&self, (port, number): Pin) -> bool {
        let port = (port as u32).wrapping_sub('A' as u32) as usize;
        let [.., package, _] = self.chip.as_bytes() else { return false };
        port < self.ports as usize
            && number < 16
            && pins(self.line, package.to_ascii_uppercase())[port] >> number & 1 != 0
    }

    /// The CAN controller, 1 or 2, that this pin can be connected to, and by which of its lines (alternate
    /// functions of the datasheets; the HAL's table has the same). CAN3 is not supported.
    #[must_use]
    pub const fn can_line(&self, pin: Pin) -> Option<(u8, CanLine)> {
        let line = match pin {
            ('A', 11) | ('B', 8) | ('D', 0) | ('I', 9) => (1, CanLine::Receive),
            ('A', 12) | ('B', 9) | ('D', 1) | ('H', 13) => (1, CanLine::Transmit),
            ('B', 5 | 12) => (2, CanLine::Receive),
            ('B', 6 | 13) => (2, CanLine::Transmit),
            ('G', 0) if self.line.has_can_on_port_g() => (1, CanLine::Receive),
            ('G', 1) if self.line.has_can_on_port_g() => (1, CanLine::Transmit),
            ('G', 11) if self.line.has_can_on_port_g() => (2, CanLine::Receive),
            ('G', 12) if self.line.has_can_on_port_g() => (2, CanLine::Transmit),
            _ => return None,
        };
        if self.has_pin(pin) {
            Some(line)
        } else {
            None
        }
    }
}

impl Line {
    const fn has_can_on_port_g(self) -> bool {
        matches!(self, F412 | F413 | F423)
    }
}

/// Whether the debugger has this pin after a reset: SWJ debug port pins, PA13 to PA15, PB3 and PB4 (RM0090
/// section 38.4.1).
#[must_use]
pub const fn is_debug_pin(pin: Pin) -> bool {
    matches!(pin, ('A', 13..=15) | ('B', 3..=4))
}

#[cfg(test)]
mod tests {
    use super::super::*;
    use super::*;

    /// Pinouts: DS8626 (F405, F407), DS11139 (F412), DS10693 (F446), DS9405 (F429), DS11189 (F469).
    #[test]
    fn a_package_has_the_pins_of_its_datasheet() {
        for (chip, pin, expected) in [
            (STM32F405RG, ('B', 11), true),
            (STM32F405RG, ('D', 2), true),
            (STM32F405RG, ('D', 0), false),
            (STM32F407VG, ('E', 15), true),
            (STM32F407VG, ('F', 0), false),
            (STM32F407VG, ('H', 1), true),
            (STM32F407ZG, ('G', 15), true),
            (STM32F407IG, ('I', 11), true),
            (STM32F412CE, ('C', 13), true),
            (STM32F412CE, ('C', 12), false),
            (STM32F412CE, ('B', 11), false),
            (STM32F446RE, ('B', 11), false),
            (STM32F446ZE, ('B', 11), true),
            (STM32F429ZI, ('G', 13), true),
            (STM32F429ZI, ('H', 2), false),
            (STM32F429NI, ('K', 7), true),
            (STM32F469NI, ('J', 6), false),
            (STM32F407IG, ('J', 0), false),
            (STM32F407IG, ('A', 16), false),
            (STM32F407IG, ('@', 0), false),
            (STM32F407IG, ('a', 0), false),
        ] {
            assert_eq!(chip.has_pin(pin), expected, "{}: {pin:?}", chip.chip);
        }
    }

    /// DS8626 table 9, DS11139 and DS11581 (alternate functions).
    #[test]
    fn the_can_pins_are_those_of_the_datasheets() {
        use CanLine::{Receive, Transmit};
        for (chip, pin, expected) in [
            (STM32F407VG, ('D', 0), Some((1, Receive))),
            (STM32F407VG, ('D', 1), Some((1, Transmit))),
            (STM32F407VG, ('B', 12), Some((2, Receive))),
            (STM32F407VG, ('B', 6), Some((2, Transmit))),
            (STM32F407VG, ('B', 7), None),
            // Not on this package.
            (STM32F405RG, ('D', 0), None),
            (STM32F407VG, ('I', 9), None),
            (STM32F407IG, ('I', 9), Some((1, Receive))),
            (STM32F407IG, ('H', 13), Some((1, Transmit))),
            (STM32F412ZG, ('G', 0), Some((1, Receive))),
            (STM32F413ZG, ('G', 12), Some((2, Transmit))),
            (STM32F407ZG, ('G', 0), None),
            // CAN3.
            (STM32F413ZG, ('A', 8), None),
        ] {
            assert_eq!(chip.can_line(pin), expected, "{}: {pin:?}", chip.chip);
        }
    }

    /// What `new-board` and the boards build upon: these are on every package.
    #[test]
    fn every_package_has_pins_for_can1_and_can2() {
        for chip in CHIPS {
            for pin in [('A', 11), ('A', 12), ('B', 8), ('B', 9), ('B', 12), ('B', 13)] {
                assert!(chip.can_line(pin).is_some(), "{}: {pin:?}", chip.chip);
            }
        }
    }
}
