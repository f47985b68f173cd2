//! Values of objects by their data type (CiA 301, clause 7.1.6): conversion between text and bytes.

use std::fmt;

/// A data type of an object.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DataType {
    /// BOOLEAN: one byte, 0 or 1.
    Boolean,
    /// UNSIGNED8 to UNSIGNED64: the number of bytes, 1 to 8.
    Unsigned(u8),
    /// INTEGER8 to INTEGER64: the number of bytes, 1 to 8, two's complement.
    Integer(u8),
    /// REAL32 (IEEE 754).
    Real32,
    /// REAL64 (IEEE 754).
    Real64,
    /// VISIBLE_STRING: printable ASCII.
    VisibleString,
    /// OCTET_STRING, and all types without another notation here: bytes.
    OctetString,
    /// DOMAIN: any number of bytes.
    Domain,
}

/// Why a text is not a value of a type. `Display` describes a valid value.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ValueError {
    /// The text does not follow the type's notation.
    #[error("'{text}' is not a {kind}: {notation}")]
    Notation {
        /// The text.
        text: String,
        /// The type.
        kind: DataType,
        /// The type's notation.
        notation: &'static str,
    },
    /// The number is out of the type's range.
    #[error("{text} is out of the range of {kind}: {low} to {high}")]
    Range {
        /// The text.
        text: String,
        /// The type.
        kind: DataType,
        /// The type's lowest value.
        low: String,
        /// The type's highest value.
        high: String,
    },
    /// An SDO transfer has at least one byte.
    #[error("an empty value cannot be written")]
    Empty,
}

/// The types with their names for [`DataType::by_name`].
const NAMES: [(&str, DataType); 21] = [
    ("bool", DataType::Boolean),
    ("u8", DataType::Unsigned(1)),
    ("u16", DataType::Unsigned(2)),
    ("u24", DataType::Unsigned(3)),
    ("u32", DataType::Unsigned(4)),
    ("u40", DataType::Unsigned(5)),
    ("u48", DataType::Unsigned(6)),
    ("u56", DataType::Unsigned(7)),
    ("u64", DataType::Unsigned(8)),
    ("i8", DataType::Integer(1)),
    ("i16", DataType::Integer(2)),
    ("i24", DataType::Integer(3)),
    ("i32", DataType::Integer(4)),
    ("i40", DataType::Integer(5)),
    ("i48", DataType::Integer(6)),
    ("i56", DataType::Integer(7)),
    ("i64", DataType::Integer(8)),
    ("f32", DataType::Real32),
    ("f64", DataType::Real64),
    ("string", DataType::VisibleString),
    ("hex", DataType::OctetString),
];

impl DataType {
    /// The type with this name: `u8`, `i32`, `f64`, `string`, `hex` and so on.
    #[must_use]
    pub fn by_name(name: &str) -> Option<Self> {
        NAMES.iter().find(|(known, _)| *known == name).map(|(_, kind)| *kind)
    }

