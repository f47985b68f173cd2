//! Where the configuration file is, and its way into the command line.
//!
//! What the command line or the environment says wins over it.

use std::path::{Path, PathBuf};

use clap::Command;
use coflash::file::limit::read_text;
use coflash::update::config::{parse, Fault, KEYS};

use super::output::Failure;

/// The file: what `--config` or `COFLASH_CONFIG` says, otherwise `coflash.toml` in the current
/// folder, otherwise the user's own; `None` where there is none.
pub(super) fn find(named: Option<PathBuf>) -> Option<PathBuf> {
    named.or_else(|| {
        let here = PathBuf::from("coflash.toml");
        let folder = std::env::var_os(if cfg!(windows) { "APPDATA" } else { "XDG_CONFIG_HOME" });
        let folder = folder.map(PathBuf::from).filter(|folder| folder.is_absolute());
        let folder = folder.or_else(|| std::env::home_dir().map(|home| home.join(".config")));
        let own = folder.map(|folder| folder.join("coflash").join("coflash.toml"));
        [Some(here), own].into_iter().flatten().find(|path| path.is_file())
    })
}

/// The command line with the file's values as defaults.
pub(super) fn apply(command: Command, path: &Path) -> Result<Command, Failure> {
    let text = read_text(path).map_err(|error| Failure::unreadable(path, &error))?;
    let settings = parse(&text).map_err(|fault| match fault {
        Fault::Line(line, what) => Failure::line(path, line, &what),
        Fault::Setting(what) => {
            Failure::usage(format!("{}: {what}", path.display()), format!("it may have {}", KEYS.join(", ")))
        }
    })?;
    let mut command = command;
    for (key, value) in settings {
        command = with_default(command, &key.replace('-', "_"), &value);
    }
    Ok(command)
}

/// Sets a default wherever the option is.
fn with_default(command: Command, id: &str, value: &str) -> Command {
    let has = command.get_arguments().any(|argument| argument.get_id() == id);
    let command = if has {
        let value = value.to_string();
        // An option that had to be given is given now.
        command.mut_arg(id, |argument| argument.required(false).default_value(value))
    } else {
        command
    };
    // What `lss` gives a device is said on the command line alone.
    if command.get_name() == "lss" {
        return command;
    }
    let names: Vec<String> =
        command.get_subcommands().map(|subcommand| subcommand.get_name().to_string()).collect();
    names.into_iter().fold(command, |command, name| {
        command.mut_subcommand(name, |subcommand| with_default(subcommand, id, value))
    })
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    #[test]
    fn every_setting_is_an_option_of_some_command() {
        for key in KEYS {
            let id = key.replace('-', "_");
            let is_option =
                |command: &Command| command.get_arguments().any(|argument| argument.get_id() == id.as_str());
            let command = super::super::Cli::command();
            assert!(is_option(&command) || command.get_subcommands().any(is_option), "{key}");
        }
    }
}
