//! The host tool, as a user calls it: an external program that answers in JSON.

use std::path::{Path, PathBuf};
use std::process::{Output, Stdio};
use std::time::Duration;

use serde_json::Value;

use crate::{files, outcome::Outcome, process};

/// The time for any call. The longest one is a download in segments at 10 kbit/s.
const LIMIT: Duration = Duration::from_secs(600);

/// coflash for one device.
pub struct Coflash {
    pub program: PathBuf,
    /// The bus; `{rate}` in it becomes the bit rate.
    pub bus: String,
    pub node: u64,
    /// The bit rate in kbit/s.
    pub rate: u32,
}

/// The answer of a call.
pub struct Answer {
    /// The exit code; `None` if a signal ended it.
    pub code: Option<i32>,
    /// The last document that was printed.
    pub value: Value,
    /// All that was printed.
    pub stdout: String,
    errors: String,
}

impl Answer {
    fn new(output: &Output, stdout: String) -> Self {
        let whole = process::json(&stdout).ok();
        let last = || stdout.lines().rev().find_map(|line| process::json(line).ok());
        let value = whole.or_else(last).unwrap_or(Value::Null);
        let errors = String::from_utf8_lossy(&output.stderr).into_owned();
        Self { code: output.status.code(), value, stdout, errors }
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

/// A frame in a trace.
pub struct TracedFrame {
    /// The adapter's time, in seconds.
    pub seconds: f64,
    /// As candump writes it: `701#00`.
    pub frame: String,
}

/// The frames of a candump log.
fn frames(log: &str) -> Vec<TracedFrame> {
    let frame = |line: &str| {
        let mut words = line.split_whitespace();
        let seconds = words.next()?.trim_matches(['(', ')']).parse().ok()?;
        Some(TracedFrame { seconds, frame: words.nth(1)?.to_owned() })
    };
    log.lines().filter_map(frame).collect()
}

/// The seconds from the last frame that begins like this to the frame `end` that follows.
pub fn between(frames: &[TracedFrame], start: &str, end: &str) -> Option<f64> {
    let at = frames.iter().rposition(|one| one.frame == end)?;
    let from = frames[..at].iter().rfind(|one| one.frame.starts_with(start))?;
    Some(frames[at].seconds - from.seconds)
}

impl Coflash {
    /// Calls coflash, which prints one document.
    pub fn call(&self, words: &[&str]) -> Outcome<Answer> {
        let bus = self.bus.replace("{rate}", &self.rate.to_string());
        let mut command = process::within(LIMIT, &self.program);
        command.args(words).args(["--bus", &bus, "--json"]);
        if words[0] != "monitor" {
            command.args(["--node", &self.node.to_string()]);
        }
        command.stdin(Stdio::null());
        let output = command.output().map_err(|error| process::not_started(&command, &error))?;
        let stdout = String::from_utf8_lossy(&output.stdout).into_owned();
        Ok(Answer::new(&output, stdout))
    }

    /// The same, with the frames that were on the bus meanwhile; a file in `folder` gets them.
    pub fn traced(&self, words: &[&str], folder: &Path) -> Outcome<(Answer, Vec<TracedFrame>)> {
        files::make(folder)?;
        let file = folder.join("trace.log");
        let answer = self.call(&[words, &["--trace", &file.display().to_string()]].concat())?;
        Ok((answer, frames(&files::text(&file)?)))
    }

    /// Whether `--bus` leaves the adapter's bit rate to the job.
    pub fn can_change_rate(&self) -> bool {
        self.bus.contains("{rate}")
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::process::ExitStatusExt;
    use std::process::ExitStatus;

    use super::*;

    #[test]
    fn the_time_between_two_frames_is_that_of_the_log() {
        let log = "(1.000000) can0 581#60511F0100000000 R\n(1.5) can0 701#05\n\n(2.012500) can0 701#00 R\n";
        assert_eq!(between(&frames(log), "581#60511F01", "701#00"), Some(2.0125 - 1.0));
        assert_eq!(between(&frames(log), "701#00", "581#60511F01"), None);
        assert_eq!(between(&frames("x\n(a) b c\n"), "581", "701#00"), None);
    }

    #[test]
    fn an_error_brings_its_advice() {
        let document = r#"{"error":{"what":"node 1 does not answer","advice":"check its power"}}"#;
        let output = Output { status: ExitStatus::from_raw(5 << 8), stdout: Vec::new(), stderr: Vec::new() };
        let problem = Answer::new(&output, document.into()).good().err().unwrap();
        assert_eq!(problem, "node 1 does not answer. What to do: check its power.");
    }
}
