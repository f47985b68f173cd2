//! Errors of a device: what happened, a stable number, and what to do next.

use std::fmt;
use std::time::Duration;

use canopen::program::{FlashError, FlashStatus, SUPPLY_DETAIL};
use canopen::AbortCode;
use canopen::{Address, NodeId};
use shared_abi::handoff::ResetCause;
use shared_abi::renewal::TrialEnd;
use shared_abi::warm_start::Damage;

use super::device_type::DeviceType;
use super::dialect::Dialect;
use super::doing::{Doing, LssDoing};
use super::state::{reason, source, trial_end, BootloaderState};
use crate::advice::Advice;
use coboot_can::gateway::GatewayError;
use coboot_can::{AdapterError, Losses};

mod advice;

/// Why a conversation with a device ended early.
///
/// `Display` says what happened, [`advice`](Self::advice) what to do next.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The CAN adapter failed.
    #[error("{0}")]
    Adapter(#[from] AdapterError),
    /// The user cancelled.
    #[error("cancelled")]
    Cancelled,
    /// The device does not answer.
    #[error("node {node} does not answer ({doing})")]
    NoAnswer {
        /// The device.
        node: NodeId,
        /// The action.
        doing: Doing,
    },
    /// The device answers with frames that are too short for SDO.
    #[error("node {node} answers, but with frames of {len} bytes where SDO has 8 ({doing})")]
    ShortAnswer {
        /// The device.
        node: NodeId,
        /// The action.
        doing: Doing,
        /// Bytes of the last such frame, 0 to 7; SDO has 8 (CiA 301 clause 7.2.4.3).
        len: usize,
    },
    /// The device answered with an SDO abort, and 1F57h gives no further reason.
    #[error("node {node} refuses {doing}: abort {code}")]
    Refused {
        /// The device.
        node: NodeId,
        /// The action.
        doing: Doing,
        /// The abort code.
        code: AbortCode,
    },
    /// The device sent an invalid answer: wrong toggle bit, wrong command, wrong length.
    #[error("the answer to {doing} is invalid: {code}")]
    Protocol {
        /// The action.
        doing: Doing,
        /// The abort code that was sent to the device.
        code: AbortCode,
    },
    /// 1F57h reports that the bootloader could not carry out a command.
    #[error(
        "{doing} failed: {what} (1F57h reads {:02X}h{number}{abort})",
        .error.code(),
        what = failure_words(*.error, *.detail),
        number = detail_words(Some(*.error), *.detail),
        abort = .code.map_or(String::new(), |code| format!(", abort {code}"))
    )]
    Failed {
        /// The action.
        doing: Doing,
        /// The error in 1F57h.
        error: FlashError,
        /// The manufacturer's detail of the error.
        detail: u16,
        /// The abort code, if the SDO request was refused.
        code: Option<AbortCode>,
    },
    /// 1F57h stays busy.
    #[error("node {node} is still busy {doing} after {:.1} s", .waited.as_secs_f64())]
    Busy {
        /// The device.
        node: NodeId,
        /// The action.
        doing: Doing,
        /// How long the tool has waited.
        waited: Duration,
    },
    /// The file is for another device.
    #[error("the program is for {} {file:08X}h, and node {node} has {device:08X}h", .what.words())]
    WrongTarget {
        /// The device.
        node: NodeId,
        /// The property that differs.
        what: IdentityPart,
        /// The device's value.
        device: u32,
        /// The file's value.
        file: u32,
    },
    /// The device takes sealed images only, and the file is none.
    #[error("node {node} takes sealed images only{}", roots_in_brackets(.roots))]
    SealedOnly {
        /// The device.
        node: NodeId,
        /// The ids of its root keys, as far as it reports them.
        roots: Vec<u32>,
    },
    /// The image cannot be a program of this device.
    #[error("the image {why}")]
    NoProgram {
        /// The stable error number.
        number: u32,
        /// What is wrong with it, as the rest of a sentence that begins with "the image".
        why: String,
        /// What to do next.
        advice: Advice,
    },
    /// The device has the program at another address than the image.
    #[error(
        "the image is for {:#010x}..={:#010x}, and node {node} has program {program} at {:#010x}..={:#010x}",
        .image.0, .image.1, .region.0, .region.1
    )]
    OtherRegion {
        /// The device.
        node: NodeId,
        /// The program's number.
        program: u8,
        /// First and last address of the image.
        image: (u32, u32),
        /// First and last address of the device's program, as 2004h reports it.
        region: (u32, u32),
    },
    /// The program on trial reports another identity than its bootloader.
    #[error(
        "the program on trial tells {} {is}, and the bootloader of node {node} {was}",
        .what.words(),
        is = identity_words(*.application),
        was = identity_words(*.bootloader)
    )]
    OtherIdentity {
        /// The device.
        node: NodeId,
        /// The property that differs.
        what: IdentityPart,
        /// The bootloader's value.
        bootloader: Option<u32>,
        /// The value of the program on trial; `None` if it reports none.
        application: Option<u32>,
    },
    /// The application does not return to the bootloader.
    #[error(
        "node {node} {runs}{}{refuses}",
        elsewhere_words(*.elsewhere),
        runs = running_words(*.running, "does not come back in the bootloader"),
        refuses = .code.map_or(String::new(), |code| format!(": it refuses the call with abort {code}"))
    )]
    NoBootloader {
        /// The device.
        node: NodeId,
        /// What runs instead; `None` if nothing answers.
        running: Option<DeviceType>,
        /// The abort code, if the application refused.
        code: Option<AbortCode>,
        /// Another node that has booted up since the call, if nothing answers.
        elsewhere: Option<NodeId>,
    },
    /// The program in the device is not the program of the file.
    #[error("the program in the device has CRC {device:08X}h, that of the file {file:08X}h")]
    WrongCrc {
        /// The value of 1F56h.
        device: u32,
        /// The file's value.
        file: u32,
    },
    /// The device's dialect does not support an option.
    #[error("in the dialect {}: {what}", .dialect.name())]
    NotInDialect {
        /// The dialect.
        dialect: Dialect,
        /// The missing feature, as a sentence.
        what: &'static str,
    },
    /// The device is locked, and the user gave no password.
    #[error("node {node} is locked, and no password was given")]
    NoPassword {
        /// The device.
        node: NodeId,
    },
    /// Another device has the node-ID that the bootloader of this device uses.
    #[error("another device is in its bootloader and answers as node {node}")]
    Occupied {
        /// The node-ID.
        node: NodeId,
    },
    /// Another tool is using the device.
    #[error("{}", .who.words(*.node))]
    NotAlone {
        /// The device.
        node: NodeId,
        /// How it was noticed.
        who: Intruder,
    },
    /// A layer setting service failed.
    #[error("{}", .failure.words(*.doing))]
    Lss {
        /// The master's action.
        doing: LssDoing,
        /// The kind of failure.
        failure: LssFailure,
    },
    /// The program on trial did not answer, or could not be called back: it is not released for
    /// autostart.
    #[error("the trial failed, and the program is not released for autostart: {}", .how.words(*.node))]
    TrialFailed {
        /// The device.
        node: NodeId,
        /// The kind of failure.
        how: TrialFailure,
    },
    /// The adapter failed while the program was tried or started, so that its silence says nothing.
    #[error("no verdict on the program of node {node}: while it was started and watched, {losses}")]
    NoVerdict {
        /// The device.
        node: NodeId,
        /// What did not go through the adapter.
        losses: Losses,
    },
    /// The program does not start.
    #[error(
        "the program does not start: node {node} {runs}{}{}{}",
        elsewhere_words(*.elsewhere),
        status_words(*.status),
        why_words(*.state),
        runs = running_words(*.running, "does not answer")
    )]
    StartFailed {
        /// The device.
        node: NodeId,
        /// What answers instead; `None` if nothing answers.
        running: Option<DeviceType>,
        /// The status in 1F57h, if it could be read.
        status: Option<FlashStatus>,
        /// The state in 2007h, if the device has it.
        state: Option<BootloaderState>,
        /// Another node that has booted up since the start, if nothing answers.
        elsewhere: Option<NodeId>,
    },
    /// The program has started, and ended soon after.
    #[error("the program of node {node} has ended: {ended}")]
    ProgramEnded {
        /// The device.
        node: NodeId,
        /// Its end.
        ended: Ended,
    },
    /// The bootloader of the device cannot be renewed over the bus.
    #[error("the bootloader of node {node} cannot be renewed over the bus")]
    NotRenewable {
        /// The device.
        node: NodeId,
    },
    /// The new bootloader did not come up, or was not installed: the old one runs.
    #[error("the new bootloader of node {node} {}; the old one runs", trial_end(*.end))]
    RenewalFailed {
        /// The device.
        node: NodeId,
        /// The end of its trial.
        end: TrialEnd,
    },
    /// Nothing has answered since the new bootloader was started on trial.
    #[error("the new bootloader of node {node} was started on trial, and nothing has answered for {} s", .waited.as_secs())]
    SilentOnTrial {
        /// The device.
        node: NodeId,
        /// How long the tool has waited.
        waited: Duration,
    },
    /// The new bootloader runs on trial, and cannot be confirmed: it is built without renewal.
    #[error("the new bootloader of node {node} cannot be confirmed: it is built without renewal; a reset brings the old one back")]
    Unconfirmable {
        /// The device.
        node: NodeId,
    },
    /// The bootloader of the first device could not be renewed, so that of this one was left alone.
    #[error("not renewed: the bootloader of node {first} was the first, and could not be renewed")]
    FirstFailed {
        /// The first device.
        first: NodeId,
    },
    /// The program has started and answered, and the device does not answer any more.
    #[error("the program does not answer any more: {}", silence_words(*.node, *.elsewhere))]
    FellSilent {
        /// The device.
        node: NodeId,
        /// Another node that has booted up since the start.
        elsewhere: Option<NodeId>,
    },
}

