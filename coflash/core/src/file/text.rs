//! Common code of the two text formats: lines and hexadecimal digits.

use super::fault::{Cause, Encoding, Place, ReadError};

/// The lines with their numbers, without line end (LF, CR LF or CR) and blanks around them. Empty
/// lines are left out, and so is what fills a file after its last line: the end mark of CP/M and
/// DOS (1Ah), zeros, and erased flash.
pub(super) fn lines(bytes: &[u8]) -> impl Iterator<Item = (Place, &[u8])> {
    let is_text = |byte: &u8| !matches!(byte, 0x1A | 0x00 | 0xFF) && !byte.is_ascii_whitespace();
    let end = bytes.iter().rposition(is_text).map_or(0, |last| last + 1);
    let mut rest = Some(&bytes[..end]);
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
    .map(|(place, line)| (place, line.trim_ascii()))
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

/// The encoding of a text that is not in ASCII, if its first letter is that of an Intel HEX file or of an
/// S-record.
pub(super) fn encoding(bytes: &[u8]) -> Option<Encoding> {
    // The mark of UTF-32 begins with that of UTF-16.
    const MARKS: [(&[u8], &str); 5] = [
        (b"\xEF\xBB\xBF", "UTF-8"),
        (b"\xFF\xFE\0\0", "UTF-32"),
        (b"\0\0\xFE\xFF", "UTF-32"),
        (b"\xFF\xFE", "UTF-16"),
        (b"\xFE\xFF", "UTF-16"),
    ];
    if let Some((text, name)) =
        MARKS.iter().find_map(|(mark, name)| Some((bytes.strip_prefix(*mark)?, *name)))
    {
        let letter = text.iter().find(|byte| **byte != 0 && !byte.is_ascii_whitespace());
        return is_first_letter(letter).then_some(Encoding { name, is_marked: true });
    }
    let wide = [(2, "UTF-16"), (4, "UTF-32")].into_iter().find(|(width, _)| is_wide(bytes, *width));
    wide.map(|(_, name)| Encoding { name, is_marked: false })
}

fn is_first_letter(letter: Option<&u8>) -> bool {
    matches!(letter, Some(b':' | b'S'))
}

/// Whether a text begins, after blanks, with characters of `width` bytes, one of which is not 0: the
/// first or the last.
fn is_wide(bytes: &[u8], width: usize) -> bool {
    const LOOKED_AT: usize = 4;
    [0, width - 1].into_iter().any(|place| {
        let is_ascii = |unit: &&[u8]| unit.iter().enumerate().all(|(at, byte)| (at == place) == (*byte != 0));
        let is_blank = |unit: &&[u8]| is_ascii(unit) && unit[place].is_ascii_whitespace();
        let mut units = bytes.chunks_exact(width).skip_while(is_blank).take_while(is_ascii);
        is_first_letter(units.next().map(|unit| &unit[place]))
            && units.take(LOOKED_AT - 1).count() == LOOKED_AT - 1
    })
}

/// Checks that a record of `found` bytes has the announced length.
pub(super) fn check_length(found: usize, needed: usize, place: Place) -> Result<(), ReadError> {
    match found {
        _ if found < needed => Err(place.fault(Cause::CutOff { what: "the record", needed, found })),
        _ if found > needed => Err(place.fault(Cause::TooLong { needed, found })),
        _ => Ok(()),
    }
}
