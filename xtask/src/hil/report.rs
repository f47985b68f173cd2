//! The report: a line for each step, a table at the end, and the same as JSON.

use std::fmt::Write as _;

use crate::Outcome;
use serde_json::{json, Value};

/// The outcome of a step.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// It passed; a detail, which may be empty.
    Passed(String),
    /// It failed: why, and what to do.
    Failed(String),
    /// It was not done, for this reason.
    LeftOut(String),
}

impl Verdict {
    /// The word for the table and the report, and the text.
    fn parts(&self) -> (&'static str, &str) {
        match self {
            Self::Passed(text) => ("passed", text),
            Self::Failed(text) => ("FAILED", text),
            Self::LeftOut(text) => ("left out", text),
        }
    }
}

/// A step with its outcome.
pub struct Line {
    /// The step.
    pub name: &'static str,
    /// Its outcome.
    pub verdict: Verdict,
    /// The time that it took.
    pub seconds: f64,
}

/// The results of a run.
pub struct Report {
    board: String,
    bus: String,
    node: u8,
    lines: Vec<Line>,
    /// The document of `coflash conform`, if it ran.
    pub conform: Option<Value>,
}

impl Report {
    /// An empty report.
    pub fn new(board: &str, bus: &str, node: u8) -> Self {
        Self { board: board.into(), bus: bus.into(), node, lines: Vec::new(), conform: None }
    }

    /// Takes a step, and prints it.
    pub fn take(&mut self, line: Line) {
        let (word, text) = line.verdict.parts();
        let colon = if text.is_empty() { "" } else { ": " };
        println!("{:>2}  {word:<8}  {}{colon}{text}", self.lines.len() + 1, line.name);
        self.lines.push(line);
    }

    fn count(&self, word: &str) -> usize {
        self.lines.iter().filter(|line| line.verdict.parts().0 == word).count()
    }

    /// The table at the end.
    pub fn summary(&self) -> String {
        let mut text = format!("\n{}, node {} on {}\n", self.board, self.node, self.bus);
        for line in &self.lines {
            let _ = writeln!(text, "  {:<8}  {:>6.1} s  {}", line.verdict.parts().0, line.seconds, line.name);
        }
        let counts = ["passed", "FAILED", "left out"].map(|word| self.count(word));
        let _ = writeln!(text, "{} passed, {} failed, {} left out", counts[0], counts[1], counts[2]);
        text
    }

    /// The result of the run.
    pub fn outcome(&self) -> Outcome {
        match self.count("FAILED") {
            0 => Ok(()),
            1 => Err("1 step failed; its line above says what to do.".into()),
            failed => Err(format!("{failed} steps failed; their lines above say what to do.")),
        }
    }

    /// The report as JSON.
    pub fn json(&self) -> Value {
        let steps = self.lines.iter().map(|line| {
            let (word, text) = line.verdict.parts();
            let seconds = (line.seconds * 10.0).round() / 10.0;
            json!({"step": line.name, "outcome": word.to_ascii_lowercase(), "text": text, "seconds": seconds})
        });
        json!({
            "board": self.board,
            "bus": self.bus,
            "node": self.node,
            "passed": self.outcome().is_ok(),
            "steps": steps.collect::<Vec<_>>(),
            "conform": self.conform,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_report_is_json_whatever_a_program_says_and_one_failure_fails_it() {
        let mut report = Report::new("a board", "socketcan:can0", 5);
        let mut take = |name, verdict| report.take(Line { name, verdict, seconds: 1.5 });
        take("one", Verdict::Passed(String::new()));
        take("two", Verdict::LeftOut("no relay".into()));
        assert_eq!(report.outcome(), Ok(()));
        let said = "it said \"no\\\"\n\tand\u{1}";
        report.take(Line { name: "three", verdict: Verdict::Failed(said.into()), seconds: 0.0 });
        assert!(report.outcome().is_err());
        assert!(report.summary().ends_with("1 passed, 1 failed, 1 left out\n"), "{}", report.summary());
        let value = report.json();
        let words: Vec<_> = value["steps"]
            .as_array()
            .into_iter()
            .flatten()
            .map(|step| step["outcome"].as_str().unwrap())
            .collect();
        assert_eq!(words, ["passed", "left out", "failed"]);
        assert_eq!(value["passed"], json!(false));
        assert_eq!(value["steps"][2]["text"].as_str(), Some(said));
    }
}
