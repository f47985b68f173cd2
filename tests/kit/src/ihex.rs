//! Intel HEX as tools write it, for devices that accept it (Intel, "Hexadecimal Object File Format
//! Specification", 1988).

use std::fmt::Write;

/// One record: length, offset, type, data, and the two's complement of their sum.
pub fn record(offset: u16, kind: u8, data: &[u8]) -> String {
    let mut bytes = vec![data.len() as u8];
    bytes.extend(offset.to_be_bytes());
    bytes.push(kind);
    bytes.extend(data);
    let sum = bytes.iter().fold(0_u8, |sum, byte| sum.wrapping_add(*byte));
    bytes.push(sum.wrapping_neg());
    bytes.iter().fold(String::from(":"), |mut text, byte| {
        let _ = write!(text, "{byte:02X}");
        text
    })
}

/// The last record.
pub const END_OF_FILE: &str = ":00000001FF";

/// Bytes from this address on, in records of 16, with a linear base record where the upper half of
/// the address changes.
pub fn intel_hex(base: u32, bytes: &[u8]) -> String {
    let mut text = String::new();
    for (n, data) in (0..).zip(bytes.chunks(16)) {
        let address = base.wrapping_add(16 * n);
        if address == base || address.is_multiple_of(0x1_0000) {
            text += &record(0, 4, &((address >> 16) as u16).to_be_bytes());
            text.push('\n');
        }
        text += &record(address as u16, 0, data);
        text.push('\n');
    }
    text + END_OF_FILE + "\n"
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The best-known example (Wikipedia "Intel HEX", from the specification), and a base record
    /// with a checksum computed by hand.
    #[test]
    fn records_are_those_of_the_specification() {
        let data = [0x21, 0x46, 0x01, 0x36, 1, 0x21, 0x47, 1, 0x36, 0, 0x7E, 0xFE, 9, 0xD2, 0x19, 1];
        assert_eq!(record(0x100, 0, &data), ":10010000214601360121470136007EFE09D2190140");
        assert_eq!(intel_hex(0x0801_0000, &[2]), ":020000040801F1\n:0100000002FD\n:00000001FF\n");
    }
}
