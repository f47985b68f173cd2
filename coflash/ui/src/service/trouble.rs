//! Which message an error has: what a person at the machine can do about it.

use canopen::program::ProgramState;
use coflash_core::device::error::TrialFailure;
use coflash_core::device::{Doing, Error};
use coflash_core::machine::{Bad, DeviceFault, Missing, Outcome};
use coflash_core::update::{DeviceAfterUpdate, DeviceAnswer, DeviceState};

use super::message::Message;

/// The message of an error.
pub(super) fn of_error(error: &Error) -> Message {
    let key = match error {
        Error::Adapter(_) | Error::NoVerdict { .. } => "trouble-adapter",
        Error::Cancelled => "trouble-cancelled",
        Error::NoAnswer { .. } | Error::ShortAnswer { .. } => "trouble-no-answer",
        Error::NoPassword { .. } => "trouble-password",
        Error::Refused { doing: Doing::Unlock, .. } => "trouble-wrong-password",
        Error::Refused { .. } | Error::Failed { .. } | Error::Protocol { .. } => "trouble-refused",
        Error::Busy { .. } => "trouble-busy",
        Error::WrongTarget { .. }
        | Error::SealedOnly { .. }
        | Error::NoProgram { .. }
        | Error::OtherRegion { .. }
        | Error::OtherIdentity { .. }
        | Error::NotInDialect { .. } => "trouble-other-device",
        Error::NotAlone { .. } | Error::Occupied { .. } => "trouble-not-alone",
        error if error.refuses_now() => "trouble-refuses-now",
        // Its program runs.
        Error::NoBootloader { .. } | Error::TrialFailed { how: TrialFailure::Stays(_), .. } => {
            "trouble-stays"
        }
        Error::TrialFailed { .. }
        | Error::StartFailed { .. }
        | Error::ProgramEnded { .. }
        | Error::FellSilent { .. } => "trouble-no-start",
        Error::NotRenewable { .. }
        | Error::RenewalFailed { .. }
        | Error::SilentOnTrial { .. }
        | Error::Unconfirmable { .. }
        | Error::FirstFailed { .. } => "trouble-renewal",
        Error::WrongCrc { .. } => "trouble-crc",
        Error::Lss { .. } => "trouble-other",
    };
    Message::new(key).detail(error).number(error.number())
}

/// The message of a device that was not begun.
pub(super) fn of_device(fault: &DeviceFault) -> Message {
    let message = match fault {
        DeviceFault::Absent { .. } => Message::new("trouble-absent"),
        DeviceFault::Mute { .. } => Message::new("trouble-mute"),
        DeviceFault::TooFew { program, expected, found } => Message::new("trouble-too-few")
            .value("program", program)
            .value("expected", expected)
            .value("found", found),
        DeviceFault::OtherDevice { .. } => Message::new("trouble-other-device"),
        DeviceFault::Exchanged { .. } => Message::new("trouble-exchanged"),
        DeviceFault::EarlierFailed { .. } => Message::new("trouble-earlier"),
        // The library may have more of them one day.
        _ => Message::new("trouble-other"),
    };
    message.detail(fault).number(fault.number())
}

/// The message of what is missing, with the node-ID and the program: a report has it without its row.
pub(super) fn of_missing(missing: &Missing) -> Message {
    let message = of_device(&missing.fault);
    match missing.node {
        Some(node) => message.value("node", node).value("program", &missing.program),
        // Its message has the program.
        None => message,
    }
}

/// Whether a device was not updated because its password is missing or wrong.
pub(super) fn is_locked(outcome: &Outcome) -> bool {
    let Err(Bad::Failed(failed)) = &outcome.result else { return false };
    matches!(failed.error, Error::NoPassword { .. } | Error::Refused { doing: Doing::Unlock, .. })
}

/// The message of a bad outcome, and the key of what is in the device now, if it was begun.
pub(super) fn of_outcome(bad: &Bad) -> (Message, Option<&'static str>) {
    match bad {
        Bad::Left(fault) => (of_device(fault), None),
        Bad::Failed(failed) => {
            let message =
                of_error(&failed.error).detail(format!("{}. The device: {}", failed.error, failed.left));
            (message, Some(left(failed.left)))
        }
    }
}

fn left(after: DeviceAfterUpdate) -> &'static str {
    // The device's own answer counts.
    let is_empty = matches!(after.answer, DeviceAnswer::Given(answers)
        if answers.crc == Some(0) || answers.control == Some(ProgramState::Absent as u32));
    match after.state {
        DeviceState::Called | DeviceState::Postponed if is_empty => "left-none",
        DeviceState::Untouched => "left-untouched",
        DeviceState::OtherChanged => "left-other",
        DeviceState::Called | DeviceState::Renewed => "left-old",
        DeviceState::Postponed | DeviceState::Begun => "left-unknown",
        DeviceState::Erased => "left-none",
        DeviceState::Written | DeviceState::Unreleased | DeviceState::Released => "left-new",
    }
}
