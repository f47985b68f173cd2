//! A download that was cut off: object 2006h of coboot.

use canopen::program::{region_of, PROGRAM_PARTIAL};
use canopen::Address;

use super::error::{reported, Error};
use super::session::Session;

/// The download of a block file that a device has begun and not ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PartialDownload {
    /// The CRC of its block 0.
    pub control_crc: u32,
    /// The address up to which its data have arrived.
    pub end: u32,
}

impl PartialDownload {
    /// Parses the value of 2006h; `None` if there is nothing to go on with.
    #[must_use]
    pub fn parse(value: &[u8]) -> Option<Self> {
        let (control_crc, end) = region_of(value.try_into().ok()?);
        (control_crc != 0).then_some(Self { control_crc, end })
    }
}

/// Reads the begun download of a program; `None` if there is none, or the device reports none.
///
/// # Errors
/// The errors of a [read](Session::read), except a refusal.
pub fn partial_download(session: &mut Session<'_>, program: u8) -> Result<Option<PartialDownload>, Error> {
    let value = reported(session.read(Address::new(PROGRAM_PARTIAL, program)))?;
    Ok(value.and_then(|value| PartialDownload::parse(&value)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_crc_and_an_address_are_a_begun_download() {
        let value = [0x78, 0x56, 0x34, 0x12, 0, 0x80, 1, 8];
        assert_eq!(
            PartialDownload::parse(&value),
            Some(PartialDownload { control_crc: 0x1234_5678, end: 0x0801_8000 })
        );
        for none in [&[0; 8][..], &value[..4], &[0, 0, 0, 0, 0, 0x80, 1, 8], &[]] {
            assert_eq!(PartialDownload::parse(none), None, "{none:x?}");
        }
    }
}
