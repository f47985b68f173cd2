//! What came of a download, and whether sending it again may help.

use canopen::program::FlashError;
use canopen::AbortCode;

use super::event::RepeatReason;
use crate::device::{Doing, Error};

/// What came of a download.
pub(crate) enum Judgement {
    /// It arrived, and the device is content.
    Good,
    /// It did not, or it is not.
    Bad {
        /// Why sending it again may help, if it may.
        why: Option<RepeatReason>,
        /// What it is called if it is not sent again.
        error: Error,
    },
}

/// Judges a download by its outcome and by what the device's status says, with its detail.
pub(crate) fn judge(sent: Result<(), Error>, status: Option<(FlashError, u16)>, doing: Doing) -> Judgement {
    let (why, error) = match (sent, status) {
        (Ok(()), None) => return Judgement::Good,
        (sent, Some((error, detail))) => {
            let code = match sent {
                Err(Error::Refused { code, .. }) => Some(code),
                _ => None,
            };
            (repeatable(error), Error::Failed { doing, error, detail, code })
        }
        (Err(error @ Error::Refused { code, .. }), None) => {
            let broken =
                matches!(code, AbortCode::TOGGLE | AbortCode::TIMEOUT | AbortCode::COMMAND | AbortCode::CRC);
            (broken.then_some(RepeatReason::Broken(code)), error)
        }
        (Err(error), None) => (Some(RepeatReason::NoAnswer), error),
    };
    Judgement::Bad { why, error }
}

/// Whether sending a block again can help against this error.
fn repeatable(error: FlashError) -> Option<RepeatReason> {
    match error {
        FlashError::Crc => Some(RepeatReason::Crc),
        FlashError::Busy => Some(RepeatReason::Busy),
        _ => None,
    }
}
