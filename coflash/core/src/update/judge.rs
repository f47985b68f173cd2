//! The result of a download, and whether a repetition may help.

use canopen::program::FlashError;
use canopen::AbortCode;

use super::event::{RepeatReason, Retry};
use crate::device::{Doing, Error, Session, Transfers};

/// The error in 1F57h after a download, with its detail; `None` if it reports none.
pub(crate) type DownloadStatus = Option<(FlashError, u16)>;

/// A failed download: the data did not arrive, or the device reports an error.
pub(crate) struct Failure {
    /// The reason for a repetition, if a repetition may help.
    pub(crate) why: Option<RepeatReason>,
    /// The error if it is not repeated.
    pub(crate) error: Error,
}

/// Judges a download by its result and by the device's status.
pub(crate) fn judge(sent: Result<(), Error>, status: DownloadStatus, doing: Doing) -> Result<(), Failure> {
    let (why, error) = match (sent, status) {
        (Ok(()), None) => return Ok(()),
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
    Err(Failure { why, error })
}

/// The repetitions of a download.
pub(crate) struct Repeats {
    /// The block that is sent; `None` for the whole program.
    pub(crate) block: Option<u32>,
    /// The repetitions so far.
    pub(crate) count: u32,
    /// The permitted ones.
    pub(crate) of: u32,
}

impl Repeats {
    /// Counts one more repetition after this failure. From the second one on, the data go in segments: a
    /// device or an adapter with problems in block transfer may work with them.
    ///
    /// # Errors
    /// The error of the failure, if a repetition does not help, or is not permitted any more.
    pub(crate) fn again(&mut self, session: &mut Session<'_>, failure: Failure) -> Result<Retry, Error> {
        let Some(why) = failure.why.filter(|_| self.count < self.of) else { return Err(failure.error) };
        self.count += 1;
        if self.count > 1 && matches!(why, RepeatReason::Broken(_) | RepeatReason::NoAnswer) {
            session.transfer_by(Transfers::Segments);
        }
        Ok(Retry { block: self.block, repeat: self.count, of: self.of, why })
    }
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
