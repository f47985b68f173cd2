//! The password of a locked device.

use std::fmt;

/// The longest password.
const PASSWORD_MAX: usize = 64;

/// The password of a locked device. `Debug` does not show it.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Password {
    bytes: [u8; PASSWORD_MAX],
    len: usize,
}

impl Password {
    /// A password from its text; `None` for an empty text, and for more than 64 bytes.
    #[must_use]
    pub fn new(text: &str) -> Option<Self> {
        let mut bytes = [0; PASSWORD_MAX];
        let len = text.len();
        bytes.get_mut(..len)?.copy_from_slice(text.as_bytes());
        (len > 0).then_some(Self { bytes, len })
    }

    /// The text, for 6005h.
    pub(super) fn text(&self) -> &[u8] {
        &self.bytes[..self.len]
    }

    /// The number, for 7F50h: `0x494E4954`, or its four characters, most significant first, `INIT`.
    #[must_use]
    pub fn number(&self) -> Option<u32> {
        let text = std::str::from_utf8(self.text()).ok()?;
        match text.strip_prefix("0x").or_else(|| text.strip_prefix("0X")) {
            Some(digits) if digits.bytes().all(|digit| digit.is_ascii_hexdigit()) => {
                u32::from_str_radix(digits, 16).ok()
            }
            _ => self.text().try_into().ok().map(u32::from_be_bytes),
        }
    }
}

impl fmt::Debug for Password {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Password(…)")
    }
}
