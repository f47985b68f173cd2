//! CRC calculation unit (RM0090 section 4).

use crate::peripheral::{unmodelled, Peripheral, Unmodelled};
use crate::time::Time;

const POLYNOMIAL: u32 = 0x04C1_1DB7;

/// CRC-32 over whole words, most significant bit first, start value FFFF_FFFFh, nothing reflected
/// or inverted.
#[derive(Clone, Debug)]
pub struct Crc {
    data: u32,
    independent: u32,
}

impl Default for Crc {
    fn default() -> Self {
        Self { data: u32::MAX, independent: 0 }
    }
}

impl Peripheral for Crc {
    fn name(&self) -> &'static str {
        "CRC"
    }

    fn read(&mut self, offset: u32, _now: Time) -> Result<u32, Unmodelled> {
        match offset {
            0x00 => Ok(self.data),
            0x04 => Ok(self.independent),
            0x08 => Ok(0),
            _ => unmodelled("the CRC unit has no such register"),
        }
    }

    fn write(&mut self, offset: u32, value: u32, _now: Time) -> Result<(), Unmodelled> {
        match offset {
            0x00 => {
                let mut crc = self.data ^ value;
                for _ in 0..32 {
                    crc = if crc & 1 << 31 != 0 { crc << 1 ^ POLYNOMIAL } else { crc << 1 };
                }
                self.data = crc;
            }
            0x04 => self.independent = value & 0xFF,
            0x08 if value & 1 != 0 => self.data = u32::MAX,
            0x08 => {}
            _ => return unmodelled("the CRC unit has no such register"),
        }
        Ok(())
    }

    fn reset(&mut self) {
        *self = Self::default();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The CRC-32/MPEG-2 check value: 0376_E6E7h over the text "123456789", of which the unit takes
    /// the first eight bytes as two big-endian words; one more byte by hand gives the published
    /// value.
    #[test]
    fn agrees_with_the_published_check_value() {
        let mut unit = Crc::default();
        unit.write(0x00, 0x3132_3334, Time(0)).unwrap();
        unit.write(0x00, 0x3536_3738, Time(0)).unwrap();
        let mut crc = unit.read(0x00, Time(0)).unwrap() ^ 0x3900_0000;
        for _ in 0..8 {
            crc = if crc & 1 << 31 != 0 { crc << 1 ^ POLYNOMIAL } else { crc << 1 };
        }
        assert_eq!(crc, 0x0376_E6E7);
        unit.write(0x08, 1, Time(0)).unwrap();
        assert_eq!(unit.read(0x00, Time(0)), Ok(u32::MAX));
    }
}