/// How the trial of a program failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TrialFailure {
    /// The program was started, and nothing answers; with another node that has booted up since then.
    Silent(Option<NodeId>),
    /// The program has answered, and does not answer any more; with another node that has booted up since
    /// its start.
    FellSilent(Option<NodeId>),
    /// The device stays in its bootloader; with the status in 1F57h and the state in 2007h, if they could
    /// be read.
    NotStarted(Option<FlashStatus>, Option<BootloaderState>),
    /// The program runs and does not return to the bootloader; with the abort code, if it refused.
    Stays(Option<AbortCode>),
    /// The program was called back, and nothing answers any more; with another node that has booted up
    /// since then.
    Lost(Option<NodeId>),
    /// The program ran for a while and then ended by a reset.
    Ended(Ended),
}

impl TrialFailure {
    /// The failure in words, for the device with this node-ID.
    fn words(self, node: NodeId) -> String {
        match self {
            Self::Silent(elsewhere) => {
                let elsewhere = elsewhere_words(elsewhere);
                format!("node {node} has not answered since the program was started{elsewhere}")
            }
            Self::FellSilent(elsewhere) => silence_words(node, elsewhere),
            Self::NotStarted(status, state) => {
                let (status, why) = (status_words(status), why_words(state));
                format!("it does not start, node {node} stays in the bootloader{status}{why}")
            }
            Self::Stays(None) => {
                format!("it runs in node {node} and does not return to the bootloader when called")
            }
            Self::Stays(Some(code)) => {
                format!("it runs in node {node}, and refuses the call to the bootloader with abort {code}")
            }
            Self::Lost(elsewhere) => {
                let elsewhere = elsewhere_words(elsewhere);
                format!("node {node} has not answered since the program was called back{elsewhere}")
            }
            Self::Ended(ended) => format!("{ended} (node {node})"),
        }
    }
}

