//! What follows from the supply (VDD): how wide the flash is programmed, and the voltage below which it is left
//! alone.

/// The supplies at which a chip works, in mV (datasheets, general operating conditions).
pub const RANGE: core::ops::RangeInclusive<u32> = 1_800..=3_600;

/// The lowest supply, in mV, at which 4, 2 and 1 bytes of the flash are programmed or erased at a time
/// (RM0090 table 13, RM0390 table 6).
const NEEDS: [(u32, u32); 3] = [(4, 2_700), (2, 2_100), (1, 1_800)];

/// The thresholds of the voltage detector from `PLS` = 0 on, in mV: the lowest one of a falling supply, and the
/// highest one of a rising supply, in any chip (DS8626, DS10693, DS9405, "Embedded reset and power control
/// block characteristics").
const DETECTOR: [(u32, u32); 8] = [
    (1_980, 2_190),
    (2_130, 2_370),
    (2_290, 2_510),
    (2_440, 2_650),
    (2_590, 2_820),
    (2_650, 2_990),
    (2_850, 3_100),
    (2_950, 3_210),
];

/// How many bytes of the flash are programmed at a time on a board with at least this supply, in mV.
///
/// As many as every chip can at the lowest supply that its voltage detector lets pass: a supply that falls
/// slowly is between the board's lowest and that for as long as it likes. Without a detector 1.
#[must_use]
pub const fn flash_width(supply_mv: u32) -> u32 {
    let lowest = lowest(supply_mv);
    let [words, halves, bytes] = NEEDS;
    if lowest >= words.1 {
        words.0
    } else if lowest >= halves.1 {
        halves.0
    } else {
        bytes.0
    }
}

/// The lowest supply, in mV, that the voltage detector of some chip lets pass on a board with at least this supply: what
/// the flash has to work with. Without a detector it is the chip's.
#[must_use]
pub const fn lowest(supply_mv: u32) -> u32 {
    match detector_level(supply_mv) {
        Some(level) => DETECTOR[level as usize].0,
        None => *RANGE.start(),
    }
}

/// `PLS` of the voltage detector for a board with at least this supply, in mV: the highest level that no chip
/// takes for too low at this supply. `None` if there is no such level: the detector stays off.
///
/// The reference manual calls the levels 2.0 to 2.9 V; the datasheet has what chips do. With level 7 a board
/// needs 3.21 V, or some chips never leave the state "too low".
#[must_use]
pub const fn detector_level(supply_mv: u32) -> Option<u8> {
    let mut level = DETECTOR.len();
    while level > 0 {
        level -= 1;
        let (_, rising) = DETECTOR[level];
        if rising <= supply_mv {
            return Some(level as u8);
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    /// DS8626 table 19. Rising edge, maximum: 3.21 V for level 7, 3.10, 2.99 and 2.82 V down to level 4.
    /// Falling edge, minimum: 2.85 V for level 6, 2.65 V for level 5, 2.13 V for level 1 and 1.98 V for level 0.
    /// RM0090 table 13: words from 2.7 V on, half-words from 2.1 V, bytes from 1.8 V.
    #[test]
    fn no_chip_takes_the_supply_of_its_board_for_too_low_or_writes_more_than_it_can() {
        for (mv, level, width) in [
            (3_600, Some(7), 4),
            (3_210, Some(7), 4),
            (3_209, Some(6), 4),
            (3_100, Some(6), 4),
            (3_099, Some(5), 2),
            (2_990, Some(5), 2),
            (2_989, Some(4), 2),
            (2_820, Some(4), 2),
            (2_819, Some(3), 2),
            (2_700, Some(3), 2),
            (2_510, Some(2), 2),
            (2_370, Some(1), 2),
            (2_369, Some(0), 1),
            (2_190, Some(0), 1),
            (2_189, None, 1),
            (1_800, None, 1),
        ] {
            assert_eq!((detector_level(mv), flash_width(mv)), (level, width), "{mv} mV");
        }
    }
}
