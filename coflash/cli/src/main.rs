//! The command line of coflash: the commands, one file for each, and the code that they share.
#![forbid(unsafe_code)]

use std::ffi::OsString;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::{ArgMatches, CommandFactory, FromArgMatches, Parser, Subcommand};

use self::context::Context;
use self::output::{Failure, Output, GLOBAL};
use self::search::Kinds;
use self::values::base_id;

mod access;
mod adapters;
#[cfg(feature = "agent")]
mod agent;
mod catch;
mod config;
#[cfg(feature = "conform")]
mod conform;
mod context;
mod convert;
mod debug;
mod device;
mod dialect;
mod events;
mod file;
mod flash;
mod generate;
mod help;
mod info;
mod inspect;
mod keys;
mod legacy;
mod lss;
mod many;
mod memory;
mod monitor;
mod nameplate;
mod nmt;
mod objects;
mod output;
mod output_file;
mod package;
#[cfg(all(test, repository))]
mod pages;
mod program;
mod progress;
mod provision;
mod read;
mod record;
mod report;
mod reset;
mod scan;
mod seal;
mod search;
mod secrets;
mod shell;
#[cfg(feature = "ui")]
mod ui;
mod units;
mod values;
mod verify;
mod verify_device;
mod waiting;
mod words;
mod write;

/// Converts firmware and downloads it over CANopen.
#[derive(Debug, Parser)]
#[command(name = "coflash", version = env!("COFLASH_VERSION"), max_term_width = 100)]
struct Cli {
    /// The CAN bus: socketcan:INTERFACE (on Linux), slcan:PORT@BITRATE,
    /// slcan:tcp://HOST:PORT@BITRATE, peak:CHANNEL@BITRATE, kvaser:NUMBER@BITRATE,
    /// gs_usb:NUMBER@BITRATE or socketcand://HOST:PORT/BUS; or a gateway to it:
    /// cia309://HOST:PORT/NET. The default is the only adapter of this computer.
    #[arg(long, global = true, help_heading = GLOBAL, env = "COFLASH_BUS", value_name = "URL")]
    bus: Option<String>,

    /// The kinds of adapters to search for, with the command adapters and if no --bus is given:
    /// serial, socketcan, peak, kvaser, gs_usb, socketcand (separated by commas), or none.
    #[arg(long, global = true, help_heading = GLOBAL, env = "COFLASH_SEARCH", value_name = "KINDS",
          value_parser = Kinds::parse)]
    search: Option<Kinds>,

    /// A file with defaults for options; by default coflash.toml in the current folder, or the
    /// user's own file.
    #[arg(long, global = true, help_heading = GLOBAL, env = "COFLASH_CONFIG", value_name = "FILE")]
    config: Option<PathBuf>,

    /// Write all frames to this file in the format of candump -L; monitor --replay shows it in
    /// words.
    #[arg(long, global = true, help_heading = GLOBAL, value_name = "FILE")]
    trace: Option<PathBuf>,

    /// Write everything that happens to this file, with time stamps: events, messages and frames,
    /// but no passwords.
    #[arg(long, global = true, help_heading = GLOBAL, value_name = "FILE")]
    log_file: Option<PathBuf>,

    /// Create a folder in this folder with everything that a service department needs: versions,
    /// command line, events, log and trace, but no passwords.
    #[arg(long, global = true, help_heading = GLOBAL, value_name = "FOLDER")]
    report_dir: Option<PathBuf>,

    /// The base COB-ID of SDO requests, to which the node-ID is added, for devices that do not
    /// listen on 0x600 (BLCOP_BASE_REQUEST of the manual).
    #[arg(long, global = true, help_heading = GLOBAL, value_name = "COB-ID", value_parser = base_id)]
    sdo_request: Option<u16>,

    /// The base COB-ID of SDO answers, to which the node-ID is added, in place of 0x580
    /// (BLCOP_BASE_RESPONSE of the manual).
    #[arg(long, global = true, help_heading = GLOBAL, value_name = "COB-ID", value_parser = base_id)]
    sdo_response: Option<u16>,

    #[command(flatten)]
    output: Output,

    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Convert(convert::Convert),
    Inspect(inspect::Inspect),
    Key(keys::Key),
    Seal(Box<seal::Seal>),
    Verify(Box<verify::Verify>),
    VerifyDevice(verify_device::VerifyDevice),
    Show(verify::Show),
    Provision(provision::Provision),
    Nameplate(nameplate::MakeNameplate),
    Package(package::MakePackage),
    Flash(Box<flash::Flash>),
    Adapters(adapters::Adapters),
    Scan(scan::Scan),
    Info(info::Info),
    Status(program::Status),
    Start(program::Start),
    Enter(program::Enter),
    Catch(catch::Catch),
    Erase(program::Erase),
    Release(program::Release),
    Withdraw(program::Withdraw),
    Unlock(access::Unlock),
    Events(access::Events),
    Reset(reset::Reset),
    Read(read::Read),
    Write(write::Write),
    Nmt(nmt::Nmt),
    Lss(lss::Lss),
    Debug(debug::Debug),
    Monitor(monitor::Monitor),
    Report(report::Report),
    Shell(shell::Shell),
    #[cfg(feature = "conform")]
    Conform(conform::Conform),
    #[cfg(feature = "ui")]
    Ui(ui::Ui),
    #[cfg(feature = "agent")]
    Agent(agent::Agent),
    Completions(generate::Completions),
    Man(generate::Manual),
}

