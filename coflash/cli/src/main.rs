//! The command line of coflash: the commands, one file for each, and the code that they share.
#![forbid(unsafe_code)]

use std::ffi::OsString;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};

use self::context::Context;
use self::output::{Failure, Output};

mod adapters;
#[cfg(feature = "agent")]
mod agent;
mod catch;
mod config;
mod context;
mod convert;
mod device;
mod dialect;
mod events;
mod file;
mod flash;
mod help;
mod info;
mod inspect;
mod legacy;
mod lss;
mod many;
mod memory;
mod monitor;
mod more;
mod nmt;
mod objects;
mod output;
mod output_file;
mod package;
#[cfg(all(test, repository))]
mod pages;
mod program;
mod progress;
mod read;
mod record;
mod reset;
mod scan;
mod seal;
mod search;
mod secrets;
#[cfg(feature = "ui")]
mod ui;
mod units;
mod values;
mod waiting;
mod words;
mod write;

/// Converts firmware and downloads it over CANopen.
#[derive(Debug, Parser)]
#[command(name = "coflash", version = env!("COFLASH_VERSION"), max_term_width = 100)]
struct Cli {
    #[command(flatten)]
    context: Context,

    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Flash(Box<flash::Flash>),
    Info(info::Info),
    Scan(scan::Scan),
    /// Starts the program, and waits until it answers.
    Start(device::Program),
    Enter(program::Enter),
    /// Erases the program.
    ///
    /// A running application is called back to the bootloader first.
    Erase(device::Program),
    Reset(reset::Reset),
    Convert(convert::Convert),
    Inspect(inspect::Inspect),
    #[command(subcommand)]
    Seal(seal::Seal),
    Read(read::Read),
    Write(write::Write),
    Lss(lss::Lss),
    Nmt(nmt::Nmt),
    Monitor(monitor::Monitor),
    Package(package::MakePackage),
    #[cfg(feature = "agent")]
    Agent(agent::Agent),
    #[cfg(feature = "ui")]
    Ui(ui::Ui),
    Adapters(adapters::Adapters),
    #[command(subcommand)]
    More(more::More),
}

impl Command {
    /// Whether the command may use a bus.
    fn takes_a_bus(&self) -> bool {
        match self {
            Self::Convert(_) | Self::Inspect(_) | Self::Package(_) | Self::Adapters(_) => false,
            Self::Seal(seal) => seal.takes_a_bus(),
            Self::More(more) => more.takes_a_bus(),
            _ => true,
        }
    }

    /// What the command writes into an object, if that may be a password.
    fn passwords(&self) -> Vec<&str> {
        match self {
            Self::Write(write) => write.passwords(),
            _ => Vec::new(),
        }
    }

    fn run(&self, context: &Context) -> Result<(), Failure> {
        if let Some(bus) = context.bus.as_deref().filter(|_| self.takes_a_bus()) {
            coboot_can::check(bus)?;
        }
        if self.takes_a_bus() {
            // Before the adapter is opened: each command ends in order.
            device::cancelled()?;
        }
        match self {
            Self::Flash(flash) => flash.run(context),
            Self::Info(info) => info.run(context),
            Self::Scan(scan) => scan.run(context),
            Self::Start(program) => program::start(context, program),
            Self::Enter(enter) => enter.run(context),
            Self::Erase(program) => program::erase(context, program),
            Self::Reset(reset) => reset.run(context),
            Self::Convert(convert) => convert.run(context),
            Self::Inspect(inspect) => inspect.run(context),
            Self::Seal(seal) => seal.run(context),
            Self::Read(read) => read.run(context),
            Self::Write(write) => write.run(context),
            Self::Lss(lss) => lss.run(context),
            Self::Nmt(nmt) => nmt.run(context),
            Self::Monitor(monitor) => monitor.run(context),
            Self::Package(package) => package.run(context),
            #[cfg(feature = "agent")]
            Self::Agent(agent) => agent.run(context),
            #[cfg(feature = "ui")]
            Self::Ui(ui) => ui.run(context),
            Self::Adapters(adapters) => adapters.run(context),
            Self::More(more) => more.run(context, shell_line, commands()),
        }
    }
}

/// The commands and their options, with the help arranged.
fn commands() -> clap::Command {
    help::in_order(Cli::command())
}

