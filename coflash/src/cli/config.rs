//! The configuration file: defaults for options, so that they need not be typed.
//!
//! What the command line or the environment says wins over it.

use std::path::{Path, PathBuf};

use clap::Command;

use super::output::Failure;

/// The options that a file may give defaults for.
const KEYS: [&str; 8] =
    ["bus", "node", "board", "block-size", "sdo-timeout", "command-timeout", "boot-timeout", "block-repeats"];

/// The file: what `--config` or `COFLASH_CONFIG` says, otherwise `coflash.toml` in the current folder, otherwise the user's
/// own; `None` where there is none.
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
    let text = std::fs::read_to_string(path).map_err(|error| Failure::unreadable(path, &error))?;
    let table: toml::Table = text.parse().map_err(|error: toml::de::Error| {
        let line =
            error.span().map_or(1, |span| 1 + text[..span.start.min(text.len())].matches('\n').count());
        Failure::line(path, line, error.message())
    })?;
    let mut command = command;
    for (key, value) in table {
        let wrong = |what: String| {
            Failure::usage(format!("{}: {what}", path.display()), format!("it may have {}", KEYS.join(", ")))
        };
        if !KEYS.contains(&key.as_str()) {
            return Err(wrong(format!("there is no setting '{key}'")));
        }
        let value = match value {
            toml::Value::String(text) => text,
            toml::Value::Integer(number) => number.to_string(),
            other => {
                return Err(wrong(format!("'{key}' must be a number or a text, and is {}", other.type_str())))
            }
        };
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
    fn the_documentations_example_is_all_that_a_file_may_have() {
        let page = include_str!("../../../docs/coflash.md");
        let example = page.split("```toml\n").nth(1).and_then(|block| block.split("```").next()).unwrap();
        let table: toml::Table = example.parse().unwrap();
        let mut keys: Vec<&str> = table.keys().map(String::as_str).collect();
        let mut known = KEYS.to_vec();
        keys.sort_unstable();
        known.sort_unstable();
        assert_eq!(keys, known);
    }

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
