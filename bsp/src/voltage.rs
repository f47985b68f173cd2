//! What follows from the supply (VDD): how wide the flash is programmed, and the voltage below which it is left
//! alone.

/// The supplies at which a chip works, in mV (datasheets, general operating conditions).
pub const RANGE: core::ops::RangeInclusive<u32> = 1_800..=3_600;

/// The lowest supply, in mV, at which 4, 2 and 1 bytes of the flash are programmed or erased at a time
/// (RM0090 table 13, RM0390 table 6).
const NEEDS: [(u32, u32); 3] = [(4, 2_700), (2, 2_100), (1, 1_800)];

/// The thresholds of the voltage detector from `PLS` = 0 on, in mV: the highest one of a falling and of a
/// rising supply in any chip (DS8626, DS10693, DS9405, "Embedded reset and power control block
/// characteristics").
const DETECTOR: [(u32, u32); 8] = [
    (2_080, 2_190),
    (2_250, 2_370),
    (2_390, 2_510),
    (2_560, 2_650),
    (2_710, 2_820),
    (2_920, 2_990),
    (2_990, 3_100),
    (3_090, 3_210),
];

/// How many bytes of the flash are programmed at a time with at least this supply, in mV.
#[must_use]
pub const fn flash_width(supply_mv: u32) -> u32 {
    needs(supply_mv).0
}

/// `PLS` of the voltage detector for a board with at least this supply, in mV: the highest level that no chip
/// takes for too low at this supply. `None` if that level is below what the flash needs: the detector stays
/// off.
///
/// The reference manual calls the levels 2.0 to 2.9 V; the datasheet has what chips do. With level 7 a board
/// needs 3.21 V, or some chips never leave the state "too low".
#[must_use]
pub const fn detector_level(supply_mv: u32) -> Option<u8> {
    let (_, needed) = needs(supply_mv);
    let mut level = DETECTOR.len();
    while level > 0 {
        level -= 1;
        let (falling, rising) = DETECTOR[level];
        if rising <= supply_mv {
            return if falling >= needed { Some(level as u8) } else { None };
        }
    }
    None
}

/// The width, and the supply that it needs.
const fn needs(supply_mv: u32) -> (u32, u32) {
    let [words, halves, bytes] = NEEDS;
    if supply_mv >= words.1 {
        words
    } else if supply_mv >= halves.1 {
        halves
    } else {
        bytes
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// RM0090 table 13: words from 2.7 V on, half-words from 2.1 V, bytes from 1.8 V.
    #[test]
    fn the_width_follows_from_the_supply() {
        for (mv, width) in
            [(3_600, 4), (2_700, 4), (2_699, 2), (2_400, 2), (2_100, 2), (2_099, 1), (1_800, 1)]
        {
            assert_eq!(flash_width(mv), width, "{mv} mV");
        }
    }

    /// DS8626 table 19, rising edge, maximum: 3.21 V for level 7, 3.10, 2.99 and 2.82 V down to level 4, which
    /// falls at 2.66 V. Level 3 falls at 2.56 V at most, too late for words.
    #[test]
    fn no_chip_takes_the_supply_of_its_board_for_too_low() {
        for (mv, level) in [
            (3_600, Some(7)),
            (3_210, Some(7)),
            (3_209, Some(6)),
            (3_100, Some(6)),
            (3_000, Some(5)),
            (2_989, Some(4)),
            (2_820, Some(4)),
            (2_819, None),
            (2_700, None),
            // By half-words.
            (2_699, Some(3)),
            (2_510, Some(2)),
            (2_400, Some(1)),
            (2_369, None),
            (2_100, None),
            (1_800, None),
        ] {
            assert_eq!(detector_level(mv), level, "{mv} mV");
        }
    }
}