/// The end of a program that ran for a while.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Ended {
    /// The time from its first frame on.
    pub ran: Duration,
    /// The reset that ended it, if the device has told it.
    pub by: Option<ResetCause>,
}

impl fmt::Display for Ended {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "it ran for {} ms and was reset by ", self.ran.as_millis())?;
        f.write_str(self.by.map_or("itself or by a watchdog", source))
    }
}

/// How the tool noticed another tool.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Intruder {
    /// Its SDO requests were seen; with the object of the last one, if the request names it.
    Requests(Option<Address>),
    /// Another process of this computer has locked the node; with its process id, if it is known.
    Process(Option<u32>),
}

impl Intruder {
    /// The intruder in words, and what it does with the device with this node-ID.
    fn words(self, node: NodeId) -> String {
        match self {
            Self::Requests(None) => format!("another tool is using node {node}: it sends SDO requests"),
            Self::Requests(Some(at)) => {
                format!("another tool is using node {node}: it sends SDO requests, the last one for {at}")
            }
            Self::Process(None) => format!("another coflash on this computer is using node {node}"),
            Self::Process(Some(id)) => {
                format!("another coflash on this computer, process {id}, is using node {node}")
            }
        }
    }
}

/// How a layer setting service failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LssFailure {
    /// No device answers.
    NoAnswer,
    /// The device has no node-ID, and the user has not given one.
    None,
    /// The device refuses.
    Refused {
        /// The standard's error code; FFh for a manufacturer's code.
        code: u8,
        /// The manufacturer's error code.
        detail: u8,
    },
}

