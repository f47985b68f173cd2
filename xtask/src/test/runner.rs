//! Runs tests with cargo-nextest, and sums up what it reports; `.config/nextest.toml` says in which order, and when a
//! test counts as hanging.

use std::ffi::OsString;
use std::process::{Command, Stdio};
use std::thread;

use serde_json::{json, Value};

use crate::{outcome::Outcome, process, setup, workspace};

/// Variables for test programs.
pub type Variables = Vec<(&'static str, OsString)>;

/// What has run so far.
#[derive(Default)]
pub struct Summary {
    passed: u64,
    /// What failed, and what did not get as far as a test.
    pub failed: Vec<String>,
    /// Tests with `#[ignore]`.
    skipped: u64,
}

impl Summary {
    /// The last line of a run.
    pub fn line(&self) -> String {
        format!("{} passed, {} failed, {} skipped", self.passed, self.failed.len(), self.skipped)
    }

    /// Whether not a single test ran.
    pub fn is_empty(&self) -> bool {
        self.passed == 0 && self.failed.is_empty()
    }

    /// The record of the run.
    pub fn as_json(&self) -> Value {
        json!({
            "passed": self.passed,
            "failed": self.failed.len(),
            "skipped": self.skipped,
            "names of the failed": self.failed,
        })
    }

    /// Counts a job that is one test in itself.
    pub fn count(&mut self, name: &str, ended: Outcome) {
        match ended {
            Ok(()) => self.passed += 1,
            Err(problem) => {
                println!("{name}: {problem}");
                self.failed.push(name.to_owned());
            }
        }
    }

    /// Counts what a message of nextest reports, in the form of libtest's JSON with `PACKAGE::PROGRAM$MODULE::TEST` as
    /// the name of a test.
    fn read(&mut self, message: &Value, place: &str) {
        match (message["type"].as_str(), message["event"].as_str()) {
            // A test with `#[ignore]` is said to start, and sometimes to be ignored, but never to end.
            (Some("test"), Some("started")) => self.skipped += 1,
            (Some("test"), Some("ignored")) => {}
            (Some("test"), Some(event)) => {
                self.skipped = self.skipped.saturating_sub(1);
                if event == "ok" {
                    self.passed += 1;
                } else {
                    self.failed.push(format!("{place}{}", message["name"].as_str().unwrap_or_default()));
                }
            }
            _ => {}
        }
    }
}

/// nextest of the Python environment on this workspace; `line` is its subcommand with options.
fn nextest(line: &str, arguments: &[String]) -> Command {
    let mut nextest = Command::new(setup::python().with_file_name("cargo-nextest"));
    nextest.arg("nextest");
    let mut nextest = process::on_workspace(nextest, workspace::root(), line);
    nextest.args(arguments).current_dir(workspace::root());
    nextest
}

/// Builds the test programs of packages; `arguments` select them for cargo.
pub fn build(arguments: &[String], variables: &Variables) -> Outcome {
    process::run(nextest("run --no-run", arguments).envs(variables.iter().cloned()))
}

/// Runs the tests of these packages that a filter of nextest takes; `place` names what is special about them.
///
/// # Errors
/// When the programs do not build, or nextest cannot be started.
pub fn run(
    arguments: &[String],
    filter: &str,
    place: &str,
    variables: &Variables,
    summary: &mut Summary,
) -> Outcome {
    const LINE: &str = "run --no-fail-fast --no-tests=pass --status-level=slow --final-status-level=fail \
                        --message-format=libtest-json";
    let mut nextest = nextest(LINE, arguments);
    // Many tests mostly wait for other programs.
    let threads = 3 * thread::available_parallelism().map_or(2, usize::from);
    nextest.args(["-E", filter, "--test-threads", &threads.to_string()]);
    nextest.envs(variables.iter().cloned()).env("NEXTEST_EXPERIMENTAL_LIBTEST_JSON", "1");
    // It shows the failed tests on its standard error, and reports all on its standard output.
    let output = nextest.stdin(Stdio::null()).stderr(Stdio::inherit()).output();
    let output = output.map_err(|error| process::not_started(&nextest, &error))?;
    // 100: a test failed.
    if !matches!(output.status.code(), Some(0 | 100)) {
        return Err("the tests could not be built or run; what is printed above says why.".into());
    }
    for line in String::from_utf8_lossy(&output.stdout).lines() {
        summary.read(&process::json(line)?, place);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::files;

    /// Messages as nextest 0.9 prints them.
    #[test]
    fn a_report_of_nextest_is_counted() {
        let mut summary = Summary::default();
        for message in [
            r#"{"type":"suite","event":"started","test_count":4}"#,
            r#"{"type":"test","event":"started","name":"coboot-tests::device$line::ignored"}"#,
            r#"{"type":"test","event":"started","name":"coboot-tests::device$line::silence"}"#,
            r#"{"type":"test","event":"ignored","name":"coboot-tests::device$line::ignored"}"#,
            r#"{"type":"test","event":"started","name":"coboot-tests::device$line::noise"}"#,
            r#"{"type":"test","event":"ok","name":"coboot-tests::device$line::silence","exec_time":0.25}"#,
            r#"{"type":"test","event":"failed","name":"coboot-tests::device$line::noise","exec_time":0.5}"#,
            r#"{"type":"suite","event":"failed","passed":1,"failed":1,"ignored":1,"filtered_out":7}"#,
        ] {
            summary.read(&process::json(message).unwrap(), "[a-board] ");
        }
        assert_eq!(summary.line(), "1 passed, 1 failed, 1 skipped");
        assert_eq!(summary.failed, ["[a-board] coboot-tests::device$line::noise"]);
        summary.count("a job", Err("it broke off".into()));
        assert_eq!(summary.line(), "1 passed, 2 failed, 1 skipped");
        assert_eq!(summary.as_json()["failed"], 2);
    }

    /// `test = false` saves a link, and would let a test rest in silence.
    #[test]
    fn what_cargo_builds_no_tests_of_has_none() {
        let metadata = process::metadata().unwrap();
        let targets =
            process::list(&metadata, "packages").flat_map(|package| process::list(package, "targets"));
        let kinds = ["lib", "bin", "cdylib"];
        let without =
            |target: &&Value| kinds.iter().any(|kind| target["kind"][0] == **kind) && target["test"] == false;
        for target in targets.filter(without) {
            let folder = Path::new(target["src_path"].as_str().unwrap()).parent().unwrap();
            for file in files::below(folder, &[]).unwrap() {
                let is_test = |line: &str| line.trim() == "#[test]";
                assert!(!files::text(&file).unwrap().lines().any(is_test), "{}", file.display());
            }
        }
    }
}
