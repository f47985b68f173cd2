//! The output of a command: words for people, one JSON document for programs, and the exit code.

use std::fmt;
use std::io::{self, IsTerminal, Write as _};
use std::path::Path;

use canopen::NodeId;
use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::Args;
use coboot_can::AdapterError;
use coflash_core::device::diagnose::{diagnose, Diagnosis};
use coflash_core::device::error::LssFailure;
use coflash_core::device::{legacy, Session};
use coflash_core::file::board::NamedError;
use coflash_core::file::convert::ConvertError;
use coflash_core::file::sealed::Refusal;
use coflash_core::file::{judge, ram_image, Cause, FileError};
use coflash_core::machine;
use coflash_core::update::{refusal_number, ContentFault, DeviceAfterUpdate, DeviceAnswer};
use coflash_core::Error;
use serde_json::{json, Value};

use super::record;

/// The options for the amount and the form of the output, for all commands.
#[derive(Clone, Copy, Debug, Default, Args)]
pub(super) struct Output {
    /// Write one JSON document to standard output in place of words.
    #[arg(long, global = true)]
    json: bool,

    /// Write events to standard output as they happen, one JSON object on each line: found, phase,
    /// progress, retry, done; then the result, or the error.
    #[arg(long, global = true, conflicts_with = "json", hide_short_help = true)]
    json_events: bool,

    /// Print nothing unless there is an error.
    #[arg(long, short, global = true, conflicts_with = "verbose", hide_short_help = true)]
    quiet: bool,

    /// Print more: what the tool waits for, and what it has chosen by itself.
    #[arg(long, short, global = true, hide_short_help = true)]
    verbose: bool,

    /// Exit with the error numbers of the manual's tools (0x60000013 and so on) in place of the
    /// exit codes below; Unix keeps only the last two digits of these numbers.
    #[arg(long, global = true, env = "COFLASH_LEGACY_EXIT_CODES",
          value_parser = clap::builder::FalseyValueParser::new(), hide_short_help = true)]
    legacy_exit_codes: bool,
}

impl Output {
    /// Combines the options of two sources.
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

    /// The output options among the words of a command line that cannot be parsed as a whole.
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

    /// The program's exit code for a failure.
    pub(super) fn code(self, failure: &Failure) -> u32 {
        if self.legacy_exit_codes {
            failure.legacy
        } else {
            failure.exit as u32
        }
    }

    /// Ends the program with a failure.
    pub(super) fn exit(self, failure: &Failure) -> ! {
        let code = self.code(failure);
        // All numbers are below 2^31.
        std::process::exit(code as i32)
    }

    /// Whether the output is for people.
    pub(super) fn for_people(self) -> bool {
        !self.for_programs() && !self.quiet
    }

    /// Whether the output is for programs alone.
    pub(super) fn for_programs(self) -> bool {
        self.json || self.json_events
    }

    /// Whether programs get events.
    pub(super) fn shows_events(self) -> bool {
        self.json_events
    }

    /// Whether to show what the tool waits for; this goes to standard error.
    pub(super) fn shows_waiting(self) -> bool {
        self.for_people() && io::stderr().is_terminal()
    }

    /// Whether a progress bar is useful.
    pub(super) fn on_terminal(self) -> bool {
        self.for_people() && io::stdout().is_terminal()
    }

    /// Prints a message for people. A closed standard output (`| head`) does not stop an update.
    pub(super) fn say(self, words: impl fmt::Display) {
        record::note("said", &words.to_string());
        if self.for_people() {
            let _ = writeln!(io::stdout(), "{words}");
        }
    }

    /// Prints a message on standard error that people need and programs do not.
    pub(super) fn note(self, words: impl fmt::Display) {
        if self.for_people() {
            let _ = writeln!(io::stderr(), "{words}");
        }
    }

    /// Prints a message for people who asked for more output.
    pub(super) fn detail(self, words: impl fmt::Display) {
        record::note("detail", &words.to_string());
        if self.verbose {
            let _ = writeln!(io::stderr(), "{words}");
        }
    }

