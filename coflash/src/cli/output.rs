//! What a command says: words for people, one JSON document for programs, and how it ends.

use std::fmt;
use std::io::{self, IsTerminal, Write as _};
use std::path::Path;

use canopen::NodeId;
use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::Args;
use coflash::bus::AdapterError;
use coflash::device::diagnose::{diagnose, Diagnosis};
use coflash::device::error::LssFailure;
use coflash::device::{legacy, Session};
use coflash::file::convert::ConvertError;
use coflash::file::sealed::Refusal;
use coflash::file::{judge, Cause, FileError};
use coflash::update::job::Fault;
use coflash::update::{refusal_number, Left, Look};
use coflash::Error;
use serde_json::{json, Value};

use super::record;

/// Under this the options that all commands have are listed.
pub(super) const GLOBAL: &str = "For all commands";

/// How much is said, and in which form. For all commands.
#[derive(Clone, Copy, Debug, Default, Args)]
pub(super) struct Output {
    /// Write one JSON document to standard output in place of words for people.
    #[arg(long, global = true, help_heading = GLOBAL)]
    json: bool,

    /// Write what happens to standard output as it happens, one JSON object a line: found, phase,
    /// progress, retry, done; then the result, or the error.
    #[arg(long, global = true, help_heading = GLOBAL, conflicts_with = "json")]
    json_events: bool,

    /// Say nothing unless something goes wrong.
    #[arg(long, short, global = true, help_heading = GLOBAL, conflicts_with = "verbose")]
    quiet: bool,

    /// Say more: what is waited for, and what was chosen where the command line did not say it.
    #[arg(long, short, global = true, help_heading = GLOBAL)]
    verbose: bool,

    /// End with the error numbers of the manual's tools (0x60000013 and so on) in place of the exit
    /// codes below; of these numbers Unix keeps the last two digits.
    #[arg(long, global = true, help_heading = GLOBAL, env = "COFLASH_LEGACY_EXIT_CODES",
          value_parser = clap::builder::FalseyValueParser::new())]
    legacy_exit_codes: bool,
}

impl Output {
    /// What either of two says.
    pub(super) fn or(self, other: Self) -> Self {
        let Self { json, json_events, quiet, verbose, legacy_exit_codes } = other;
        Self {
            json: self.json || json,
            json_events: self.json_events || json_events,
            quiet: self.quiet || quiet,
            verbose: self.verbose || verbose,
            legacy_exit_codes: self.legacy_exit_codes || legacy_exit_codes,
        }
    }

    /// What the plain words of the command line say, where it cannot be read as a whole.
    pub(super) fn of_words() -> Self {
        let set = std::env::var("COFLASH_LEGACY_EXIT_CODES").unwrap_or_default().to_lowercase();
        let falsey = matches!(set.as_str(), "" | "0" | "n" | "no" | "f" | "false" | "off");
        let said = |option: &str| std::env::args_os().any(|word| word == *option);
        let legacy_exit_codes = said("--legacy-exit-codes") || !falsey;
        Self {
            legacy_exit_codes,
            json: said("--json"),
            json_events: said("--json-events"),
            ..Self::default()
        }
    }

    /// The code that the program ends with for a failure.
    pub(super) fn code(self, failure: &Failure) -> u32 {
        if self.legacy_exit_codes {
            failure.legacy
        } else {
            failure.exit as u32
        }
    }

    /// Ends the program for a failure.
    pub(super) fn exit(self, failure: &Failure) -> ! {
        let code = self.code(failure);
        // All numbers are below 2^31.
        std::process::exit(code as i32)
    }

    /// Whether people read along.
    pub(super) fn for_people(self) -> bool {
        !self.for_programs() && !self.quiet
    }

    /// Whether a program reads along, and people do not.
    pub(super) fn for_programs(self) -> bool {
        self.json || self.json_events
    }

    /// Whether a program is told what happens.
    pub(super) fn shows_events(self) -> bool {
        self.json_events
    }

