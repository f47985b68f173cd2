//! The arguments of a command line. A job takes the options it knows; [`Args::none_left`] refuses
//! the rest.

use std::ops::RangeInclusive;

use crate::outcome::Outcome;

/// The arguments after `cargo xtask JOB`.
pub struct Args {
    /// The words before `--`.
    own: Vec<String>,
    /// `--` and the words after it, for another program.
    behind: Vec<String>,
}

impl Args {
    /// Splits the words at the first `--`.
    pub fn new(words: impl Iterator<Item = String>) -> Self {
        let mut own: Vec<String> = words.collect();
        let split = own.iter().position(|word| word == "--").unwrap_or(own.len());
        let behind = own.split_off(split);
        Self { own, behind }
    }

    /// Whether `--help` or `-h` is among the words.
    pub fn asks_for_help(&self) -> bool {
        self.own.iter().any(|word| word == "--help" || word == "-h")
    }

    /// Whether an option is there, with its value; it is not taken.
    pub fn has(&self, name: &str) -> bool {
        self.position(name).is_some()
    }

    fn position(&self, name: &str) -> Option<usize> {
        let is_it = |rest: &str| rest.is_empty() || rest.starts_with('=');
        self.own.iter().position(|word| word.strip_prefix(name).is_some_and(is_it))
    }

    /// Takes a flag; returns whether it was there.
    pub fn flag(&mut self, name: &str) -> bool {
        let before = self.own.len();
        self.own.retain(|word| word != name);
        self.own.len() != before
    }

    /// Takes `NAME VALUE` or `NAME=VALUE`.
    pub fn value(&mut self, name: &str) -> Outcome<Option<String>> {
        let mut found = None;
        while let Some(at) = self.position(name) {
            let word = self.own.remove(at);
            let value = match word.split_once('=') {
                Some((_, value)) => value.to_owned(),
                None if at < self.own.len() && !self.own[at].starts_with("--") => self.own.remove(at),
                None => return Err(format!("{name} needs a value behind it.")),
            };
            if found.replace(value).is_some() {
                return Err(format!("{name} is given twice."));
            }
        }
        Ok(found)
    }

    /// Takes `NAME NUMBER`, with a number in this range.
    pub fn number(&mut self, name: &str, range: RangeInclusive<u64>) -> Outcome<Option<u64>> {
        let Some(text) = self.value(name)? else { return Ok(None) };
        let number = text.parse().ok().filter(|number| range.contains(number));
        let (least, most) = range.into_inner();
        number
            .map(Some)
            .ok_or_else(|| format!("{name} takes a number from {least} to {most}, not \"{text}\"."))
    }

    /// All words that were not taken, for the program that the job starts.
    pub fn rest(self) -> Vec<String> {
        let mut words = self.own;
        words.extend(self.behind);
        words
    }

    /// Checks that all words were taken, for a job that passes none on.
    pub fn none_left(self) -> Outcome {
        match self.rest().first() {
            None => Ok(()),
            Some(word) => Err(format!("\"{word}\" is not understood here; --help lists the options.")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn args(line: &str) -> Args {
        Args::new(line.split_whitespace().map(str::to_owned))
    }

    #[test]
    fn options_are_taken_and_the_rest_is_passed_on_in_order() {
        let mut args = args("-p canopen --board nucleo sdo --yes -- --board kept --nocapture");
        assert!(args.has("--board") && !args.has("--boar"));
        assert_eq!(args.value("--board"), Ok(Some("nucleo".into())));
        assert!(!args.has("--board"), "it was taken");
        assert_eq!(args.value("--trace"), Ok(None));
        assert!(args.flag("--yes"));
        assert!(!args.flag("--yes"));
        assert_eq!(args.rest(), ["-p", "canopen", "sdo", "--", "--board", "kept", "--nocapture"]);
    }

    #[test]
    fn an_equals_sign_will_do_and_a_longer_name_is_another_option() {
        let mut args = args("--board=a=b --boards c");
        assert_eq!(args.value("--board"), Ok(Some("a=b".into())));
        assert_eq!(args.rest(), ["--boards", "c"]);
    }

    #[test]
    fn what_is_wrong_is_said() {
        assert!(args("--board").value("--board").is_err());
        assert!(args("--board --yes").value("--board").is_err());
        assert!(args("--board a --board b").value("--board").is_err());
        for wrong in ["0", "128", "x", "-1", "1.5"] {
            assert!(args(&format!("--node={wrong}")).number("--node", 1..=127).is_err(), "{wrong}");
        }
        assert_eq!(args("--node 127").number("--node", 1..=127), Ok(Some(127)));
        assert!(args("nonsense").none_left().unwrap_err().contains("nonsense"));
        assert!(args("-- x").none_left().is_err());
        assert!(args("").none_left().is_ok());
    }
}
