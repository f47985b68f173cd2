//! Checks before the tool changes a device: whether the image can be a program, whether it is for
//! this device, and whether it is linked for the device's region.

use canopen::program::IDENTITY;
use canopen::Address;

use super::content::Content;
use super::dialect::is_data;
use super::options::{FlashOptions, Target};
use crate::device::access::told_challenge;
use crate::device::error::{optional, Error, Mismatch};
use crate::device::region::program_region;
use crate::device::{Dialect, Session};
use crate::file::image::Image;
use crate::file::judge::{judge, judge_place, Fault};
use crate::file::sealed::{Refusal, SealedFile};
use crate::file::{AddressRange, BlockFile};

/// Checks a file for a device with this dialect. Returns whether the check is complete: an
/// application may not know its region, and then the bootloader is asked later.
///
/// # Errors
/// [`Error::NoProgram`], [`Error::WrongTarget`], [`Error::OtherRegion`], and the errors of a
/// [read](Session::read).
pub(super) fn admit(
    session: &mut Session<'_>,
    file: Content<'_>,
    dialect: Dialect,
    options: &FlashOptions,
) -> Result<bool, Error> {
    if options.force {
        return Ok(true);
    }
    let file = match file {
        Content::Blocks(file) => file,
        Content::Sealed(file) => return admit_sealed(session, file, options.program),
    };
    let image = file.image();
    if !is_data(dialect, options.program) {
        judge(&image, file.program_start()).map_err(no_program)?;
        for target in [Target::of_control(file), Target::of_label(&image, file.program_start())] {
            check_identity(session, target)?;
        }
    }
    admit_place(session, file, &image, dialect, options.program)
}

/// Checks only the region; returns whether the device has reported its region.
///
/// # Errors
/// As [`admit`].
pub(super) fn admit_to_bootloader(
    session: &mut Session<'_>,
    file: Content<'_>,
    dialect: Dialect,
    options: &FlashOptions,
) -> Result<bool, Error> {
    match file {
        _ if options.force => Ok(true),
        Content::Blocks(file) => admit_place(session, file, &file.image(), dialect, options.program),
        Content::Sealed(file) => admit_capable(session, file, options.program),
    }
}

/// Checks a sealed image: its program number, its device and its size.
fn admit_sealed(session: &mut Session<'_>, file: &SealedFile, program: u8) -> Result<bool, Error> {
    let head = file.head();
    if head.program() != program {
        return Err(refused(&Refusal::Program { image: head.program(), device: program }));
    }
    for (sub, image, what) in
        [(1, head.vendor_id(), Mismatch::VendorId), (2, head.product_code(), Mismatch::ProductCode)]
    {
        // 0 is a normal value here: it only matches a device with the identity 0.
        compare_identity(session, sub, image, what)?;
    }
    admit_capable(session, file, program)
}

/// Checks what the bootloader reports and an application may not: whether the device accepts sealed
/// images, and its room. Returns whether the device has reported both.
fn admit_capable(session: &mut Session<'_>, file: &SealedFile, program: u8) -> Result<bool, Error> {
    let challenge = told_challenge(session)?;
    if challenge.is_some_and(|challenge| !challenge.is_sealed()) {
        let why = "cannot be installed: the device is not sealed and has no keys to check the image";
        let advice =
            "write keys into the device with a debug probe (coflash provision makes the file), or flash the \
                      program as it is, not sealed";
        return Err(Error::NoProgram { why: why.to_string(), advice });
    }
    let room = admit_room(session, file.head().size(), program)?;
    Ok(room && challenge.is_some())
}

/// Checks the size of a sealed image; returns whether the device has reported its room.
fn admit_room(session: &mut Session<'_>, size: u32, program: u8) -> Result<bool, Error> {
    match program_region(session, program)? {
        None => Ok(false),
        Some(region) if size > region.size => {
            Err(refused(&Refusal::Room { image: size, device: region.size }))
        }
        Some(_) => Ok(true),
    }
}

fn refused(refusal: &Refusal) -> Error {
    Error::NoProgram { why: format!("does not fit: {refusal}"), advice: refusal.advice() }
}

fn admit_place(
    session: &mut Session<'_>,
    file: &BlockFile,
    image: &Image,
    dialect: Dialect,
    program: u8,
) -> Result<bool, Error> {
    let Some(told) = program_region(session, program)? else { return Ok(false) };
    let region = AddressRange { first: told.base, last: told.last() };
    let (start, size) = (file.program_start(), u64::from(file.program_size()));
    let fits = match dialect {
        // The CRC of the program counts from the region's start.
        Dialect::Block => file.check_region(region).is_ok(),
        Dialect::Hex | Dialect::EsAcademy => region.contains(&file.span()),
        Dialect::Raw | Dialect::Lift if start == 0 => {
            if !is_data(dialect, program) {
                judge_place(image, region).map_err(no_program)?;
            }
            size <= region.len()
        }
        Dialect::Raw | Dialect::Lift => start == region.first && size <= region.len(),
    };
    if fits {
        return Ok(true);
    }
    let AddressRange { first, .. } = region;
    let last = u64::from(start) + size.saturating_sub(1);
    Err(Error::OtherRegion {
        node: session.node(),
        program,
        image: (start, u32::try_from(last).unwrap_or(u32::MAX)),
        region: (first, region.last),
    })
}

/// Compares the identity in the file with 1018h. 0 in the file stands for any device, as it does
/// for a bootloader; a value that the device does not report cannot differ.
fn check_identity(session: &mut Session<'_>, target: Option<Target>) -> Result<(), Error> {
    let Some(Target { vendor_id, product_code }) = target else { return Ok(()) };
    for (sub, file, what) in [(1, vendor_id, Mismatch::VendorId), (2, product_code, Mismatch::ProductCode)] {
        if file == 0 {
            continue;
        }
        compare_identity(session, sub, file, what)?;
    }
    Ok(())
}

fn compare_identity(session: &mut Session<'_>, sub: u8, file: u32, what: Mismatch) -> Result<(), Error> {
    match optional(session.read_number(Address::new(IDENTITY, sub)))? {
        Some(device) if device != file => {
            Err(Error::WrongTarget { node: session.node(), what, device, file })
        }
        _ => Ok(()),
    }
}

fn no_program(fault: Fault) -> Error {
    Error::NoProgram { why: fault.to_string(), advice: fault.advice() }
}
