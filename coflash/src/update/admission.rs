//! Checks before the tool changes a device: whether the image can be a program, whether it is for
//! this device, and whether it is linked for the device's region.

use canopen::program::{DEVICE_NAME, IDENTITY};
use canopen::Address;
use seal::access::right;
use shared_abi::layout;

use super::content::{refusal_number, Content};
use super::dialect::is_data;
use super::options::FlashOptions;
use super::steps::compare_target;
use crate::device::access::{security_of, told_challenge, Challenge};
use crate::device::error::{told, Error, Mismatch};
use crate::device::region::program_region;
use crate::device::{Dialect, Session};
use crate::file::judge::{judge, judge_place, Fault, StackAtEnd};
use crate::file::sealed::{Refusal, SealedFile};
use crate::file::{AddressRange, Program};

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
    let program = match file {
        Content::Program(program) => program,
        Content::Sealed(file) => return admit_sealed(session, file, options.program),
    };
    let says = admit_open(session)?;
    let mut is_judged = true;
    if !is_data(dialect, options.program) {
        judge(program.image(), program.start(), None).map_err(no_program)?;
        is_judged = admit_stack(session, program)?;
        // A value that the device does not report cannot differ.
        for target in program.targets().into_iter().flatten() {
            compare_target(session, target, |session, at| told(session.read_number(at)))?;
        }
    }
    Ok(admit_place(session, program, dialect, options.program)? && is_judged && says)
}

/// Checks what an application may not know: the stack, the region, and which images the device takes;
/// returns whether the device has reported its region.
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
        Content::Program(program) => {
            admit_open(session)?;
            if !is_data(dialect, options.program) {
                admit_stack(session, program)?;
            }
            admit_place(session, program, dialect, options.program)
        }
        Content::Sealed(file) => admit_capable(session, file, options.program),
    }
}

/// Checks that a device takes images that are not sealed; returns whether it has said so.
fn admit_open(session: &mut Session<'_>) -> Result<bool, Error> {
    match told_challenge(session)? {
        Some(challenge) if challenge.is_sealed() => {
            let roots = security_of(session, &challenge)?.roots;
            Err(Error::SealedOnly { node: session.node(), roots })
        }
        challenge => Ok(challenge.is_some()),
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
        return Err(Error::NoProgram { number: Fault::NUMBER, why: why.to_string(), advice });
    }
    if let Some(challenge) = &challenge {
        admit_age(session, file, challenge)?;
    }
    let room = admit_room(session, file.head().size(), program)?;
    Ok(room && challenge.is_some())
}

/// Checks security counter and epoch against those that the device has had at its last reset. It may have
/// raised them since then, and refuses the image itself in that case.
fn admit_age(session: &mut Session<'_>, file: &SealedFile, challenge: &Challenge) -> Result<(), Error> {
    let (head, lowest) = (file.head(), security_of(session, challenge)?);
    let image = head.counter();
    match lowest.counters.get(usize::from(head.program()).wrapping_sub(1)) {
        Some(device) if image < *device && challenge.granted() & right::LOWER_COUNTER == 0 => {
            return Err(refused(&Refusal::Counter { image, device: *device }));
        }
        _ => {}
    }
    match (head.certificate().map(|certificate| certificate.epoch()), lowest.epoch) {
        (Some(image), Some(device)) if image < device => Err(refused(&Refusal::Epoch { image, device })),
        _ => Ok(()),
    }
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
    let (number, why) = (refusal_number(refusal), format!("does not fit: {refusal}"));
    Error::NoProgram { number, why, advice: refusal.advice() }
}

/// Checks a stack that begins at the end of a chip's SRAM: whether the handoff is there depends on the
/// board, which the device's name (1008h) gives. Returns whether the device has told its name, or need
/// not.
fn admit_stack(session: &mut Session<'_>, program: &Program) -> Result<bool, Error> {
    let (image, start) = (program.image(), program.start());
    if StackAtEnd::of(image, start).is_none() {
        return Ok(true);
    }
    let Some(name) = told(session.read_text(Address::new(DEVICE_NAME, 0)))? else { return Ok(false) };
    let board = name.strip_prefix("coboot ").and_then(|name| layout::by_name(&name.to_lowercase()));
    judge(image, start, board).map_err(no_program)?;
    Ok(true)
}

fn admit_place(
    session: &mut Session<'_>,
    program: &Program,
    dialect: Dialect,
    number: u8,
) -> Result<bool, Error> {
    let Some(told) = program_region(session, number)? else { return Ok(false) };
    let region = AddressRange { first: told.base, last: told.last() };
    let (image, start, size) = (program.image(), program.start(), u64::from(program.size()));
    let fits = match dialect {
        // The CRC of the program counts from the region's start.
        Dialect::Block => program.check_region(region).is_ok(),
        Dialect::Hex | Dialect::EsAcademy if region.contains(&program.span()) => {
            // The data go to their own addresses: the vectors must be there.
            judge(image, region.first, None).map_err(no_program)?;
            true
        }
        Dialect::Hex | Dialect::EsAcademy => false,
        Dialect::Raw | Dialect::Lift if start == 0 => {
            if !is_data(dialect, number) {
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
        program: number,
        image: (start, u32::try_from(last).unwrap_or(u32::MAX)),
        region: (first, region.last),
    })
}

fn compare_identity(session: &mut Session<'_>, sub: u8, file: u32, what: Mismatch) -> Result<(), Error> {
    match told(session.read_number(Address::new(IDENTITY, sub)))? {
        Some(device) if device != file => {
            Err(Error::WrongTarget { node: session.node(), what, device, file })
        }
        _ => Ok(()),
    }
}

fn no_program(fault: Fault) -> Error {
    Error::NoProgram { number: Fault::NUMBER, why: fault.to_string(), advice: fault.advice() }
}
