//! Checks whether an image can be a program of an STM32F4, without a device and without its memory
//! map.
//!
//! The checks are not stricter than the device's, with two exceptions: an image at the start of the
//! flash is a bootloader and not a program, and a reset vector must point into the image.

use super::image::Image;
use super::range::AddressRange;

/// Main flash of the STM32F4: at most 2 MiB.
pub(crate) const FLASH: AddressRange = AddressRange { first: 0x0800_0000, last: 0x081F_FFFF };
/// Its first sector, which has 16 KiB on every chip. No program can have it, because the CPU starts
/// there after a reset.
const FIRST_SECTOR: AddressRange = AddressRange { first: 0x0800_0000, last: 0x0800_3FFF };
/// The possible ends of a stack: inside the RAM, or directly after its last byte. The RAM has at
/// most 320 KiB (STM32F413, STM32F469), the core-coupled RAM 64 KiB.
const STACKS: [AddressRange; 2] = [
    AddressRange { first: 0x2000_0008, last: 0x2005_0000 },
    AddressRange { first: 0x1000_0008, last: 0x1001_0000 },
];

/// Why an image cannot be a program.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Fault {
    /// It begins at the address of the bootloader.
    #[error("begins at the start of the flash, as a bootloader does and a program does not")]
    Bootloader,
    /// All its bytes have this value, 00h or FFh.
    #[error("is not a program: all its bytes are {0:02X}h")]
    Blank(u8),
    /// It does not contain the first two vectors.
    #[error("is not a program: it does not begin with an initial stack pointer and a reset vector")]
    NoVectors,
    /// The first word cannot be an initial stack pointer.
    #[error(
        "is not a program: its first word, {0:08X}h, is not an initial stack pointer (a multiple \
         of 8 in the RAM)"
    )]
    StackPointer(u32),
    /// The second word does not point into the program.
    #[error("is not a program: its reset vector is {vector:08X}h, outside {range}")]
    ResetVector {
        /// The reset vector.
        vector: u32,
        /// The range for a valid vector.
        range: AddressRange,
    },
    /// The reset vector points into the program, but its bit 0 is clear: this CPU only executes
    /// Thumb code.
    #[error("is not a program: its reset vector is {0:08X}h, without the Thumb bit")]
    NotThumb(u32),
}

impl Fault {
    /// The stable error number: that of a file that is not firmware.
    pub const NUMBER: u32 = 0x6000_0021;

    /// What to do next.
    #[must_use]
    pub fn advice(&self) -> &'static str {
        match self {
            Self::Bootloader => {
                "give the program, linked for an address after the bootloader; use a debug probe to write a bootloader"
            }
            _ => {
                "check that it is the right file, and that it begins with the vector table; \
                 --force leaves that to the device"
            }
        }
    }
}

/// Checks an image with a program that starts at `start`; 0 for an image without addresses.
///
/// # Errors
/// The first fault.
pub fn judge(image: &Image, start: u32) -> Result<(), Fault> {
    let end = image.span().last;
    if start == FLASH.first
        || image.part(AddressRange { first: FLASH.first, last: FLASH.first + 3 }).is_some()
    {
        return Err(Fault::Bootloader);
    }
    if let Some(byte) = image.only_byte().filter(|byte| matches!(byte, 0 | 0xFF)) {
        return Err(Fault::Blank(byte));
    }
    let [stack_pointer, vector] = vectors(image, start).ok_or(Fault::NoVectors)?;
    if !stack_pointer.is_multiple_of(8) || !STACKS.iter().any(|stacks| stacks.has(stack_pointer)) {
        return Err(Fault::StackPointer(stack_pointer));
    }
    let code = vector & !1;
    if start == 0 && FIRST_SECTOR.has(code) {
        return Err(Fault::Bootloader);
    }
    let range = if start == 0 { FLASH } else { AddressRange { first: start, last: end } };
    judge_reset_vector(vector, range)
}

/// Checks the reset vector of an image without addresses, when its place is known.
///
/// # Errors
/// [`Fault::ResetVector`], [`Fault::NotThumb`] or [`Fault::NoVectors`].
pub fn judge_place(image: &Image, region: AddressRange) -> Result<(), Fault> {
    let [_, vector] = vectors(image, 0).ok_or(Fault::NoVectors)?;
    judge_reset_vector(vector, region)
}

fn judge_reset_vector(vector: u32, range: AddressRange) -> Result<(), Fault> {
    if !range.has(vector & !1) {
        return Err(Fault::ResetVector { vector, range });
    }
    if vector & 1 == 0 {
        return Err(Fault::NotThumb(vector));
    }
    Ok(())
}

