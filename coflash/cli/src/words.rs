//! Reorders the words of the command line before parsing: an option of a command may also come
//! before the command.

use std::ffi::OsString;
use std::iter::successors;

use clap::error::{ContextKind, ContextValue};
use clap::{Arg, ArgMatches, Command};

use super::secrets;

/// A word as the parser expects it. The manual prints the dash of `–F` and `–I` as an en dash, and
/// so does a command line that was copied from it.
pub fn typed(word: OsString) -> OsString {
    match word.to_str().and_then(|text| text.strip_prefix('\u{2013}')) {
        Some(letter) if letter.len() == 1 && letter.as_bytes()[0].is_ascii_alphabetic() => {
            format!("-{letter}").into()
        }
        _ => word,
    }
}

/// Moves options from before their command to after it: `coflash --node 5 info` becomes
/// `coflash info --node 5`. Unknown options stay in place, and the parser reports them.
pub fn ordered(words: Vec<OsString>, root: &Command) -> Vec<OsString> {
    let mut kept: Vec<OsString> = Vec::new();
    let mut moved: Vec<(String, Vec<OsString>)> = Vec::new();
    let mut remaining = words.iter();
    // The program's name.
    kept.extend(remaining.next().cloned());
    let command = loop {
        let Some(word) = remaining.next() else { return words };
        let Some(text) = word.to_str() else { return words };
        let Some(name) = Name::of(text) else {
            if let Some(command) = root.find_subcommand(text) {
                kept.push(word.clone());
                break command;
            }
            if paths(text, root).is_empty() {
                return words;
            }
            // The command of a group without its group: the parser names the word, and not an option before.
            kept.push(word.clone());
            kept.extend(moved.into_iter().flat_map(|(_, words)| words));
            kept.extend(remaining.cloned());
            return kept;
        };
        let own = root.get_arguments().find(|argument| name.is_of(argument));
        let known = own.is_some() || ["help", "version", "h", "V"].contains(&name.bare);
        let Some(takes) = own.or_else(|| within(root, &name)).map(|argument| name.takes_next(argument))
        else {
            if known {
                kept.push(word.clone());
                continue;
            }
            return words;
        };
        let mut all = vec![word.clone()];
        if takes {
            all.extend(remaining.next().cloned());
        }
        if known {
            kept.extend(all);
        } else {
            moved.push((text.to_string(), all));
        }
    };
    // A subcommand of a command, for example `lss assign`.
    let mut levels = vec![(command, kept.len())];
    let mut remaining: Vec<OsString> = remaining.cloned().collect();
    while let Some(next) = remaining.first().and_then(|word| levels.last()?.0.find_subcommand(word)) {
        kept.push(remaining.remove(0));
        levels.push((next, kept.len()));
    }
    // Insert after the last command with this option, from the end on, so that earlier positions
    // stay valid.
    let place = |text: &str| {
        let has = |(command, _): &&(&Command, usize)| {
            Name::of(text).is_some_and(|name| command.get_arguments().any(|argument| name.is_of(argument)))
        };
        levels.iter().rev().find(has).or(levels.last()).map_or(kept.len(), |(_, place)| *place)
    };
    let mut moved: Vec<(usize, Vec<OsString>)> =
        moved.into_iter().map(|(text, words)| (place(&text), words)).collect();
    moved.sort_by_key(|(place, _)| *place);
    for (place, words) in moved.into_iter().rev() {
        kept.splice(place..place, words);
    }
    kept.extend(remaining);
    kept
}

/// The names of the command and its subcommands, with a blank between them.
pub fn path(matches: &ArgMatches) -> String {
    let below = successors(matches.subcommand(), |(_, below)| below.subcommand());
    below.map(|(name, _)| name).collect::<Vec<_>>().join(" ")
}

