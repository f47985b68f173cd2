//! Checks before the tool changes a device: whether the image can be a program, whether it is for
//! this device, and whether it is linked for the device's region.

use canopen::program::{DEVICE_NAME, IDENTITY};
use canopen::Address;
use seal::access::right;
use shared_abi::layout;

use super::dialect::is_data;
use super::options::FlashOptions;
use super::payload::{refusal_number, Payload};
use super::phase::Warning;
use super::steps::compare_target;
use crate::advice::Advice;
use crate::device::access::{challenge, security_of, takes_open, Challenge};
use crate::device::error::{reported, Error, IdentityPart};
use crate::device::region::program_region;
use crate::device::renewal;
use crate::device::{Dialect, Form, Session};
use crate::file::judge::{judge, judge_place, Fault, StackAtEnd};
use crate::file::sealed::{Refusal, SealedFile};
use crate::file::{AddressRange, Program};

/// The questions to a device before it is changed that are still open.
pub(super) struct Admission<'f> {
    /// The program: the sub-index of 1F50h.
    number: u8,
    /// Whether it is a sealed image that goes in blocks.
    is_sealed_in_blocks: bool,
    open: Vec<Question<'f>>,
}

/// What decides whether a device can take the content.
#[derive(Clone, Copy)]
enum Question<'f> {
    /// Whether it takes images that are not sealed.
    TakesOpen,
    /// Whether the image can be a program of its board.
    Image(&'f Program),
    /// Whether it is the device that the file names.
    Target(&'f Program),
    /// Whether the program is linked for its region.
    Place(&'f Program),
    /// Whether the sealed image is for this program of this device.
    Manifest(&'f SealedFile),
    /// Whether it takes sealed images, and this one is not too old.
    TakesSealed(&'f SealedFile),
    /// Whether the program has room in its region.
    Size(&'f SealedFile),
}

/// The questions to a device that is to get this file.
pub(super) fn questions<'f>(file: &'f Payload, dialect: Dialect, options: &FlashOptions) -> Admission<'f> {
    let number = options.program;
    let open = match file {
        // The renewal asks the bootloader itself.
        file if options.force || file.is_bootloader() => vec![],
        Payload::Program(program) if is_data(dialect, number) => {
            vec![Question::TakesOpen, Question::Place(program)]
        }
        Payload::Program(program) => vec![
            Question::TakesOpen,
            Question::Image(program),
            Question::Target(program),
            Question::Place(program),
        ],
        Payload::Sealed(file) => {
            vec![Question::Manifest(file), Question::TakesSealed(file), Question::Size(file)]
        }
        Payload::Bootloader(_) => vec![],
    };
    let is_sealed_in_blocks =
        matches!(file, Payload::Sealed(_)) && !file.is_bootloader() && options.blocks.is_some();
    Admission { number, is_sealed_in_blocks, open }
}

impl Admission<'_> {
    /// Checks what the dialect alone decides: the way in which the content is to be sent.
    ///
    /// # Errors
    /// [`Error::NotInDialect`].
    pub(super) fn judge(&self, dialect: Dialect) -> Result<(), Error> {
        let what = "a sealed image is sent in one download, not in blocks";
        match self.is_sealed_in_blocks && dialect != Dialect::Block {
            true => Err(Error::NotInDialect { dialect, what }),
            false => Ok(()),
        }
    }

    /// [Judges](Self::judge), and asks all that is open of what runs now, a bootloader or an
    /// application. If an application leaves an answer out, its bootloader is asked all that it
    /// knows better.
    ///
    /// # Errors
    /// [`Error::NotInDialect`], [`Error::NoProgram`], [`Error::WrongTarget`], [`Error::OtherRegion`],
    /// [`Error::SealedOnly`], and the errors of a [read](Session::read).
    pub(super) fn ask(&mut self, session: &mut Session<'_>, dialect: Dialect) -> Result<(), Error> {
        self.judge(dialect)?;
        let mut has_all = true;
        for question in &self.open {
            has_all &= question.is_answered(session, dialect, self.number)?;
        }
        self.open.retain(|question| !has_all && question.is_for_bootloader());
        Ok(())
    }
}

impl Question<'_> {
    /// Whether the answer of the bootloader counts more. Both have the same identity.
    fn is_for_bootloader(&self) -> bool {
        !matches!(self, Self::Target(_) | Self::Manifest(_))
    }

    /// Asks it; whether the device has answered.
    fn is_answered(self, session: &mut Session<'_>, dialect: Dialect, number: u8) -> Result<bool, Error> {
        match self {
            Self::TakesOpen => takes_open(session),
            Self::Image(program) => admit_image(session, program),
            Self::Target(program) => {
                // A value that the device does not report cannot differ.
                for target in program.targets().into_iter().flatten() {
                    compare_target(session, target, |session, at| reported(session.read_number(at)))?;
                }
                Ok(true)
            }
            Self::Place(program) => admit_place(session, program, dialect, number),
            Self::Manifest(file) => admit_manifest(session, file, number),
            Self::TakesSealed(file) => takes_sealed(session, file),
            Self::Size(file) => admit_size(session, file.head().size(), number),
        }
    }
}

/// Checks that a sealed image is for this program and this device.
fn admit_manifest(session: &mut Session<'_>, file: &SealedFile, program: u8) -> Result<bool, Error> {
    let head = file.head();
    if head.program() != program {
        return Err(refused(&Refusal::Program { image: head.program(), device: program }));
    }
    // 0 is a normal value here: it only matches a device with the identity 0.
    for (sub, file) in [(1, head.vendor_id()), (2, head.product_code())] {
        if let Some(device) =
            reported(session.read_number(Address::new(IDENTITY, sub)))?.filter(|it| *it != file)
        {
            return Err(Error::WrongTarget {
                node: session.node(),
                what: IdentityPart::of(sub),
                device,
                file,
            });
        }
    }
    Ok(true)
}

/// Checks what the bootloader reports and an application may not: whether the device accepts sealed
/// images, and of which age. Returns whether the device has reported it.
fn takes_sealed(session: &mut Session<'_>, file: &SealedFile) -> Result<bool, Error> {
    match reported(challenge(session))? {
        Some(challenge) if !challenge.is_sealed() => {
            let why = "cannot be installed: the device is not sealed and has no keys to check the image";
            Err(Error::NoProgram { number: Fault::NUMBER, why: why.to_string(), advice: Advice::Provision })
        }
        Some(challenge) => admit_age(session, file, &challenge).map(|()| true),
        None => Ok(false),
    }
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
fn admit_size(session: &mut Session<'_>, size: u32, program: u8) -> Result<bool, Error> {
    match program_region(session, program)? {
        None => Ok(false),
        Some(region) if size > region.size => {
            Err(refused(&Refusal::TooLarge { image: size, device: region.size }))
        }
        Some(_) => Ok(true),
    }
}

/// Whether the content reaches into staging: the last sector of the last program, of 128 KiB on
/// each chip that has it, in a device that can renew its bootloader. No program begins there.
pub(super) fn covers_staging(
    session: &mut Session<'_>,
    file: &Payload,
    program: u8,
) -> Result<Option<Warning>, Error> {
    const STAGING: u32 = 128 * 1024;
    if file.is_bootloader() || file.size() <= STAGING {
        return Ok(None);
    }
    let Some(region) = program_region(session, program)?.filter(|it| it.size > STAGING) else {
        return Ok(None);
    };
    // The bootloader has the number after the last program.
    let is_last = renewal::number(session)?.and_then(|number| number.checked_sub(1)) == Some(program);
    let first = region.last() - (STAGING - 1);
    Ok((is_last && file.size() > first - region.base).then_some(Warning::CoversStaging { first }))
}

fn refused(refusal: &Refusal) -> Error {
    let (number, why) = (refusal_number(refusal), format!("does not fit: {refusal}"));
    Error::NoProgram { number, why, advice: refusal.advice() }
}

/// Checks that the image can be a program. Whether the handoff is where a stack begins, at the end of a
/// chip's SRAM, depends on the board, which the device's name (1008h) gives. Returns whether the device has
/// told its name, or need not.
fn admit_image(session: &mut Session<'_>, program: &Program) -> Result<bool, Error> {
    let (image, start) = (program.image(), program.start());
    judge(image, start, None).map_err(no_program)?;
    if StackAtEnd::of(image, start).is_none() {
        return Ok(true);
    }
    let Some(name) = reported(session.read_text(Address::new(DEVICE_NAME, 0)))? else { return Ok(false) };
    let board = name.strip_prefix("coboot ").and_then(|name| layout::by_name(&name.to_lowercase()));
    judge(image, start, board).map_err(no_program)?;
    Ok(true)
}

/// Checks that the program is linked for its region; returns whether the device has reported it.
fn admit_place(
    session: &mut Session<'_>,
    program: &Program,
    dialect: Dialect,
    number: u8,
) -> Result<bool, Error> {
    let Some(reported) = program_region(session, number)? else { return Ok(false) };
    let region = AddressRange { first: reported.base, last: reported.last() };
    let (image, start, size) = (program.image(), program.start(), u64::from(program.size()));
    let fits = match dialect.form() {
        // The CRC of the program counts from the region's start.
        Form::Blocks => program.check_region(region).is_ok(),
        Form::Hex if region.contains(&program.span()) => {
            // The data go to their own addresses: the vectors must be there.
            judge(image, region.first, None).map_err(no_program)?;
            true
        }
        Form::Hex => false,
        Form::Image if start == 0 => {
            if !is_data(dialect, number) {
                judge_place(image, region).map_err(no_program)?;
            }
            size <= region.len()
        }
        Form::Image => start == region.first && size <= region.len(),
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

fn no_program(fault: Fault) -> Error {
    Error::NoProgram { number: Fault::NUMBER, why: fault.to_string(), advice: fault.advice() }
}
