//! The advice for an error.

use canopen::program::FlashError;
use canopen::program::{ACCESS, EVENTS};
use canopen::AbortCode;

use coboot_can::AdapterError;
use shared_abi::boot_report::Reason;
use shared_abi::handoff::ResetCause;

use super::{absent, Error, LssFailure, TrialFailure, LOW_SUPPLY};
use crate::advice::Advice;
use crate::device::doing::{Doing, LssDoing};
use crate::device::state::BootloaderState;

/// An application that refuses with one of these does so in its present state (CiA 301 table 22).
const DEVICE_STATE: AbortCode = AbortCode::DEVICE_STATE;
const LOCAL_CONTROL: AbortCode = AbortCode::LOCAL_CONTROL;

impl Error {
    /// What to do next.
    #[must_use]
    pub fn advice(&self) -> Advice {
        match self {
            Self::Adapter(error) => error.into(),
            Self::Cancelled => Advice::Continue,
            Self::NoAnswer { node, .. } => Advice::Reach { node: *node },
            Self::ShortAnswer { .. } => Advice::ShortAnswer,
            Self::Refused { doing: Doing::Unlock, code, .. } => unlock_advice(*code),
            Self::Refused { doing: Doing::Read(at) | Doing::Write(at), code, .. }
                if at.index == canopen::debugger::DEBUGGER =>
            {
                debugger_advice(*code)
            }
            Self::Refused { doing: Doing::Read(at) | Doing::Write(at), code, .. }
                if matches!(at.index, ACCESS | EVENTS) && absent(*code) =>
            {
                Advice::CallBootloader
            }
            Self::Refused { code, .. } => refusal_advice(*code),
            Self::NotInDialect { .. } => Advice::OtherDialect,
            Self::NoPassword { .. } => Advice::GivePassword,
            Self::Occupied { node } => Advice::Occupied { node: *node },
            Self::NotAlone { .. } => Advice::NotAlone,
            Self::Protocol { .. } => Advice::InvalidAnswer,
            Self::Failed { error: FlashError::Crc, doing: Doing::Block(0), .. } => Advice::OtherCrc,
            Self::Failed { error: FlashError::Secured, detail: sector @ 1.., .. } => {
                Advice::Unprotect { sector: *sector }
            }
            Self::Failed { error: FlashError::NotCleared, detail: program @ 1.., .. } => {
                Advice::ClearFirst { program: *program }
            }
            Self::Failed { doing: Doing::Bootloader, error: FlashError::Format, .. } => {
                Advice::OtherBootloader
            }
            Self::Failed { error: FlashError::NoAccess, detail: LOW_SUPPLY, .. } => Advice::Supply,
            Self::Failed { error, .. } => failure_advice(*error),
            Self::NotRenewable { .. } => Advice::NotRenewable,
            Self::Unconfirmable { .. } => Advice::Unconfirmable,
            Self::FirstFailed { first } => Advice::FirstFailed { first: *first },
            Self::RenewalFailed { .. } => Advice::RenewalFailed,
            Self::SilentOnTrial { .. } => Advice::SilentOnTrial,
            Self::WrongTarget { what, .. } => failure_advice(what.error()),
            Self::SealedOnly { .. } => Advice::Seal,
            Self::NoProgram { advice, .. } => advice.clone(),
            Self::OtherRegion { .. } => Advice::OtherRegion,
            Self::OtherIdentity { .. } => Advice::OtherIdentity,
            Self::Busy { .. } => Advice::StaysBusy,
            Self::NoBootloader { elsewhere: Some(other), .. } => {
                Advice::BootloaderElsewhere { other: *other }
            }
            Self::NoBootloader { node, code: Some(DEVICE_STATE | LOCAL_CONTROL), .. }
            | Self::TrialFailed { node, how: TrialFailure::Stays(Some(DEVICE_STATE | LOCAL_CONTROL)) } => {
                Advice::RefusesNow { node: *node }
            }
            Self::NoBootloader { code: Some(code), .. } => call_advice(*code),
            Self::NoBootloader { .. } => Advice::Catch,
            Self::Lss { doing, failure: LssFailure::NoAnswer } => match doing {
                LssDoing::Fastscan => Advice::FastscanAgain,
                LssDoing::Select => Advice::LssAddress,
                _ => Advice::LssSilence,
            },
            Self::Lss { failure: LssFailure::None, .. } => Advice::AssignNode,
            Self::Lss { doing, failure: LssFailure::Refused { code, .. } } => match (doing, code) {
                (LssDoing::Store, 1) => Advice::NoStorage,
                (LssDoing::Store, _) => Advice::BrokenStorage,
                (LssDoing::BitRate, _) => Advice::OtherBitRate,
                _ => Advice::OtherNodeId,
            },
            Self::WrongCrc { .. } => Advice::WrongCrc,
            Self::TrialFailed { how: TrialFailure::NotStarted(_, state), .. } => not_started_advice(*state),
            Self::TrialFailed {
                how:
                    TrialFailure::Silent(Some(other))
                    | TrialFailure::FellSilent(Some(other))
                    | TrialFailure::Lost(Some(other)),
                ..
            } => Advice::TrialElsewhere { other: *other },
            Self::TrialFailed {
                node,
                how: TrialFailure::Silent(None) | TrialFailure::FellSilent(None) | TrialFailure::Lost(None),
            } => Advice::TrialSilent { node: *node },
            Self::TrialFailed { node, how: TrialFailure::Stays(_) } => Advice::GiveWayBack { node: *node },
            Self::ProgramEnded { ended, .. } | Self::TrialFailed { how: TrialFailure::Ended(ended), .. } => {
                ended_advice(ended.by)
            }
            Self::StartFailed { running: Some(running), state, .. } if running.is_bootloader() => {
                not_started_advice(*state)
            }
            Self::StartFailed { elsewhere: Some(other), .. }
            | Self::FellSilent { elsewhere: Some(other), .. } => Advice::ProgramElsewhere { other: *other },
            Self::StartFailed { node, .. } | Self::FellSilent { node, .. } => {
                Advice::ProgramSilent { node: *node }
            }
        }
    }
}