    /// Whether a person may want to know what is waited for; that goes to standard error.
    pub(super) fn shows_waiting(self) -> bool {
        self.for_people() && io::stderr().is_terminal()
    }

    /// Whether a bar that moves makes sense.
    pub(super) fn on_terminal(self) -> bool {
        self.for_people() && io::stdout().is_terminal()
    }

    /// Says something to people. A reader that has gone away (`| head`) is no reason to stop an
    /// update.
    pub(super) fn say(self, words: impl fmt::Display) {
        record::note("said", &words.to_string());
        if self.for_people() {
            let _ = writeln!(io::stdout(), "{words}");
        }
    }

    /// Says on standard error what people should know and programs need not.
    pub(super) fn note(self, words: impl fmt::Display) {
        if self.for_people() {
            let _ = writeln!(io::stderr(), "{words}");
        }
    }

    /// Says something to people who asked for more.
    pub(super) fn detail(self, words: impl fmt::Display) {
        record::note("detail", &words.to_string());
        if self.verbose {
            let _ = writeln!(io::stderr(), "{words}");
        }
    }

    /// The result of a command: words for people, the value for programs.
    pub(super) fn result(self, words: impl fmt::Display, value: impl FnOnce() -> Value) {
        let text = words.to_string();
        record::note("result", &text);
        if self.for_programs() || record::is_kept() {
            self.value(&value());
        }
        if self.for_people() {
            let _ = writeln!(io::stdout(), "{}", text.trim_end());
        }
    }

    /// What a command came to, as one JSON document in one line.
    pub(super) fn value(self, value: &Value) {
        record::result(value);
        self.document("result", value);
    }

    /// Something that happens, for programs.
    pub(super) fn event(self, line: &Value) {
        if self.json_events {
            let _ = writeln!(io::stdout(), "{line}");
        }
    }

    fn document(self, event: &str, value: &Value) {
        if self.json_events {
            let mut line = json!({ "event": event });
            if let (Some(line), Some(value)) = (line.as_object_mut(), value.as_object()) {
                line.extend(value.clone());
            }
            self.event(&line);
        } else if self.json {
            let _ = writeln!(io::stdout(), "{value}");
        }
    }

    /// A line of an endless list: words for people, a value for programs. Tells whether anybody
    /// still reads.
    pub(super) fn listed(self, words: impl fmt::Display, value: impl FnOnce() -> Value) -> bool {
        if self.for_programs() {
            writeln!(io::stdout(), "{}", value()).is_ok()
        } else {
            self.quiet || writeln!(io::stdout(), "{words}").is_ok()
        }
    }

    /// Something that people should know although the command goes on. Never on standard output.
    pub(super) fn warn(self, words: impl fmt::Display) {
        record::note("warning", &words.to_string());
        let _ = writeln!(io::stderr(), "{} {words}", paint("warning:", "33"));
    }

    /// A failure, as the last thing that a command says.
    pub(super) fn failure(self, failure: &Failure) {
        record::note("error", failure.to_string().trim_end());
        if self.for_programs() {
            if !failure.told {
                self.document("error", &failure.value());
            }
        } else {
            let _ = write!(io::stderr(), "{failure}");
        }
    }
}

/// Colours a word on standard error, if that is a terminal and nobody objects
/// (<https://no-color.org>).
fn paint(word: &str, colour: &str) -> String {
    let objected = std::env::var_os("NO_COLOR").is_some_and(|value| !value.is_empty());
    if io::stderr().is_terminal() && !objected {
        format!("\x1B[1;{colour}m{word}\x1B[0m")
    } else {
        word.to_string()
    }
}

