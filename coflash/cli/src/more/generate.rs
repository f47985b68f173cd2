//! `coflash more completions` and `coflash more man`: files for an installer.

use std::io::{self, Write as _};
use std::path::{Path, PathBuf};

use clap::{Arg, Args, Command};
use clap_complete::Shell;
use clap_mangen::Man;

use crate::context::Context;
use crate::help;
use crate::output::{Failure, EXIT_CODES};

/// Writes shell completions to standard output.
#[derive(Debug, Args)]
pub(crate) struct Completions {
    /// The shell that reads them.
    #[arg(value_enum)]
    shell: Shell,
}

/// Writes the manual pages.
///
/// By default, the page of the program goes to standard output. With --out, one page for each
/// command goes into a folder.
#[derive(Debug, Args)]
pub(crate) struct Manual {
    /// The folder.
    #[arg(long, value_name = "FOLDER")]
    out: Option<PathBuf>,
}

impl Completions {
    pub(crate) fn run(&self, mut commands: Command) -> Result<(), Failure> {
        // Written to memory first: clap's own writer panics if standard output is closed.
        let mut script = Vec::new();
        clap_complete::generate(self.shell, &mut commands, "coflash", &mut script);
        let _ = std::io::stdout().write_all(&script);
        Ok(())
    }
}

impl Manual {
    pub(crate) fn run(&self, context: &Context, commands: Command) -> Result<(), Failure> {
        let mut commands = commands.disable_help_subcommand(true);
        commands.build();
        let Some(folder) = &self.out else {
            let page = page(&commands)
                .map_err(|error| Failure::system(format!("the page cannot be made: {error}")))?;
            let _ = std::io::stdout().write_all(&page);
            return Ok(());
        };
        let write = || {
            std::fs::create_dir_all(folder)?;
            write_pages(&commands, folder)
        };
        write()
            .map_err(|error| Failure::system(format!("{}: cannot be written: {error}", folder.display())))?;
        context.out.say(format_args!("{}: manual pages", folder.display()));
        Ok(())
    }
}

/// Writes a page for each command and each subcommand.
fn write_pages(command: &Command, folder: &Path) -> io::Result<()> {
    let name = Man::new(command.clone()).get_filename();
    std::fs::write(folder.join(name), page(command)?)?;
    let shown = command.get_subcommands().filter(|below| !below.is_hide_set());
    shown.into_iter().try_for_each(|below| write_pages(below, folder))
}

/// A page in the order of man-pages(7).
fn page(command: &Command) -> io::Result<Vec<u8>> {
    let mut page = Vec::new();
    // A page shows the long help alone of an option that the short help leaves out.
    let man = Man::new(command.clone().mut_args(|option| {
        match (option.get_long_help(), option.get_help().cloned()) {
            (None, Some(words)) => option.long_help(words),
            _ => option,
        }
    }));
    man.render_title(&mut page)?;
    man.render_name_section(&mut page)?;
    man.render_synopsis_section(&mut page)?;
    man.render_description_section(&mut page)?;
    man.render_options_section(&mut page)?;
    if command.get_subcommands().any(|below| !below.is_hide_set()) {
        man.render_subcommands_section(&mut page)?;
    }
    let examples = help::examples(command.get_bin_name().unwrap_or_default());
    if !examples.is_empty() {
        let lines: Vec<String> = examples.iter().map(|line| format!("coflash {line}")).collect();
        section(&mut page, "EXAMPLES", &lines.iter().map(|line| (line.as_str(), "")).collect::<Vec<_>>())?;
    }
    section(&mut page, "FILES", &FILES)?;
    let variables = variables(command);
    let variables: Vec<(&str, &str)> =
        variables.iter().map(|(name, what)| (name.as_str(), what.as_str())).collect();
    section(&mut page, "ENVIRONMENT", &variables)?;
    let codes = EXIT_CODES.lines().filter_map(|line| line.trim().split_once(' '));
    let codes: Vec<(&str, &str)> = codes.map(|(code, what)| (code, what.trim())).skip(1).collect();
    section(&mut page, "EXIT STATUS", &codes)?;
    if command.get_version().is_some() {
        man.render_version_section(&mut page)?;
    }
    Ok(page)
}

/// The files that the tool reads by itself.
const FILES: [(&str, &str); 3] = [
    ("coflash.toml", "Defaults for options, in the current folder."),
    ("~/.config/coflash/coflash.toml", "Defaults of the user, if the current folder has no such file."),
    ("~/.local/state/coflash/history", "The commands typed into coflash more shell."),
];

/// The environment variables of the options.
fn variables(command: &Command) -> Vec<(String, String)> {
    let variable = |argument: &Arg| {
        let name = argument.get_env()?.to_string_lossy().into_owned();
        let option = argument.get_long().map_or_else(String::new, |long| format!("In place of --{long}. "));
        Some((name, format!("{option}{}", argument.get_help().map(ToString::to_string).unwrap_or_default())))
    };
    let mut all: Vec<_> = command.get_arguments().filter_map(variable).collect();
    all.push(("NO_COLOR".to_string(), "If it is set, output has no colours.".to_string()));
    all
}

/// Words with their meanings; without a meaning, a line is written unchanged.
fn section(page: &mut Vec<u8>, title: &str, rows: &[(&str, &str)]) -> io::Result<()> {
    writeln!(page, ".SH \"{title}\"")?;
    for (word, meaning) in rows {
        if meaning.is_empty() {
            writeln!(page, ".nf\n{}\n.fi", escaped(word))?;
        } else {
            writeln!(page, ".TP\n\\fB{}\\fR\n{}", escaped(word), escaped(meaning))?;
        }
    }
    Ok(())
}

/// Text for roff: backslashes and leading dots are escaped.
fn escaped(text: &str) -> String {
    let text = text.replace('\\', "\\e").replace('-', "\\-");
    if text.starts_with(['.', '\'']) {
        format!("\\&{text}")
    } else {
        text
    }
}
