//! The commands, one file each, and what they share: arguments, failures and exit codes.

use std::fmt;
use std::io::Write as _;
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::time::Duration;

use canopen::NodeId;
use clap::{Args, Parser, Subcommand};
use coflash::adapter::{self, Adapter, AdapterError};
use coflash::convert::ConvertError;
use coflash::read::FileError;
use coflash::session::{Session, Timing};
use coflash::Error;

/// Prints a line; a reader that has gone away (`| head`) is no reason to stop an update.
macro_rules! say {
    ($($words:tt)*) => {{
        use std::io::Write as _;
        let _ = writeln!(std::io::stdout(), $($words)*);
    }};
}

mod convert;
mod file;
mod flash;
mod info;
mod progress;

/// Converts firmware and flashes it over CANopen.
#[derive(Debug, Parser)]
#[command(name = "coflash", version, after_help = EXIT_CODES)]
struct Cli {
    /// The CAN bus: socketcand://HOST:PORT/BUS or (on Linux) socketcan:INTERFACE.
    #[arg(long, global = true, env = "COFLASH_BUS", value_name = "URL")]
    bus: Option<String>,

    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Convert(convert::Convert),
    Flash(flash::Flash),
    Info(info::Info),
}

const EXIT_CODES: &str = "\
Exit codes:
  0    done
  1    the result cannot be written, or the system refuses something else
  2    wrong usage
  3    the firmware file is bad, or does not fit the board; no device was touched
  4    the CAN adapter cannot be opened, or is gone
  5    the device does not answer
  6    the device refuses, or reports an error
  7    the program does not start, or the application does not go back to the bootloader
  130  cancelled";

/// Runs the command that the user gave.
pub fn main() -> ExitCode {
    let Cli { bus, command } = Cli::parse();
    let bus = Bus(bus);
    let done = match command {
        Command::Convert(convert) => convert.run(),
        Command::Flash(flash) => flash.run(&bus),
        Command::Info(info) => info.run(&bus),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            let _ = write!(std::io::stderr(), "{failure}");
            failure.exit.into()
        }
    }
}

/// What `--bus` or `COFLASH_BUS` said.
struct Bus(Option<String>);

impl Bus {
    fn open(&self) -> Result<Box<dyn Adapter>, Failure> {
        let Some(url) = &self.0 else {
            let advice = format!("give --bus URL or set COFLASH_BUS; known are {}", adapter::URLS);
            return Err(Failure::usage("it is not said on which CAN bus the device is", advice));
        };
        Ok(adapter::open(url)?)
    }
}

/// Which device, and how patient to be with it.
#[derive(Debug, Args)]
struct Device {
    /// The device's node-ID.
    #[arg(long, short = 'N', alias = "node_id", default_value = "1", value_parser = node_id, value_name = "1..127")]
    node: NodeId,

    /// How long the answer to one request may take, in milliseconds.
    #[arg(long, alias = "sdo_timeout", default_value = "500", value_parser = milliseconds, value_name = "MS")]
    sdo_timeout: Duration,

    /// How long a command (erasing, checking) may take, in milliseconds.
    #[arg(long, default_value = "60000", value_parser = milliseconds, value_name = "MS")]
    timeout: Duration,

    /// How long a restart may take, in milliseconds.
    #[arg(long, default_value = "5000", value_parser = milliseconds, value_name = "MS")]
    boot_timeout: Duration,
}

impl Device {
    /// A session which Ctrl-C ends.
    fn session<'a>(&self, adapter: &'a mut dyn Adapter) -> Result<Session<'a>, Failure> {
        let timing = Timing {
            sdo: self.sdo_timeout,
            command: self.timeout,
            boot: self.boot_timeout,
            ..Timing::default()
        };
        let mut session = Session::new(adapter, self.node, timing);
        let cancelled = Arc::new(AtomicBool::new(false));
        session.cancel_by(cancelled.clone());
        // The first time ends the transfer in order, the second time at once.
        ctrlc::set_handler(move || {
            if cancelled.swap(true, Ordering::Relaxed) {
                std::process::exit(i32::from(Exit::Cancelled as u8));
            }
        })
        .map_err(|error| Failure::system(format!("Ctrl-C cannot be caught: {error}")))?;
        Ok(session)
    }
}

