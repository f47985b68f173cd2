//! The commands, one file each, and what they share.

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use coflash::adapter::{self, Adapter};

use self::output::{Failure, Output, EXIT_CODES};

mod convert;
mod device;
mod file;
mod flash;
mod info;
mod inspect;
mod legacy;
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

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    #[test]
    fn the_arguments_are_well_formed() {
        Cli::command().debug_assert();
    }
}
