//! What a dialect makes of the procedure.

use std::time::Duration;

use canopen::NodeId;

use crate::device::{DeviceType, Dialect, Error, Session};
use crate::update::content::Content;
use crate::update::course::Course;
use crate::update::event::{Note, Phase};
use crate::update::left::DeviceState;
use crate::update::options::FlashOptions;
use crate::update::steps;

/// The parts of an update that each dialect has its own way of, in their order.
pub(in crate::update) trait Procedure {
    /// Step 3: afterwards the bootloader is running. Gives what that speaks; it may tell more than
    /// the application did.
    ///
    /// # Errors
    /// [`Error::NoBootloader`], [`Error::NotInDialect`], and what opens the device not.
    fn enter(
        &self,
        session: &mut Session<'_>,
        running: DeviceType,
        options: &FlashOptions,
        course: &mut Course<'_>,
    ) -> Result<Dialect, Error>;

    /// Steps 4 to 14: afterwards the program is in the device, and starts with the next reset.
    ///
    /// # Errors
    /// What the device objects to.
    fn download(
        &self,
        session: &mut Session<'_>,
        file: Content<'_>,
        options: &FlashOptions,
        course: &mut Course<'_>,
    ) -> Result<Downloaded, Error>;

    /// Step 15: starts the program; afterwards the session is with the node that it runs as.
    /// `original` is the node that the update was begun with.
    ///
    /// # Errors
    /// [`Error::StartFailed`].
    fn start(&self, session: &mut Session<'_>, original: NodeId, number: u8) -> Result<DeviceType, Error> {
        let _ = original;
        steps::start(session, number)
    }
}

/// A program that is in its device.
pub(in crate::update) struct Downloaded {
    /// How often a block, or the whole of it, was sent again.
    pub(in crate::update) repeats: u32,
    /// How long the blocks took.
    pub(in crate::update) took: Duration,
    /// Whether it is released for autostart; `None` in a dialect that knows no release.
    pub(in crate::update) released: Option<bool>,
}

/// Asks an application for its bootloader as coboot's and SYS TEC's take it. Gives what the
/// bootloader speaks: what its device type says, unless the user has named it; otherwise `found`.
pub(super) fn enter_by_call(
    session: &mut Session<'_>,
    running: DeviceType,
    found: Dialect,
    options: &FlashOptions,
    course: &mut Course<'_>,
) -> Result<Dialect, Error> {
    let mut dialect = found;
    if !running.is_bootloader() {
        course.state = DeviceState::Called;
        course.tell(Phase::CallingBack.into());
        let running = steps::call_back(session)?;
        course.tell(Phase::InBootloader.into());
        if options.dialect.is_none() {
            dialect = Dialect::of_bootloader(running, session.node()).unwrap_or(found);
        }
    }
    course.tell(Note::Dialect { dialect }.into());
    Ok(dialect)
}