impl Command {
    /// Whether the command may use a bus.
    fn takes_a_bus(&self) -> bool {
        !matches!(
            self,
            Self::Convert(_)
                | Self::Inspect(_)
                | Self::Key(_)
                | Self::Seal(_)
                | Self::Verify(_)
                | Self::Show(_)
                | Self::Provision(_)
                | Self::Nameplate(_)
                | Self::Package(_)
                | Self::Adapters(_)
                // A bad bus is one of the faults that it is for.
                | Self::Report(_)
                | Self::Completions(_)
                | Self::Man(_)
        )
    }

    /// What the command writes into an object, if that may be a password.
    fn password(&self) -> Option<&str> {
        match self {
            Self::Write(write) => write.password(),
            _ => None,
        }
    }

    fn run(&self, context: &Context) -> Result<(), Failure> {
        if let Some(bus) = context.bus.as_deref().filter(|_| self.takes_a_bus()) {
            coboot_can::check(bus)?;
        }
        match self {
            Self::Convert(convert) => convert.run(context),
            Self::Inspect(inspect) => inspect.run(context),
            Self::Key(key) => key.run(context),
            Self::Seal(seal) => seal.run(context),
            Self::Verify(verify) => verify.run(context),
            Self::VerifyDevice(verify) => verify.run(context),
            Self::Show(show) => show.run(context),
            Self::Provision(provision) => provision.run(context),
            Self::Nameplate(nameplate) => nameplate.run(context),
            Self::Package(package) => package.run(context),
            Self::Flash(flash) => flash.run(context),
            Self::Adapters(adapters) => adapters.run(context),
            Self::Scan(scan) => scan.run(context),
            Self::Info(info) => info.run(context),
            Self::Status(status) => status.run(context),
            Self::Start(start) => start.run(context),
            Self::Enter(enter) => enter.run(context),
            Self::Catch(catch) => catch.run(context),
            Self::Erase(erase) => erase.run(context),
            Self::Release(release) => release.run(context),
            Self::Withdraw(withdraw) => withdraw.run(context),
            Self::Unlock(unlock) => unlock.run(context),
            Self::Events(events) => events.run(context),
            Self::Reset(reset) => reset.run(context),
            Self::Read(read) => read.run(context),
            Self::Write(write) => write.run(context),
            Self::Nmt(nmt) => nmt.run(context),
            Self::Lss(lss) => lss.run(context),
            Self::Debug(debug) => debug.run(context),
            Self::Monitor(monitor) => monitor.run(context),
            Self::Report(report) => report.run(context),
            Self::Shell(shell) => shell.run(context, shell_line),
            #[cfg(feature = "conform")]
            Self::Conform(conform) => conform.run(context),
            #[cfg(feature = "ui")]
            Self::Ui(ui) => ui.run(context),
            #[cfg(feature = "agent")]
            Self::Agent(agent) => agent.run(context),
            Self::Completions(completions) => completions.run(commands()),
            Self::Man(manual) => manual.run(context, commands()),
        }
    }
}

impl Cli {
    fn context(&self) -> Context {
        Context {
            bus: self.bus.clone(),
            search: self.search.clone(),
            trace: self.trace.clone(),
            sdo_request: self.sdo_request,
            sdo_response: self.sdo_response,
            config: self.config.clone(),
            report_dir: self.report_dir.clone(),
            out: self.output,
        }
    }
}

/// The commands and their options, with the help arranged.
fn commands() -> clap::Command {
    help::in_order(Cli::command())
}

