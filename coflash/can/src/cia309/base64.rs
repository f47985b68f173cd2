//! base64 (RFC 2045) in one line, the form in which CiA 309-3 sends domains.

use ::base64::alphabet::STANDARD;
use ::base64::engine::general_purpose::{GeneralPurpose, GeneralPurposeConfig};
use ::base64::Engine as _;

/// Padded. An encoder may leave bits in the last digit that belong to no byte.
const BASE64: GeneralPurpose =
    GeneralPurpose::new(&STANDARD, GeneralPurposeConfig::new().with_decode_allow_trailing_bits(true));

/// The number of digits for so many bytes.
pub(super) const fn length(bytes: usize) -> usize {
    bytes.div_ceil(3).saturating_mul(4)
}

pub(super) fn encode(bytes: &[u8]) -> String {
    BASE64.encode(bytes)
}

/// `None` if the text has an invalid digit, if its length is not a multiple of four, or if padding is
/// anywhere but at the end.
pub(super) fn decode(text: &str) -> Option<Vec<u8>> {
    BASE64.decode(text).ok()
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
            assert_eq!((encode(bytes).as_str(), length(bytes.len())), (text, text.len()));
            assert_eq!(decode(text).as_deref(), Some(bytes), "{text}");
        }
        assert_eq!(decode("Zh==").as_deref(), Some(&b"f"[..]));
        for text in ["Z", "OK", "Zg=", "Zg===", "====", "Z===", "Zm9v=Zg=", "Zm-v", "Zm 9", "Zm9v\r"] {
            assert_eq!(decode(text), None, "{text}");
        }
    }
}
