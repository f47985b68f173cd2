//! I2C1 to I2C3 without anything on their buses (RM0090 section 27): the registers hold what a program
//! that sets the block up writes, and both lines are high. A START is reported, for nobody would answer.

use crate::peripheral::{unmodelled, Peripheral, Unmodelled};
use crate::time::Time;

const CR1_START: u32 = 1 << 8;
const CR1_SWRST: u32 = 1 << 15;

/// Bits that a program can write: CR1, CR2, OAR1, OAR2, DR, SR1, SR2, CCR, TRISE, FLTR.
const WRITABLE: [u32; 10] = [0xFBFB, 0x1F3F, 0xC3FF, 0xFF, 0xFF, 0, 0, 0xCFFF, 0x3F, 0x1F];
/// TRISE after a reset (section 27.6.9).
const TRISE_RESET: u32 = 2;

/// One of them.
#[derive(Clone, Debug)]
pub struct I2c {
    name: &'static str,
    registers: [u32; 10],
}

impl I2c {
    /// As after a reset.
    #[must_use]
    pub fn new(name: &'static str) -> Self {
        let mut registers = [0; 10];
        registers[8] = TRISE_RESET;
        Self { name, registers }
    }

    fn index(&self, offset: u32) -> Result<usize, Unmodelled> {
        let index = offset as usize / 4;
        let there = index < self.registers.len();
        there.then_some(index).ok_or_else(|| Unmodelled(format!("{} has no such register", self.name)))
    }
}

impl Peripheral for I2c {
    fn name(&self) -> &'static str {
        self.name
    }

    fn read(&mut self, offset: u32, _now: Time) -> Result<u32, Unmodelled> {
        Ok(self.registers[self.index(offset)?])
    }

    fn write(&mut self, offset: u32, value: u32, _now: Time) -> Result<(), Unmodelled> {
        let index = self.index(offset)?;
        self.registers[index] = value & WRITABLE[index];
        if index == 0 && value & CR1_SWRST != 0 {
            *self = Self::new(self.name);
            self.registers[0] = CR1_SWRST;
        } else if index == 0 && value & CR1_START != 0 {
            return unmodelled(format!("{} sends START: nothing is modelled on its bus", self.name));
        }
        Ok(())
    }

    fn reset(&mut self) {
        *self = Self::new(self.name);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Section 27.6: reset values, and bits.
    #[test]
    fn a_program_sets_it_up_and_a_start_is_told() {
        let mut i2c = I2c::new("I2C1");
        assert_eq!(i2c.read(0x20, Time(0)), Ok(2));
        for (offset, value, read) in [(0x04, 0xFFFF_FF2A, 0x1F2A), (0x1C, 0x801E, 0x801E), (0x20, 43, 43)] {
            i2c.write(offset, value, Time(0)).unwrap();
            assert_eq!(i2c.read(offset, Time(0)), Ok(read), "offset {offset:02X}h");
        }
        i2c.write(0x00, 1, Time(0)).unwrap();
        assert_eq!(i2c.read(0x18, Time(0)), Ok(0), "SR2: not busy");
        assert!(i2c.write(0x00, 1 | CR1_START, Time(0)).is_err());
        assert!(i2c.read(0x28, Time(0)).is_err() && i2c.write(0x28, 0, Time(0)).is_err());
        i2c.write(0x00, CR1_SWRST, Time(0)).unwrap();
        assert_eq!(i2c.read(0x1C, Time(0)), Ok(0));
    }
}