    /// All names for [`by_name`](Self::by_name).
    pub fn names() -> impl Iterator<Item = &'static str> {
        NAMES.iter().map(|(name, _)| *name)
    }

    /// The type with this index (CiA 301, table 44): 0007h is UNSIGNED32. `None` for a type without
    /// a notation here, such as structures and times.
    #[must_use]
    pub const fn from_index(index: u32) -> Option<Self> {
        Some(match index {
            0x01 => Self::Boolean,
            0x02..=0x04 => Self::Integer(1 << (index - 0x02)),
            0x05..=0x07 => Self::Unsigned(1 << (index - 0x05)),
            0x08 => Self::Real32,
            0x09 => Self::VisibleString,
            0x0A => Self::OctetString,
            0x0F => Self::Domain,
            0x10 => Self::Integer(3),
            0x11 => Self::Real64,
            0x12..=0x15 => Self::Integer((index - 0x12 + 5) as u8),
            0x16 => Self::Unsigned(3),
            0x18..=0x1B => Self::Unsigned((index - 0x18 + 5) as u8),
            _ => return None,
        })
    }

    /// The lowest and the highest value of an integer type.
    #[must_use]
    pub fn range(self) -> Option<(i128, i128)> {
        match self {
            Self::Boolean => Some((0, 1)),
            Self::Unsigned(bytes) => Some((0, (1 << (8 * u32::from(bytes))) - 1)),
            Self::Integer(bytes) => {
                let half = 1_i128 << (8 * u32::from(bytes) - 1);
                Some((-half, half - 1))
            }
            Self::Real32 | Self::Real64 | Self::VisibleString | Self::OctetString | Self::Domain => None,
        }
    }

    /// The bytes of a value given as text: a number in C notation, `true` or `false`, a text, or
    /// pairs of hexadecimal digits.
    ///
    /// # Errors
    /// [`ValueError`] if the text is not a value of the type.
    pub fn encode(self, text: &str) -> Result<Vec<u8>, ValueError> {
        let notation = |notation| ValueError::Notation { text: text.to_string(), kind: self, notation };
        let whole = |bytes: u8| -> Result<Vec<u8>, ValueError> {
            let number = integer(text).ok_or_else(|| {
                notation("a number is written as 4096, 0x1000, octal 010000, or with a minus sign")
            })?;
            self.in_range(number, text)?;
            Ok(number.to_le_bytes()[..usize::from(bytes)].to_vec())
        };
        let real = || {
            let number = text.trim().parse::<f64>().ok();
            number.ok_or_else(|| notation("a number is written as 0.5, -3 or 1.5e-3"))
        };
        let bytes = match self {
            Self::Boolean => match text {
                "true" => vec![1],
                "false" => vec![0],
                _ => whole(1).map_err(|_| notation("it is true, false, 1 or 0"))?,
            },
            Self::Unsigned(bytes) | Self::Integer(bytes) => whole(bytes)?,
            Self::Real32 => {
                let number = real()?;
                let short = number as f32;
                if number.is_finite() && !short.is_finite() {
                    let (low, high) = (format!("{:e}", f32::MIN), format!("{:e}", f32::MAX));
                    return Err(ValueError::Range { text: text.to_string(), kind: self, low, high });
                }
                short.to_le_bytes().to_vec()
            }
            Self::Real64 => real()?.to_le_bytes().to_vec(),
            Self::VisibleString => {
                if !text.bytes().all(|byte| matches!(byte, b' '..=b'~')) {
                    return Err(notation(
                        "a text consists of printable ASCII characters; give other bytes as hex",
                    ));
                }
                text.as_bytes().to_vec()
            }
            Self::OctetString | Self::Domain => hex_digits(text)
                .ok_or_else(|| notation("bytes are pairs of hexadecimal digits, like \"DE AD BE EF\""))?,
        };
        if bytes.is_empty() {
            return Err(ValueError::Empty);
        }
        Ok(bytes)
    }

    fn in_range(self, number: i128, text: &str) -> Result<(), ValueError> {
        match self.range() {
            Some((low, high)) if !(low..=high).contains(&number) => Err(ValueError::Range {
                text: text.to_string(),
                kind: self,
                low: low.to_string(),
                high: high.to_string(),
            }),
            _ => Ok(()),
        }
    }

    /// The value as text; `None` if the bytes are not a value of this type, or not printable.
    #[must_use]
    pub fn show(self, bytes: &[u8]) -> Option<String> {
        let number = || bytes.iter().rev().fold(0_u64, |number, byte| number << 8 | u64::from(*byte));
        Some(match self {
            Self::Boolean if bytes.len() == 1 => (bytes[0] != 0).to_string(),
            Self::Unsigned(len) if bytes.len() == usize::from(len) => {
                format!("{} ({:0digits$X}h)", number(), number(), digits = bytes.len() * 2)
            }
            Self::Integer(len) if bytes.len() == usize::from(len) => {
                let unused = 64 - 8 * u32::from(len);
                ((number() << unused) as i64 >> unused).to_string()
            }
            Self::Real32 => f32::from_le_bytes(bytes.try_into().ok()?).to_string(),
            Self::Real64 => f64::from_le_bytes(bytes.try_into().ok()?).to_string(),
            Self::VisibleString => format!("{:?}", visible(bytes)?),
            Self::Boolean | Self::Unsigned(_) | Self::Integer(_) | Self::OctetString | Self::Domain => {
                return None
            }
        })
    }
}

impl fmt::Display for DataType {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = NAMES.iter().find(|(_, kind)| kind == self).map_or("domain", |(name, _)| name);
        f.pad(name)
    }
}

/// An integer in C notation, optionally with a minus sign: `-1`, `4096`, `0x1000`, octal `010000`.
#[must_use]
pub fn integer(text: &str) -> Option<i128> {
    let (sign, bare) = match text.strip_prefix('-') {
        Some(rest) => (-1, rest),
        None => (1, text),
    };
    let (digits, radix) = match bare.strip_prefix("0x").or_else(|| bare.strip_prefix("0X")) {
        Some(digits) => (digits, 16),
        None if bare.len() > 1 && bare.starts_with('0') => (&bare[1..], 8),
        None => (bare, 10),
    };
    // `from_str_radix` would accept a sign.
    if digits.is_empty() || !digits.chars().all(|digit| digit.is_digit(radix)) {
        return None;
    }
    i128::from_str_radix(digits, radix).ok().map(|number| sign * number)
}

/// Bytes as pairs of hexadecimal digits, with blanks anywhere: `DE AD BE EF`, `DEADBEEF`. At least
/// one byte.
#[must_use]
pub fn hex_digits(text: &str) -> Option<Vec<u8>> {
    let digits: Vec<char> = text.chars().filter(|c| !c.is_whitespace()).collect();
    if !digits.len().is_multiple_of(2) || digits.is_empty() {
        return None;
    }
    let digit = |c: char| c.to_digit(16).map(|digit| digit as u8);
    let pair = |pair: &[char]| Some(digit(pair[0])? << 4 | digit(pair[1])?);
    digits.chunks_exact(2).map(pair).collect()
}

