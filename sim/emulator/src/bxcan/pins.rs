//! The pins of the controllers: which alternate function they need, and which packages have them.
//!
//! From the datasheets (alternate function mapping; pin and ball definitions): DS8626 and DS8597
//! (F405 to F417), DS11139 (F412), DS11581 and DS11582 (F413, F423), DS9405 and DS9484 (F42x, F43x),
//! DS10693 (F446), DS11189 and DS11118 (F469, F479); compared with ST's open pin data.

use shared_abi::geometry::{Geometry, Line};

use super::filters::Share;

/// Port and number.
type Pin = (char, u8);

/// RX and TX of a controller, side by side.
struct Pair {
    controller: Share,
    rx: Pin,
    tx: Pin,
    function: u8,
    lines: Lines,
    /// Letters of the packages without them.
    lacking: &'static str,
}

/// The F412, F413 and F423 differ from the others.
#[derive(PartialEq, Eq)]
enum Lines {
    All,
    F41x,
    Others,
}

/// 48 and 64 pins.
const SMALL: &str = "cr";
/// Fewer than 144 pins.
const BELOW_144: &str = "cromv";
/// Fewer than 168 balls.
const BELOW_168: &str = "cromvz";

#[rustfmt::skip]
const PAIRS: [Pair; 9] = {
    use Lines::{All, F41x, Others};
    use Share::{Can1, Can2};
    [
        Pair { controller: Can1, rx: ('A', 11), tx: ('A', 12), function: 9, lines: All, lacking: "" },
        // There, I2C has function 9 of these.
        Pair { controller: Can1, rx: ('B', 8), tx: ('B', 9), function: 8, lines: F41x, lacking: "" },
        Pair { controller: Can1, rx: ('B', 8), tx: ('B', 9), function: 9, lines: Others, lacking: "" },
        Pair { controller: Can1, rx: ('D', 0), tx: ('D', 1), function: 9, lines: All, lacking: SMALL },
        Pair { controller: Can1, rx: ('G', 0), tx: ('G', 1), function: 9, lines: F41x, lacking: BELOW_144 },
        Pair { controller: Can1, rx: ('I', 9), tx: ('H', 13), function: 9, lines: Others, lacking: BELOW_168 },
        Pair { controller: Can2, rx: ('B', 5), tx: ('B', 6), function: 9, lines: All, lacking: "" },
        Pair { controller: Can2, rx: ('B', 12), tx: ('B', 13), function: 9, lines: All, lacking: "" },
        Pair { controller: Can2, rx: ('G', 11), tx: ('G', 12), function: 9, lines: F41x, lacking: BELOW_144 },
    ]
};

/// Pins that a package lacks though it has the RX beside: PD1 in WLCSP81, and PH13 where the display
/// of the F469 has its ball.
fn lacks(chip: &Geometry, package: char, pin: Pin) -> bool {
    match (chip.line, package) {
        (Line::F413 | Line::F423, 'm') => pin == ('D', 1),
        (Line::F469 | Line::F479, 'i') => pin == ('H', 13),
        _ => false,
    }
}

/// Whether the program has connected RX, and TX, of a controller to a pin of this package; `function`
/// is the alternate function that a pin has.
pub fn connected(
    chip: &Geometry,
    controller: Share,
    function: impl Fn(char, u8) -> Option<u8>,
) -> (bool, bool) {
    // The letter after the line (`shared_abi::geometry`, order codes).
    let package = char::from(chip.chip.as_bytes()[9]);
    let is_f41x = matches!(chip.line, Line::F412 | Line::F413 | Line::F423);
    let other = if is_f41x { Lines::Others } else { Lines::F41x };
    let pairs = PAIRS
        .iter()
        .filter(|pair| pair.controller == controller && pair.lines != other)
        .filter(|pair| !pair.lacking.contains(package));
    let is_given =
        |pin: Pin, pair: &Pair| !lacks(chip, package, pin) && function(pin.0, pin.1) == Some(pair.function);
    pairs
        .fold((false, false), |(rx, tx), pair| (rx || is_given(pair.rx, pair), tx || is_given(pair.tx, pair)))
}

#[cfg(test)]
mod tests {
    use shared_abi::geometry::{
        STM32F405RG, STM32F407IG, STM32F407VG, STM32F412CG, STM32F412ZG, STM32F413MH, STM32F446RE,
        STM32F469IG, STM32F469NI,
    };

    use super::*;

    /// Whether RX and TX are connected with these two pins, both with function `af`.
    fn pair(chip: &Geometry, controller: Share, rx: Pin, tx: Pin, af: u8) -> (bool, bool) {
        connected(chip, controller, |port, pin| [rx, tx].contains(&(port, pin)).then_some(af))
    }

    /// Datasheets, alternate function mapping.
    #[test]
    fn a_controller_needs_its_alternate_function_on_a_pin_of_the_package() {
        use Share::{Can1, Can2};
        const BOTH: (bool, bool) = (true, true);
        const NONE: (bool, bool) = (false, false);
        for (chip, controller, rx, tx, af, expected) in [
            (&STM32F407VG, Can1, ('D', 0), ('D', 1), 9, BOTH),
            (&STM32F407VG, Can1, ('D', 0), ('D', 1), 8, NONE),
            (&STM32F407VG, Can2, ('D', 0), ('D', 1), 9, NONE),
            (&STM32F407VG, Can2, ('B', 5), ('B', 13), 9, BOTH),
            (&STM32F407VG, Can1, ('I', 9), ('H', 13), 9, NONE),
            (&STM32F407IG, Can1, ('I', 9), ('H', 13), 9, BOTH),
            (&STM32F405RG, Can1, ('D', 0), ('D', 1), 9, NONE),
            (&STM32F446RE, Can1, ('B', 8), ('B', 9), 9, BOTH),
            (&STM32F412CG, Can1, ('B', 8), ('B', 9), 9, NONE),
            (&STM32F412CG, Can1, ('B', 8), ('B', 9), 8, BOTH),
            (&STM32F412ZG, Can2, ('G', 11), ('G', 12), 9, BOTH),
            (&STM32F413MH, Can1, ('D', 0), ('D', 1), 9, (true, false)),
            (&STM32F469IG, Can1, ('I', 9), ('H', 13), 9, (true, false)),
            (&STM32F469NI, Can1, ('I', 9), ('H', 13), 9, BOTH),
        ] {
            assert_eq!(pair(chip, controller, rx, tx, af), expected, "{}: {rx:?}, {tx:?}", chip.chip);
        }
    }

    /// Two tables, written down by two people from the datasheets: this one, and that of shared-abi, by which a
    /// board is built.
    #[test]
    fn every_chip_has_the_can_pins_that_the_geometry_has() {
        use shared_abi::geometry::{CanLine, CHIPS};
        for chip in CHIPS {
            for pin in ('A'..='K').flat_map(|port| (0..16).map(move |number| (port, number))) {
                let found =
                    [(Share::Can1, 1), (Share::Can2, 2)].into_iter().find_map(|(controller, number)| {
                        let line = |function| match pair(chip, controller, pin, pin, function) {
                            (false, false) => None,
                            (true, false) => Some((number, CanLine::Receive)),
                            (false, true) => Some((number, CanLine::Transmit)),
                            (true, true) => panic!("{pin:?} has both lines"),
                        };
                        line(9).or_else(|| line(8))
                    });
                assert_eq!(found, chip.can_line(pin), "{}: {pin:?}", chip.chip);
            }
        }
    }
}
