//! Texts from outside in the encodings that editors and data sheets have.

/// A text in Unicode: UTF-8, with or without a byte order mark, or UTF-16 with one.
pub(crate) fn text(bytes: &[u8]) -> Option<String> {
    let utf_16 = |of: fn([u8; 2]) -> u16, bytes: &[u8]| {
        let units: Vec<u16> = bytes.chunks_exact(2).map(|pair| of([pair[0], pair[1]])).collect();
        String::from_utf16(&units).ok().filter(|_| bytes.len().is_multiple_of(2))
    };
    let text = match bytes {
        [0xFF, 0xFE, rest @ ..] => utf_16(u16::from_le_bytes, rest),
        [0xFE, 0xFF, rest @ ..] => utf_16(u16::from_be_bytes, rest),
        [0xEF, 0xBB, 0xBF, rest @ ..] => std::str::from_utf8(rest).map(str::to_owned).ok(),
        bytes => std::str::from_utf8(bytes).map(str::to_owned).ok(),
    };
    text.filter(|text| !text.contains('\0'))
}
