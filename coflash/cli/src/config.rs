//! Finds the configuration file and adds its values to the command line as defaults.
//!
//! The command line and the environment take precedence over the file.

use std::path::{Path, PathBuf};

use clap::builder::FalseyValueParser;
use clap::parser::ValueSource;
use clap::{Arg, ArgAction, ArgMatches, Command};
use coflash_core::file::limit::read_text;
use coflash_core::update::config::{parse, Fault, Setting};

use super::output::Failure;

/// The path of the file: the value of `--config` or `COFLASH_CONFIG`, otherwise `coflash.toml` in
/// the current folder, otherwise the user's own file; `None` if none exists.
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

/// The options that a file cannot set: the option that names the file, help and version, and the
/// job file, which the user names in each call like FILE.
const NOT_SETTINGS: [&str; 4] = ["config", "help", "version", "job"];

/// The options that a file can set: all options of `flash`.
fn settings(command: &Command) -> impl Iterator<Item = &Arg> {
    let flash = command.find_subcommand("flash").into_iter().flat_map(Command::get_arguments);
    command.get_arguments().chain(flash).filter(|argument| {
        let name = argument.get_long();
        !argument.is_hide_set() && name.is_some_and(|name| !NOT_SETTINGS.contains(&name))
    })
}

/// The command line with the file's values as defaults. `given` holds the options that the user
/// gave, as far as they can be read.
pub(super) fn apply(command: Command, path: &Path, given: &ArgMatches) -> Result<Command, Failure> {
    let text = read_text(path).map_err(|error| Failure::unreadable(path, &error))?;
    let is_switch = |key: &str| {
        let argument = settings(&command).find(|argument| argument.get_long() == Some(key))?;
        Some(!argument.get_action().takes_values())
    };
    let wrong = |what: String| {
        let all: Vec<&str> = settings(&command).filter_map(Arg::get_long).collect();
        Failure::usage(
            format!("{}: {what}", path.display()),
            format!("the file may contain {}", all.join(", ")),
        )
    };
    let settings: Vec<(String, Setting)> = parse(&text, &is_switch).map_err(|fault| match fault {
        Fault::Line(line, what) => Failure::line(path, line, &what),
        Fault::Setting(what) => wrong(what),
    })?;
    // Two options that exclude each other are a mistake, as on the command line.
    if let Some(flash) = command.find_subcommand("flash") {
        let on = |setting: &Setting| *setting != Setting::Switch(false);
        for (number, (one, value)) in settings.iter().enumerate() {
            let other = settings[..number]
                .iter()
                .find(|(other, also)| on(value) && on(also) && exclude(flash, one, other));
            if let Some((other, _)) = other {
                let what = format!("{}: '{other}' and '{one}' exclude each other", path.display());
                return Err(Failure::usage(what, "leave one of them out"));
            }
        }
    }
    let said = said(given);
    Ok(settings.iter().fold(command, |command, (key, value)| with_default(command, key, value, &said)))
}

/// The options that the user gave on the command line or in the environment.
fn said(given: &ArgMatches) -> Vec<String> {
    let own = given.ids().filter(|id| {
        let by_user = [ValueSource::CommandLine, ValueSource::EnvVariable];
        // Groups have no source.
        given.try_contains_id(id.as_str()).is_ok()
            && given.value_source(id.as_str()).is_some_and(|source| by_user.contains(&source))
    });
    let mut all: Vec<String> = own.map(|id| id.as_str().to_string()).collect();
    if let Some((_, below)) = given.subcommand() {
        all.extend(self::said(below));
    }
    all
}

/// Whether a command rejects two options together. Both are long names.
fn exclude(command: &Command, one: &str, other: &str) -> bool {
    let named = |name: &str| command.get_arguments().find(|argument| argument.get_long() == Some(name));
    let (Some(one), Some(other)) = (named(one), named(other)) else { return false };
    excludes(command, one, other.get_id().as_str()) || excludes(command, other, one.get_id().as_str())
}

fn excludes(command: &Command, one: &Arg, other: &str) -> bool {
    command.get_arg_conflicts_with(one).iter().any(|conflict| conflict.get_id() == other)
}

/// Sets a default wherever the option exists, unless the user gave an option that excludes it.
fn with_default(command: Command, key: &str, value: &Setting, said: &[String]) -> Command {
    let own = command.get_arguments().find(|argument| argument.get_long() == Some(key));
    let excluded = own.is_some_and(|own| {
        said.iter().any(|id| {
            let other = command.get_arguments().find(|argument| argument.get_id() == id.as_str());
            excludes(&command, own, id)
                || other.is_some_and(|other| excludes(&command, other, own.get_id().as_str()))
        })
    });
    let id = own.filter(|_| !excluded).map(|own| own.get_id().clone());
    let command = match id {
        Some(id) => command.mut_arg(id, |argument| default(argument, value)),
        None => command,
    };
    // The values that `lss` gives a device come only from the command line.
    if command.get_name() == "lss" {
        return command;
    }
    let names: Vec<String> =
        command.get_subcommands().map(|subcommand| subcommand.get_name().to_string()).collect();
    names.into_iter().fold(command, |command, name| {
        command.mut_subcommand(name, |subcommand| with_default(subcommand, key, value, said))
    })
}

