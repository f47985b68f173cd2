//! The commands, one file each, and what they share.

use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::time::Duration;

use canopen::NodeId;
use clap::{Args, Parser, Subcommand};
use coflash::adapter::{self, Adapter};
use coflash::session::{Session, Timing};

use self::output::{Exit, Failure, Output, EXIT_CODES};
use self::values::{milliseconds, node_id};

mod convert;
mod file;
mod flash;
mod info;
mod inspect;
mod output;
mod progress;
mod values;

/// Converts firmware and flashes it over CANopen.
#[derive(Debug, Parser)]
#[command(name = "coflash", version, after_help = EXIT_CODES)]
struct Cli {
    /// The CAN bus: socketcand://HOST:PORT/BUS or (on Linux) socketcan:INTERFACE.
    #[arg(long, global = true, env = "COFLASH_BUS", value_name = "URL")]
    bus: Option<String>,

    #[command(flatten)]
    output: Output,

    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Convert(convert::Convert),
    Inspect(inspect::Inspect),
    Flash(flash::Flash),
    Info(info::Info),
}

/// Runs the command that the user gave.
pub fn main() -> ExitCode {
    let Cli { bus, output, command } = Cli::parse();
    let context = Context { bus, out: output };
    let done = match command {
        Command::Convert(convert) => convert.run(&context),
        Command::Inspect(inspect) => inspect.run(&context),
        Command::Flash(flash) => flash.run(&context),
        Command::Info(info) => info.run(&context),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            output.failure(&failure);
            failure.exit.into()
        }
    }
}

/// What every command is given.
struct Context {
    /// What `--bus` or `COFLASH_BUS` said.
    bus: Option<String>,
    out: Output,
}

impl Context {
    fn open(&self) -> Result<Box<dyn Adapter>, Failure> {
        let Some(url) = &self.bus else {
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

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    #[test]
    fn the_arguments_are_well_formed() {
        Cli::command().debug_assert();
    }
}
