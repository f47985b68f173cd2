//! The commands, one file each, and what they share.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
use coflash::adapter::{self, Adapter, Trace};

use self::output::{Failure, Output, EXIT_CODES};

mod config;
mod convert;
mod debug;
mod device;
mod dialect;
mod file;
mod flash;
mod generate;
mod info;
mod inspect;
mod legacy;
mod lss;
mod many;
mod monitor;
mod output;
mod program;
mod progress;
mod read;
mod reset;
mod scan;
mod shell;
mod values;

/// Under this the options that all commands have are listed.
const GLOBAL: &str = "For all commands";

/// Converts firmware and flashes it over CANopen.
#[derive(Debug, Parser)]
#[command(name = "coflash", version, max_term_width = 100, after_help = EXIT_CODES)]
struct Cli {
    /// The CAN bus: socketcand://HOST:PORT/BUS, slcan:PORT@BITRATE, slcan:tcp://HOST:PORT@BITRATE
    /// or (on Linux) socketcan:INTERFACE.
    #[arg(long, global = true, help_heading = GLOBAL, env = "COFLASH_BUS", value_name = "URL")]
    bus: Option<String>,

    /// A file with defaults for options; otherwise coflash.toml in the current folder, or the
    /// user's own.
    #[arg(long, global = true, help_heading = GLOBAL, env = "COFLASH_CONFIG", value_name = "FILE")]
    config: Option<PathBuf>,

    /// Write all frames to this file, as candump -L does; monitor --replay shows it in words.
    #[arg(long, global = true, help_heading = GLOBAL, value_name = "FILE")]
    trace: Option<PathBuf>,

    #[command(flatten)]
    output: Output,

    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Convert(convert::Convert),
    Inspect(inspect::Inspect),
    Flash(Box<flash::Flash>),
    Scan(scan::Scan),
    Info(info::Info),
    Status(program::Status),
    Start(program::Start),
    Enter(program::Enter),
    Erase(program::Erase),
    Sign(program::Sign),
    Unsign(program::Unsign),
    Reset(reset::Reset),
    Read(read::Read),
    Lss(lss::Lss),
    Debug(debug::Debug),
    Monitor(monitor::Monitor),
    Shell(shell::Shell),
    Completions(generate::Completions),
    Man(generate::Manual),
}

impl Command {
    fn run(&self, context: &Context) -> Result<(), Failure> {
        match self {
            Self::Convert(convert) => convert.run(context),
            Self::Inspect(inspect) => inspect.run(context),
            Self::Flash(flash) => flash.run(context),
            Self::Scan(scan) => scan.run(context),
            Self::Info(info) => info.run(context),
            Self::Status(status) => status.run(context),
            Self::Start(start) => start.run(context),
            Self::Enter(enter) => enter.run(context),
            Self::Erase(erase) => erase.run(context),
            Self::Sign(sign) => sign.run(context),
            Self::Unsign(unsign) => unsign.run(context),
            Self::Reset(reset) => reset.run(context),
            Self::Read(read) => read.run(context),
            Self::Lss(lss) => lss.run(context),
            Self::Debug(debug) => debug.run(context),
            Self::Monitor(monitor) => monitor.run(context),
            Self::Shell(shell) => shell.run(context),
            Self::Completions(completions) => completions.run(),
            Self::Man(manual) => manual.run(context),
        }
    }
}

impl Cli {
    fn context(&self) -> Context {
        Context {
            bus: self.bus.clone(),
            trace: self.trace.clone(),
            config: self.config.clone(),
            out: self.output,
        }
    }
}

/// Runs the command that the user gave.
pub fn main() -> ExitCode {
    let cli = match command_line() {
        Ok(cli) => cli,
        Err(failure) => {
            Output::default().failure(&failure);
            return failure.exit.into();
        }
    };
    match cli.command.run(&cli.context()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            cli.output.failure(&failure);
            failure.exit.into()
        }
    }
}

/// Reads the command line, with defaults from the configuration file. Help and wrong usage end the
/// program here.
fn command_line() -> Result<Cli, Failure> {
    // The file has to be known before the command line can be read in earnest.
    let first = Cli::command().ignore_errors(true).get_matches();
    let named = first.get_one::<PathBuf>("config").cloned();
    let mut matches = configured(named)?.get_matches();
    Cli::from_arg_matches_mut(&mut matches).map_err(|error| Failure::bare_usage(error.to_string()))
}

/// The commands and their options, with defaults from the configuration file.
fn configured(named: Option<PathBuf>) -> Result<clap::Command, Failure> {
    match config::find(named) {
        Some(path) => config::apply(Cli::command(), &path),
        None => Ok(Cli::command()),
    }
}

/// What every command is given.
struct Context {
    /// What `--bus`, `COFLASH_BUS` or the configuration says.
    bus: Option<String>,
    trace: Option<PathBuf>,
    /// The configuration file that `--config` or `COFLASH_CONFIG` names.
    config: Option<PathBuf>,
    out: Output,
}

impl Context {
    fn open(&self) -> Result<Box<dyn Adapter>, Failure> {
        self.open_at(None)
    }

    /// At this bit rate, if the URL names none and the adapter sets it.
    fn open_at(&self, bit_rate: Option<u32>) -> Result<Box<dyn Adapter>, Failure> {
        let Some(url) = &self.bus else {
            let advice = format!("give --bus URL or set COFLASH_BUS; known are {}", adapter::URLS);
            return Err(Failure::usage("it is not said on which CAN bus the device is", advice));
        };
        let adapter = adapter::open_at(url, bit_rate)?;
        Ok(match &self.trace {
            Some(path) => {
                let (out, name) = (self.out, path.display().to_string());
                let failed =
                    move |error| out.warn(format_args!("{name}: cannot be written any more: {error}"));
                Box::new(Trace::new(adapter, path, Box::new(failed))?)
            }
            None => adapter,
        })
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

    /// The commands that the manual page of this tool shows are commands of this tool.
    #[test]
    fn what_the_documentation_shows_is_understood() {
        let page = include_str!("../../../docs/coflash.md");
        let lines: Vec<&str> = page.lines().filter_map(|line| line.strip_prefix("$ ")).collect();
        assert!(lines.len() > 5, "{lines:?}");
        for line in lines {
            // What stands behind it is for a shell: a variable in front, a pipe behind.
            let words = line.split(" | ").next().unwrap_or_default().split(" > ").next().unwrap_or_default();
            let words =
                words.split_whitespace().skip_while(|word| word.contains('=') && !word.starts_with('-'));
            if let Err(error) = Cli::try_parse_from(words) {
                panic!("{line}: {error}");
            }
        }
    }
}
