//! The pause between two polls, as a server names it: `HH:MM:SS` up to a day, and an ISO 8601
//! duration from a day on.

use std::time::Duration;

/// The longest text that is read, in bytes.
const LONGEST: usize = 64;
const MINUTE: u32 = 60;
const HOUR: u32 = 60 * MINUTE;
const DAY: u32 = 24 * HOUR;
/// The units before and after the `T`, in their order. A pause needs no calendar: a year is 365
/// days, a month 30.
const DATE: [(char, u32); 4] = [('Y', 365 * DAY), ('M', 30 * DAY), ('W', 7 * DAY), ('D', DAY)];
const TIME: [(char, u32); 3] = [('H', HOUR), ('M', MINUTE), ('S', 1)];

/// Reads `HH:MM:SS`, or a duration with designators like `P1DT2H` (ISO 8601-1:2019 section
/// 5.5.2.2; capitals or not, as Java's `Duration.parse`). `None` for anything else, a negative
/// duration, and one that no [`Duration`] holds.
pub(super) fn parse(text: &str) -> Option<Duration> {
    if text.len() > LONGEST {
        return None;
    }
    match text.strip_prefix(['P', 'p']) {
        Some(rest) => duration(&rest.to_ascii_uppercase()),
        None => clock(text),
    }
}

fn clock(text: &str) -> Option<Duration> {
    let number = |part: &str| match part.len() {
        1 | 2 if is_digits(part) => part.parse::<u32>().ok(),
        _ => None,
    };
    let parts: Vec<u32> = text.split(':').map(number).collect::<Option<_>>()?;
    match parts[..] {
        [hours, minutes @ 0..60, seconds @ 0..60] => {
            Some(Duration::from_secs((hours * HOUR + minutes * MINUTE + seconds).into()))
        }
        _ => None,
    }
}

/// What follows the `P`.
fn duration(text: &str) -> Option<Duration> {
    let (date, time) = match text.split_once('T') {
        Some((_, "")) => return None,
        Some((date, time)) => (date, time),
        None => (text, ""),
    };
    if date.is_empty() && time.is_empty() {
        return None;
    }
    elements(date, &DATE, time.is_empty())?.checked_add(elements(time, &TIME, true)?)
}

/// The sum of numbers, each with a unit, in the order of the units. Only the last number of the
/// duration may have a fraction, which this text has if it is `last`.
fn elements(mut text: &str, units: &[(char, u32)], last: bool) -> Option<Duration> {
    let mut units = units.iter();
    let mut sum = Duration::ZERO;
    while let Some(unit) = text.chars().find(char::is_ascii_uppercase) {
        let (number, rest) = text.split_once(unit)?;
        let (_, seconds) = units.find(|(name, _)| *name == unit)?;
        sum = sum.checked_add(times(number, *seconds, last && rest.is_empty())?)?;
        text = rest;
    }
    text.is_empty().then_some(sum)
}

/// A number of units, with digits after a point or a comma where a fraction may be.
fn times(number: &str, seconds: u32, may_be_fraction: bool) -> Option<Duration> {
    let number = number.replace(',', ".");
    let good = match number.split_once('.') {
        Some((whole, fraction)) => may_be_fraction && is_digits(whole) && is_digits(fraction),
        None => is_digits(&number),
    };
    let number: f64 = number.parse().ok().filter(|_| good)?;
    Duration::try_from_secs_f64(number * f64::from(seconds)).ok()
}

fn is_digits(text: &str) -> bool {
    !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clock_and_every_form_of_a_duration_are_read() {
        let pauses = "00:00:00=0 12:01:30=43290 23:59:59=86399 P1DT2H=93600 PT36H=129600 PT24H=86400 \
                      P1D=86400 p1dt2h=93600 PT0S=0 PT1M30S=90 PT90M=5400 P2W=1209600 P1M=2592000 \
                      P1Y=31536000 P1Y2M3DT4H5M6S=36993906 PT1.5H=5400 PT1,5H=5400 PT0.5S=0.5 \
                      P0.5D=43200 P1DT0.5M=86430 P0001DT00002H=93600";
        for (text, seconds) in pauses.split(' ').map(|pair| pair.split_once('=').unwrap()) {
            let seconds = Duration::from_secs_f64(seconds.parse().unwrap());
            assert_eq!(parse(text), Some(seconds), "{text}");
        }
    }

    #[test]
    fn what_is_no_pause_is_none() {
        let long = format!("PT{}S", "1".repeat(100));
        let none = "|1:2|-1:00:00|+1:00:00|00:60:00|00:00:60|00:00:00:00|100:00:00|99999999999999999999:00:00|\
                    aa:bb:cc|٠٠:٠٠:٠١|P|PT|P1DT|P1|PT1|P1H|PT1D|P1D2H|PT1S1M|PT1H1H|P1DT1HT1M|-P1D|P-1D|PT-6H|\
                    P+1D|PD|PT.5H|PT5.H|PT1.5.5H|PT1.5H30M|P0.5DT1H|PT1e9H|PTinfS|PTNaNS| PT1H|PT1H |P1D\0|\
                    P9999999999999999999999Y|300";
        for text in none.split('|').chain([&*long]) {
            assert_eq!(parse(text), None, "{text}");
        }
    }
}
