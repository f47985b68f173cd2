//! The exit codes of the manual's download tools: `ERRORLEVEL` of Windows, 32 bits wide (manual
//! L-1112e_5, chapter 5.4; L-1112d_10, chapter 5.2.1).
//!
//! [`Error::number`] uses these numbers if the manual has one, and new numbers otherwise. A script
//! written for those tools knows only the old numbers, so this module gives every error one of
//! them. Numbers below 60000000h are those of the operating system (errno).

use std::io::ErrorKind;

use canopen::program::FlashError;

use super::error::{Error, LssFailure};
use coboot_can::{AdapterError, Obstacle};

/// `ERR_BL_ERROR`: the bootloader reports an error that the tool does not know.
pub const UNKNOWN: u32 = 0x6000_0008;
/// `ERR_DOWNLOAD_RUNNING`: a download was started during another one.
pub const DOWNLOAD_RUNNING: u32 = 0x6000_0012;
/// `ERR_INVALID_NODEID`.
pub const INVALID_NODE_ID: u32 = 0x6000_0017;
/// `ERR_INVALID_PARAM`.
pub const INVALID_PARAMETER: u32 = 0x6000_0018;
/// The numbers from here on are return codes of the CANopen stack plus this value (table 5; the
/// codes are in the stack's `errordef.h`, which L-1020 lists).
pub const STACK: u32 = 0x6000_1000;

/// The CAN driver could not be initialised (`kCopCdrvInitError`).
const DRIVER_INIT: u32 = STACK + 0x13;
/// This kind of CAN interface does not exist (`kCopCdrvInvalidDriverType`).
const DRIVER_TYPE: u32 = STACK + 0x19;
/// The CAN interface was not found (`kCopCdrvInvalidBaseAddress`).
const NO_CONTROLLER: u32 = STACK + 0x1B;
/// The CAN interface is in use (`kCopCdrvDevAlreadyInUse`).
const IN_USE: u32 = STACK + 0x1E;
/// The CAN interface cannot send a frame (`kCopCdrvBusy`).
const BUSY: u32 = STACK + 0x18;
/// The operating system has lost the interface (`kCopCdrvHostOsError`).
const HOST: u32 = STACK + 0x1F;
/// No LSS slave answers (`kCopLssmTimeout`).
const LSS_TIMEOUT: u32 = STACK + 0xD4;
/// The LSS slave answers with an error code (`kCopLssmErrorInConfirm`).
const LSS_REFUSED: u32 = STACK + 0xD5;

/// The exit code of the manual's tools for this error.
#[must_use]
pub fn exit_code(error: &Error) -> u32 {
    match error {
        Error::Adapter(AdapterError::Url { .. }) => DRIVER_TYPE,
        Error::Adapter(AdapterError::Open { source, .. }) => match source.kind() {
            ErrorKind::ResourceBusy | ErrorKind::AddrInUse => IN_USE,
            _ => NO_CONTROLLER,
        },
        Error::Adapter(AdapterError::Unusable { obstacle: Obstacle::InUse, .. }) => IN_USE,
        Error::Adapter(AdapterError::Unusable { .. }) => NO_CONTROLLER,
        Error::Adapter(AdapterError::Protocol { .. }) => DRIVER_INIT,
        Error::Adapter(AdapterError::Stuck { .. }) => HOST,
        Error::Adapter(AdapterError::Lost { .. }) => HOST,
        Error::Adapter(AdapterError::Gateway { .. }) => BUSY,
        Error::Lss { failure: LssFailure::NoAnswer, .. } => LSS_TIMEOUT,
        Error::Lss { failure: LssFailure::Refused { .. }, .. } => LSS_REFUSED,
        // 1F57h reads 86h: program data were written during another download.
        Error::Failed { error: FlashError::Busy, .. } => DOWNLOAD_RUNNING,
        // The codes of 1F57h that are newer than the table are unknown errors to its tools.
        error => match error.number() {
            0x6000_0100..=0x6000_01FF => UNKNOWN,
            number => number,
        },
    }
}

#[cfg(test)]
mod tests {
    use std::io;

    use canopen::program::FlashStatus;
    use canopen::NodeId;

    use super::*;
    use crate::device::doing::{Doing, LssDoing};

    /// Table 5, and the codes of 1F57h that table 3 of the newer manual adds.
    #[test]
    fn every_error_has_a_number_of_the_manuals() {
        let failed = |word| {
            let status = FlashStatus::from_word(word);
            let error = status.error.unwrap();
            exit_code(&Error::Failed { doing: Doing::Program, error, detail: 0, code: None })
        };
        for (word, number) in [
            (0x02, 0x6000_0001),
            (0x04, 0x6000_0002),
            (0x06, 0x6000_0003),
            (0x08, 0x6000_0004),
            (0x0A, 0x6000_0005),
            (0x0C, 0x6000_0006),
            (0x0E, 0x6000_0007),
            (0x10, 0x6000_0008),
            (0x7E, 0x6000_0008),
            (0x80, 0x6000_0008),
            (0x82, 0x6000_0008),
            (0x84, 0x6000_0008),
            (0x86, 0x6000_0012),
            (0x88, 0x6000_0008),
        ] {
            assert_eq!(failed(word), number, "{word:02X}h");
        }
        let node = NodeId::new(5).unwrap();
        let adapter = || "can0".to_string();
        let open = |kind| AdapterError::Open { adapter: adapter(), source: io::Error::from(kind).into() };
        let unusable = |obstacle| AdapterError::Unusable {
            adapter: adapter(),
            what: String::new(),
            advice: String::new(),
            obstacle,
        };
        let lss = |failure| Error::Lss { doing: LssDoing::Select, failure };
        for (error, number) in [
            (Error::Cancelled, 0x6000_0011),
            (Error::NoAnswer { node, doing: Doing::Program }, 0x6000_0013),
            (Error::NoBootloader { node, running: None, code: None, elsewhere: None }, 0x6000_0010),
            (
                Error::StartFailed { node, running: None, status: None, state: None, elsewhere: None },
                0x6000_0014,
            ),
            (Error::Adapter(AdapterError::Url { url: adapter(), why: String::new() }), 0x6000_1019),
            (Error::Adapter(open(ErrorKind::NotFound)), 0x6000_101B),
            (Error::Adapter(open(ErrorKind::ResourceBusy)), 0x6000_101E),
            (Error::Adapter(unusable(Obstacle::Absent)), 0x6000_101B),
            (Error::Adapter(unusable(Obstacle::InUse)), 0x6000_101E),
            (Error::Adapter(unusable(Obstacle::Other)), 0x6000_101B),
            (Error::Adapter(AdapterError::Protocol { adapter: adapter(), said: String::new() }), 0x6000_1013),
            (lss(LssFailure::NoAnswer), 0x6000_10D4),
            (lss(LssFailure::Refused { code: 1, detail: 0 }), 0x6000_10D5),
            (lss(LssFailure::None), 0x6000_0017),
        ] {
            assert_eq!(exit_code(&error), number, "{error}");
        }
    }
}
