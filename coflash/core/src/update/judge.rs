//! The result of a download, and whether a repetition may help.

use canopen::program::FlashError;
use canopen::AbortCode;

use super::event::RepeatReason;
use crate::device::{Doing, Error};

/// The result of a download.
pub(crate) enum Judgement {
    /// The data arrived, and the device reports no error.
    Good,
    /// The data did not arrive, or the device reports an error.
    Bad {
        /// The reason for a repetition, if a repetition may help.
        why: Option<RepeatReason>,
        /// The error if it is not repeated.
        error: Error,
    },
}

/// Judges a download by its result and by the device's status with its detail.
pub(crate) fn judge(sent: Result<(), Error>, status: Option<(FlashError, u16)>, doing: Doing) -> Judgement {
    let (why, error) = match (sent, status) {
        (Ok(()), None) => return Judgement::Good,
        (sent, Some((error, detail))) => {
            let code = match sent {
                Err(Error::Refused { code, .. }) => Some(code),
                _ => None,
            };
            // Data that broke off are not in the expected form.
            let broken = sent.as_ref().err().and_then(broken).filter(|_| error == FlashError::Format);
            (repeatable(error).or(broken), Error::Failed { doing, error, detail, code })
        }
        (Err(error @ Error::Refused { .. }), None) => (broken(&error), error),
        (Err(error), None) => (Some(RepeatReason::NoAnswer), error),
    };
    Judgement::Bad { why, error }
}

/// The reason for a repetition, if the transfer broke off.
fn broken(error: &Error) -> Option<RepeatReason> {
    match error {
        Error::NoAnswer { .. } => Some(RepeatReason::NoAnswer),
        Error::Refused { code, .. } => {
            let codes = [AbortCode::TOGGLE, AbortCode::TIMEOUT, AbortCode::COMMAND, AbortCode::CRC];
            codes.contains(code).then_some(RepeatReason::Broken(*code))
        }
        _ => None,
    }
}

/// The reason for a repetition, if it can help against this error.
fn repeatable(error: FlashError) -> Option<RepeatReason> {
    match error {
        FlashError::Crc => Some(RepeatReason::Crc),
        FlashError::Busy => Some(RepeatReason::Busy),
        _ => None,
    }
}