    /// Prints the result of a command: words for people, the value for programs.
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

    /// Prints the result of a command as one JSON document in one line.
    pub(super) fn value(self, value: &Value) {
        record::result(value);
        self.document("result", value);
    }

    /// Prints an event for programs.
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

    /// Prints a line of an endless list: words for people, a value for programs. Returns whether
    /// standard output is still open.
    pub(super) fn listed(self, words: impl fmt::Display, value: impl FnOnce() -> Value) -> bool {
        if self.for_programs() {
            writeln!(io::stdout(), "{}", value()).is_ok()
        } else {
            self.quiet || writeln!(io::stdout(), "{words}").is_ok()
        }
    }

    /// Prints a warning: the command continues, but people should know about it. Never uses
    /// standard output.
    pub(super) fn warn(self, words: impl fmt::Display) {
        record::note("warning", &words.to_string());
        let _ = writeln!(io::stderr(), "{} {words}", paint("warning:", "33"));
    }

    /// Prints a failure, the last message of a command.
    pub(super) fn failure(self, failure: &Failure) {
        let words = failure.unquoted().unwrap_or_else(|| failure.to_string());
        record::note("error", words.trim_end());
        if self.for_programs() {
            if !failure.is_shown {
                self.document("error", &failure.value());
            }
        } else {
            let _ = write!(io::stderr(), "{failure}");
        }
    }
}

/// Colours a word on standard error, if that is a terminal and the user allows colours
/// (<https://no-color.org>).
fn paint(word: &str, colour: &str) -> String {
    let objected = std::env::var_os("NO_COLOR").is_some_and(|value| !value.is_empty());
    if io::stderr().is_terminal() && !objected {
        format!("\x1B[1;{colour}m{word}\x1B[0m")
    } else {
        word.to_string()
    }
}

/// The exit codes, for the end of each `--help`.
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
  8    some of several devices failed; the summary says which
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

/// EIO: an error of the operating system has its own number if this is known, and this number
/// otherwise.
const INPUT_OUTPUT: u32 = 5;

impl Exit {
    /// The exit code of the manual's tools, if the failure itself has no number.
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

/// Why a command failed: what happened, what to do, and the exit code.
#[derive(Debug)]
pub(super) struct Failure {
    pub(super) exit: Exit,
    /// The stable error number, if it is more exact than `legacy`.
    number: Option<u32>,
    /// The exit code of the manual's tools.
    pub(super) legacy: u32,
    what: String,
    /// The state of the device after the failure, if it is known.
    left: Option<DeviceAfterUpdate>,
    advice: Option<String>,
    /// The device's own answers, in words.
    answers: Vec<String>,
    /// What is wrong with the line, if `what` quotes words of it: one may be a secret, so records
    /// have this alone.
    quoted: Option<ErrorKind>,
    /// Whether the document on standard output already contains the failure.
    is_shown: bool,
}

impl Failure {
    /// An error of a conversation. If the device is silent, the tool observes the bus to find the
    /// reason.
    pub(super) fn diagnosed(error: impl Into<Self>, session: &mut Session<'_>) -> Self {
        let failure = error.into();
        let silent = failure.exit == Exit::NoAnswer && session.hears_the_bus();
        match silent.then(|| diagnose(session)) {
            Some(Ok(diagnosis)) => failure.advised(diagnosis),
            // The first error remains the reason.
            Some(Err(_)) | None => failure,
        }
    }

    /// An error of one of several conversations. If the device was silent, `diagnosis` gives the
    /// reason.
    pub(super) fn diagnosed_by(error: Error, diagnosis: Option<&Diagnosis>, node: NodeId) -> Self {
        let silent = matches!(error, Error::NoAnswer { .. });
        let failure = Self::from(error);
        match diagnosis.filter(|_| silent) {
            Some(diagnosis) => failure.advised(Diagnosis { node, ..diagnosis.clone() }),
            None => failure,
        }
    }

