//! `coflash more`: the commands that few people need every day.

#[cfg(feature = "conform")]
mod conform;
mod debug;
mod generate;
mod report;
mod shell;

use clap::{Command, Subcommand};

use crate::catch;
use crate::context::Context;
use crate::device::Program;
use crate::output::Failure;
use crate::program::{self, Status};

/// Single steps, debugger, reports, checks, shell, man.
#[derive(Debug, Subcommand)]
pub(crate) enum More {
    Status(Status),
    Catch(catch::Catch),
    /// Releases the program for autostart (83h of 1F51h).
    ///
    /// On a product on which it does, it then starts by itself after a reset.
    Release(Program),
    /// Withdraws the program's release for autostart.
    ///
    /// The device then stays in the bootloader after a reset.
    Withdraw(Program),
    Debug(debug::Debug),
    Report(report::Report),
    Shell(shell::Shell),
    #[cfg(feature = "conform")]
    Conform(conform::Conform),
    Completions(generate::Completions),
    Man(generate::Manual),
}

impl More {
    /// Whether the command needs a bus. A bad one is one of the faults that a report is for.
    pub(crate) fn takes_a_bus(&self) -> bool {
        !matches!(self, Self::Report(_) | Self::Completions(_) | Self::Man(_))
    }

    /// Runs the command; the shell runs each of its lines with `line`. `commands` are those of the program.
    pub(crate) fn run(
        &self,
        context: &Context,
        line: shell::Runner,
        commands: Command,
    ) -> Result<(), Failure> {
        match self {
            Self::Status(status) => status.run(context),
            Self::Catch(catch) => catch.run(context),
            Self::Release(it) => program::release(context, it),
            Self::Withdraw(it) => program::withdraw(context, it),
            Self::Debug(debug) => debug.run(context),
            Self::Report(report) => report.run(context),
            Self::Shell(shell) => shell.run(context, line),
            #[cfg(feature = "conform")]
            Self::Conform(conform) => conform.run(context),
            Self::Completions(completions) => completions.run(commands),
            Self::Man(manual) => manual.run(context, commands),
        }
    }
}
