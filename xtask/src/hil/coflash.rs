//! The host tool, as a user calls it: an external program that answers in JSON.

use std::io::{BufRead, BufReader};
use std::path::PathBuf;
use std::process::{Command, Output, Stdio};
use std::time::Duration;

use serde_json::Value;

use super::command::within;
use crate::{process, workspace, Outcome};

/// The time for any call. The longest one is a download in segments at 10 kbit/s.
const LIMIT: Duration = Duration::from_secs(600);

/// coflash for one device.
pub struct Coflash {
    pub bus: String,
    pub node: u64,
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
    fn new(output: &Output, said: String) -> Self {
        let whole = process::json(&said).ok();
        let last = || said.lines().rev().find_map(|line| process::json(line).ok());
        let value = whole.or_else(last).unwrap_or(Value::Null);
        let errors = String::from_utf8_lossy(&output.stderr).into_owned();
        Self { code: output.status.code(), value, said, errors }
    }

    /// The answer of a call that had to succeed; otherwise its message is the error.
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

/// The program.
pub fn program() -> PathBuf {
    workspace::target_dir().join("debug/coflash")
}

impl Coflash {
    fn command(&self, words: &[&str], json: &str) -> Command {
        let mut command = within(LIMIT, program());
        command.args(words).args(["--bus", &self.bus, "--node", &self.node.to_string(), json]);
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        command
    }

    /// Calls coflash, which prints one document.
    pub fn call(&self, words: &[&str]) -> Outcome<Answer> {
        let mut command = self.command(words, "--json");
        let output = command.output().map_err(|error| process::not_started(&command, &error))?;
        let said = String::from_utf8_lossy(&output.stdout).into_owned();
        Ok(Answer::new(&output, said))
    }

    /// Flashes a program, and does `act` in the middle, when a third of the bytes is in the device;
    /// `act` gets the number of the process.
    pub fn flash_until_middle(&self, words: &[&str], act: impl Fn(u32) -> Outcome) -> Outcome<Answer> {
        let mut command = self.command(words, "--json-events");
        let failed = |error| format!("coflash: {error}.");
        let mut running = command.spawn().map_err(failed)?;
        let (mut acted, mut said) = (None, String::new());
        // The lines end with the program.
        for line in running.stdout.take().into_iter().flat_map(|pipe| BufReader::new(pipe).lines()) {
            let line = line.map_err(failed)?;
            if acted.is_none() && is_middle(&process::json(&line)?) {
                acted = Some(act(running.id()));
            }
            said = said + &line + "\n";
        }
        let answer = Answer::new(&running.wait_with_output().map_err(failed)?, said);
        match acted {
            Some(acted) => acted.map(|()| answer),
            None => Err(format!("the update never came to its middle. {}", answer.problem())),
        }
    }
}

/// Whether an event reports that more than a third is in the device, and not all of it.
fn is_middle(event: &Value) -> bool {
    match (event["done"].as_u64(), event["total"].as_u64()) {
        (Some(done), Some(total)) => event["event"] == "progress" && done < total && done >= total / 3,
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::process::ExitStatusExt;
    use std::process::ExitStatus;

    use serde_json::json;

    use super::*;

    #[test]
    fn the_middle_is_a_third_and_never_the_end() {
        assert!(is_middle(&json!({"event": "progress", "done": 4, "total": 12})));
        assert!(!is_middle(&json!({"event": "progress", "done": 3, "total": 12})));
        assert!(!is_middle(&json!({"event": "progress", "done": 12, "total": 12})));
        assert!(!is_middle(&json!({"event": "phase", "done": 4, "total": 12})));
    }

    #[test]
    fn an_error_brings_its_advice() {
        let told = r#"{"error":{"what":"node 1 does not answer","advice":"check its power"}}"#;
        let output = Output { status: ExitStatus::from_raw(5 << 8), stdout: Vec::new(), stderr: Vec::new() };
        let problem = Answer::new(&output, told.into()).good().err().unwrap();
        assert_eq!(problem, "node 1 does not answer. What to do: check its power.");
    }
}
