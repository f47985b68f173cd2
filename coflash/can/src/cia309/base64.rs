//! base64 (RFC 2045) in one line, the form in which CiA 309-3 sends domains.

const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
const PAD: u8 = b'=';

/// The number of digits for so many bytes.
pub(super) const fn length(bytes: usize) -> usize {
    bytes.div_ceil(3).saturating_mul(4)
}

/// Encodes three bytes as four digits and pads the end.
pub(super) fn encode(bytes: &[u8]) -> String {
    let mut text = String::with_capacity(length(bytes.len()));
    for group in bytes.chunks(3) {
        let word = group.iter().chain([&0, &0]).take(3).fold(0, |word, byte| word << 8 | usize::from(*byte));
        for digit in 0..4 {
            let padding = digit > group.len();
            let value = if padding { PAD } else { DIGITS[word >> (18 - 6 * digit) & 0x3F] };
            text.push(char::from(value));
        }
    }
    text
}

/// Decodes base64. `None` if the text has an invalid digit, if its length is not a multiple of
/// four, or if padding is anywhere but at the end.
pub(super) fn decode(text: &[u8]) -> Option<Vec<u8>> {
    if !text.len().is_multiple_of(4) {
        return None;
    }
    let padding = text.iter().rev().take_while(|digit| **digit == PAD).count();
    let digits = text.get(..text.len() - padding).filter(|_| padding <= 2)?;
    let mut bytes = Vec::with_capacity(text.len() / 4 * 3);
    for group in digits.chunks(4) {
        let mut word = 0_u32;
        for at in 0..4 {
            let value = match group.get(at) {
                Some(digit) => DIGITS.iter().position(|known| known == digit)?,
                None => 0,
            };
            word = word << 6 | value as u32;
        }
        let [_, whole @ ..] = word.to_be_bytes();
        bytes.extend_from_slice(whole.get(..group.len() * 3 / 4)?);
    }
    Some(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The test vectors of RFC 4648, chapter 10, which has the same alphabet and padding.
    #[test]
    fn the_vectors_of_the_standard() {
        for (bytes, text) in [
            (&b""[..], ""),
            (b"f", "Zg=="),
            (b"fo", "Zm8="),
            (b"foo", "Zm9v"),
            (b"foob", "Zm9vYg=="),
            (b"fooba", "Zm9vYmE="),
            (b"foobar", "Zm9vYmFy"),
            (&[0xFB, 0xFF, 0xBF], "+/+/"),
        ] {
            assert_eq!(encode(bytes), text);
            assert_eq!(decode(text.as_bytes()).as_deref(), Some(bytes), "{text}");
        }
        for text in ["Z", "OK", "Zg=", "Zg===", "====", "Z===", "Zm9v=Zg=", "Zm-v", "Zm 9", "Zm9v\r"] {
            assert_eq!(decode(text.as_bytes()), None, "{text}");
        }
    }
}