    /// Several devices have failed, and the summary has shown the reasons. `legacy` is the exit
    /// code of the manual's tools, which handle one device, for the first failed device.
    pub(super) fn several(exit: Exit, legacy: u32, what: String) -> Self {
        Self { legacy, ..Self::new(exit, what).shown() }
    }

    /// The end of a command for so many devices, of which these have failed.
    pub(super) fn of_all(failures: &[&Self], of: usize) -> Result<(), Self> {
        Self::of_each(failures, of, "devices failed")
    }

    /// The same for the programs of a package: a device may have several, and an older one has not failed.
    pub(super) fn of_programs(failures: &[&Self], of: usize) -> Result<(), Self> {
        Self::of_each(failures, of, "programs are not in their devices")
    }

    fn of_each(failures: &[&Self], of: usize, what: &str) -> Result<(), Self> {
        let Some(first) = failures.first() else { return Ok(()) };
        let is_cancelled = failures.iter().any(|failure| failure.exit == Exit::Cancelled);
        let exit = if is_cancelled { Exit::Cancelled } else { Exit::Some };
        Err(Self::several(exit, first.legacy, format!("{} of {of} {what}", failures.len())))
    }

    /// Nothing on the bus is a device that a package is for.
    pub(super) fn no_device_for(package: &Path) -> Self {
        let what = format!("{}: no device on the bus is one that the package is for", package.display());
        let advice =
            "look at the bus with coflash scan: check the bit rate, and that the package is for this machine";
        Self::new(Exit::NoAnswer, what).advised(advice)
    }

    /// A device without a node-ID, for which none is left.
    pub(super) fn no_node_id_left() -> Self {
        let advice = "begin with a lower node-ID";
        Self::new(Exit::Some, "no node-ID is left for further devices").advised(advice)
    }

    /// A device that differs from a file in `count` properties; each one was shown.
    pub(super) fn differs(node: NodeId, count: usize) -> Self {
        let what = match count {
            1 => format!("node {node} differs from the file in one property"),
            count => format!("node {node} differs from the file in {count} properties"),
        };
        let advice =
            "flash the file, or find the file that the device was programmed with; coflash seal events shows \
                      what was installed";
        Self::new(Exit::File, what).advised(advice).shown()
    }

    /// A device whose state or option bytes forbid its delivery; each reason was shown.
    pub(super) fn not_ready(node: NodeId) -> Self {
        let advice = "do what each line says, and run the command again";
        Self::new(Exit::Device, format!("node {node} is not ready")).advised(advice).shown()
    }

    /// A device that has failed `count` conformance checks; each one was shown.
    #[cfg(feature = "conform")]
    pub(super) fn nonconforming(node: NodeId, count: usize) -> Self {
        Self::new(Exit::Device, format!("node {node} has failed {count} of the checks")).shown()
    }

    /// The device refused some of several objects; each refusal was shown. The exit code is that of
    /// the first refusal.
    pub(super) fn unread(first: &Self, failed: usize, of: usize) -> Self {
        let what = format!("{failed} of {of} objects could not be read");
        Self { legacy: first.legacy, ..Self::new(first.exit, what).shown() }
    }

    fn new(exit: Exit, what: impl Into<String>) -> Self {
        let (legacy, what) = (exit.legacy(), what.into());
        let (number, left, advice, answers) = (None, None, None, Vec::new());
        Self { exit, number, legacy, what, left, advice, answers, quoted: None, is_shown: false }
    }

    /// The same failure with the manual's number, which is its exit code for the manual's tools.
    fn numbered(self, number: u32) -> Self {
        Self { number: Some(number), legacy: number, ..self }
    }

    fn advised(self, advice: impl ToString) -> Self {
        Self { advice: Some(advice.to_string()), ..self }
    }

    /// The same failure, which the output of the command has shown already.
    fn shown(self) -> Self {
        Self { is_shown: true, ..self }
    }

