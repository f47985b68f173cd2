//! The place of a device's programs: object 2004h of coboot.

use canopen::program::{region_of, PROGRAM_REGION};
use canopen::Address;

use super::error::{reported, Error};
use super::session::Session;

/// Main flash of the STM32F4: 08000000h, at most 2 MiB.
const FLASH: std::ops::Range<u64> = 0x0800_0000..0x0820_0000;

/// The flash of a program: its first address and its size, at least one byte.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ProgramRegion {
    /// First address.
    pub base: u32,
    /// Size in bytes.
    pub size: u32,
}

impl ProgramRegion {
    /// Parses the value of 2004h. A device of another manufacturer may use this object differently:
    /// a value outside an STM32F4's flash gives `None`.
    #[must_use]
    pub fn parse(value: &[u8]) -> Option<Self> {
        let (base, size) = region_of(value.try_into().ok()?);
        let end = u64::from(base) + u64::from(size);
        let plausible =
            size > 0 && base.is_multiple_of(4) && FLASH.contains(&base.into()) && end <= FLASH.end;
        plausible.then_some(Self { base, size })
    }

    /// Last address.
    #[must_use]
    pub const fn last(&self) -> u32 {
        self.base + (self.size - 1)
    }
}

/// Reads the place of a program from a device; `None` if the device does not report it.
///
/// # Errors
/// The errors of a [read](Session::read), except a refusal.
pub fn program_region(session: &mut Session<'_>, program: u8) -> Result<Option<ProgramRegion>, Error> {
    let value = reported(session.read(Address::new(PROGRAM_REGION, program)))?;
    Ok(value.and_then(|value| ProgramRegion::parse(&value)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_part_of_the_flash_is_a_region() {
        // 08010000h and 000F0000h, little-endian.
        let value = [0, 0, 1, 8, 0, 0, 0x0F, 0];
        assert_eq!(
            ProgramRegion::parse(&value),
            Some(ProgramRegion { base: 0x0801_0000, size: 0x000F_0000 })
        );
        assert_eq!(ProgramRegion::parse(&value).unwrap().last(), 0x080F_FFFF);
        for other in [
            &value[..4],
            &[value, value].concat(),
            b"\0\0\x01\x20\0\0\x01\0",
            b"\0\0\x01\x08\0\0\0\0",
            b"\0\0\x01\x08\0\0\x20\0",
            b"\x02\0\x01\x08\0\0\x01\0",
            &[0xFF; 8],
        ] {
            assert_eq!(ProgramRegion::parse(other), None, "{other:x?}");
        }
    }
}
