//! Command lines of the user: for the debug probe, and for the relay of the supply.

use std::time::Duration;

use crate::{outcome::Outcome, process};

/// A command line with placeholders. No shell reads it; quotes keep words together.
pub struct CommandLine {
    words: Vec<String>,
}

impl CommandLine {
    /// Reads the line of an option, and looks whether its program is there.
    pub fn new(option: &str, line: &str) -> Outcome<Self> {
        let words = shlex::split(line).filter(|words| !words.is_empty());
        let words =
            words.ok_or_else(|| format!("{option} `{line}`: it is empty, or a quote is not closed."))?;
        // `command` is a word of the shell; its argument is $0 here.
        if process::succeeds("sh", &["-c", "command -v \"$0\"", &words[0]]) {
            return Ok(Self { words });
        }
        let remedy = match words[0].as_str() {
            "probe-rs" => " `cargo install probe-rs-tools --locked` installs it.",
            _ => "",
        };
        Err(format!("{option}: the program \"{}\" is not there.{remedy}", words[0]))
    }

    /// The words with values in the places of their names; a word with the name of an empty value is
    /// left out.
    fn with(&self, values: &[(&str, &str)]) -> Vec<String> {
        let is_left_out =
            |word: &str| values.iter().any(|(name, value)| value.is_empty() && word.contains(name));
        let words = self.words.iter().filter(|word| !is_left_out(word));
        let fill = |word: String, (name, value): &(&str, &str)| word.replace(name, value);
        words.map(|word| values.iter().fold(word.clone(), fill)).collect()
    }

    /// Runs the command to its end, for this time at most.
    pub fn run(&self, values: &[(&str, &str)], limit: Duration) -> Outcome {
        let words = self.with(values);
        process::output(process::within(limit, &words[0]).args(&words[1..])).map(drop)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_becomes_words_with_values_in_their_places() {
        for wrong in ["sh 'b", "  ", ""] {
            assert!(CommandLine::new("--probe", wrong).err().unwrap().contains("not closed"), "{wrong}");
        }
        let probe = CommandLine::new("--probe", "sh {action} --chip {chip} {elf}").ok().unwrap();
        let line = |elf| probe.with(&[("{action}", "reset"), ("{chip}", "STM32F407VG"), ("{elf}", elf)]);
        assert_eq!(line("a b.elf"), ["sh", "reset", "--chip", "STM32F407VG", "a b.elf"]);
        assert_eq!(line(""), ["sh", "reset", "--chip", "STM32F407VG"]);
    }

    #[test]
    fn a_program_that_is_missing_fails_or_does_not_end_is_told() {
        let missing = CommandLine::new("--probe", "no-such-probe {elf}").err().unwrap();
        assert!(missing.contains("--probe") && missing.contains("no-such-probe"), "{missing}");
        let run = |line, limit| CommandLine::new("--probe", line)?.run(&[], limit);
        // Time enough, on a busy machine too, for what ends by itself.
        let minute = Duration::from_mins(1);
        assert_eq!(run("/bin/true", minute), Ok(()));
        let problem = run("sh -c 'echo broken >&2; exit 3'", minute).unwrap_err();
        assert!(problem.contains('3') && problem.ends_with(": broken"), "{problem}");
        assert!(run("sleep 1000", Duration::from_millis(50)).unwrap_err().contains("124"));
    }
}
