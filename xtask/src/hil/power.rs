//! The power of the board: a relay behind a command.

use std::process::Command;
use std::time::Duration;

use super::command;
use crate::Outcome;

/// The time for a relay.
const LIMIT: Duration = Duration::from_secs(30);
/// The time without power: the capacitors of the board empty themselves.
const DARK: Duration = Duration::from_secs(1);

/// A command that switches the supply.
pub struct Power {
    words: Vec<String>,
}

impl Power {
    /// Takes the command line with `{state}` in it.
    pub fn new(line: &str) -> Outcome<Self> {
        let words = command::words(line)?;
        if !words.iter().any(|word| word.contains("{state}")) {
            return Err(format!(
                "--power-command `{line}`: {{state}} is missing; on and off stand in its place."
            ));
        }
        Ok(Self { words })
    }

    /// Checks that the program exists.
    pub fn is_there(&self) -> Outcome {
        if command::is_there(&self.words[0]) {
            return Ok(());
        }
        Err(format!("--power-command: there is no program \"{}\" here.", self.words[0]))
    }

    /// Switches the supply.
    pub fn switch(&self, on: bool) -> Outcome {
        let state = if on { "on" } else { "off" };
        let mut words = self.words.iter().map(|word| word.replace("{state}", state));
        let mut relay = Command::new(words.next().unwrap_or_default());
        command::succeed(relay.args(words), LIMIT).map_err(|error| {
            format!("the power cannot be switched {state}: {error} Try the command by hand with {state}.")
        })
    }

    /// Switches the supply off and on again.
    pub fn cycle(&self) -> Outcome {
        self.switch(false)?;
        std::thread::sleep(DARK);
        self.switch(true)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_command_without_a_state_is_refused() {
        assert!(Power::new("relay on").err().unwrap().contains("{state}"));
        assert!(Power::new("").is_err());
    }

    #[cfg(unix)]
    #[test]
    fn the_state_stands_in_its_place_and_a_failure_is_told() {
        let power = Power::new("sh -c 'test {state} = on'").unwrap();
        assert_eq!(power.switch(true), Ok(()));
        let problem = power.cycle().unwrap_err();
        assert!(problem.contains("switched off") && problem.contains("by hand"), "{problem}");
    }
}
