//! Checks whether a device holds the program of a sealed image, from the device's answers: its
//! identity, its keys, CRC and version of the program, and its event log.
//!
//! The answers come from the device's own software. A device with foreign software may give any
//! answers.

use std::fmt;

use canopen::program::{ProgramState, ACCESS, EVENTS};
use canopen::program::{IDENTITY, PROGRAM_CONTROL, PROGRAM_ID, PROGRAM_VERSION};
use canopen::Address;
use seal::access::event;
use serde::Serialize;
use shared_abi::block_file::ProgramVersion;

use crate::device::access::{challenge, events};
use crate::device::error::{reported, Error};
use crate::device::{DeviceType, Session};
use crate::file::sealed::show::digits;
use crate::file::sealed::SealedFile;

/// The result of comparing a device with a sealed image.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Comparison {
    /// The device type of what runs: the bootloader or an application.
    pub running: DeviceType,
    /// Whether the program runs.
    pub runs: bool,
    /// The differences between device and file. If there is none, the device holds the program,
    /// according to its own answers.
    pub differences: Vec<Difference>,
    /// The objects that the device does not have, and that could therefore not be compared. An
    /// application may lack objects that the bootloader has.
    pub unanswered: Vec<Address>,
}

/// A difference between device and file.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Difference {
    /// The compared property.
    pub what: Part,
    /// The file's value.
    pub file: String,
    /// The device's value.
    pub device: String,
}

/// The compared properties.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Part {
    /// 1018h/1.
    VendorId,
    /// 1018h/2.
    ProductCode,
    /// 1018h/3, low 5 bits.
    Hardware,
    /// The unique ID of the chip, in 2002h/1.
    UniqueId,
    /// Whether the device has keys: bit 31 of the last word of 2002h/1.
    Keys,
    /// 1F56h.
    Crc,
    /// 2005h.
    Version,
    /// The security counter of this program's last installation in 2003h.
    InstalledCounter,
    /// The version of this program's last installation in 2003h.
    InstalledVersion,
}

impl fmt::Display for Part {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::VendorId => "vendor-ID (1018h/1)",
            Self::ProductCode => "product code (1018h/2)",
            Self::Hardware => "hardware revision (1018h/3)",
            Self::UniqueId => "unique ID (2002h/1)",
            Self::Keys => "keys (2002h/1)",
            Self::Crc => "CRC of the program (1F56h)",
            Self::Version => "version of the program (2005h)",
            Self::InstalledCounter => "security counter of the last installation (2003h)",
            Self::InstalledVersion => "version of the last installation (2003h)",
        })
    }
}

impl fmt::Display for Difference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { what, file, device } = self;
        write!(f, "{what}: the file has {file}, the device {device}")
    }
}

impl Comparison {
    /// Whether no reported value differs.
    #[must_use]
    pub fn is_same(&self) -> bool {
        self.differences.is_empty()
    }

    fn differs(&mut self, what: Part, file: impl Into<String>, device: impl Into<String>) {
        self.differences.push(Difference { what, file: file.into(), device: device.into() });
    }

    fn compare<T: PartialEq>(&mut self, what: Part, file: T, device: T, words: impl Fn(T) -> String) {
        if file != device {
            self.differs(what, words(file), words(device));
        }
    }
}

/// Compares a device's answers with a sealed image, in the bootloader or in an application. Changes
/// nothing in the device.
///
/// # Errors
/// [`Error::NoAnswer`] and the like; an object that the device does not have is no error.
pub fn compare_sealed(session: &mut Session<'_>, file: &SealedFile) -> Result<Comparison, Error> {
    let head = file.head();
    let program = head.program();
    let running = session.find()?;
    let mut comparison = Comparison { running, runs: false, differences: Vec::new(), unanswered: Vec::new() };
    let mut number = |comparison: &mut Comparison, at: Address| -> Result<Option<u32>, Error> {
        let value = reported(session.read_number(at))?;
        if value.is_none() {
            comparison.unanswered.push(at);
        }
        Ok(value)
    };

    for (sub, what, said) in
        [(1, Part::VendorId, head.vendor_id()), (2, Part::ProductCode, head.product_code())]
    {
        if let Some(device) = number(&mut comparison, Address::new(IDENTITY, sub))? {
            comparison.compare(what, said, device, hexadecimal);
        }
    }
    if head.hardware() != 0 {
        if let Some(device) = number(&mut comparison, Address::new(IDENTITY, 3))? {
            if head.hardware() >> (device & 31) & 1 == 0 {
                comparison.differs(
                    Part::Hardware,
                    format!("the mask {:08X}h", head.hardware()),
                    hexadecimal(device),
                );
            }
        }
    }
    comparison.runs = number(&mut comparison, Address::new(PROGRAM_CONTROL, program))?
        == Some(ProgramState::Running as u32);
    match number(&mut comparison, Address::new(PROGRAM_ID, program))? {
        Some(0) if head.crc() != 0 => comparison.differs(Part::Crc, hexadecimal(head.crc()), "no program"),
        Some(device) => comparison.compare(Part::Crc, head.crc(), device, hexadecimal),
        // No other object identifies the program.
        None => comparison.differs(Part::Crc, hexadecimal(head.crc()), "reports none"),
    }
    if let Some(device) = number(&mut comparison, Address::new(PROGRAM_VERSION, program))? {
        comparison.compare(Part::Version, head.version(), device, release);
    }
    compare_access(session, file, &mut comparison)?;
    compare_events(session, file, &mut comparison)?;
    Ok(comparison)
}

/// 2002h: compares the unique ID, and checks whether the device is sealed.
fn compare_access(
    session: &mut Session<'_>,
    file: &SealedFile,
    comparison: &mut Comparison,
) -> Result<(), Error> {
    match reported(challenge(session))? {
        Some(challenge) => {
            let only_for = file.head().unique_id();
            if only_for != [0; 12] {
                comparison.compare(Part::UniqueId, only_for, challenge.unique_id(), |id| digits(&id));
            }
            if !challenge.is_sealed() {
                comparison.differs(Part::Keys, "a signature to be checked", "is not sealed and has no keys");
            }
        }
        None if comparison.running.is_bootloader() => {
            let device = "has a bootloader without support for sealed images";
            comparison.differs(Part::Keys, "a signature to be checked", device);
        }
        None => comparison.unanswered.push(Address::new(ACCESS, 1)),
    }
    Ok(())
}

/// 2003h: compares the last installation of this program. An installation that is not among the
/// last eight events counts as not reported.
fn compare_events(
    session: &mut Session<'_>,
    file: &SealedFile,
    comparison: &mut Comparison,
) -> Result<(), Error> {
    let head = file.head();
    let installed = event::INSTALLED | u32::from(head.program());
    let last =
        reported(events(session))?.unwrap_or_default().into_iter().find(|event| event.what == installed);
    match last {
        Some(last) => {
            comparison
                .compare(Part::InstalledCounter, head.counter(), last.counter, |number| number.to_string());
            comparison.compare(Part::InstalledVersion, head.version(), last.version, release);
        }
        None => comparison.unanswered.push(Address::new(EVENTS, 1)),
    }
    Ok(())
}

fn hexadecimal(number: u32) -> String {
    format!("{number:08X}h")
}

fn release(version: u32) -> String {
    ProgramVersion(version).to_string()
}