fn default(argument: Arg, value: &Setting) -> Arg {
    // A required option now has a value.
    let argument = argument.required(false);
    match value {
        Setting::Value(value) => argument.default_value(value.clone()),
        // The user can override a switch that the file sets: --verify=false.
        Setting::Switch(on) if !argument.get_action().takes_values() => argument
            .action(ArgAction::Set)
            .value_parser(FalseyValueParser::new())
            .num_args(0..=1)
            .require_equals(true)
            .default_missing_value("true")
            .value_name("false")
            .default_value(if *on { "true" } else { "false" }),
        Setting::Switch(_) => argument,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Each option of `flash` must have a line in the example on the page, which shows everything
    /// that a file may contain, and the command line's reader must accept each line.
    #[cfg(repository)]
    #[test]
    fn the_documentations_example_has_every_option_of_flash() {
        let page = include_str!("../../../docs/coflash.md");
        let example = page.split("```toml\n").nth(1).and_then(|block| block.split("```").next()).unwrap();
        let command = super::super::commands();
        let is_switch = |key: &str| {
            let argument = settings(&command).find(|argument| argument.get_long() == Some(key))?;
            Some(!argument.get_action().takes_values())
        };
        // Options that exclude another one are there as comments.
        let example: String =
            example.lines().map(|line| format!("{}\n", line.trim_start_matches("# "))).collect();
        let shown = parse(&example, &is_switch).unwrap();
        let mut shown: Vec<&str> = shown.iter().map(|(key, _)| key.as_str()).collect();
        let mut all: Vec<&str> = settings(&command).filter_map(Arg::get_long).collect();
        shown.sort_unstable();
        all.sort_unstable();
        assert_eq!(shown, all);
    }

    fn flash(file: &str, words: &[&str]) -> Result<ArgMatches, String> {
        let path = std::env::temp_dir().join(format!("coflash-config-{}-{file:p}.toml", std::process::id()));
        std::fs::write(&path, file).unwrap();
        let words = [&["coflash", "flash", "a.elf"], words].concat();
        let given = super::super::commands().ignore_errors(true).get_matches_from(&words);
        let command = apply(super::super::commands(), &path, &given);
        std::fs::remove_file(&path).unwrap();
        let command = command.map_err(|failure| failure.to_string())?;
        let matches = command.try_get_matches_from(&words).map_err(|error| error.to_string())?;
        Ok(matches.subcommand().unwrap().1.clone())
    }

    #[test]
    fn every_option_of_flash_reaches_it_from_a_file() {
        let command = super::super::commands();
        for argument in settings(&command) {
            let key = argument.get_long().unwrap();
            let id = argument.get_id().as_str();
            if argument.get_action().takes_values() {
                let value = match argument.get_possible_values().first() {
                    Some(value) => value.get_name().to_string(),
                    None if key == "board" => "nucleo-f446re".to_string(),
                    None if key == "search" => "serial".to_string(),
                    None if key.starts_with("sdo-re") => "0x640".to_string(),
                    None => "7".to_string(),
                };
                let matches =
                    flash(&format!("{key} = '{value}'"), &[]).unwrap_or_else(|why| panic!("{key}: {why}"));
                let raw = matches.get_raw(id).unwrap_or_else(|| panic!("{key}")).next().unwrap();
                assert_eq!(raw, value.as_str(), "{key}");
            } else {
                assert!(flash(&format!("{key} = true"), &[]).unwrap().get_flag(id), "{key}");
                let back = format!("--{key}=false");
                assert!(!flash(&format!("{key} = true"), &[&back]).unwrap().get_flag(id), "{key}");
                assert!(
                    flash(&format!("{key} = false"), &[&format!("--{key}")]).unwrap().get_flag(id),
                    "{key}"
                );
            }
        }
    }

    #[test]
    fn what_excludes_a_setting_wins_over_it() {
        let board = "board = 'stm32f407g-disc1'";
        let matches = flash(board, &["--start-address", "0x1000"]).unwrap();
        assert!(matches.get_raw("board").is_none());
        assert!(flash(board, &[]).unwrap().get_raw("board").is_some());
        let error = flash("board = 'stm32f407g-disc1'\nstart-address = 0\n", &[]).unwrap_err();
        assert!(error.contains("exclude each other"), "{error}");
    }
}