impl From<&AdapterError> for Advice {
    fn from(error: &AdapterError) -> Self {
        let words = error.advice();
        match error {
            AdapterError::Url { .. } => Self::Url { words },
            error if error.is_absent() => Self::NoAdapter { words },
            _ => Self::Adapter { words },
        }
    }
}

/// The advice for a program after whose start the bootloader runs, by what the device says.
fn not_started_advice(state: Option<BootloaderState>) -> Advice {
    let reason = state.and_then(|state| Reason::from_byte(state.reason));
    let ended_by = state.and_then(BootloaderState::ended_by);
    match (reason, ended_by) {
        (Some(Reason::NoProgram), _) => Advice::FlashFirst,
        (Some(Reason::Damaged), _) => Advice::FlashAgain,
        (Some(Reason::NodeId), _) => Advice::NodeIdForProduct,
        (Some(Reason::Forbidden), _) => Advice::StartForbidden,
        (Some(Reason::Unsigned | Reason::CrashLoop), Some(by)) => ended_advice(Some(by)),
        _ => Advice::NotStarted,
    }
}

/// The advice for a program that ran for a while.
const fn ended_advice(by: Option<ResetCause>) -> Advice {
    match by {
        Some(ResetCause::IndependentWatchdog | ResetCause::WindowWatchdog) => Advice::FeedWatchdog,
        Some(ResetCause::Software) => Advice::ResetsItself,
        Some(ResetCause::PowerOn | ResetCause::BrownOut) => Advice::PowerLost,
        Some(ResetCause::Standby) => Advice::Standby,
        _ => Advice::EndsItself,
    }
}

const fn failure_advice(error: FlashError) -> Advice {
    match error {
        FlashError::NoValidProgram => Advice::NoValidProgram,
        FlashError::Format => Advice::WrongFormat,
        FlashError::Crc => Advice::CheckBus,
        FlashError::NotCleared => Advice::NotCleared,
        FlashError::Write => Advice::WriteFailed,
        FlashError::Address => Advice::OtherMap,
        FlashError::Secured => Advice::Secured,
        FlashError::NvData => Advice::NvData,
        FlashError::WrongVendorId | FlashError::WrongProductId => Advice::OtherProduct,
        FlashError::NoAccess => Advice::NoAccess,
        FlashError::Busy => Advice::WaitABit,
        FlashError::Signature => Advice::BadSignature,
        FlashError::Rollback => Advice::Rollback,
        FlashError::Key => Advice::OtherKey,
        FlashError::Sequence => Advice::Sequence,
        _ => Advice::OnceMore,
    }
}

/// The advice for an application that refuses the call to the bootloader, whatever its state.
fn call_advice(code: AbortCode) -> Advice {
    match code {
        AbortCode::INVALID_VALUE => Advice::UnknownCall,
        AbortCode::NO_OBJECT
        | AbortCode::NO_SUB_INDEX
        | AbortCode::READ_ONLY
        | AbortCode::UNSUPPORTED_ACCESS => Advice::NoCallBack,
        code => refusal_advice(code),
    }
}

fn unlock_advice(code: AbortCode) -> Advice {
    match code {
        AbortCode::NO_OBJECT | AbortCode::NO_SUB_INDEX => Advice::NeedsNoPassword,
        AbortCode::DEVICE_STATE => Advice::PasswordLater,
        _ => Advice::WrongPassword,
    }
}

fn refusal_advice(code: AbortCode) -> Advice {
    match code {
        AbortCode::NO_OBJECT => Advice::NoObject,
        AbortCode::NO_SUB_INDEX => Advice::NoProgramNumber,
        AbortCode::LENGTH | AbortCode::LENGTH_TOO_HIGH | AbortCode::OUT_OF_MEMORY => Advice::SmallerBlocks,
        AbortCode::TIMEOUT | AbortCode::TOGGLE | AbortCode::COMMAND => Advice::LostFrames,
        _ => Advice::Refused,
    }
}

/// The advice for a refusal of the debugger interface, 1025h.
fn debugger_advice(code: AbortCode) -> Advice {
    match code {
        AbortCode::NO_OBJECT => Advice::NoDebugger,
        AbortCode::INVALID_VALUE => Advice::NoAccessToBytes,
        AbortCode::DEVICE_STATE => Advice::ReadOutProtected,
        AbortCode::LOCAL_CONTROL => Advice::FlashBusy,
        code => refusal_advice(code),
    }
}
