//! Runs the tests for each change.

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsStr;
use std::fs;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{self, Receiver};
use std::sync::Mutex;
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{ensure, Context, Result};

use crate::compile::Program;

/// No test runs for ever: what takes as many times as long as without a change is noticed.
const TIMES: u32 = 5;
/// The shortest time for a test program.
const SHORTEST: Duration = Duration::from_secs(10);
/// The memory of a test program, in KiB: a change may make it fill the machine's.
const MEMORY: &str = "4000000";

/// Whether each of these changes makes a test fail. The quickest test programs run first, and only
/// those that reach the place of the change.
///
/// # Errors
/// When a test fails without a change, or the folder for notes cannot be written.
pub fn all(programs: &[Program], changes: &[usize], notes: &Path) -> Result<BTreeMap<usize, bool>> {
    let mut timed = Vec::new();
    fs::create_dir_all(notes).with_context(|| notes.display().to_string())?;
    for (n, program) in programs.iter().enumerate() {
        let note = notes.join(format!("reached-{n}"));
        let _ = fs::remove_file(&note);
        let started = Instant::now();
        let passes = passes(program, Some(note.as_os_str()), Duration::from_secs(900))?;
        ensure!(passes, "{} fails without a change", program.0.display());
        timed.push((started.elapsed(), program, reached(&note)));
    }
    timed.sort();
    let limits: Vec<(&Program, Duration, BTreeSet<usize>)> = timed
        .into_iter()
        .map(|(took, program, reached)| (program, (took * TIMES).max(SHORTEST), reached))
        .collect();
    let (next, ends, problem) = (AtomicUsize::new(0), Mutex::new(BTreeMap::new()), Mutex::new(None));
    let threads = thread::available_parallelism().map_or(1, usize::from);
    thread::scope(|scope| {
        for _ in 0..threads {
            scope.spawn(|| {
                while let Some(number) = changes.get(next.fetch_add(1, Ordering::Relaxed)) {
                    let change = number.to_string();
                    let mut there = limits.iter().filter(|(_, _, reached)| reached.contains(number));
                    let is_noticed = there.try_fold(false, |noticed, (program, limit, _)| {
                        Ok::<_, anyhow::Error>(noticed || !passes(program, Some(change.as_ref()), *limit)?)
                    });
                    match is_noticed {
                        Ok(is_noticed) => {
                            let mut ends = lock(&ends);
                            ends.insert(*number, is_noticed);
                            if ends.len() % 100 == 0 {
                                println!("  {} of {} changes were tried", ends.len(), changes.len());
                            }
                        }
                        Err(error) => *lock(&problem) = Some(error),
                    }
                }
            });
        }
    });
    let problem = problem.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner);
    match problem {
        Some(problem) => Err(problem),
        None => Ok(ends.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner)),
    }
}

fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}

/// The changes whose places a test program has reached.
fn reached(note: &Path) -> BTreeSet<usize> {
    let lines = fs::read_to_string(note).unwrap_or_default();
    lines.lines().filter_map(|line| line.parse().ok()).collect()
}

/// Whether a test program passes within this time, with this change; or with a note of what it
/// reaches.
fn passes((program, folder): &Program, mutant: Option<&OsStr>, limit: Duration) -> Result<bool> {
    let mut test = Command::new("sh");
    test.args(["-c", "ulimit -v \"$0\" && exec \"$@\"", MEMORY]).arg(program).current_dir(folder);
    test.envs(mutant.map(|mutant| ("MUTANT", mutant)));
    test.env("PROPTEST_MAX_SHRINK_ITERS", "0").env("RUST_BACKTRACE", "0");
    test.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::null());
    let mut test = test.spawn().context("a test program cannot be started")?;
    // The first failure is enough; the program itself would go on with its other tests.
    let (sender, failed) = mpsc::channel();
    if let Some(said) = test.stdout.take() {
        thread::spawn(move || {
            let mut lines = BufReader::new(said).lines().map_while(std::io::Result::ok);
            if lines.by_ref().any(|line| line.ends_with("... FAILED")) {
                let _ = sender.send(());
            }
            // Nobody else reads the pipe.
            lines.for_each(drop);
        });
    }
    let passed = wait(&mut test, &failed, limit)?;
    if test.try_wait()?.is_none() {
        test.kill().context("a test program cannot be ended")?;
        test.wait()?;
    }
    Ok(passed == Some(true))
}

/// Whether a program succeeds, and no test in it fails; `None` if it still runs after this time.
fn wait(program: &mut Child, failed: &Receiver<()>, limit: Duration) -> Result<Option<bool>> {
    let started = Instant::now();
    let mut pause = Duration::from_millis(1);
    loop {
        if let Some(status) = program.try_wait()? {
            return Ok(Some(status.success()));
        }
        if failed.try_recv().is_ok() {
            return Ok(Some(false));
        }
        if started.elapsed() > limit {
            return Ok(None);
        }
        thread::sleep(pause);
        pause = (pause * 2).min(Duration::from_millis(50));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn executable(path: &Path, text: &str) {
        use std::os::unix::fs::PermissionsExt;
        fs::write(path, text).unwrap();
        fs::set_permissions(path, fs::Permissions::from_mode(0o755)).unwrap();
    }

    #[test]
    fn a_program_fails_by_its_status_by_a_test_or_by_its_time() {
        let program = |path: &str| (path.into(), "/".into());
        let long = Duration::from_secs(60);
        assert!(passes(&program("/bin/true"), None, long).unwrap());
        assert!(!passes(&program("/bin/false"), Some("3".as_ref()), long).unwrap());
        assert!(!passes(&program("/usr/bin/yes"), None, Duration::from_millis(50)).unwrap());
        // It would go on for an hour.
        let path = std::env::temp_dir().join(format!("coboot-mutants-fails-{}", std::process::id()));
        executable(&path, "#!/bin/sh\necho 'test a ... ok'\necho 'test b ... FAILED'\nexec sleep 3600\n");
        assert!(!passes(&(path.clone(), "/".into()), None, Duration::from_secs(3000)).unwrap());
        fs::remove_file(path).unwrap();
        let notes = std::env::temp_dir().join(format!("coboot-mutants-{}", std::process::id()));
        assert!(all(&[program("/bin/false")], &[1], &notes).is_err());
        let ends = all(&[program("/bin/true")], &[1, 2], &notes).unwrap();
        assert_eq!(ends, BTreeMap::from([(1, false), (2, false)]));
        fs::remove_dir_all(notes).unwrap();
    }

    /// A test program that reaches two places and fails with one of the changes.
    #[test]
    fn a_program_runs_only_for_the_changes_that_it_reaches() {
        let notes = std::env::temp_dir().join(format!("coboot-mutants-reached-{}", std::process::id()));
        fs::create_dir_all(&notes).unwrap();
        let path = notes.join("program");
        let text =
            "#!/bin/sh\ncase $MUTANT in\n/*) printf '1\\n2\\n' > $MUTANT ;;\n1) ;;\n*) exit 1 ;;\nesac\n";
        executable(&path, text);
        let ends = all(&[(path, "/".into())], &[1, 2, 3], &notes).unwrap();
        assert_eq!(ends, BTreeMap::from([(1, false), (2, true), (3, false)]), "3 is never reached");
        fs::remove_dir_all(notes).unwrap();
    }
}
