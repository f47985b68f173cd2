//! Quantities in the same units everywhere: amounts in bytes, rates in KiB/s, bit rates in kbit/s,
//! times in seconds.

use std::time::Duration;

/// `6.7 KiB/s`.
pub(super) fn rate(bytes: f64) -> String {
    format!("{:.1} KiB/s", bytes / 1024.0)
}

/// Bytes in hexadecimal, with this text between them.
pub(super) fn hex(bytes: &[u8], between: &str) -> String {
    let pairs: Vec<String> = bytes.iter().map(|byte| format!("{byte:02X}")).collect();
    pairs.join(between)
}

/// Rows in columns of the same width, with two blanks between them.
pub(super) fn table<const COLUMNS: usize>(rows: &[[String; COLUMNS]]) -> String {
    let width = |column: usize| rows.iter().map(|row| row[column].chars().count()).max().unwrap_or_default();
    let widths: [usize; COLUMNS] = std::array::from_fn(width);
    let line = |row: &[String; COLUMNS]| {
        let cells: Vec<_> = row.iter().zip(widths).map(|(cell, width)| format!("{cell:<width$}")).collect();
        format!("{}\n", cells.join("  ").trim_end())
    };
    rows.iter().map(line).collect()
}

/// The progress of a job of known length.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Pace {
    pub(super) done: usize,
    pub(super) total: usize,
    /// Bytes per second on average.
    pub(super) rate: f64,
    /// Seconds until the end at this rate.
    pub(super) left: f64,
}

impl Pace {
    pub(super) fn new(done: usize, total: usize, took: Duration) -> Self {
        let rate = done as f64 / took.as_secs_f64().max(1e-3);
        let left = total.saturating_sub(done) as f64 / rate.max(1.0);
        Self { done, total, rate, left }
    }

    pub(super) fn percent(&self) -> usize {
        (self.done * 100).checked_div(self.total).unwrap_or(100)
    }
}

impl std::fmt::Display for Pace {
    /// `30 %  1234 of 4100 bytes, 2.5 KiB/s, 3 s left`.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { done, total, left, .. } = self;
        write!(f, "{:>3} %  {done} of {total} bytes, {}, {left:.0} s left", self.percent(), rate(self.rate))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pace_has_rate_and_remaining_time() {
        let pace = |done, total, seconds| Pace::new(done, total, Duration::from_secs(seconds)).to_string();
        assert_eq!(pace(1000, 4000, 2), " 25 %  1000 of 4000 bytes, 0.5 KiB/s, 6 s left");
        assert_eq!(pace(0, 4000, 0), "  0 %  0 of 4000 bytes, 0.0 KiB/s, 4000 s left");
        assert_eq!(pace(0, 0, 0), "100 %  0 of 0 bytes, 0.0 KiB/s, 0 s left");
    }
}