impl LssFailure {
    /// The failure of this action in words.
    fn words(self, doing: LssDoing) -> String {
        let doing = doing.words();
        match self {
            Self::NoAnswer => format!("no device answers ({doing})"),
            Self::None => "the device has no node-ID".to_string(),
            Self::Refused { code, detail: 0 } => format!("the device refuses {doing}: error {code}"),
            Self::Refused { code, detail } => {
                format!("the device refuses {doing}: error {code}, manufacturer's code {detail}")
            }
        }
    }
}

/// A part of the identity object, 1018h.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum IdentityPart {
    /// 1018h/1.
    VendorId,
    /// 1018h/2.
    ProductCode,
    /// 1018h/4.
    SerialNumber,
}

impl IdentityPart {
    /// The part at this sub-index of 1018h.
    pub(crate) const fn of(sub: u8) -> Self {
        match sub {
            1 => Self::VendorId,
            2 => Self::ProductCode,
            _ => Self::SerialNumber,
        }
    }

    /// The error that the bootloader reports for a file with another value. A file names no serial number.
    const fn error(self) -> FlashError {
        match self {
            Self::VendorId => FlashError::WrongVendorId,
            Self::ProductCode | Self::SerialNumber => FlashError::WrongProductId,
        }
    }

    pub(crate) const fn words(self) -> &'static str {
        match self {
            Self::VendorId => "vendor-ID",
            Self::ProductCode => "product code",
            Self::SerialNumber => "serial number",
        }
    }
}

impl Error {
    /// The error of a value of another length than its type has.
    pub(crate) const fn wrong_length(at: Address) -> Self {
        Self::Protocol { doing: Doing::Read(at), code: AbortCode::LENGTH }
    }

    /// Whether the device has refused the command at once with an abort, and so has not begun to
    /// carry it out.
    #[must_use]
    pub const fn is_refusal(&self) -> bool {
        matches!(self, Self::Refused { .. } | Self::Failed { code: Some(_), .. })
    }

    /// Whether this is the silence of a program that was started: the adapter may be its reason.
    pub(crate) const fn is_silence(&self) -> bool {
        matches!(
            self,
            Self::NoAnswer { .. }
                | Self::FellSilent { .. }
                | Self::SilentOnTrial { .. }
                | Self::StartFailed { running: None, .. }
                | Self::TrialFailed {
                    how: TrialFailure::Silent(_) | TrialFailure::FellSilent(_) | TrialFailure::Lost(_),
                    ..
                }
        )
    }

    /// Whether the device has refused block 0 or the first block with data. A device that erases
    /// when it receives the first good block has then lost nothing.
    #[must_use]
    pub fn refuses_first_blocks(&self) -> bool {
        matches!(
            self,
            Self::Refused { doing: Doing::Block(0 | 1), .. }
                | Self::Failed { doing: Doing::Block(0 | 1), .. }
        )
    }

    /// What the device has answered, one sentence for each: the abort code, the status in 1F57h, the state
    /// in 2007h. Empty if it has given no reason.
    #[must_use]
    pub fn answers(&self) -> Vec<String> {
        let (code, failed, state) = match self {
            Self::Refused { code, .. } => (Some(*code), None, None),
            Self::NoBootloader { code, .. } | Self::TrialFailed { how: TrialFailure::Stays(code), .. } => {
                (*code, None, None)
            }
            Self::Failed { error, detail, code, .. } => (*code, Some((*error, *detail)), None),
            Self::StartFailed { status, state, .. }
            | Self::TrialFailed { how: TrialFailure::NotStarted(status, state), .. } => {
                let failed = status.and_then(|status| Some((status.error?, status.detail)));
                (None, failed, *state)
            }
            _ => (None, None, None),
        };
        let code = code.map(|code| format!("SDO abort {code}"));
        let failed = failed.map(|(error, detail)| {
            let words = failure_words(error, detail);
            format!("1F57h reads {:02X}h, detail {detail:04X}h: {words}", error.code())
        });
        let state = state.map(|state| format!("2007h: it {state}"));
        [code, failed, state].into_iter().flatten().collect()
    }

