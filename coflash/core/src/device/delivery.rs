//! Whether a device may leave production, by the state of its bootloader and its option bytes (2007h of
//! coboot).

use std::fmt;

use canopen::program::{DEVICE_STATE, STATE_BOOTLOADER, STATE_OPTION_BYTES, STATE_RENEWAL};
use canopen::Address;
use serde::{Serialize, Serializer};
use shared_abi::renewal::{Origin, Progress, State, TrialEnd};

use super::error::{reported, Error};
use super::option_bytes::OptionBytes;
use super::renewal::progress;
use super::session::Session;
use super::state::trial_end;

/// What a device reports about its delivery.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Delivery {
    /// Whether its bootloader can be renewed; `None` if it does not report that.
    pub renewal: Option<bool>,
    /// Its option bytes; `None` if it does not report them.
    pub option_bytes: Option<OptionBytes>,
    /// The reasons against its delivery.
    pub faults: Vec<Fault>,
    /// The objects that it does not report. An application has the number of its bootloader alone.
    pub unanswered: Vec<Address>,
}

/// A reason against the delivery of a device. `Display` says what to do, too.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// A bootloader runs on trial.
    OnTrial,
    /// Another bootloader waits for its trial, or has failed it.
    Staged(TrialEnd),
    /// The bootloader is confirmed, and not installed yet.
    Confirmed,
    /// The bootloader in its own place is damaged, and its spare runs.
    Damaged,
    /// SPRMOD is set.
    ReadProtection,
    /// BFB2 is set.
    SecondBank,
}

impl Fault {
    /// Its stable name for programs.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::OnTrial => "on_trial",
            Self::Staged(_) => "staged",
            Self::Confirmed => "confirmed",
            Self::Damaged => "damaged",
            Self::ReadProtection => "read_protection",
            Self::SecondBank => "second_bank",
        }
    }

    /// The fault in a state of a renewal.
    const fn of(progress: Progress) -> Option<Self> {
        match progress {
            Progress { origin: Origin::Spare, .. } => Some(Self::Damaged),
            Progress { state: State::Confirmed, .. } => Some(Self::Confirmed),
            Progress { origin: Origin::Trial, state: State::Staged | State::None, .. } => Some(Self::OnTrial),
            Progress { state: State::Staged, trial_end, .. } => Some(Self::Staged(trial_end)),
            // After its installation an image runs from staging until the next reset.
            Progress { state: State::None | State::Installed, .. } => None,
        }
    }
}

impl Serialize for Fault {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name())
    }
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::OnTrial => {
                "a bootloader runs on trial: coflash flash with its file confirms it, and a reset ends the trial"
            }
            Self::Staged(TrialEnd::None) => {
                "another bootloader waits for its trial: coflash flash with its file completes the renewal"
            }
            Self::Staged(end) => {
                return write!(
                    f,
                    "another bootloader waits in the device, and on trial it {}: coflash flash with a good one \
                     replaces it",
                    trial_end(*end)
                )
            }
            Self::Confirmed => {
                "its bootloader is confirmed and not installed: coflash flash with the file of that bootloader \
                 completes the renewal"
            }
            Self::Damaged => {
                "its bootloader is damaged, and the spare runs, which repairs it: switch the device off and on, and \
                 compare again; if it is still damaged, the flash is worn out or write-protected"
            }
            Self::ReadProtection => {
                "SPRMOD is set, so that nWRP protects against reading, and a 1 protects: clear it with a debug probe, \
                 which erases the chip"
            }
            Self::SecondBank => {
                "BFB2 is set, so that the chip may start from its second bank, where there is no bootloader: clear it \
                 with a debug probe"
            }
        })
    }
}

/// Reads what a device reports about its delivery. It changes nothing in the device.
///
/// # Errors
/// Those of a [read](Session::read); an object that the device does not have is no error.
pub fn delivery(session: &mut Session<'_>) -> Result<Delivery, Error> {
    let (mut faults, mut unanswered) = (Vec::new(), Vec::new());
    let mut number = |sub| {
        let at = Address::new(DEVICE_STATE, sub);
        let value = reported(session.read_number(at))?;
        if value.is_none() {
            unanswered.push(at);
        }
        Ok::<_, Error>(value)
    };
    // 0 stands for unknown.
    let option_bytes = number(STATE_OPTION_BYTES)?.filter(|value| *value != 0).map(OptionBytes);
    let renewal = number(STATE_BOOTLOADER)?.map(|number| number != 0);
    if option_bytes.is_some_and(OptionBytes::protects_from_reading) {
        faults.push(Fault::ReadProtection);
    }
    if option_bytes.is_some_and(OptionBytes::boots_from_bank_2) {
        faults.push(Fault::SecondBank);
    }
    if renewal == Some(true) {
        match reported(progress(session))?.flatten() {
            Some(progress) => faults.extend(Fault::of(progress)),
            // None, or a state of a later version.
            None => unanswered.push(Address::new(DEVICE_STATE, STATE_RENEWAL)),
        }
    }
    Ok(Delivery { renewal, option_bytes, faults, unanswered })
}
