//! What a device reports about itself.

use std::fmt;

use canopen::program::{self, FlashStatus, ProgramState};
use canopen::Address;
use serde::ser::SerializeStruct as _;
use serde::{Serialize, Serializer};
use shared_abi::block_file::ProgramVersion;

use super::access::{security, Security};
use super::device_type::DeviceType;
use super::dialect::Dialect;
use super::error::{detail_words, failure_words, reported, Error};
use super::read_state::read_state;
use super::recognise::recognise;
use super::renewal::{self, Bootloader};
use super::session::Session;
use super::state::{supply, BootloaderState};
use crate::advice::Advice;
use crate::json;

/// What a device reports about itself; `None` for an object that it does not have.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct DeviceInfo {
    /// Its node-ID.
    #[serde(serialize_with = "json::node")]
    pub node: canopen::NodeId,
    /// 1000h: bootloader or application.
    #[serde(flatten)]
    pub device_type: DeviceType,
    /// 1001h, error register.
    pub error_register: Option<u32>,
    /// 1008h, device name.
    pub name: Option<String>,
    /// 1009h, hardware version.
    pub hardware_version: Option<String>,
    /// 100Ah, software version.
    pub software_version: Option<String>,
    /// 1018h/1 to 4: vendor-ID, product code, revision, serial number.
    #[serde(flatten, serialize_with = "identity_fields")]
    pub identity: Identity,
    /// The dialect of its bootloader, as far as it can be detected; `None` for a device without
    /// programs.
    pub dialect: Option<Dialect>,
    /// Its programs, from number 1 on.
    pub programs: Vec<ProgramInfo>,
    /// What it reports about sealed images (2002h, 2003h). An application need not have these objects.
    pub security: Option<Security>,
    /// 2007h: why it stays in its bootloader; `None` for an application.
    pub state: Option<BootloaderState>,
    /// 2007h: its bootloader, if that can be renewed. (`bootloader` says for programs whether the
    /// bootloader runs.)
    #[serde(rename = "renewal")]
    pub bootloader: Option<Bootloader>,
}

/// The data that the user sees before an update (CiA 814-1 clause 6.3): 1008h, 1009h, 100Ah and
/// 1018h. `Display` shows them in one line.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct Nameplate {
    /// 1008h, device name.
    pub name: Option<String>,
    /// 1009h, hardware version.
    pub hardware_version: Option<String>,
    /// 100Ah, software version.
    pub software_version: Option<String>,
    /// 1018h/1 to 4.
    #[serde(flatten, serialize_with = "identity_fields")]
    pub identity: Identity,
}

/// 1018h/1 to 4: vendor-ID, product code, revision, serial number; `None` for a value that the
/// device does not report.
pub type Identity = [Option<u32>; 4];

/// The parts of the identity under their names.
pub(crate) fn identity_fields<S: Serializer>(identity: &Identity, serializer: S) -> Result<S::Ok, S::Error> {
    let names = ["vendor_id", "product_code", "revision", "serial_number"];
    let mut fields = serializer.serialize_struct("Identity", names.len())?;
    for (name, part) in names.into_iter().zip(identity) {
        fields.serialize_field(name, part)?;
    }
    fields.end()
}

/// What a device reports about one of its programs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct ProgramInfo {
    /// Sub-index of 1F51h, 1F56h and 1F57h.
    pub number: u8,
    /// 1F51h: 0 stopped, 1 running.
    pub control: Option<u32>,
    /// 1F56h: CRC of the program.
    pub crc: Option<u32>,
    /// 2005h of coboot: version of the stored program, 0 if unknown.
    pub version: Option<u32>,
    /// 2007h/12 of coboot: whether it is released for autostart; `None` from an application.
    pub released: Option<bool>,
    /// 1F57h.
    #[serde(serialize_with = "json::status")]
    pub status: Option<FlashStatus>,
}

impl ProgramInfo {
    /// Whether there is a program, and whether it runs, as far as the device reports it: some
    /// devices report a missing program in 1F51h, others by a CRC of 0.
    #[must_use]
    pub const fn state(&self) -> Option<ProgramState> {
        const STOPPED: u32 = ProgramState::Stopped as u32;
        const RUNNING: u32 = ProgramState::Running as u32;
        const ABSENT: u32 = ProgramState::Absent as u32;
        match (self.control, self.crc) {
            (Some(RUNNING), _) => Some(ProgramState::Running),
            (Some(ABSENT), _) | (Some(STOPPED), Some(0)) => Some(ProgramState::Absent),
            (Some(STOPPED), _) => Some(ProgramState::Stopped),
            _ => None,
        }
    }

