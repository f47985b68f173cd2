//! The update of a device: the procedure of the manual (L-1112d_10, "Prinzipieller Ablauf"), steps
//! 2 to 15.
//!
//! Step 1, making the blocks, is [`convert`](crate::file::convert). Everything that can be judged
//! without the device was judged there.

use std::time::Duration;

use super::course::Course;
use super::dialect::{self, Downloaded};
use super::event::Event;
use super::options::FlashOptions;
use super::reach::reach;
use super::steps::compare_crc;
use crate::device::{flying_master, DeviceType, Dialect, Error, Session, Transfers};
use crate::file::BlockFile;

/// What an update did.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Report {
    /// Bytes of the program, from its region's start on.
    pub program_size: u32,
    /// CRC of the program in the device: what 1F56h reads.
    pub program_crc: u32,
    /// Blocks that had to be sent again.
    pub repeats: u32,
    /// How long all of it took, on the bus's clock.
    pub took: Duration,
    /// How long the blocks took.
    pub transfer: Duration,
    /// How the blocks were written at the end.
    pub transfers: Transfers,
    /// What runs now, if the program was started.
    pub running: Option<DeviceType>,
    /// The dialect that the device speaks.
    pub dialect: Dialect,
}

/// Puts a program into a device: finds out what runs there, calls the bootloader, erases, sends the
/// blocks, compares the CRC, and as the options say tries, signs and starts it.
///
/// A run that was interrupted at any point can be started again at once.
///
/// # Errors
/// The first step that fails ends the procedure. Until the program is signed, the device comes up
/// in the bootloader.
pub fn flash(
    session: &mut Session<'_>,
    file: &BlockFile,
    options: &FlashOptions,
    tell: &mut dyn FnMut(Event),
) -> Result<Report, Error> {
    let mut course = Course::new(tell);
    let result = procedure(session, file, options, &mut course);
    if let Some(taken) = course.mastership {
        // What became of the update stands, whatever becomes of this.
        if let Ok(master) = flying_master::give_back(session, taken) {
            course.tell(Event::MasterBack(master.map(|master| master.node)));
        }
    }
    if result.is_err() {
        course.tell(Event::Left(course.state));
    }
    result
}

/// [`flash`], but for what has to be done however it ends.
fn procedure(
    session: &mut Session<'_>,
    file: &BlockFile,
    options: &FlashOptions,
    course: &mut Course<'_>,
) -> Result<Report, Error> {
    let began = session.now();
    let original = session.node();
    let dialect = reach(session, options, course)?;
    let its = dialect::of(dialect);
    let Downloaded { repeats, took: transfer } = its.download(session, file, options, course)?;
    let running = if options.start {
        course.tell(Event::Starting);
        let running = its.start(session, original, options.program)?;
        course.tell(Event::Started(running));
        Some(running)
    } else {
        None
    };
    if options.verify {
        let crc = file.program_crc();
        compare_crc(session, options.program, crc)?;
        course.tell(Event::VerifiedAgain { crc });
    }
    let took = session.now().saturating_sub(began);
    let (program_size, program_crc) = (file.program_size(), file.program_crc());
    let transfers = session.transfers();
    Ok(Report { program_size, program_crc, repeats, took, transfer, transfers, running, dialect })
}