    /// The same failure, as a part of the only document of the command.
    pub(super) fn within(self, document: &mut Value) -> Self {
        document["error"] = self.value()["error"].take();
        self.shown()
    }

    /// An error of the command line's parser.
    pub(super) fn unreadable_line(error: &clap::Error) -> Self {
        let of_node = error.get(ContextKind::InvalidArg).is_some_and(|name| {
            let ContextValue::String(name) = name else { return false };
            name.split_whitespace().any(|word| matches!(word, "--node" | "--nodes" | "--node_id"))
        });
        let wrong_value = matches!(error.kind(), ErrorKind::ValueValidation | ErrorKind::InvalidValue);
        let number = (of_node && wrong_value).then_some(legacy::INVALID_NODE_ID);
        let legacy = number.unwrap_or(legacy::INVALID_PARAMETER);
        Self { number, legacy, ..Self::bare_usage(error.render().to_string()).quoting(error.kind()) }
    }

    /// The same failure, which quotes words of the line.
    pub(super) fn quoting(self, kind: ErrorKind) -> Self {
        Self { quoted: Some(kind), ..self }
    }

    /// What records have in place of words that quote the line.
    fn unquoted(&self) -> Option<String> {
        let kind = self.quoted?.as_str().unwrap_or_default();
        Some(format!("the line cannot be read: {kind}"))
    }

    /// An error in a recipe.
    pub(super) fn recipe(path: &Path, fault: &machine::RecipeFault) -> Self {
        Self::new(Exit::File, format!("{}, {fault}", path.display()))
    }

    /// A package that breaks a rule.
    pub(super) fn package(path: &Path, fault: &machine::Fault) -> Self {
        // The manual's tools do not know such files, and have no number for them.
        let failure = Self::new(Exit::File, format!("{} {fault}", path.display()));
        Self { number: Some(fault.number()), ..failure.advised(fault.advice()) }
    }

    /// A device of a package that was not begun.
    pub(super) fn of_device(fault: &machine::DeviceFault) -> Self {
        let exit = match fault {
            machine::DeviceFault::Absent { .. } | machine::DeviceFault::TooFew { .. } => Exit::NoAnswer,
            _ => Exit::Device,
        };
        let failure = Self::new(exit, fault.to_string()).advised(fault.advice());
        Self { number: Some(fault.number()), ..failure }
    }

    /// The same failure, with the state of the device.
    pub(super) fn leaving(self, left: Option<DeviceAfterUpdate>) -> Self {
        Self { left, ..self }
    }

    pub(super) fn usage(what: impl Into<String>, advice: impl Into<String>) -> Self {
        Self::new(Exit::Usage, what).advised(advice.into())
    }

    /// A message of the command line's parser, which contains its advice.
    pub(super) fn bare_usage(words: String) -> Self {
        Self::new(Exit::Usage, words.strip_prefix("error: ").unwrap_or(&words).trim_end())
    }

    /// A file, other than firmware, that cannot be read.
    pub(super) fn unreadable(path: &Path, error: &io::Error) -> Self {
        let number = error.raw_os_error().and_then(|code| u32::try_from(code).ok());
        let failure = Self::new(Exit::File, format!("{}: cannot be read: {error}", path.display()));
        match number {
            Some(number) => failure.numbered(number),
            None => failure,
        }
    }

    /// A file, other than firmware, with invalid contents.
    pub(super) fn file(path: &Path, why: impl fmt::Display) -> Self {
        Self::new(Exit::File, format!("{}: {why}", path.display()))
    }

    /// There is no such board, or its file has a mistake.
    pub(super) fn board(error: NamedError) -> Self {
        match error {
            NamedError::File(path, why) => Self::file(Path::new(&path), &why),
            unknown @ NamedError::Unknown(_) => Self::bare_usage(unknown.to_string()),
        }
    }

    /// An error in a line of a file, other than firmware.
    pub(super) fn line(path: &Path, line: usize, why: impl fmt::Display) -> Self {
        Self::new(Exit::File, format!("{}, line {line}: {why}", path.display()))
    }

