//! The renewal of a device's bootloader, as the device reports it (2007h/1, /8, /9 and 2005h of coboot).

use std::fmt;

use canopen::program::{DEVICE_STATE, PROGRAM_VERSION, STATE_BOOTLOADER, STATE_RENEWAL, STATE_VERSIONS};
use canopen::Address;
use serde::ser::SerializeStruct as _;
use serde::{Serialize, Serializer};
use shared_abi::ram_image::Version;
use shared_abi::renewal::{Origin, Progress, State, TrialEnd};

use super::error::{reported, Error};
use super::session::Session;
use super::state::trial_end;
use crate::advice::Advice;

/// What a device reports about its bootloader.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Bootloader {
    /// Its program number: sub-index of 1F50h, 1F51h, 1F56h and 1F57h.
    pub number: u8,
    /// The version of its RAM image.
    pub version: Version,
    /// What it reports itself; `None` while an application runs.
    pub running: Option<Running>,
}

/// What a bootloader that runs reports about itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Running {
    /// The version of the services of its resident part.
    pub services: u32,
    /// The state of a renewal.
    pub progress: Progress,
}

/// The program number of a device's bootloader; `None` if that cannot be renewed, or an application does
/// not report it.
///
/// # Errors
/// Those of a [read](Session::read).
pub fn number(session: &mut Session<'_>) -> Result<Option<u8>, Error> {
    let number = reported(session.read_number(Address::new(DEVICE_STATE, STATE_BOOTLOADER)))?;
    Ok(number.and_then(|number| u8::try_from(number).ok()).filter(|number| *number != 0))
}

/// What an application reports about the bootloader with this number, which does not run.
///
/// # Errors
/// Those of a [read](Session::read).
pub fn asleep(session: &mut Session<'_>, number: u8) -> Result<Option<Bootloader>, Error> {
    let version = reported(session.read_number(Address::new(PROGRAM_VERSION, number)))?;
    Ok(version.map(|version| Bootloader { number, version: Version(version), running: None }))
}

/// Reads what a bootloader reports about itself; `None` if it cannot be renewed, or an application runs.
///
/// # Errors
/// Those of a [read](Session::read).
pub fn bootloader(session: &mut Session<'_>) -> Result<Option<Bootloader>, Error> {
    let Some(number) = number(session)? else { return Ok(None) };
    let versions = reported(session.read(Address::new(DEVICE_STATE, STATE_VERSIONS)))?.unwrap_or_default();
    let word = |at: usize| {
        let bytes = versions.get(at..at + 4).and_then(|bytes| bytes.try_into().ok());
        bytes.map_or(0, u32::from_le_bytes)
    };
    let running = Running { services: word(4), progress: progress(session)?.unwrap_or_default() };
    Ok(Some(Bootloader { number, version: Version(word(0)), running: Some(running) }))
}

/// 2007h/9; `None` for a state of a later version.
///
/// # Errors
/// Those of a [read](Session::read).
pub fn progress(session: &mut Session<'_>) -> Result<Option<Progress>, Error> {
    let word = session.read_number(Address::new(DEVICE_STATE, STATE_RENEWAL))?;
    Ok(Progress::from_bytes(word.to_le_bytes()))
}

impl Bootloader {
    /// The advice in its text, if there is any.
    #[must_use]
    pub fn advice(&self) -> Option<Advice> {
        let progress = self.running?.progress;
        let is_on_trial = progress.state == State::Staged && progress.origin == Origin::Trial;
        is_on_trial.then_some(Advice::ConfirmIt)
    }
}

impl fmt::Display for Bootloader {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { number, version, running } = self;
        let Some(Running { services, progress: Progress { state, origin, trial_end: end } }) = running else {
            return write!(f, "version {version}, renewed as program {number}");
        };
        write!(f, "version {version}, services {services}, renewed as program {number}")?;
        match (state, origin) {
            (State::None, _) => {}
            (State::Staged, Origin::Trial) => {
                write!(f, "; it is on trial: {}", Advice::ConfirmIt)?;
            }
            (State::Staged, _) => f.write_str("; another one waits for its trial")?,
            (_, Origin::Spare) => f.write_str("; its place was damaged, and is being repaired")?,
            (State::Confirmed, _) => f.write_str("; it is confirmed, and not installed yet")?,
            (State::Installed, _) => f.write_str("; a spare of it is in the flash of the last program")?,
        }
        match end {
            TrialEnd::None => Ok(()),
            end => write!(f, "; the last one on trial {}", trial_end(*end)),
        }
    }
}

impl Serialize for Bootloader {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let fields = if self.running.is_some() { 6 } else { 2 };
        let mut fields = serializer.serialize_struct("Bootloader", fields)?;
        fields.serialize_field("number", &self.number)?;
        fields.serialize_field("version", &self.version.0)?;
        let Some(Running { services, progress }) = self.running else { return fields.end() };
        let Progress { state, origin, trial_end: end } = progress;
        fields.serialize_field("services", &services)?;
        fields.serialize_field(
            "state",
            match state {
                State::None => "none",
                State::Staged => "staged",
                State::Confirmed => "confirmed",
                State::Installed => "installed",
            },
        )?;
        fields.serialize_field(
            "from",
            match origin {
                Origin::Home => "home",
                Origin::Trial => "trial",
                Origin::Confirmed => "staging",
                Origin::Spare => "spare",
            },
        )?;
        let end = (end != TrialEnd::None).then(|| trial_end(end));
        fields.serialize_field("last_trial", &end)?;
        fields.end()
    }
}
