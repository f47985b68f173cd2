//! The advice for an error.

use canopen::debugger::DEBUGGER;
use canopen::program::{FlashError, FlashStatus, ProgramControl, ACCESS, EVENTS};
use canopen::{AbortCode, NodeId};
use coboot_can::AdapterError;
use shared_abi::boot_report::Reason;
use shared_abi::handoff::ResetCause;

use super::{absent, Ended, Error, LssFailure, TrialFailure, LOW_SUPPLY};
use crate::advice::Advice;
use crate::device::doing::{Doing, LssDoing};
use crate::device::state::BootloaderState;

impl Error {
    /// What to do next.
    #[must_use]
    pub fn advice(&self) -> Advice {
        match *self {
            Self::Adapter(ref error) => error.into(),
            Self::NoVerdict { .. } => Advice::NoVerdict,
            Self::Cancelled => Advice::Continue,
            Self::NoAnswer { node, .. } => Advice::Reach { node },
            Self::ShortAnswer { .. } => Advice::ShortAnswer,
            Self::Refused { doing, code, .. } => refusal_advice(doing, code),
            Self::NotInDialect { .. } => Advice::OtherDialect,
            Self::NoPassword { .. } => Advice::GivePassword,
            Self::Occupied { node } => Advice::Occupied { node },
            Self::NotAlone { .. } => Advice::NotAlone,
            Self::Protocol { .. } => Advice::InvalidAnswer,
            Self::Failed { doing, error, detail, .. } => failure_advice(doing, error, detail),
            Self::NotRenewable { .. } => Advice::NotRenewable,
            Self::Unconfirmable { .. } => Advice::Unconfirmable,
            Self::FirstFailed { first } => Advice::FirstFailed { first },
            Self::RenewalFailed { .. } => Advice::RenewalFailed,
            Self::SilentOnTrial { .. } => Advice::SilentOnTrial,
            Self::WrongTarget { .. } => Advice::OtherProduct,
            Self::SealedOnly { .. } => Advice::Seal,
            Self::NoProgram { ref advice, .. } => advice.clone(),
            Self::OtherRegion { .. } => Advice::OtherRegion,
            Self::OtherIdentity { .. } => Advice::OtherIdentity,
            Self::Busy { .. } => Advice::StaysBusy,
            Self::NoBootloader { elsewhere: Some(other), .. } => Advice::BootloaderElsewhere { other },
            Self::NoBootloader { node, code: Some(code), .. } => call_advice(node, code),
            Self::NoBootloader { .. } => Advice::Catch,
            Self::Lss { doing, failure } => lss_advice(doing, failure),
            Self::WrongCrc { .. } => Advice::WrongCrc,
            Self::TrialFailed { node, how } => trial_advice(node, how),
            Self::ProgramEnded { ended, .. } => ended_advice(ended.by),
            Self::StartFailed { running: Some(running), status, state, .. } if running.is_bootloader() => {
                match not_started_advice(state) {
                    // It was not written a moment ago: it may not be there.
                    Advice::NotStarted if finds_none(status) => Advice::NoValidProgram,
                    advice => advice,
                }
            }
            Self::StartFailed { elsewhere: Some(other), .. }
            | Self::FellSilent { elsewhere: Some(other), .. } => Advice::ProgramElsewhere { other },
            Self::StartFailed { node, .. } | Self::FellSilent { node, .. } => Advice::ProgramSilent { node },
        }
    }
}

impl Error {
    /// Whether an application that runs as it should refuses the call to the bootloader in its
    /// present state: its machine moves, or is in use.
    #[must_use]
    pub fn refuses_now(&self) -> bool {
        match *self {
            Self::NoBootloader { code: Some(code), .. } => is_of_state(code),
            _ => false,
        }
    }
}

fn trial_advice(node: NodeId, how: TrialFailure) -> Advice {
    match how {
        TrialFailure::NotStarted(_, state) => not_started_advice(state),
        TrialFailure::Silent(elsewhere)
        | TrialFailure::FellSilent(elsewhere)
        | TrialFailure::Lost(elsewhere) => {
            elsewhere.map_or(Advice::TrialSilent { node }, |other| Advice::TrialElsewhere { other })
        }
        TrialFailure::Stays(Some(code)) if is_of_state(code) => Advice::RefusesNow { node },
        TrialFailure::Stays(_) => Advice::GiveWayBack { node },
        TrialFailure::Ended(Ended { by, .. }) => ended_advice(by),
    }
}

fn lss_advice(doing: LssDoing, failure: LssFailure) -> Advice {
    match (failure, doing) {
        (LssFailure::NoAnswer, LssDoing::Fastscan) => Advice::FastscanAgain,
        (LssFailure::NoAnswer, LssDoing::Select) => Advice::LssAddress,
        (LssFailure::NoAnswer, _) => Advice::LssSilence,
        (LssFailure::None, _) => Advice::AssignNode,
        (LssFailure::Refused { code: 1, .. }, LssDoing::Store) => Advice::NoStorage,
        (LssFailure::Refused { .. }, LssDoing::Store) => Advice::BrokenStorage,
        (LssFailure::Refused { .. }, LssDoing::BitRate) => Advice::OtherBitRate,
        (LssFailure::Refused { .. }, _) => Advice::OtherNodeId,
    }
}