/// The text, if it is all printable ASCII; a zero may end it.
#[must_use]
pub fn visible(bytes: &[u8]) -> Option<String> {
    let bytes = bytes.strip_suffix(&[0]).unwrap_or(bytes);
    let printable = !bytes.is_empty() && bytes.iter().all(|byte| matches!(byte, b' '..=b'~'));
    printable.then(|| bytes.iter().map(|byte| char::from(*byte)).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn encoded(name: &str, text: &str) -> Result<Vec<u8>, String> {
        DataType::by_name(name).unwrap().encode(text).map_err(|error| error.to_string())
    }

    #[test]
    fn a_value_has_the_bytes_of_its_type() {
        for (kind, text, bytes) in [
            ("bool", "true", &[1][..]),
            ("bool", "0", &[0]),
            ("u8", "255", &[0xFF]),
            ("u16", "0x1234", &[0x34, 0x12]),
            ("u24", "010", &[8, 0, 0]),
            ("u32", "4294967295", &[0xFF; 4]),
            ("u64", "18446744073709551615", &[0xFF; 8]),
            ("i8", "-128", &[0x80]),
            ("i16", "-2", &[0xFE, 0xFF]),
            ("i40", "-1", &[0xFF; 5]),
            ("i64", "-9223372036854775808", &[0, 0, 0, 0, 0, 0, 0, 0x80]),
            // IEEE 754: 1.5 is 3FC00000h, and -2.5 C004000000000000h.
            ("f32", "1.5", &[0, 0, 0xC0, 0x3F]),
            ("f64", "-2.5", &[0, 0, 0, 0, 0, 0, 0x04, 0xC0]),
            ("string", "evas", b"evas"),
            ("hex", "DE ad BEEF", &[0xDE, 0xAD, 0xBE, 0xEF]),
        ] {
            assert_eq!(encoded(kind, text).as_deref(), Ok(bytes), "{kind} {text}");
        }
    }

    #[test]
    fn what_a_type_has_no_room_for_is_refused_with_its_range() {
        for (kind, text, words) in [
            ("u8", "256", "256 is out of the range of u8: 0 to 255"),
            ("u8", "-1", "-1 is out of the range of u8: 0 to 255"),
            ("i8", "0xFF", "0xFF is out of the range of i8: -128 to 127"),
            ("i8", "-129", "out of the range of i8: -128 to 127"),
            ("u24", "16777216", "0 to 16777215"),
            ("i56", "36028797018963968", "-36028797018963968 to 36028797018963967"),
            ("u64", "18446744073709551616", "0 to 18446744073709551615"),
            ("u64", "999999999999999999999999999999999999999999", "is not a u64"),
            ("f32", "1e39", "1e39 is out of the range of f32"),
            ("bool", "2", "'2' is not a bool: it is true, false, 1 or 0"),
            ("u16", "12h", "'12h' is not a u16: a number is written as 4096, 0x1000"),
            ("u16", "", "is not a u16"),
            ("u16", "--1", "is not a u16"),
            ("f64", "one", "'one' is not a f64"),
            ("string", "größe", "printable ASCII"),
            ("string", "", "an empty value"),
            ("hex", "ABC", "pairs of hexadecimal digits"),
        ] {
            let error = encoded(kind, text).unwrap_err();
            assert!(error.contains(words), "{kind} {text}: {error}");
        }
    }

    #[test]
    fn a_value_is_shown_as_its_type_writes_it() {
        let shown = |name, bytes: &[u8]| DataType::by_name(name).unwrap().show(bytes);
        assert_eq!(shown("i16", &[0xFE, 0xFF]).as_deref(), Some("-2"));
        assert_eq!(shown("u16", &[0xFE, 0xFF]).as_deref(), Some("65534 (FFFEh)"));
        assert_eq!(shown("i64", &[0xFF; 8]).as_deref(), Some("-1"));
        assert_eq!(shown("f32", &[0, 0, 0xC0, 0x3F]).as_deref(), Some("1.5"));
        assert_eq!(shown("bool", &[1]).as_deref(), Some("true"));
        assert_eq!(shown("string", b"1.0.0\0").as_deref(), Some("\"1.0.0\""));
        assert_eq!((shown("u32", &[1]), shown("f64", &[1]), shown("hex", &[1])), (None, None, None));
    }

    #[test]
    fn types_have_the_indices_of_the_standard() {
        for (index, name) in [
            (0x01, "bool"),
            (0x02, "i8"),
            (0x04, "i32"),
            (0x05, "u8"),
            (0x07, "u32"),
            (0x08, "f32"),
            (0x09, "string"),
            (0x0A, "hex"),
            (0x10, "i24"),
            (0x11, "f64"),
            (0x12, "i40"),
            (0x15, "i64"),
            (0x16, "u24"),
            (0x18, "u40"),
            (0x1B, "u64"),
        ] {
            assert_eq!(DataType::from_index(index), DataType::by_name(name), "{index:02X}h");
        }
        for index in [0, 0x0B, 0x0C, 0x0D, 0x0E, 0x17, 0x1C, 0x20, u32::MAX] {
            assert_eq!(DataType::from_index(index), None, "{index:X}h");
        }
        assert_eq!(DataType::from_index(0x0F).unwrap().to_string(), "domain");
    }
}