/// The exit codes, as every `--help` tells them.
pub(super) const EXIT_CODES: &str = "\
Exit codes:
  0    done
  1    the result cannot be written, or the system refuses something else
  2    wrong usage
  3    the firmware file is bad, or does not fit the board or the device; nothing was changed
  4    the CAN adapter cannot be opened, or is gone
  5    the device does not answer
  6    the device refuses, or reports an error
  7    the program does not start, or the application does not go back to the bootloader
  8    some of several devices failed; the summary tells which
  130  cancelled";

/// The exit codes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub(super) enum Exit {
    System = 1,
    Usage = 2,
    File = 3,
    Adapter = 4,
    NoAnswer = 5,
    Device = 6,
    NoStart = 7,
    Some = 8,
    Cancelled = 130,
}

/// EIO: what the system refuses has its own number where it is known, and this one elsewhere.
const INPUT_OUTPUT: u32 = 5;

impl Exit {
    /// The number that a tool of the manual ends with, where the failure itself has none.
    const fn legacy(self) -> u32 {
        match self {
            Self::System => INPUT_OUTPUT,
            Self::Usage | Self::File => legacy::INVALID_PARAMETER,
            Self::Adapter | Self::NoAnswer | Self::Device | Self::NoStart | Self::Some | Self::Cancelled => {
                legacy::UNKNOWN
            }
        }
    }
}

/// Why a command failed: what happened, what to do, and how it ends.
#[derive(Debug)]
pub(super) struct Failure {
    pub(super) exit: Exit,
    /// The stable number, where there is one.
    number: Option<u32>,
    /// What a tool of the manual ends with.
    pub(super) legacy: u32,
    what: String,
    /// In what state the device is left, where that is known.
    left: Option<Left>,
    advice: Option<String>,
    /// Whether the document on standard output has it already.
    told: bool,
}

impl Failure {
    /// A conversation that failed. Where the device is silent, the bus is listened to for the
    /// reason.
    pub(super) fn diagnosed(error: Error, session: &mut Session<'_>) -> Self {
        let silent = matches!(error, Error::NoAnswer { .. }) && session.hears_the_bus();
        let failure = Self::from(error);
        match silent.then(|| diagnose(session)) {
            Some(Ok(diagnosis)) => Self { advice: Some(diagnosis.to_string()), ..failure },
            // The first reason stands.
            Some(Err(_)) | None => failure,
        }
    }

    /// A conversation of several that failed: where the device was silent, this is why.
    pub(super) fn diagnosed_by(error: Error, diagnosis: Option<&Diagnosis>, node: NodeId) -> Self {
        let silent = matches!(error, Error::NoAnswer { .. });
        let failure = Self::from(error);
        match diagnosis.filter(|_| silent) {
            Some(diagnosis) => {
                let its = Diagnosis { node, ..diagnosis.clone() };
                Self { advice: Some(its.to_string()), ..failure }
            }
            None => failure,
        }
    }

    /// Devices of several have failed, and the summary has told why; the manual's tools, which know
    /// one device, would have ended with `legacy` for the first of them.
    pub(super) fn told(exit: Exit, legacy: u32, failed: usize, of: usize) -> Self {
        let what = format!("{failed} of {of} devices failed");
        Self { told: true, legacy, ..Self::new(exit, None, what, None) }
    }

    /// A device that differs from a file in so many things, each of which was told.
    pub(super) fn differs(node: NodeId, count: usize) -> Self {
        let what = match count {
            1 => format!("node {node} differs from the file in one thing"),
            count => format!("node {node} differs from the file in {count} things"),
        };
        let advice =
            "flash the file, or look for the one that the device was made with; coflash events tells \
                      what was installed";
        Self { told: true, ..Self::new(Exit::File, None, what, Some(advice.to_string())) }
    }

    /// Objects of several that the device refused, each of which was told; it ends as the first of
    /// them would have.
    pub(super) fn unread(first: &Self, failed: usize, of: usize) -> Self {
        let what = format!("{failed} of {of} objects could not be read");
        Self { told: true, legacy: first.legacy, ..Self::new(first.exit, None, what, None) }
    }