/// Adds the full command to an error about an unknown one, where a group has a command of this name;
/// otherwise the commands of the group in which it was searched.
pub fn with_paths(mut error: clap::Error, words: &[OsString], root: &Command) -> clap::Error {
    let Some(ContextValue::String(name)) = error.get(ContextKind::InvalidSubcommand) else { return error };
    let words = secrets::without(words, &[]);
    // The value of an option may be the same word.
    let is_value = |at: usize| {
        let option = Name::of(&words[at - 1]);
        option.is_some_and(|name| within(root, &name).is_some_and(|option| name.takes_next(option)))
    };
    // Options may come before the command, and so may the name of another group.
    let (mut group, mut at, mut before) = (root, 1, String::new());
    loop {
        match words.get(at) {
            None => return error,
            Some(word) if is_value(at) => before += &format!(" {word}"),
            Some(word) => match group.find_subcommand(word) {
                Some(below) => group = below,
                None if word == name => break,
                None => before += &format!(" {word}"),
            },
        }
        at += 1;
    }
    let after: String = words[at + 1..].iter().map(|word| format!(" {word}")).collect();
    let given = format!(" {}", words[1..].join(" "));
    let lines = paths(name, root).into_iter().map(|path| format!("{before}{path}{after}"));
    let mut tips: Vec<_> = lines
        .filter(|line| *line != given)
        .map(|line| format!("the command is 'coflash{line}'").into())
        .collect();
    let is_like_another = error.get(ContextKind::SuggestedSubcommand).is_some();
    if tips.is_empty() && !is_like_another && group.get_name() != root.get_name() {
        let below: Vec<&str> = group.get_subcommands().map(Command::get_name).collect();
        tips.push(format!("the commands of '{}' are {}", group.get_name(), below.join(", ")).into());
    }
    if tips.is_empty() {
        return error;
    }
    let tips = ContextValue::StyledStrs(tips);
    error.remove(ContextKind::SuggestedSubcommand);
    error.insert(ContextKind::Suggested, tips);
    error
}

/// The full names of the commands with this name on the first level that has one, each after a blank. A
/// plural s makes no difference.
fn paths(name: &str, root: &Command) -> Vec<String> {
    let is_same = |below: &Command| below.get_name().trim_end_matches('s') == name.trim_end_matches('s');
    let mut level = vec![(String::new(), root)];
    let mut found: Vec<String> = Vec::new();
    while found.is_empty() && !level.is_empty() {
        let mut next = Vec::new();
        for (path, command) in level {
            let below = command.get_subcommands();
            next.extend(below.map(|below| (format!("{path} {}", below.get_name()), below)));
        }
        found.extend(next.iter().filter(|(_, below)| is_same(below)).map(|(path, _)| path.clone()));
        level = next;
    }
    found
}

/// The first command or subcommand that has this option.
fn within<'c>(command: &'c Command, name: &Name<'_>) -> Option<&'c Arg> {
    let own = command.get_arguments().find(|argument| name.is_of(argument));
    own.or_else(|| command.get_subcommands().find_map(|below| within(below, name)))
}

/// An option as written by the user.
struct Name<'w> {
    /// The name without dashes and value.
    bare: &'w str,
    long: bool,
    /// Whether the same word contains the value.
    valued: bool,
}

impl<'w> Name<'w> {
    /// `None` for a word that is not an option.
    fn of(word: &'w str) -> Option<Self> {
        match word.strip_prefix("--") {
            Some("") => None,
            Some(long) => {
                let (bare, value) =
                    long.split_once('=').map_or((long, None), |(bare, value)| (bare, Some(value)));
                Some(Self { bare, long: true, valued: value.is_some() })
            }
            None => {
                let short = word.strip_prefix('-').filter(|short| !short.is_empty())?;
                let first = short.chars().next().map_or(0, char::len_utf8);
                Some(Self { bare: &short[..first], long: false, valued: short.len() > first })
            }
        }
    }

    fn is_of(&self, argument: &Arg) -> bool {
        if self.long {
            let aliases = argument.get_all_aliases().unwrap_or_default();
            argument.get_long() == Some(self.bare) || aliases.contains(&self.bare)
        } else {
            argument.get_short().is_some_and(|short| self.bare.starts_with(short))
        }
    }