    /// The stable error number: the manual's number (L-1112e_5, table 5, which contains all numbers
    /// of the newer manual) if there is one, otherwise 60000100h plus the code of 1F57h, 60000200h
    /// plus the error code of LSS, or 6000030xh for adapters.
    #[must_use]
    pub const fn number(&self) -> u32 {
        match self {
            Self::Adapter(error) => error.number(),
            Self::NoVerdict { .. } => 0x6000_0303,
            Self::WrongCrc { .. } => 0x6000_0001,
            Self::Failed { error, .. } => flash_error_number(*error),
            Self::WrongTarget { what, .. } => flash_error_number(what.error()),
            // The numbers of the same errors in a firmware file, found without a device.
            Self::OtherRegion { .. } => 0x6000_0015,
            Self::NoProgram { number, .. } => *number,
            Self::SealedOnly { .. } => flash_error_number(FlashError::NoAccess),
            Self::NoBootloader { .. } => 0x6000_0010,
            Self::Cancelled => 0x6000_0011,
            Self::NotAlone { .. } => 0x6000_0012,
            Self::NoAnswer { .. } => 0x6000_0013,
            Self::Lss { failure: LssFailure::NoAnswer, .. } => 0x6000_0013,
            Self::Lss { failure: LssFailure::None, .. } => 0x6000_0017,
            Self::NotInDialect { .. } | Self::NoPassword { .. } | Self::NotRenewable { .. } => 0x6000_0018,
            Self::Occupied { .. } => 0x6000_0010,
            Self::Lss { failure: LssFailure::Refused { code, .. }, .. } => 0x6000_0200 + *code as u32,
            Self::TrialFailed { how: TrialFailure::Stays(_) | TrialFailure::Lost(_), .. } => 0x6000_0010,
            Self::StartFailed { .. }
            | Self::ProgramEnded { .. }
            | Self::FellSilent { .. }
            | Self::TrialFailed { .. }
            | Self::RenewalFailed { .. }
            | Self::SilentOnTrial { .. }
            | Self::FirstFailed { .. }
            | Self::Unconfirmable { .. }
            | Self::OtherIdentity { .. } => 0x6000_0014,
            Self::Busy { .. } => 0x6000_0016,
            Self::Refused { .. } | Self::Protocol { .. } | Self::ShortAnswer { .. } => 0x6000_0025,
        }
    }
}

/// The manual's number for an error of 1F57h.
#[must_use]
pub const fn flash_error_number(error: FlashError) -> u32 {
    match error {
        FlashError::NoValidProgram => 0x6000_0001,
        FlashError::Format => 0x6000_0002,
        FlashError::Crc => 0x6000_0003,
        FlashError::NotCleared => 0x6000_0004,
        FlashError::Write => 0x6000_0005,
        FlashError::Address => 0x6000_0006,
        FlashError::Secured => 0x6000_0007,
        // Newer than the list in the manual.
        FlashError::NvData
        | FlashError::WrongVendorId
        | FlashError::WrongProductId
        | FlashError::NoAccess
        | FlashError::Busy
        | FlashError::Sequence
        | FlashError::Signature
        | FlashError::Rollback
        | FlashError::Key => 0x6000_0100 + error.code() as u32,
        // "An error that is unknown to the tool", or unspecified.
        _ => 0x6000_0008,
    }
}

/// The ids of root keys in brackets, if there are any.
fn roots_in_brackets(roots: &[u32]) -> String {
    if roots.is_empty() {
        return String::new();
    }
    format!(" ({})", roots_words(roots))
}

/// What runs in the place of the expected program; `silence` if nothing answers.
fn running_words(running: Option<DeviceType>, silence: &str) -> String {
    running.map_or(silence.to_string(), |running| format!("stays in {running}"))
}

/// A program that answered once.
fn silence_words(node: NodeId, elsewhere: Option<NodeId>) -> String {
    format!("it answered after its start, and node {node} is silent since then{}", elsewhere_words(elsewhere))
}