    /// The version of the stored program, if the device reports one.
    #[must_use]
    pub fn release(&self) -> Option<ProgramVersion> {
        self.version.filter(|version| *version != 0).map(ProgramVersion)
    }
}

impl DeviceInfo {
    /// What to do with a device that is in its bootloader, if that is known.
    #[must_use]
    pub fn advice(&self) -> Option<Advice> {
        let has_one = |program: &&ProgramInfo| program.state() != Some(ProgramState::Absent);
        let mut programs = self.programs.iter().filter(has_one);
        let any = programs.clone().next();
        // What starts is one that is released, and of a single one nothing else can be meant.
        let program = programs.find(|program| program.released == Some(true)).or(any);
        self.state?.advice(program.map_or(1, |program| program.number))
    }
}

/// Reads all of a device's information.
///
/// # Errors
/// [`Error::NoAnswer`] and others. An object that the device refuses, or about which it says nothing,
/// is not an error: it is not reported.
pub fn info(session: &mut Session<'_>) -> Result<DeviceInfo, Error> {
    let device_type = session.find()?;
    let Nameplate { name, hardware_version, software_version, identity } = nameplate(session)?;
    let mut number = |index, sub| cell(session, |session| session.read_number(Address::new(index, sub)));
    let error_register = number(program::ERROR_REGISTER, 0)?;
    // The highest sub-index is the number of programs; a device without the object has none.
    let count = number(program::PROGRAM_CONTROL, 0)?.map_or(0, |count| count.min(254) as u8);
    let of_bootloader = cell(session, renewal::number)?.flatten();
    let bootloader = match of_bootloader {
        None => None,
        Some(_) if device_type.is_bootloader() => cell(session, renewal::bootloader)?.flatten(),
        Some(number) => cell(session, |session| renewal::asleep(session, number))?.flatten(),
    };
    let is_program = |number: &u8| of_bootloader.is_none_or(|bootloader| bootloader > *number);
    let mut programs = Vec::new();
    for number in (1..=count).filter(is_program) {
        programs.push(program_info(session, number)?);
    }
    let dialect = match count {
        0 => Dialect::of_bootloader(device_type, session.node()),
        _ => cell(session, |session| recognise(session, device_type, 1))?,
    };
    let security = cell(session, security)?.flatten();
    let state = if device_type.is_bootloader() { cell(session, read_state)?.flatten() } else { None };
    for program in &mut programs {
        let has_one = program.state() != Some(ProgramState::Absent);
        program.released = state.and_then(|state| state.is_released(program.number)).filter(|_| has_one);
    }
    Ok(DeviceInfo {
        node: session.node(),
        device_type,
        error_register,
        name,
        hardware_version,
        software_version,
        identity,
        dialect,
        programs,
        security,
        state,
        bootloader,
    })
}

