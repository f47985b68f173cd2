//! Runs the tests for each change.

use std::collections::BTreeMap;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::Mutex;
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{ensure, Context, Result};

use crate::compile::Program;

/// No test runs for ever: what takes as many times as long as without a change is noticed.
const TIMES: u32 = 10;
/// The shortest time for a test program.
const SHORTEST: Duration = Duration::from_secs(10);
/// The memory of a test program, in KiB: a change may make it fill the machine's.
const MEMORY: &str = "4000000";

/// Whether each of these changes makes a test fail. The quickest test programs run first.
///
/// # Errors
/// When a test fails without a change.
pub fn all(programs: &[Program], changes: &[usize]) -> Result<BTreeMap<usize, bool>> {
    let mut timed = Vec::new();
    for program in programs {
        let started = Instant::now();
        let passes = passes(program, None, Duration::from_secs(900))?;
        ensure!(passes, "{} fails without a change", program.0.display());
        timed.push((started.elapsed(), program));
    }
    timed.sort();
    let limits: Vec<(&Program, Duration)> =
        timed.iter().map(|(took, program)| (*program, (*took * TIMES).max(SHORTEST))).collect();
    let (next, ends, problem) = (AtomicUsize::new(0), Mutex::new(BTreeMap::new()), Mutex::new(None));
    let threads = thread::available_parallelism().map_or(1, usize::from);
    thread::scope(|scope| {
        for _ in 0..threads {
            scope.spawn(|| {
                while let Some(number) = changes.get(next.fetch_add(1, Ordering::Relaxed)) {
                    let is_noticed = limits.iter().try_fold(false, |noticed, (program, limit)| {
                        Ok::<_, anyhow::Error>(noticed || !passes(program, Some(*number), *limit)?)
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

/// Whether a test program passes within this time, with this change.
fn passes((program, folder): &Program, change: Option<usize>, limit: Duration) -> Result<bool> {
    let mut test = Command::new("sh");
    test.args(["-c", "ulimit -v \"$0\" && exec \"$@\"", MEMORY]).arg(program).current_dir(folder);
    test.envs(change.map(|number| ("MUTANT", number.to_string())));
    // The first failure is enough.
    test.env("PROPTEST_MAX_SHRINK_ITERS", "0").env("RUST_BACKTRACE", "0");
    test.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    let mut test = test.spawn().context("a test program cannot be started")?;
    let passed = wait(&mut test, limit)?;
    if passed.is_none() {
        test.kill().context("a test program cannot be ended")?;
        test.wait()?;
    }
    Ok(passed == Some(true))
}

/// Whether a program succeeds; `None` if it still runs after this time.
fn wait(program: &mut Child, limit: Duration) -> Result<Option<bool>> {
    let started = Instant::now();
    let mut pause = Duration::from_millis(1);
    loop {
        if let Some(status) = program.try_wait()? {
            return Ok(Some(status.success()));
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

    #[test]
    fn a_program_fails_by_its_status_or_by_its_time() {
        let program = |path: &str| (path.into(), "/".into());
        let long = Duration::from_secs(60);
        assert!(passes(&program("/bin/true"), None, long).unwrap());
        assert!(!passes(&program("/bin/false"), Some(3), long).unwrap());
        assert!(!passes(&program("/usr/bin/yes"), None, Duration::from_millis(50)).unwrap());
        assert!(all(&[program("/bin/false")], &[1]).is_err());
        assert_eq!(all(&[program("/bin/true")], &[1, 2]).unwrap(), BTreeMap::from([(1, false), (2, false)]));
    }
}
