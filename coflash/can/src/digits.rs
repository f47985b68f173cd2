//! Digits in URLs, in the text protocols of adapters and in logs.

use std::str::FromStr;

/// A number of decimal digits alone, without sign or blank.
pub(crate) fn decimal<T: FromStr>(text: &str) -> Option<T> {
    text.bytes().all(|byte| byte.is_ascii_digit()).then(|| text.parse().ok()).flatten()
}

/// A number of hexadecimal digits alone, without sign or blank.
pub(crate) fn hex_number(text: &str) -> Option<u32> {
    let digits = !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_hexdigit());
    digits.then(|| u32::from_str_radix(text, 16).ok()).flatten()
}

/// Bytes as pairs of hexadecimal digits alone.
pub(crate) fn hex_bytes(text: &str) -> Option<Vec<u8>> {
    if !text.is_ascii() || !text.len().is_multiple_of(2) {
        return None;
    }
    (0..text.len()).step_by(2).map(|at| hex_number(&text[at..at + 2]).map(|byte| byte as u8)).collect()
}