    pub(super) fn system(what: String) -> Self {
        Self::new(Exit::System, what)
    }

    /// A device that sent no boot-up message after a reset.
    pub(super) fn no_boot_up(node: NodeId) -> Self {
        let advice = "check that node-ID and bit rate are right; a device with a new node-ID comes back under that one";
        let failure = Self::new(Exit::NoAnswer, format!("node {node} has sent no boot-up message"));
        failure.numbered(0x6000_0013).advised(advice)
    }

    /// A firmware file that cannot contain a program.
    pub(super) fn no_program(path: &Path, fault: judge::Fault) -> Self {
        let failure = Self::new(Exit::File, format!("{}: {fault}", path.display()));
        failure.numbered(judge::Fault::NUMBER).advised(fault.advice())
    }

    /// A sealed image that breaks a rule.
    pub(super) fn sealed(path: &Path, refusal: &Refusal) -> Self {
        // The manual's tools do not know such files, and have no number for them.
        let failure = Self::new(Exit::File, format!("{}: {refusal}", path.display()));
        Self { number: Some(refusal_number(refusal)), ..failure.advised(refusal.advice()) }
    }

    /// A program number that a board does not have.
    pub(super) fn no_such_program(board: &str, program: u8, programs: usize) -> Self {
        Self::usage(format!("{board} has no program {program}"), format!("its programs are 1 to {programs}"))
    }

    /// A file that is nothing for a device.
    pub(super) fn content(path: &Path, fault: ContentFault) -> Self {
        match fault {
            ContentFault::Bootloader(fault) => {
                Self::file(path, format_args!("it {fault}")).advised(ram_image::Fault::ADVICE)
            }
            ContentFault::Sealed(refusal) => Self::sealed(path, &refusal),
            ContentFault::NoProgram { board, program, programs } => {
                Self::no_such_program(board, program, programs)
            }
            ContentFault::File(error) => error.of(path.display()).into(),
            ContentFault::Convert(error) => Self::convert(error, path),
            ContentFault::Judged(fault) => Self::no_program(path, fault),
        }
    }

    /// A failed conversion of `file`.
    pub(super) fn convert(error: ConvertError, file: &Path) -> Self {
        match error {
            ConvertError::File(error) => error.of(file.display()).into(),
            ConvertError::Judged(fault) => Self::no_program(file, fault),
            ConvertError::BlockSize { .. }
            | ConvertError::Start(_)
            | ConvertError::Range(_)
            | ConvertError::Adjust(_)
            | ConvertError::Blocks(_) => Self::new(Exit::Usage, error.to_string()).numbered(0x6000_0018),
        }
    }

    /// What a record has of it.
    pub(super) fn recorded(&self) -> Value {
        let mut error = self.value()["error"].take();
        if let Some(words) = self.unquoted() {
            error["what"] = words.into();
        }
        error
    }

