//! Runs test programs side by side, module by module, and sums up what they print.

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::{OsStr, OsString};
use std::fs::File;
use std::io::Write;
use std::process::Stdio;
use std::sync::{Mutex, PoisonError};
use std::thread;
use std::time::Instant;

use serde_json::{json, Value};

use super::plan::{SLOW, WAITING};
use super::programs::{Program, PATIENCE};
use crate::{files, outcome::Outcome, process, workspace};

/// Variables for test programs.
pub type Variables = Vec<(&'static str, OsString)>;

/// The tests of one module, which run in a process of their own.
pub struct Job {
    /// `device::line`, with the board where it is not the default one.
    name: String,
    program: Program,
    tests: Vec<String>,
    variables: Variables,
}

/// The jobs of a program with the tests that `chosen` takes; and how many tests it has with
/// `#[ignore]`.
pub fn jobs(
    program: &Program,
    place: Option<&str>,
    variables: &Variables,
    chosen: impl Fn(&str) -> bool,
) -> Outcome<(Vec<Job>, usize)> {
    let (tests, ignored) = program.tests()?;
    let mut modules = BTreeMap::<String, Vec<String>>::new();
    for test in tests.into_iter().filter(|test| chosen(test)) {
        let module = test.split_once("::").map_or("", |(module, _)| module).to_owned();
        modules.entry(module).or_default().push(test);
    }
    let place = place.map(|board| format!("[{board}] ")).unwrap_or_default();
    let jobs = modules.into_iter().map(|(module, tests)| Job {
        name: format!("{place}{}{}{module}", program.name, if module.is_empty() { "" } else { "::" }),
        program: program.clone(),
        tests,
        variables: variables.clone(),
    });
    Ok((jobs.collect(), ignored))
}

/// What has run so far.
#[derive(Default)]
pub struct Summary {
    /// Passed and failed tests, and seconds, by job.
    counts: BTreeMap<String, (usize, usize, f64)>,
    /// What failed, and what did not get as far as a test.
    pub failed: Vec<String>,
    /// Tests with `#[ignore]`.
    pub skipped: usize,
}

impl Summary {
    fn passed(&self) -> usize {
        self.counts.values().map(|(passed, ..)| passed).sum()
    }

    /// The last line of a run.
    pub fn line(&self) -> String {
        let mut line = format!("{} passed, {} failed", self.passed(), self.failed.len());
        if self.skipped > 0 {
            line += &format!(", {} skipped", self.skipped);
        }
        line
    }

    /// Whether not a single test ran.
    pub fn is_empty(&self) -> bool {
        self.counts.is_empty()
    }

    /// The record of the run.
    pub fn as_json(&self) -> Value {
        let jobs = self.counts.iter().map(|(name, (passed, failed, seconds))| {
            json!({ "tests": name, "passed": passed, "failed": failed, "seconds": (seconds * 10.0).round() / 10.0 })
        });
        json!({
            "passed": self.passed(),
            "failed": self.failed.len(),
            "skipped": self.skipped,
            "jobs": jobs.collect::<Vec<_>>(),
        })
    }

    fn add(&mut self, job: &Job, ran: &Ran) {
        let failed = job.tests.iter().filter(|test| !ran.passed.contains(*test));
        let failed: Vec<String> = failed.map(|test| format!("{} {test}", job.name)).collect();
        let counts = (ran.passed.len(), failed.len(), ran.seconds);
        self.counts.insert(job.name.clone(), counts);
        self.failed.extend(failed);
    }
}

/// Counts a job that is one test in itself.
pub fn count(name: &str, ended: Outcome, summary: &mut Summary) {
    let failed = ended.is_err();
    if let Err(problem) = ended {
        println!("{name}: {problem}");
        summary.failed.push(name.to_owned());
    }
    summary.counts.insert(name.to_owned(), (usize::from(!failed), usize::from(failed), 0.0));
}

/// Runs jobs, as many side by side as there are cores, and one more of those that mostly wait; the
/// slow ones begin first.
pub fn run(mut jobs: Vec<Job>, summary: &mut Summary) {
    let rank = |job: &Job| {
        let module = job.tests.first().and_then(|test| test.split("::").next());
        SLOW.split(' ').position(|slow| Some(slow) == module).unwrap_or(usize::MAX)
    };
    jobs.sort_by_key(|job| std::cmp::Reverse(rank(job)));
    let (waiting, computing): (Vec<_>, Vec<_>) =
        jobs.into_iter().partition(|job| WAITING.contains(&job.program.name.as_str()));
    let (waiting, computing, shared) = (Mutex::new(waiting), Mutex::new(computing), Mutex::new(summary));
    let work = |queue: &Mutex<Vec<Job>>| {
        let next = || queue.lock().unwrap_or_else(PoisonError::into_inner).pop();
        while let Some(job) = next() {
            let ran = job.run();
            job.report(&ran);
            shared.lock().unwrap_or_else(PoisonError::into_inner).add(&job, &ran);
        }
    };
    thread::scope(|scope| {
        scope.spawn(|| work(&waiting));
        for _ in 0..thread::available_parallelism().map_or(2, usize::from) {
            scope.spawn(|| {
                work(&computing);
                work(&waiting);
            });
        }
    });
}

/// What a job did.
#[derive(Default)]
struct Ran {
    passed: BTreeSet<String>,
    seconds: f64,
    /// What the program printed, if a test failed.
    printed: Vec<u8>,
    /// Tests that did not come to an end.
    hung: Vec<String>,
}

impl Job {
    /// Runs the tests in one process. If they do not end, each that is left runs in one of its own,
    /// so that the one that hangs is named and ends alone.
    fn run(&self) -> Ran {
        let started = Instant::now();
        let mut ran = Ran::default();
        if let Some(mut left) = self.attempt(&self.tests, &mut ran) {
            if left.len() > 1 {
                left.retain(|test| self.attempt(std::slice::from_ref(test), &mut ran).is_some());
            }
            ran.hung = left;
        }
        ran.seconds = started.elapsed().as_secs_f64();
        ran
    }

    /// Runs some tests in one process; returns those that were not finished in time.
    fn attempt(&self, tests: &[String], ran: &mut Ran) -> Option<Vec<String>> {
        let (printed, code) = self.output(tests).unwrap_or_else(|problem| (problem.into_bytes(), None));
        if code == Some(0) {
            ran.passed.extend(tests.iter().cloned());
            return None;
        }
        let text = String::from_utf8_lossy(&printed);
        let results: BTreeMap<&str, bool> = text.lines().filter_map(result).collect();
        ran.passed.extend(results.iter().filter(|(_, ok)| **ok).map(|(test, _)| (*test).to_owned()));
        let unfinished = tests.iter().filter(|test| !results.contains_key(test.as_str())).cloned().collect();
        ran.printed.extend_from_slice(&printed);
        (code == Some(process::TOO_LATE)).then_some(unfinished)
    }

    /// Runs some tests in one process; returns what it printed, and its exit code.
    fn output(&self, tests: &[String]) -> Outcome<(Vec<u8>, Option<i32>)> {
        // In a file no program that a test has left holds the output up.
        let log = workspace::target_dir().join("tests").join(self.name.replace(['/', ':'], "-"));
        files::write(&log, "")?;
        let unusable = |error: std::io::Error| format!("{}: {error}.", log.display());
        // Both streams are in one file, so that they stay in order.
        let file = File::options().append(true).open(&log).map_err(unusable)?;
        let mut command = self.program.command();
        command.envs(self.variables.iter().map(|(name, value)| (name, OsStr::new(value))));
        // The results are lines of their own, whatever the tests print.
        command.args(["--exact", "--color=never"]).args(tests);
        command.stdin(Stdio::null()).stdout(file.try_clone().map_err(unusable)?).stderr(file);
        let status = command.status().map_err(|error| process::not_started(&command, &error))?;
        Ok((files::bytes(&log)?, status.code()))
    }

    /// Prints a line, and what a failed test printed.
    fn report(&self, ran: &Ran) {
        let mut out = std::io::stdout().lock();
        let failed = self.tests.len() - ran.passed.len();
        if failed > 0 {
            let _ = out.write_all(&ran.printed);
        }
        for test in &ran.hung {
            let _ = writeln!(out, "{test} did not end within {} s; it was ended.", PATIENCE.as_secs());
        }
        let failed = if failed > 0 { format!(", {failed} FAILED") } else { String::new() };
        let _ =
            writeln!(out, "{:<44} {:>4} passed{failed} {:>7.1} s", self.name, ran.passed.len(), ran.seconds);
    }
}

/// The result in a line of libtest, `test line::silence ... ok`; `None` for every other line.
fn result(line: &str) -> Option<(&str, bool)> {
    let (test, result) = line.trim_end().strip_prefix("test ")?.split_once(" ... ")?;
    let test = test.strip_suffix(" - should panic").unwrap_or(test);
    match result {
        "ok" => Some((test, true)),
        _ if result.ends_with("FAILED") => Some((test, false)),
        // What a test writes past the capture may come between name and result.
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_result_is_read_in_the_form_of_libtest() {
        assert_eq!(result("test line::silence ... ok"), Some(("line::silence", true)));
        assert_eq!(result("test line::silence ... FAILED\n"), Some(("line::silence", false)));
        assert_eq!(result("test a::b - should panic ... ok"), Some(("a::b", true)));
        assert_eq!(result("test line::silence has been running for over 60 seconds"), None);
        assert_eq!(result("test result: ok. 20 passed; 0 failed"), None);
    }

    #[test]
    fn what_did_not_report_counts_as_failed() {
        let program = Program::of_a_test("device", "false".into());
        let tests = ["line::a", "line::b", "line::c"].map(str::to_owned).to_vec();
        let job = Job { name: "device::line".into(), program, tests, variables: Vec::new() };
        let ran = Ran { passed: BTreeSet::from(["line::b".to_owned()]), ..Ran::default() };
        let mut summary = Summary { skipped: 2, ..Summary::default() };
        summary.add(&job, &ran);
        assert_eq!(summary.line(), "1 passed, 2 failed, 2 skipped");
        assert_eq!(summary.failed, ["device::line line::a", "device::line line::c"]);
        assert_eq!(summary.as_json()["jobs"][0]["failed"], 2);
        // A program that fails and prints no result: nothing passed.
        assert!(job.run().passed.is_empty());
        let good = Job { program: Program::of_a_test("device", "true".into()), ..job };
        assert_eq!(good.run().passed.len(), 3);
    }
}
