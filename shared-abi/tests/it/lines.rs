//! What the chips of a line have in common, by the documents of each line.

use shared_abi::geometry::{Limits, Line};

const MHZ: u32 = 1_000_000;

/// Maximum frequencies without over-drive: general operating conditions of DS8626 and DS8597
/// (F405 to F417), DS9405 and DS9484 (F42x, F43x), DS10693 (F446), DS11189 and DS11118 (F469,
/// F479), DS11139 (F412), DS11581 and DS11582 (F413, F423). Wait states at 2.7 to 3.6 V: one for
/// each 30 MHz; RM0430: 25 MHz.
#[test]
fn clocks_are_those_of_the_datasheets() {
    for line in Line::ALL {
        let [sysclk, after_reset, apb1, apb2, wait] = match line {
            Line::F412 => [100, 84, 50, 100, 30],
            Line::F413 | Line::F423 => [100, 84, 50, 100, 25],
            _ => [168, 168, 42, 84, 30],
        };
        let expected = Limits {
            sysclk: sysclk * MHZ,
            sysclk_after_reset: after_reset * MHZ,
            apb1: apb1 * MHZ,
            apb2: apb2 * MHZ,
            per_wait_state: wait * MHZ,
        };
        assert_eq!(line.limits(), expected, "{}", line.name());
    }
}

/// Wait states at a lower supply: RM0090 tables 11 and 12 (F405 to F439), RM0390, RM0386: 24, 22 and 20 MHz
/// each; RM0402 (F412): 24, 18, 16; RM0430 (F413, F423): 20, 18, 16. With seven of them, F405 to F417 reach
/// 160 MHz below 2.1 V.
#[test]
fn a_lower_supply_needs_more_wait_states() {
    for line in Line::ALL {
        let each = match line {
            Line::F412 => [30, 24, 24, 18, 18, 16, 16],
            Line::F413 | Line::F423 => [25, 20, 20, 18, 18, 16, 16],
            _ => [30, 24, 24, 22, 22, 20, 20],
        };
        for (mv, wait) in [2_700, 2_699, 2_400, 2_399, 2_100, 2_099, 1_800].into_iter().zip(each) {
            let limits = line.limits_at(mv);
            assert_eq!(limits.per_wait_state, wait * MHZ, "{} at {mv} mV", line.name());
            let is_slow = matches!(line, Line::F405 | Line::F407 | Line::F415 | Line::F417) && mv < 2_100;
            let sysclk = if is_slow { 160 * MHZ } else { line.limits().sysclk };
            assert_eq!(limits.sysclk, sysclk, "{} at {mv} mV", line.name());
        }
    }
}

/// CAN controllers, ports (register boundary addresses) and interrupts (the vector table's last
/// position and one), from RM0090, RM0402, RM0430, RM0390 and RM0386.
#[test]
fn peripherals_are_those_of_the_manuals() {
    for (lines, can, ports, interrupts) in [
        (&[Line::F405, Line::F407, Line::F415, Line::F417][..], 2, 9, 82),
        (&[Line::F427, Line::F429, Line::F437, Line::F439], 2, 11, 91),
        (&[Line::F412], 2, 8, 97),
        (&[Line::F413, Line::F423], 3, 8, 102),
        (&[Line::F446], 2, 8, 97),
        (&[Line::F469, Line::F479], 2, 11, 93),
    ] {
        for line in lines {
            let reported = (line.can_controllers(), line.ports(), line.interrupts());
            assert_eq!(reported, (can, ports, interrupts), "{}", line.name());
            // The PAC ends with SPI6, position 86, on these two.
            let pac = if matches!(line, Line::F427 | Line::F437) { 87 } else { interrupts };
            assert_eq!(line.pac_interrupts(), pac, "{}", line.name());
        }
    }
}