fn node_id(text: &str) -> Result<NodeId, String> {
    let number = number(text)?;
    u8::try_from(number).ok().and_then(NodeId::new).ok_or_else(|| "node-IDs are 1 to 127".to_string())
}

/// A program number: 1 to 254, the sub-indices of 1F50h.
fn program_number(text: &str) -> Result<u8, String> {
    match u8::try_from(number(text)?) {
        Ok(program @ 1..=254) => Ok(program),
        _ => Err("programs are 1 to 254".to_string()),
    }
}

fn milliseconds(text: &str) -> Result<Duration, String> {
    match number(text)? {
        0 => Err("it must be at least 1 millisecond".to_string()),
        millis => Ok(Duration::from_millis(millis.into())),
    }
}

/// A number in decimal or, with `0x` in front, in hexadecimal.
fn number(text: &str) -> Result<u32, String> {
    let (digits, radix) = match text.strip_prefix("0x").or_else(|| text.strip_prefix("0X")) {
        Some(digits) => (digits, 16),
        None => (text, 10),
    };
    // C reads a leading 0 as octal, most people do not.
    if radix == 10 && digits.len() > 1 && digits.starts_with('0') {
        return Err("a leading 0 is ambiguous: write 0x for hexadecimal, or leave it out".to_string());
    }
    if digits.is_empty() || !digits.bytes().all(|byte| byte.is_ascii_hexdigit()) {
        return Err("it is no number (like 4096 or 0x1000)".to_string());
    }
    u32::from_str_radix(digits, radix).map_err(|_| "it is no number of up to 32 bits".to_string())
}

/// The exit codes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
enum Exit {
    System = 1,
    Usage = 2,
    File = 3,
    Adapter = 4,
    NoAnswer = 5,
    Device = 6,
    NoStart = 7,
    Cancelled = 130,
}

impl From<Exit> for ExitCode {
    fn from(exit: Exit) -> Self {
        Self::from(exit as u8)
    }
}

/// Why a command failed: what happened, what to do, and how it ends.
#[derive(Debug)]
struct Failure {
    exit: Exit,
    /// The stable number, where there is one.
    number: Option<u32>,
    what: String,
    advice: Option<String>,
}

impl Failure {
    fn usage(what: &str, advice: String) -> Self {
        Self { exit: Exit::Usage, number: None, what: what.to_string(), advice: Some(advice) }
    }

    fn system(what: String) -> Self {
        Self { exit: Exit::System, number: None, what, advice: None }
    }

    /// A conversion of `file` that failed.
    fn convert(error: ConvertError, file: &std::path::Path) -> Self {
        match error {
            ConvertError::File(error) => error.of(file.display()).into(),
            ConvertError::BlockSize { .. } | ConvertError::Start(_) | ConvertError::Range(_) => {
                Self { exit: Exit::Usage, number: Some(0x6000_0018), what: error.to_string(), advice: None }
            }
        }
    }
}

impl From<FileError> for Failure {
    fn from(error: FileError) -> Self {
        let number = Some(error.error.cause.number());
        Self { exit: Exit::File, number, what: error.to_string(), advice: None }
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
            Error::NoAnswer { .. } => Exit::NoAnswer,
            Error::Refused { .. }
            | Error::Protocol { .. }
            | Error::Failed { .. }
            | Error::Busy { .. }
            | Error::WrongCrc { .. } => Exit::Device,
            Error::NoBootloader { .. } | Error::StartFailed { .. } => Exit::NoStart,
        };
        Self { exit, number: Some(error.number()), what: error.to_string(), advice: Some(error.advice()) }
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "error: {}", self.what)?;
        if let Some(number) = self.number {
            write!(f, " [{number:#010x}]")?;
        }
        writeln!(f)?;
        match &self.advice {
            Some(advice) => writeln!(f, "  what to do: {advice}"),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    #[test]
    fn the_arguments_are_well_formed() {
        Cli::command().debug_assert();
    }

    #[test]
    fn numbers_are_decimal_or_hexadecimal_and_nothing_else() {
        for (text, value) in [("0", 0), ("0x400", 1024), ("0XfF", 255), ("4294967295", u32::MAX)] {
            assert_eq!(number(text), Ok(value));
        }
        for text in
            ["", "0x", "-1", "+1", "0x+1", "4294967296", "0x100000000", "010", "1k", " 1", "12h", "ff"]
        {
            assert!(number(text).is_err(), "{text}");
        }
    }
}
