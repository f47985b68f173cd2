//! The host tool, as a user calls it: an external program that answers in JSON.

use std::io::{BufRead, BufReader};
use std::process::Command;
use std::sync::mpsc::channel;
use std::thread;
use std::time::Duration;

use super::command::{Ended, Running};
use crate::{process, workspace, Outcome};
use serde_json::Value;

/// The time for any call. The longest one is a download in segments at 10 kbit/s.
const LIMIT: Duration = Duration::from_secs(600);

/// coflash for one device.
pub struct Coflash {
    bus: String,
    node: u8,
}

/// The answer of a call.
pub struct Answer {
    /// The exit code; `None` if a signal ended it.
    pub code: Option<i32>,
    /// The last document that was printed.
    pub value: Value,
    /// All that was printed.
    pub said: String,
    errors: String,
}

impl Answer {
    /// The answer of a call that had to succeed.
    pub fn good(self) -> Outcome<Self> {
        if self.code == Some(0) {
            Ok(self)
        } else {
            Err(self.problem())
        }
    }

    /// The message of coflash, with its advice.
    pub fn problem(&self) -> String {
        let error = &self.value["error"];
        match (error["what"].as_str(), error["advice"].as_str()) {
            (Some(what), Some(advice)) => format!("{what}. What to do: {advice}."),
            (Some(what), None) => format!("{what}."),
            _ => format!("coflash ended with {:?}: {}", self.code, self.errors.trim()),
        }
    }
}

impl Coflash {
    /// coflash on a bus, for the device with this node-ID.
    pub fn new(bus: String, node: u8) -> Self {
        Self { bus, node }
    }

    /// Calls coflash without a bus.
    pub fn plain() -> Command {
        let program = workspace::target_dir().join("debug").join("coflash");
        Command::new(program.with_extension(std::env::consts::EXE_EXTENSION))
    }

    fn command(&self, words: &[&str], json: &str) -> Command {
        let mut command = Self::plain();
        command.args(words).args(["--bus", &self.bus, "--node", &self.node.to_string(), json]);
        command
    }

    /// Calls coflash, which prints one document.
    pub fn call(&self, words: &[&str]) -> Outcome<Answer> {
        let ended = Running::start(&mut self.command(words, "--json"), false)?.wait(LIMIT)?;
        Ok(answer(ended))
    }

    /// Flashes a program, and does `act` in the middle: when a third of the bytes is in the device.
    pub fn flash_until_middle(
        &self,
        words: &[&str],
        act: impl FnOnce(&mut Running) -> Outcome,
    ) -> Outcome<Answer> {
        let mut command = self.command(words, "--json-events");
        let mut running = Running::start(&mut command, true)?;
        let (sender, lines) = channel();
        if let Some(pipe) = running.child().stdout.take() {
            thread::spawn(move || {
                for line in BufReader::new(pipe).lines().map_while(Result::ok) {
                    if sender.send(line).is_err() {
                        break;
                    }
                }
            });
        }
        let (mut act, mut said) = (Some(act), String::new());
        // The lines end with the program, and coflash itself gives up a silent device.
        while let Ok(line) = lines.recv_timeout(LIMIT) {
            let value = process::json(&line)?;
            said += &line;
            said.push('\n');
            if is_middle(&value) {
                if let Some(act) = act.take() {
                    act(&mut running)?;
                }
            }
        }
        let ended = running.wait(LIMIT)?;
        let answer = answer(Ended { said, ..ended });
        if act.is_some() {
            return Err(format!(
                "`{}` never came to the middle. {}",
                process::line(&command),
                answer.problem()
            ));
        }
        Ok(answer)
    }
}

/// Whether an event tells that more than a third is in the device, and not all of it.
fn is_middle(event: &Value) -> bool {
    let number = |key: &str| event[key].as_u64();
    let is_progress = event["event"].as_str() == Some("progress");
    match (number("done"), number("total")) {
        (Some(done), Some(total)) => is_progress && done < total && done >= total / 3,
        _ => false,
    }
}

fn answer(Ended { code, said, errors }: Ended) -> Answer {
    let whole = process::json(&said).ok();
    let last = || said.lines().rev().find_map(|line| process::json(line).ok());
    let value = whole.or_else(last).unwrap_or(Value::Null);
    Answer { code, value, said, errors }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_middle_is_a_third_and_never_the_end() {
        let event = |text: &str| process::json(text).unwrap();
        assert!(is_middle(&event(r#"{"event":"progress","done":4,"total":12}"#)));
        assert!(!is_middle(&event(r#"{"event":"progress","done":3,"total":12}"#)));
        assert!(!is_middle(&event(r#"{"event":"progress","done":12,"total":12}"#)));
        assert!(!is_middle(&event(r#"{"event":"phase","done":4,"total":12}"#)));
    }

    #[test]
    fn an_error_brings_its_advice() {
        let told = r#"{"error":{"what":"node 1 does not answer","advice":"check its power"}}"#;
        let answer = answer(Ended { code: Some(5), said: told.into(), errors: String::new() });
        let problem = answer.good().err().unwrap();
        assert_eq!(problem, "node 1 does not answer. What to do: check its power.");
    }
}