/// The advice for a program after whose start the bootloader runs, by what the device says.
fn not_started_advice(state: Option<BootloaderState>) -> Advice {
    let reason = state.and_then(|state| Reason::from_byte(state.stayed()));
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

/// Whether the bootloader has refused to start a program because it has none that is valid.
fn finds_none(status: Option<FlashStatus>) -> bool {
    status.is_some_and(|status| status.error == Some(FlashError::NoValidProgram))
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

fn failure_advice(doing: Doing, error: FlashError, detail: u16) -> Advice {
    match (error, detail) {
        (FlashError::Crc, _) if doing == Doing::Block(0) => Advice::OtherCrc,
        (FlashError::Format, _) if doing == Doing::Bootloader => Advice::OtherBootloader,
        (FlashError::Secured, sector @ 1..) => Advice::Unprotect { sector },
        (FlashError::NotCleared, program @ 1..) => Advice::ClearFirst { program },
        (FlashError::NoAccess, LOW_SUPPLY) => Advice::Supply,
        (FlashError::NoValidProgram, _) => Advice::NoValidProgram,
        (FlashError::Format, _) => Advice::WrongFormat,
        (FlashError::Crc, _) => Advice::CheckBus,
        (FlashError::NotCleared, _) => Advice::NotCleared,
        (FlashError::Write, _) => Advice::WriteFailed,
        (FlashError::Address, _) => Advice::OtherMap,
        (FlashError::Secured, _) => Advice::Secured,
        (FlashError::NvData, _) => Advice::NvData,
        (FlashError::WrongVendorId | FlashError::WrongProductId, _) => Advice::OtherProduct,
        (FlashError::NoAccess, _) => Advice::NoAccess,
        (FlashError::Busy, _) => Advice::WaitABit,
        (FlashError::Signature, _) => Advice::BadSignature,
        (FlashError::Rollback, _) => Advice::Rollback,
        (FlashError::Key, _) => Advice::OtherKey,
        (FlashError::Sequence, _) => Advice::Sequence,
        _ => Advice::OnceMore,
    }
}

/// Whether an application that refuses with this code does so in its present state (CiA 301 table 22).
fn is_of_state(code: AbortCode) -> bool {
    matches!(code, AbortCode::DEVICE_STATE | AbortCode::LOCAL_CONTROL)
}

/// The advice for an application that refuses the call to the bootloader.
fn call_advice(node: NodeId, code: AbortCode) -> Advice {
    match code {
        code if is_of_state(code) => Advice::RefusesNow { node },
        AbortCode::INVALID_VALUE => Advice::UnknownCall,
        AbortCode::NO_OBJECT
        | AbortCode::NO_SUB_INDEX
        | AbortCode::READ_ONLY
        | AbortCode::UNSUPPORTED_ACCESS => Advice::NoCallBack,
        code => any_refusal_advice(code),
    }
}

fn refusal_advice(doing: Doing, code: AbortCode) -> Advice {
    let index = match doing {
        Doing::Read(at) | Doing::Write(at) => Some(at.index),
        _ => None,
    };
    match (doing, code) {
        (Doing::Unlock, AbortCode::NO_OBJECT | AbortCode::NO_SUB_INDEX) => Advice::NeedsNoPassword,
        (Doing::Unlock, AbortCode::DEVICE_STATE) => Advice::PasswordLater,
        (Doing::Unlock, _) => Advice::WrongPassword,
        // 1F57h gives the reason of a bootloader; that of an application is always 0.
        (
            Doing::Command(ProgramControl::SetSignature | ProgramControl::ClrSignature),
            AbortCode::DEVICE_STATE,
        ) => Advice::EnterFirst,
        (_, AbortCode::NO_OBJECT) if index == Some(DEBUGGER) => Advice::NoDebugger,
        (_, AbortCode::INVALID_VALUE) if index == Some(DEBUGGER) => Advice::NoAccessToBytes,
        (_, AbortCode::DEVICE_STATE) if index == Some(DEBUGGER) => Advice::ReadOutProtected,
        (_, AbortCode::LOCAL_CONTROL) if index == Some(DEBUGGER) => Advice::FlashBusy,
        (_, code) if matches!(index, Some(ACCESS | EVENTS)) && absent(code) => Advice::CallBootloader,
        (_, code) => any_refusal_advice(code),
    }
}

fn any_refusal_advice(code: AbortCode) -> Advice {
    match code {
        AbortCode::NO_OBJECT => Advice::NoObject,
        AbortCode::NO_SUB_INDEX => Advice::NoProgramNumber,
        AbortCode::LENGTH | AbortCode::LENGTH_TOO_HIGH | AbortCode::OUT_OF_MEMORY => Advice::SmallerBlocks,
        AbortCode::TIMEOUT | AbortCode::TOGGLE | AbortCode::COMMAND => Advice::LostFrames,
        _ => Advice::Refused,
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