/// Runs the command of the user.
fn main() -> ExitCode {
    let cli = match command_line() {
        Ok(cli) => cli,
        Err(failure) => {
            let output = Output::of_words();
            output.failure(&failure);
            output.exit(&failure)
        }
    };
    let Cli { context, command } = &cli;
    let (out, log) = (context.out, context.log_file.as_deref());
    let begin = || {
        let (log, reports) = (context.log_file.as_deref(), context.report_dir.as_deref());
        let line = secrets::without(&words(), &command.passwords());
        record::begin(log, reports, &context.command, &line, context.bus.as_deref()).map_err(Failure::system)
    };
    let spared = [log, context.trace.as_deref()].into_iter().flatten().try_for_each(output_file::spare);
    let result = spared.and_then(|()| begin()).and_then(|()| command.run(context));
    if let Err(failure) = &result {
        out.failure(failure);
    }
    if let Some(folder) = record::folder() {
        out.say(format_args!("report: {}", folder.display()));
    }
    let failure = result.as_ref().err();
    let error = failure.map(Failure::recorded);
    let kept = record::end(failure.map_or(0, |failure| out.code(failure)), error);
    let result = match (result, kept) {
        (Ok(()), kept) => kept.map_err(Failure::system).inspect_err(|failure| out.failure(failure)),
        // The first failure is the result; that the report is not whole is said with it.
        (Err(failure), kept) => {
            kept.unwrap_or_else(|words| out.warn(words));
            Err(failure)
        }
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => out.exit(&failure),
    }
}

/// The words of the command line, in the order for the parser.
fn words() -> Vec<OsString> {
    words::ordered(std::env::args_os().map(words::typed).collect(), &commands())
}

/// Parses the command line, with defaults from the configuration file. Help and wrong usage end the
/// program here.
fn command_line() -> Result<Cli, Failure> {
    let read = parsed(words(), None)?;
    Ok(read.unwrap_or_else(|error| {
        let out = Output::of_words();
        if error.use_stderr() {
            let failure = Failure::unreadable_line(&error);
            if out.for_programs() {
                out.failure(&failure);
            } else {
                let _ = error.print();
            }
            out.exit(&failure)
        }
        // clap prints help to standard output and treats it as success; errors and help have their
        // own colours.
        let _ = error.print();
        std::process::exit(0)
    }))
}

/// Parses the words of a command line. `file` is the configuration file if they name none.
fn parsed(words: Vec<OsString>, file: Option<PathBuf>) -> Result<Result<Cli, clap::Error>, Failure> {
    // The name of the file must be known before the command line can be parsed completely.
    let first = commands().ignore_errors(true).get_matches_from(&words);
    let named = file.or_else(|| first.get_one("config").cloned());
    let known = match config::find(named) {
        Some(path) => config::apply(commands(), &path, &first)?,
        None => commands(),
    };
    let read = known.clone().try_get_matches_from(&words).and_then(|mut matches| {
        let command = words::path(&matches);
        let mut cli = Cli::from_arg_matches_mut(&mut matches)?;
        cli.context.command = command;
        Ok(cli)
    });
    Ok(read.map_err(|error| words::with_paths(error, &words, &known)))
}

/// Runs one line of the shell.
fn shell_line(shell: &Context, words: Vec<String>) -> Result<(), Failure> {
    let words = std::iter::once("coflash".to_string()).chain(words).map(OsString::from).map(words::typed);
    let words = words::ordered(words.collect(), &commands());
    let cli = match parsed(words, shell.config.clone())? {
        Ok(cli) => cli,
        Err(error) if !error.use_stderr() => {
            // The user asked for help.
            shell.out.say(error.to_string().trim_end());
            return Ok(());
        }
        Err(error) => return Err(Failure::unreadable_line(&error)),
    };
    if matches!(cli.command, Command::More(more::More::Shell(_))) {
        return Err(Failure::usage("this is already the shell", "leave the words more shell out"));
    }
    if cli.context.log_file.is_some() || cli.context.report_dir.is_some() {
        let advice = "start the shell with them: coflash more shell --log-file FILE";
        return Err(Failure::usage("--log-file and --report-dir apply only to the shell as a whole", advice));
    }
    cli.command.run(&cli.context.or(shell))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_arguments_are_well_formed() {
        commands().debug_assert();
    }
}
