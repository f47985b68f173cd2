//! The creation date of a program, as control blocks and labels have it and as 1F52h shows it.

/// Seconds from the start of 1970, the origin of control blocks and labels (time_t), to that of 1984, the
/// origin of CANopen (CiA 301, TIME_OF_DAY): 14 years, three of which are leap years.
const START_OF_1984: u32 = (14 * 365 + 3) * DAY;
/// The seconds of a day.
const DAY: u32 = 24 * 60 * 60;

/// The two elements of 1F52h (CiA 302-3, verify application software) for a program that was made at `seconds`
/// after the start of 1970 (UTC): days since 1984-01-01, and milliseconds after midnight. Zeros if
/// it is not known, and for a date before 1984.
#[must_use]
pub const fn days_and_milliseconds(seconds: u32) -> [u32; 2] {
    match seconds.checked_sub(START_OF_1984) {
        Some(seconds) => [seconds / DAY, seconds % DAY * 1000],
        None => [0; 2],
    }
}

/// The date in a control block, which has 64 bits. Dates after 2106-02-07 are not known.
#[must_use]
pub const fn of_control(date: u64) -> u32 {
    if date >> 32 == 0 {
        date as u32
    } else {
        0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The seconds are those of GNU `date -u -d '…' +%s`, the days those between the two dates of a
    /// calendar.
    #[test]
    fn days_count_from_the_origin_of_canopen() {
        for (seconds, expected) in [
            // 1984-01-01 00:00:00, the next midnight, and the second before.
            (441_763_200, [0, 0]),
            (441_849_599, [0, 86_399_000]),
            (441_849_600, [1, 0]),
            // 2000-02-29 12:00:00, and the day after it.
            (951_825_600, [5903, 43_200_000]),
            (951_912_000, [5904, 43_200_000]),
            // 2026-11-27 18:30:15: 42 years, 10 leap days before this year, and 330 days.
            (1_795_804_215, [15_671, 66_615_000]),
            // 1983-12-31 23:59:59, and no date.
            (441_763_199, [0, 0]),
            (0, [0, 0]),
            // 2106-02-07 06:28:15, the last one.
            (u32::MAX, [44_597, 23_295_000]),
        ] {
            assert_eq!(days_and_milliseconds(seconds), expected, "{seconds}");
        }
        assert_eq!([of_control(7), of_control(u64::MAX), of_control(1 << 32 | 7)], [7, 0, 0]);
    }
}