    fn new(exit: Exit, number: Option<u32>, what: String, advice: Option<String>) -> Self {
        let legacy = number.unwrap_or(exit.legacy());
        Self { exit, number, legacy, what, left: None, advice, told: false }
    }

    /// What the command line's reader objects to.
    pub(super) fn unreadable_line(error: &clap::Error) -> Self {
        let of_node = error.get(ContextKind::InvalidArg).is_some_and(|name| {
            let ContextValue::String(name) = name else { return false };
            name.split_whitespace().any(|word| matches!(word, "--node" | "--nodes"))
        });
        let wrong_value = matches!(error.kind(), ErrorKind::ValueValidation | ErrorKind::InvalidValue);
        let legacy = if of_node && wrong_value { legacy::INVALID_NODE_ID } else { legacy::INVALID_PARAMETER };
        Self { legacy, ..Self::bare_usage(error.render().to_string()) }
    }

    /// A fault in a job file.
    pub(super) fn job(path: &Path, fault: &Fault) -> Self {
        Self::new(Exit::File, None, format!("{}, {fault}", path.display()), None)
    }

    /// The same, with the state in which the device is left.
    pub(super) fn leaving(self, left: Option<Left>) -> Self {
        Self { left, ..self }
    }

    pub(super) fn usage(what: impl Into<String>, advice: impl Into<String>) -> Self {
        Self::new(Exit::Usage, None, what.into(), Some(advice.into()))
    }

    /// Words of the command line's reader, which have their advice in them.
    pub(super) fn bare_usage(words: String) -> Self {
        let what = words.strip_prefix("error: ").unwrap_or(&words).trim_end().to_string();
        Self::new(Exit::Usage, None, what, None)
    }

    /// A file, other than firmware, that cannot be read.
    pub(super) fn unreadable(path: &Path, error: &io::Error) -> Self {
        let number = error.raw_os_error().and_then(|code| u32::try_from(code).ok());
        let what = format!("{}: cannot be read: {error}", path.display());
        Self::new(Exit::File, number, what, None)
    }

    /// A file, other than firmware, that is not what it should be.
    pub(super) fn file(path: &Path, why: &str) -> Self {
        Self::new(Exit::File, None, format!("{}: {why}", path.display()), None)
    }

    /// A fault in a line of a file, other than firmware.
    pub(super) fn line(path: &Path, line: usize, why: &str) -> Self {
        let what = format!("{}, line {line}: {why}", path.display());
        Self::new(Exit::File, None, what, None)
    }

    pub(super) fn system(what: String) -> Self {
        Self::new(Exit::System, None, what, None)
    }

    /// A device that was reset and has not come back.
    pub(super) fn no_boot_up(node: NodeId) -> Self {
        let advice = "check that node-ID and bit rate are right; a device with a new node-ID comes back under that one";
        let what = format!("node {node} has sent no boot-up message");
        let advice = Some(advice.to_string());
        Self::new(Exit::NoAnswer, Some(0x6000_0013), what, advice)
    }

    /// A firmware file that holds no program.
    pub(super) fn no_program(path: &Path, fault: judge::Fault) -> Self {
        let (what, advice) = (format!("{}: {fault}", path.display()), fault.advice().to_string());
        Self::new(Exit::File, Some(judge::Fault::NUMBER), what, Some(advice))
    }

    /// A sealed image that breaks a rule.
    pub(super) fn sealed(path: &Path, refusal: &Refusal) -> Self {
        let number = Some(refusal_number(refusal));
        let (what, advice) = (format!("{}: {refusal}", path.display()), refusal.advice().to_string());
        // The manual's tools know no such files.
        let legacy = Exit::File.legacy();
        Self { legacy, ..Self::new(Exit::File, number, what, Some(advice)) }
    }

