//! Common code of the two text formats: lines and hexadecimal digits.

use super::fault::{Cause, Place, ReadError};

/// The lines with their numbers, without line end (LF, CR LF or CR) and trailing blanks. Empty
/// lines are left out.
pub(super) fn lines(bytes: &[u8]) -> impl Iterator<Item = (Place, &[u8])> {
    let mut rest = Some(bytes);
    let mut number = 0;
    std::iter::from_fn(move || {
        let text = rest?;
        number += 1;
        let end = text.iter().position(|byte| matches!(byte, b'\n' | b'\r'));
        let Some(end) = end else {
            rest = None;
            return Some((Place::Line(number), text));
        };
        let (line, after) = text.split_at(end);
        rest = Some(after.strip_prefix(b"\r\n").unwrap_or(&after[1..]));
        Some((Place::Line(number), line))
    })
    .map(|(place, line)| (place, line.trim_ascii_end()))
    .filter(|(_, line)| !line.is_empty())
}

/// The bytes of pairs of hexadecimal digits. `skipped` is the number of characters before them in
/// the line.
pub(super) fn bytes_of(digits: &[u8], skipped: usize, place: Place) -> Result<Vec<u8>, ReadError> {
    let nibble = |(index, digit): (usize, &u8)| {
        char::from(*digit)
            .to_digit(16)
            .map(|value| value as u8)
            .ok_or(place.fault(Cause::BadDigit { column: skipped + index + 1 }))
    };
    let nibbles = digits.iter().enumerate().map(nibble).collect::<Result<Vec<u8>, _>>()?;
    if !nibbles.len().is_multiple_of(2) {
        return Err(place
            .fault(Cause::Malformed("the last byte has only one digit; the line is truncated or damaged")));
    }
    Ok(nibbles.chunks_exact(2).map(|pair| pair[0] << 4 | pair[1]).collect())
}

/// Checks that a record of `found` bytes has the announced length.
pub(super) fn check_length(found: usize, needed: usize, place: Place) -> Result<(), ReadError> {
    match found {
        _ if found < needed => Err(place.fault(Cause::CutOff { what: "the record", needed, found })),
        _ if found > needed => Err(place.fault(Cause::TooLong { needed, found })),
        _ => Ok(()),
    }
}