/// A node that may be the device under another node-ID.
fn elsewhere_words(elsewhere: Option<NodeId>) -> String {
    elsewhere.map_or(String::new(), |other| format!(", but node {other} has booted up since then"))
}

/// A value of the identity object.
fn identity_words(value: Option<u32>) -> String {
    value.map_or("none".to_string(), |value| format!("{value:08X}h"))
}

/// The error in 1F57h of a device that stays in its bootloader.
fn status_words(status: Option<FlashStatus>) -> String {
    let error = status.and_then(|status| status.error);
    error.map_or(String::new(), |error| format!("; {error} (1F57h reads {:02X}h)", error.code()))
}

/// An error of 1F57h in words, with its detail: for a protected sector that is its number
/// (docs/protocol.md). Sector 0 belongs to the bootloader on each board, so 0 is none.
pub(crate) fn failure_words(error: FlashError, detail: u16) -> String {
    match (error, detail) {
        (FlashError::Secured, 1..) => format!("sector {detail} of the flash is write-protected"),
        (FlashError::NotCleared, 1..) => {
            format!("program {detail} reaches into the flash where a new bootloader waits")
        }
        (FlashError::Format, OTHER_FACTS) => {
            "the bootloader was built for a resident part that decides by other \
             choices: programs that it installs would not start"
                .to_string()
        }
        (FlashError::NoAccess, LOW_SUPPLY) => {
            "the supply of the device is too low to write its flash".to_string()
        }
        _ => error.to_string(),
    }
}

/// The detail of [`FlashError::NoAccess`] for a supply that is too low.
pub(crate) const LOW_SUPPLY: u16 = SUPPLY_DETAIL as u16;

/// The detail of [`FlashError::Format`] for a bootloader that does not fit the resident part.
const OTHER_FACTS: u16 = Damage::Facts as u16;

/// The detail of an error of 1F57h as a number, unless it is 0 or [`failure_words`] have it.
pub(crate) fn detail_words(error: Option<FlashError>, detail: u16) -> String {
    match (error, detail) {
        (_, 0)
        | (Some(FlashError::Secured | FlashError::NotCleared), _)
        | (Some(FlashError::Format), OTHER_FACTS)
        | (Some(FlashError::NoAccess), LOW_SUPPLY) => String::new(),
        _ => format!(", detail {detail:04X}h"),
    }
}

/// Why a device stays in its bootloader, and how its program ended.
fn why_words(state: Option<BootloaderState>) -> String {
    let Some(state) = state else { return String::new() };
    let ended = state.ended_by().map(|by| format!("; the program was ended by {}", source(by)));
    format!("; {}{}", reason(state.stayed()), ended.unwrap_or_default())
}

/// Translates a gateway's error into the error of a transfer over the bus.
pub(crate) fn of_gateway(error: GatewayError, node: NodeId, doing: Doing) -> Error {
    match error {
        GatewayError::Adapter(error) => Error::Adapter(error),
        GatewayError::NoAnswer => Error::NoAnswer { node, doing },
        GatewayError::Abort(code) => Error::Refused { node, doing, code },
        GatewayError::Cancelled => Error::Cancelled,
    }
}

/// The ids of root keys in words.
pub(crate) fn roots_words(roots: &[u32]) -> String {
    let ids: Vec<String> = roots.iter().map(|id| format!("{id:08X}h")).collect();
    let noun = if ids.len() == 1 { "root" } else { "roots" };
    format!("{noun} {}", ids.join(", "))
}

/// Turns any refusal, and a value of another length than its type has, into `None`: an object that
/// a device need not have costs nothing else.
pub(crate) fn reported<T>(read: Result<T, Error>) -> Result<Option<T>, Error> {
    match read {
        Ok(value) => Ok(Some(value)),
        Err(Error::Refused { .. } | Error::Protocol { code: AbortCode::LENGTH, .. }) => Ok(None),
        Err(error) => Err(error),
    }
}

pub(crate) fn absent(code: AbortCode) -> bool {
    matches!(
        code,
        AbortCode::NO_OBJECT
            | AbortCode::NO_SUB_INDEX
            | AbortCode::UNSUPPORTED_ACCESS
            | AbortCode::WRITE_ONLY
            | AbortCode::NO_DATA
    )
}
