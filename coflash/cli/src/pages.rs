//! The commands on the pages of the documentation, read by the command line's own reader.

use std::ffi::OsString;

use clap::error::ErrorKind;
use clap::Command;
use kit::pages;

use super::commands;
use super::words::ordered;

/// Every call of this tool on every page is parsed by the command line's own reader.
#[test]
fn what_the_pages_show_is_understood() {
    let mut count = 0;
    for shown in pages::commands() {
        let Some(words) = pages::call_of(&shown.words, "coflash") else { continue };
        // A placeholder is replaced by a value.
        let of = |word: &String| if word == "BOARD" { "stm32f407g-disc1" } else { word }.to_string();
        let words = std::iter::once("coflash".to_string()).chain(words.iter().map(of));
        let words: Vec<String> = words.filter(|word| word != "COMMAND").collect();
        count += 1;
        let words = ordered(words.iter().map(OsString::from).collect(), &commands());
        let Err(error) = commands().try_get_matches_from(&words) else { continue };
        let mention = shown.inline
            && (matches!(
                error.kind(),
                ErrorKind::MissingRequiredArgument
                    | ErrorKind::MissingSubcommand
                    | ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand
            ) || error.kind() == ErrorKind::InvalidValue
                && error.to_string().contains("a value is required"));
        let help = matches!(error.kind(), ErrorKind::DisplayHelp | ErrorKind::DisplayVersion);
        assert!(mention || help, "{}: {words:?}: {error}", shown.place);
    }
    assert!(count > 60, "{count}");
}

/// A message or a comment of the sources that names a command names it with its group.
#[test]
fn what_the_sources_name_is_a_command() {
    fn names(command: &Command) -> Vec<&str> {
        let below = command.get_subcommands();
        below.flat_map(|below| [vec![below.get_name()], names(below)].concat()).collect()
    }
    let root = commands();
    let names = names(&root);
    let house = concat!(env!("CARGO_MANIFEST_DIR"), "/../..");
    let files =
        std::process::Command::new("git").args(["ls-files", "*.rs"]).current_dir(house).output().unwrap();
    let mut count = 0;
    for file in String::from_utf8(files.stdout).unwrap().lines() {
        // A file may be deleted and not yet committed.
        let Ok(text) = std::fs::read_to_string(format!("{house}/{file}")) else { continue };
        // A text may go on in the next line.
        let text: String = text.split("\\\n").map(str::trim_start).collect();
        for call in text.split("coflash ").skip(1) {
            let is_word =
                |word: &&str| !word.is_empty() && word.bytes().all(|b| b.is_ascii_lowercase() || b == b'-');
            let line = call.lines().next().unwrap_or_default();
            let first = line.split(|c: char| !c.is_ascii_lowercase() && c != '-').next().unwrap_or_default();
            let group = root.find_subcommand(first).filter(|_| ["seal", "more"].contains(&first));
            let second =
                line[first.len()..].strip_prefix(' ').and_then(|rest| rest.split([' ', '`', ',']).next());
            let known = match (group, second.filter(is_word)) {
                (Some(group), Some(second)) => group.find_subcommand(second).is_some(),
                _ => root.find_subcommand(first).is_some() || !names.contains(&first),
            };
            assert!(known, "{file}: coflash {line}");
            count += usize::from(names.contains(&first));
        }
    }
    assert!(count > 100, "{count}");
}