/// Reads what a device need not have. Some devices do not answer at all for an object that they do not
/// have: one that then still answers for its device type does not report it.
fn cell<T>(
    session: &mut Session<'_>,
    read: impl FnOnce(&mut Session<'_>) -> Result<T, Error>,
) -> Result<Option<T>, Error> {
    match reported(read(session)) {
        Err(error @ Error::NoAnswer { .. }) => match session.device_type()? {
            Some(_) => Ok(None),
            None => Err(error),
        },
        reported => reported,
    }
}

/// Reads a device's name, versions and identity.
///
/// # Errors
/// As [`info`].
pub fn nameplate(session: &mut Session<'_>) -> Result<Nameplate, Error> {
    let mut text = |index| cell(session, |session| session.read_text(Address::new(index, 0)));
    let name = text(program::DEVICE_NAME)?;
    let hardware_version = text(program::HARDWARE_VERSION)?;
    let software_version = text(program::SOFTWARE_VERSION)?;
    Ok(Nameplate { name, hardware_version, software_version, identity: identity(session)? })
}

/// Reads a device's identity.
///
/// # Errors
/// As [`info`].
pub fn identity(session: &mut Session<'_>) -> Result<Identity, Error> {
    let mut identity = [None; 4];
    for (sub, value) in (1..).zip(&mut identity) {
        let at = Address::new(program::IDENTITY, sub);
        *value = cell(session, |session| session.read_number(at))?;
    }
    Ok(identity)
}

/// Reads the information about one of a device's programs.
///
/// # Errors
/// As [`info`].
pub fn program_info(session: &mut Session<'_>, program: u8) -> Result<ProgramInfo, Error> {
    let mut number = |index| reported(session.read_number(Address::new(index, program)));
    let control = number(program::PROGRAM_CONTROL)?;
    let crc = number(program::PROGRAM_ID)?;
    let status = number(program::FLASH_STATUS)?.map(FlashStatus::from_word);
    let version = number(program::PROGRAM_VERSION)?;
    Ok(ProgramInfo { number: program, control, crc, version, released: None, status })
}

const NOT_REPORTED: &str = "not reported";

/// A text that a device need not have, in words.
fn text(value: Option<&str>) -> &str {
    value.unwrap_or(NOT_REPORTED)
}

/// A part of an identity in words.
pub(crate) fn hex(part: Option<u32>) -> String {
    part.map_or(NOT_REPORTED.to_owned(), |part| format!("{part:08X}h"))
}

impl fmt::Display for DeviceInfo {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [vendor, product, revision, serial] = self.identity.map(hex);
        writeln!(f, "node {}: {}", self.node, self.device_type)?;
        for (name, value) in [
            ("device name", text(self.name.as_deref())),
            ("hardware version", text(self.hardware_version.as_deref())),
            ("software version", text(self.software_version.as_deref())),
            ("vendor-ID", &vendor),
            ("product code", &product),
            ("revision", &revision),
            ("serial number", &serial),
            (
                "error register",
                &match self.error_register {
                    None => NOT_REPORTED.to_string(),
                    Some(0) => "00h (no error)".to_string(),
                    Some(bits) => format!("{bits:02X}h"),
                },
            ),
            ("dialect", &self.dialect.map_or(NOT_REPORTED.to_string(), |dialect| dialect.to_string())),
        ] {
            writeln!(f, "  {name:<17} {value}")?;
        }
        if let Some(security) = &self.security {
            writeln!(f, "  {:<17} {security}", "sealed")?;
        }
        if let Some(state) = &self.state {
            writeln!(f, "  {:<17} {state}", "state")?;
            if let Some(words) = state.last_reset() {
                writeln!(f, "  {:<17} {words}", "last reset")?;
            }
            if let Some(advice) = self.advice() {
                writeln!(f, "  {:<17} {advice}", "what to do")?;
            }
            if let Some(words) = supply(state.supply) {
                writeln!(f, "  {:<17} {words}", "supply")?;
            }
            if let Some(options) = state.option_bytes {
                writeln!(f, "  {:<17} {options}", "option bytes")?;
                for warning in options.warnings() {
                    writeln!(f, "  {:<17} {warning}", "  warning")?;
                }
            }
        }
        if let Some(bootloader) = &self.bootloader {
            writeln!(f, "  {:<17} {bootloader}", "bootloader")?;
        }
        self.programs.iter().try_for_each(|program| write!(f, "{program}"))
    }
}

impl fmt::Display for Nameplate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [vendor, product, revision, serial] = self.identity.map(hex);
        write!(
            f,
            "{}, hardware {}, software {}, vendor-ID {vendor}, product code {product}, revision {revision}, \
             serial number {serial}",
            text(self.name.as_deref()),
            text(self.hardware_version.as_deref()),
            text(self.software_version.as_deref())
        )
    }
}

impl fmt::Display for ProgramInfo {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        const STOPPED: u32 = ProgramState::Stopped as u32;
        const RUNNING: u32 = ProgramState::Running as u32;
        const ABSENT: u32 = ProgramState::Absent as u32;
        writeln!(f, "  program {}", self.number)?;
        match self.control {
            None => {}
            Some(STOPPED) => writeln!(f, "    state           stopped")?,
            Some(RUNNING) => writeln!(f, "    state           running")?,
            Some(ABSENT) => writeln!(f, "    state           there is none")?,
            Some(other) => writeln!(f, "    state           {other:02X}h")?,
        }
        if let Some(crc) = self.crc {
            writeln!(f, "    CRC             {crc:08X}h")?;
        }
        if let Some(version) = self.release() {
            writeln!(f, "    version         {version}")?;
        }
        if let Some(released) = self.released {
            writeln!(f, "    released        {}", if released { "yes" } else { "no" })?;
        }
        if let Some(status) = self.status {
            write!(f, "    status          ")?;
            match status.error {
                None => f.write_str("ok")?,
                Some(error) => {
                    write!(f, "{} ({:02X}h)", failure_words(error, status.detail), error.code())?;
                }
            }
            let detail = detail_words(status.error, status.detail);
            writeln!(f, "{detail}{}", if status.busy { ", busy" } else { "" })?;
        }
        Ok(())
    }
}