    /// A conversion of `file` that failed.
    pub(super) fn convert(error: ConvertError, file: &Path) -> Self {
        match error {
            ConvertError::File(error) => error.of(file.display()).into(),
            ConvertError::BlockSize { .. }
            | ConvertError::Start(_)
            | ConvertError::Range(_)
            | ConvertError::Adjust(_)
            | ConvertError::Blocks(_) => Self::new(Exit::Usage, Some(0x6000_0018), error.to_string(), None),
        }
    }

    /// For programs.
    pub(super) fn value(&self) -> Value {
        json!({
            "error": {
                "number": self.number.map(|number| format!("{number:#010x}")),
                "exit": self.exit as u8,
                "what": self.what,
                "device": self.left.map(|left| left.state.name()),
                "seen": self.left.and_then(|left| match left.look {
                    Look::Seen(seen) => Some(json!({
                        "device_type": seen.running.0,
                        "bootloader": seen.running.is_bootloader(),
                        "control": seen.control,
                        "crc": seen.crc,
                    })),
                    Look::Silent | Look::NotAsked => None,
                }),
                "advice": self.advice,
            }
        })
    }
}

impl From<FileError> for Failure {
    fn from(error: FileError) -> Self {
        let cause = &error.error.cause;
        let advice = match cause {
            Cause::Io(error) => match error.kind() {
                io::ErrorKind::NotFound => "check the file's name, and the folder that the command runs in",
                io::ErrorKind::IsADirectory => "name the firmware file in this folder",
                io::ErrorKind::PermissionDenied => "check who may read the file",
                _ => "copy the file to this computer's own disk, and try again",
            },
            Cause::Empty => "build the program again, or copy the file again: nothing is in it",
            Cause::NotFirmware => "name the linker's output (ELF, Intel HEX, S-record) or a block file",
            Cause::CutOff { .. } | Cause::NoEnd(_) | Cause::Checksum { .. } | Cause::BadDigit { .. } => {
                "copy the file again from where it was built, or build it again"
            }
            // Their words say what to do.
            _ => "",
        };
        let advice = Some(advice.to_string()).filter(|advice| !advice.is_empty());
        Self::new(Exit::File, Some(cause.number()), error.to_string(), advice)
    }
}

impl From<AdapterError> for Failure {
    fn from(error: AdapterError) -> Self {
        Error::from(error).into()
    }
}

impl From<Error> for Failure {
    fn from(error: Error) -> Self {
        let exit = match &error {
            Error::Adapter(AdapterError::Url { .. }) => Exit::Usage,
            Error::Adapter(_) => Exit::Adapter,
            Error::Cancelled => Exit::Cancelled,
            Error::NotInDialect { .. } | Error::NoPassword { .. } => Exit::Usage,
            Error::NoAnswer { .. } | Error::Lss { failure: LssFailure::NoAnswer, .. } => Exit::NoAnswer,
            Error::Refused { .. }
            | Error::Protocol { .. }
            | Error::Failed { .. }
            | Error::Busy { .. }
            | Error::WrongCrc { .. }
            | Error::WrongTarget { .. }
            | Error::NoProgram { .. }
            | Error::OtherRegion { .. }
            | Error::NotAlone { .. }
            | Error::Lss { .. } => Exit::Device,
            Error::NoBootloader { .. }
            | Error::Occupied { .. }
            | Error::StartFailed { .. }
            | Error::TrialFailed { .. }
            | Error::OtherIdentity { .. } => Exit::NoStart,
        };
        let legacy = legacy::exit_code(&error);
        Self { legacy, ..Self::new(exit, Some(error.number()), error.to_string(), Some(error.advice())) }
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {}", paint("error:", "31"), self.what)?;
        if let Some(number) = self.number {
            write!(f, " [{number:#010x}]")?;
        }
        writeln!(f)?;
        if let Some(left) = self.left {
            writeln!(f, "  the device: {left}")?;
        }
        match &self.advice {
            Some(advice) => writeln!(f, "  what to do: {advice}"),
            None => Ok(()),
        }
    }
}