/// Runs the command of the user.
fn main() -> ExitCode {
    let (name, cli) = match command_line() {
        Ok(read) => read,
        Err(failure) => {
            let output = early_output();
            output.failure(&failure);
            output.exit(&failure)
        }
    };
    let (log, reports) = (cli.log_file.as_deref(), cli.report_dir.as_deref());
    let password = cli.command.password();
    let begin = || record::begin(log, reports, &name, &words(), password, cli.bus.as_deref());
    let spared = [log, cli.trace.as_deref()].into_iter().flatten().try_for_each(output_file::spare);
    let begun = spared.and_then(|()| begin().map_err(Failure::system));
    let result = begun.and_then(|()| cli.command.run(&cli.context()));
    if let Err(failure) = &result {
        cli.output.failure(failure);
    }
    if let Some(folder) = record::folder() {
        cli.output.say(format_args!("report: {}", folder.display()));
    }
    let failure = result.as_ref().err();
    let error = failure.map(|failure| failure.value()["error"].clone());
    let kept = record::end(failure.map_or(0, |failure| cli.output.code(failure)), error);
    let kept = kept.map_err(Failure::system);
    let result = result.and_then(|()| kept.inspect_err(|failure| cli.output.failure(failure)));
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => cli.output.exit(&failure),
    }
}

/// The options for output, as far as the command line can be read.
fn early_output() -> Output {
    let matches = commands().ignore_errors(true).get_matches_from(words());
    Output::from_arg_matches(&matches).unwrap_or_default().or(Output::of_words())
}

/// The words of the command line, in the order for the parser.
fn words() -> Vec<OsString> {
    words::ordered(std::env::args_os().map(words::typed).collect(), &commands())
}

/// Parses the command line and the command's name, with defaults from the configuration file. Help
/// and wrong usage end the program here.
fn command_line() -> Result<(String, Cli), Failure> {
    // The name of the file must be known before the command line can be parsed completely.
    let first = commands().ignore_errors(true).get_matches_from(words());
    let named = first.get_one::<PathBuf>("config").cloned();
    let matches = configured(named, &first)?.try_get_matches_from(words());
    let mut matches = matches.unwrap_or_else(|error| {
        let out = early_output();
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
    });
    let name = matches.subcommand_name().unwrap_or_default().to_string();
    let cli = Cli::from_arg_matches_mut(&mut matches);
    Ok((name, cli.map_err(|error| Failure::bare_usage(error.to_string()))?))
}

/// Runs one line of the shell.
fn shell_line(context: &Context, words: Vec<String>) -> Result<(), Failure> {
    let words = std::iter::once("coflash".to_string()).chain(words).map(OsString::from).map(words::typed);
    let words = words::ordered(words.collect(), &commands());
    let first = commands().ignore_errors(true).get_matches_from(&words);
    let read = configured(context.config.clone(), &first)?
        .try_get_matches_from(words)
        .and_then(|mut matches| Cli::from_arg_matches_mut(&mut matches));
    let cli = match read {
        Ok(cli) => cli,
        Err(error) if !error.use_stderr() => {
            // The user asked for help.
            context.out.say(error.to_string().trim_end());
            return Ok(());
        }
        Err(error) => return Err(Failure::unreadable_line(&error)),
    };
    if matches!(cli.command, Command::Shell(_)) {
        return Err(Failure::usage("this is already the shell", "leave the word shell out"));
    }
    if cli.log_file.is_some() || cli.report_dir.is_some() {
        let advice = "start the shell with them: coflash shell --log-file FILE";
        return Err(Failure::usage("--log-file and --report-dir apply only to the shell as a whole", advice));
    }
    let line = cli.context();
    // Options that the line does not contain come from the shell's own command line.
    let line = Context {
        bus: line.bus.or_else(|| context.bus.clone()),
        search: line.search.or_else(|| context.search.clone()),
        trace: line.trace.or_else(|| context.trace.clone()),
        sdo_request: line.sdo_request.or(context.sdo_request),
        sdo_response: line.sdo_response.or(context.sdo_response),
        config: context.config.clone(),
        report_dir: context.report_dir.clone(),
        out: line.out.or(context.out),
    };
    cli.command.run(&line)
}

/// The commands and their options, with defaults from the configuration file.
fn configured(named: Option<PathBuf>, given: &ArgMatches) -> Result<clap::Command, Failure> {
    match config::find(named) {
        Some(path) => config::apply(commands(), &path, given),
        None => Ok(commands()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_arguments_are_well_formed() {
        commands().debug_assert();
    }
}