    /// The JSON value.
    pub(super) fn value(&self) -> Value {
        json!({
            "error": {
                "number": format!("{:#010x}", self.number.unwrap_or(self.legacy)),
                "exit": self.exit as u8,
                "what": self.what,
                "device": self.left.map(|left| left.state.name()),
                "seen": self.left.and_then(|left| match left.answer {
                    DeviceAnswer::Given(seen) => Some(json!({
                        "device_type": seen.running.0,
                        "bootloader": seen.running.is_bootloader(),
                        "control": seen.control,
                        "crc": seen.crc,
                    })),
                    DeviceAnswer::Silent | DeviceAnswer::Unchanged | DeviceAnswer::NotAsked => None,
                }),
                "advice": self.advice,
                "answers": self.answers,
            }
        })
    }
}

impl From<FileError> for Failure {
    fn from(error: FileError) -> Self {
        let cause = &error.error.cause;
        let text = error.to_string();
        if let (Cause::Foreign(_), Some(advice)) = (cause, cause.advice()) {
            let what = text.strip_suffix(&format!(": {advice}")).unwrap_or(&text).to_owned();
            return Self::new(Exit::File, what).numbered(cause.number()).advised(advice);
        }
        let advice = match cause {
            Cause::Io(error) => match error.kind() {
                io::ErrorKind::NotFound => "check the file's name and the current folder",
                io::ErrorKind::IsADirectory => "name the firmware file in this folder",
                io::ErrorKind::PermissionDenied => "check that you have permission to read the file",
                _ => "copy the file to this computer's own disk, and try again",
            },
            Cause::Empty => "the file is empty: build the program again, or copy the file again",
            Cause::NotFirmware => "name the linker's output (ELF, Intel HEX, S-record) or a block file",
            Cause::NotNamedFormat { found: Some(_), .. } => "leave -I out: the first bytes show the format",
            Cause::NotNamedFormat { found: None, .. } => {
                "name the right file, or leave -I out: without it the tool says what the file is"
            }
            Cause::NoData => {
                "name the linker's output: an object file, or one without loadable sections, has nothing for the flash"
            }
            Cause::WrongElf(_) | Cause::WrongMachine(_) => {
                "name the linker's output for the board: Arm, 32 bit, little-endian (thumbv7em-none-eabihf, \
                 arm-none-eabi)"
            }
            Cause::AfterEnd => {
                "if these are two files one after the other, make one file of them (srec_cat, objcopy); otherwise copy \
                 the file again from where it was built"
            }
            Cause::Overlap { .. } => {
                "two parts of the file have other data for one address: link them for different addresses, or leave \
                 one of them out"
            }
            Cause::CutOff { .. }
            | Cause::TooLong { .. }
            | Cause::NoEnd(_)
            | Cause::Malformed(_)
            | Cause::UnknownRecord(_)
            | Cause::Count { .. }
            | Cause::Checksum { .. }
            | Cause::BadDigit { .. }
            | Cause::ProgramHeaderSize(_)
            | Cause::BlockCrc { .. }
            | Cause::BlockNumber { .. }
            | Cause::LastSize(_)
            | Cause::ProgramCrc { .. } => "copy the file again from where it was built, or build it again",
            // Their messages contain the advice.
            _ => "",
        };
        let advice = Some(advice.to_string()).filter(|advice| !advice.is_empty());
        Self { advice, ..Self::new(Exit::File, text).numbered(cause.number()) }
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
            Error::Adapter(_) | Error::NoVerdict { .. } => Exit::Adapter,
            Error::Cancelled => Exit::Cancelled,
            Error::NotInDialect { .. } | Error::NoPassword { .. } => Exit::Usage,
            Error::NoAnswer { .. } | Error::Lss { failure: LssFailure::NoAnswer, .. } => Exit::NoAnswer,
            // The file, found out before anything was changed.
            Error::SealedOnly { .. }
            | Error::WrongTarget { .. }
            | Error::NoProgram { .. }
            | Error::OtherRegion { .. } => Exit::File,
            Error::Refused { .. }
            | Error::Protocol { .. }
            | Error::ShortAnswer { .. }
            | Error::Failed { .. }
            | Error::Busy { .. }
            | Error::WrongCrc { .. }
            | Error::NotAlone { .. }
            | Error::NotRenewable { .. }
            | Error::Lss { .. } => Exit::Device,
            Error::NoBootloader { .. }
            | Error::Occupied { .. }
            | Error::StartFailed { .. }
            | Error::ProgramEnded { .. }
            | Error::FellSilent { .. }
            | Error::TrialFailed { .. }
            | Error::RenewalFailed { .. }
            | Error::SilentOnTrial { .. }
            | Error::FirstFailed { .. }
            | Error::Unconfirmable { .. }
            | Error::OtherIdentity { .. } => Exit::NoStart,
        };
        let failure = Self::new(exit, error.to_string()).advised(error.advice());
        let (number, legacy) = (Some(error.number()), legacy::exit_code(&error));
        Self { number, legacy, answers: error.answers(), ..failure }
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
