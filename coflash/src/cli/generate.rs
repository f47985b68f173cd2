//! `coflash completions` and `coflash man`: what an installer puts beside the program.

use std::io::Write as _;
use std::path::PathBuf;

use clap::{Args, Command};
use clap_complete::Shell;
use clap_mangen::Man;

use super::context::Context;
use super::output::Failure;

/// Writes the completions for a shell to standard output.
#[derive(Debug, Args)]
pub(super) struct Completions {
    #[arg(value_enum)]
    shell: Shell,
}

/// Writes the manual page to standard output, or one page for each command into a folder.
#[derive(Debug, Args)]
pub(super) struct Manual {
    /// The folder.
    #[arg(long, value_name = "FOLDER")]
    out: Option<PathBuf>,
}

impl Completions {
    pub(super) fn run(&self, mut commands: Command) -> Result<(), Failure> {
        // Made in memory: clap's own writer panics where nobody reads.
        let mut script = Vec::new();
        clap_complete::generate(self.shell, &mut commands, "coflash", &mut script);
        let _ = std::io::stdout().write_all(&script);
        Ok(())
    }
}

impl Manual {
    pub(super) fn run(&self, context: &Context, commands: Command) -> Result<(), Failure> {
        let Some(folder) = &self.out else {
            let mut page = Vec::new();
            Man::new(commands)
                .render(&mut page)
                .map_err(|error| Failure::system(format!("the page cannot be made: {error}")))?;
            let _ = std::io::stdout().write_all(&page);
            return Ok(());
        };
        let write = || {
            std::fs::create_dir_all(folder)?;
            clap_mangen::generate_to(commands, folder)
        };
        write()
            .map_err(|error| Failure::system(format!("{}: cannot be written: {error}", folder.display())))?;
        context.out.say(format_args!("{}: manual pages", folder.display()));
        Ok(())
    }
}