    /// Whether the next word is the option's value.
    fn takes_next(&self, argument: &Arg) -> bool {
        !self.valued && argument.get_action().takes_values() && !argument.is_require_equals_set()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(words: &str) -> String {
        let words = std::iter::once("coflash").chain(words.split_whitespace()).map(OsString::from).collect();
        let words = ordered(words, &super::super::commands());
        let words: Vec<&str> = words.iter().skip(1).filter_map(|word| word.to_str()).collect();
        words.join(" ")
    }

    #[test]
    fn a_printed_dash_is_that_of_an_option() {
        for (word, typed) in [
            ("\u{2013}F", "-F"),
            // Neither an option of the manual nor a word of one character is touched.
            ("\u{2013}Fa", "\u{2013}Fa"),
            ("\u{2013}5", "\u{2013}5"),
            ("\u{2013}", "\u{2013}"),
            ("\u{2013}\u{e4}", "\u{2013}\u{e4}"),
            ("a\u{2013}F", "a\u{2013}F"),
            ("-F", "-F"),
        ] {
            assert_eq!(super::typed(word.into()), typed, "{word}");
        }
    }

    /// A command that has moved into a group is named with its new words: none is in a list.
    #[test]
    fn a_command_of_a_group_is_named_in_full() {
        for (line, commands) in [
            ("release -N 5", &["more release -N 5"][..]),
            ("--bus x --json verify a.cbs --root r.pub", &["--bus x --json seal verify a.cbs --root r.pub"]),
            ("key new --role root", &["seal keys new --role root"]),
            ("keys new --of-value 12", &["seal keys new --of-value ***"]),
            ("verify-device a.cbs", &["seal verify-device a.cbs"]),
            ("--json more verify a.cbs", &["--json seal verify a.cbs"]),
            ("seal flash a", &["flash a"]),
            ("fastscan", &["lss fastscan"]),
            ("step", &["more debug step"]),
            ("show a.cbs", &["seal show a.cbs"]),
            ("flsh a", &[]),
            ("-N 5 release", &["more release -N 5"]),
            ("--bus release release -N 5", &["--bus release more release -N 5"]),
            ("seal seal x", &["seal x"]),
            // A file where the command of a group was meant.
            ("seal app.elf --board x", &[]),
        ] {
            // A link to the program may have the name of a command.
            let words = || std::iter::once("release").chain(line.split(' ')).map(OsString::from).collect();
            let words: Vec<OsString> = ordered(words(), &super::super::commands());
            let error = super::super::commands().try_get_matches_from(&words).unwrap_err();
            let error = with_paths(error, &words, &super::super::commands());
            let tip = |text: &str| {
                Some(text.split_once("tip: the command is 'coflash ")?.1.trim_end_matches('\'').to_owned())
            };
            let tips: Vec<String> = error.to_string().lines().filter_map(tip).collect();
            assert_eq!(tips, commands, "{line}: {error}");
            assert_eq!((error.kind(), error.exit_code()), (clap::error::ErrorKind::InvalidSubcommand, 2));
            let lists = error.to_string().contains("tip: the commands of 'seal' are keys, image, ");
            assert_eq!(lists, commands.is_empty() && line.starts_with("seal "), "{line}: {error}");
        }
    }

    #[test]
    fn an_option_before_its_command_goes_after_it() {
        for (words, ordered) in [
            ("--node 5 info", "info --node 5"),
            ("-N 5 --json flash a.elf --verify", "--json flash -N 5 a.elf --verify"),
            ("-N5 info", "info -N5"),
            ("--node=5 --bus x info", "--bus x info --node=5"),
            ("--node 5 --verify --bus x flash a.elf", "--bus x flash --node 5 --verify a.elf"),
            ("--sdo_timeout 70 info", "info --sdo_timeout 70"),
            ("--node 5 lss assign --store", "lss assign --node 5 --store"),
            ("--node 5 more debug read 0x20000000", "more debug --node 5 read 0x20000000"),
            ("-q -N 1,5-7 flash a", "-q flash -N 1,5-7 a"),
        ] {
            assert_eq!(line(words), ordered, "{words}");
        }
        // Words in the right order, and words with an unknown option.
        let unchanged = "info --node 5|--json info|--speed 5 info|--node 5|--node 5 fly|--help|-- info|";
        for words in unchanged.split('|') {
            assert_eq!(line(words), words);
        }
    }
}
