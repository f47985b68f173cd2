//! The arguments of a command line. A job takes the options it knows; [`Args::none_left`] refuses
//! the rest.

use std::ops::RangeInclusive;

use pico_args::Arguments;

use crate::outcome::Outcome;

/// The arguments after `cargo xtask JOB`.
pub struct Args {
    /// The words before `--`.
    own: Arguments,
    /// `--` and the words after it, for another program.
    passed_on: Vec<String>,
}

impl Args {
    /// Splits the words at the first `--`.
    pub fn new(words: impl Iterator<Item = String>) -> Self {
        let mut own: Vec<String> = words.collect();
        let split = own.iter().position(|word| word == "--").unwrap_or(own.len());
        let passed_on = own.split_off(split);
        Self { own: Arguments::from_vec(own.into_iter().map(Into::into).collect()), passed_on }
    }

    /// Takes a flag, with a short name or without one; returns whether it was there.
    pub fn flag(&mut self, name: impl Into<pico_args::Keys>) -> bool {
        self.own.contains(name)
    }

    /// Takes `NAME VALUE` or `NAME=VALUE`.
    pub fn value(&mut self, name: &'static str) -> Outcome<Option<String>> {
        self.own.opt_value_from_str(name).map_err(|error| format!("{name}: {error}."))
    }

    /// Takes `NAME NUMBER`, with a number in this range.
    pub fn number(&mut self, name: &'static str, range: RangeInclusive<u64>) -> Outcome<Option<u64>> {
        let Some(text) = self.value(name)? else { return Ok(None) };
        let number = text.parse().ok().filter(|number| range.contains(number));
        let (least, most) = range.into_inner();
        number
            .map(Some)
            .ok_or_else(|| format!("{name} takes a number from {least} to {most}, not \"{text}\"."))
    }

    /// All words that were not taken, for the program that the job starts.
    pub fn remaining(self) -> Vec<String> {
        let own = self.own.finish().into_iter().map(|word| word.to_string_lossy().into_owned());
        own.chain(self.passed_on).collect()
    }

    /// Checks that all words were taken, for a job that passes none on.
    pub fn none_left(self) -> Outcome {
        match self.remaining().first() {
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
        assert_eq!(args.value("--board"), Ok(Some("nucleo".into())));
        assert_eq!(args.value("--board"), Ok(None), "it was taken");
        assert_eq!(args.value("--trace"), Ok(None));
        assert!(args.flag("--yes"));
        assert!(!args.flag("--yes"));
        assert_eq!(args.remaining(), ["-p", "canopen", "sdo", "--", "--board", "kept", "--nocapture"]);
    }

    #[test]
    fn an_equals_sign_will_do_and_a_longer_name_is_another_option() {
        let mut args = args("--board=a=b --boards c");
        assert_eq!(args.value("--board"), Ok(Some("a=b".into())));
        assert_eq!(args.remaining(), ["--boards", "c"]);
    }

    #[test]
    fn what_is_wrong_is_said() {
        assert!(args("--board").value("--board").is_err());
        let mut twice = args("--board a --board b");
        assert_eq!(twice.value("--board"), Ok(Some("a".into())));
        assert!(twice.none_left().unwrap_err().contains("--board"));
        for wrong in ["0", "128", "x", "-1", "1.5"] {
            assert!(args(&format!("--node={wrong}")).number("--node", 1..=127).is_err(), "{wrong}");
        }
        assert_eq!(args("--node 127").number("--node", 1..=127), Ok(Some(127)));
        assert!(args("nonsense").none_left().unwrap_err().contains("nonsense"));
        assert!(args("-- x").none_left().is_err());
        assert!(args("").none_left().is_ok());
    }
}