/// Initial stack pointer and reset vector.
fn vectors(image: &Image, start: u32) -> Option<[u32; 2]> {
    let bytes: [u8; 8] = image.bytes(start)?;
    let [a, b, c, d, e, f, g, h] = bytes;
    Some([[a, b, c, d], [e, f, g, h]].map(u32::from_le_bytes))
}

#[cfg(test)]
mod tests {
    use super::super::raw;
    use super::*;

    const START: u32 = 0x0801_0000;

    fn with(stack_pointer: u32, vector: u32, at: u32) -> Result<(), Fault> {
        let mut bytes = vec![0x5A; 0x400];
        bytes[..4].copy_from_slice(&stack_pointer.to_le_bytes());
        bytes[4..8].copy_from_slice(&vector.to_le_bytes());
        judge(&raw::read(&bytes, Some(at)).unwrap(), at)
    }

    #[test]
    fn what_a_device_takes_is_taken() {
        for stack_pointer in [0x2000_0008, 0x2001_FFC0, 0x2002_0000, 0x2005_0000, 0x1001_0000, 0x1000_0008] {
            assert_eq!(with(stack_pointer, START + 0x189, START), Ok(()), "{stack_pointer:08X}h");
        }
        for vector in [START + 9, START + 0x3FF] {
            assert_eq!(with(0x2001_FFC0, vector, START), Ok(()), "{vector:08X}h");
        }
        // Without addresses, the image may be linked for any place of the flash that a program may
        // have.
        for vector in [0x0800_4189, 0x0801_0189, 0x081F_FFFF] {
            assert_eq!(with(0x2001_FFC0, vector, 0), Ok(()), "{vector:08X}h");
        }
    }

    #[test]
    fn what_no_device_starts_is_refused() {
        for stack_pointer in [0, 0x2000_0000, 0x2001_FFC4, 0x2005_0008, 0x1000_0000, 0x1001_0008, 0x0801_0000]
        {
            let fault = Err(Fault::StackPointer(stack_pointer));
            assert_eq!(with(stack_pointer, START + 0x189, START), fault);
        }
        let range = AddressRange { first: START, last: START + 0x3FF };
        for vector in [0, START - 1, START + 0x401, 0x0800_0189, 0xFFFF_FFFF] {
            assert_eq!(with(0x2001_FFC0, vector, START), Err(Fault::ResetVector { vector, range }));
        }
        assert_eq!(with(0x2001_FFC0, START + 0x188, START), Err(Fault::NotThumb(START + 0x188)));
        assert_eq!(
            with(0x2001_FFC0, 0x2000_0189, 0).unwrap_err(),
            Fault::ResetVector { vector: 0x2000_0189, range: FLASH }
        );
    }

    #[test]
    fn a_bootloader_is_no_program_with_addresses_and_without() {
        assert_eq!(with(0x2001_FFC0, 0x0800_0189, 0x0800_0000), Err(Fault::Bootloader));
        assert_eq!(with(0x2001_FFC0, 0x0800_0189, 0), Err(Fault::Bootloader));
        // This fault is reported before all others.
        assert_eq!(with(0, 0, 0x0800_0000), Err(Fault::Bootloader));
    }

    #[test]
    fn blank_and_short_images_are_no_programs() {
        for (byte, len) in [(0, 8), (0xFF, 0x2000), (0, 1)] {
            let image = raw::read(&vec![byte; len], Some(START)).unwrap();
            assert_eq!(judge(&image, START), Err(Fault::Blank(byte)));
        }
        let image = raw::read(&[0, 0, 1, 0x20, 0x89, 1, 1], Some(START)).unwrap();
        assert_eq!(judge(&image, START), Err(Fault::NoVectors));
        // Vectors after the start do not count.
        let image = raw::read(&[0x5A; 64], Some(START + 4)).unwrap();
        assert_eq!(judge(&image, START), Err(Fault::NoVectors));
    }

    #[test]
    fn an_image_without_addresses_is_judged_by_the_place_that_it_goes_to() {
        let mut bytes = vec![0x5A; 0x400];
        bytes[4..8].copy_from_slice(&0x0801_0189_u32.to_le_bytes());
        let image = raw::read(&bytes, Some(0)).unwrap();
        let region = |first| AddressRange { first, last: first + 0xFFFF };
        assert_eq!(judge_place(&image, region(START)), Ok(()));
        let other = Fault::ResetVector { vector: 0x0801_0189, range: region(0x0808_0000) };
        assert_eq!(judge_place(&image, region(0x0808_0000)), Err(other));
    }
}
