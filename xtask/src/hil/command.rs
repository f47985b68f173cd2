//! Command lines of the user, and programs that have to end within a time.

use std::env;
use std::io::Read;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{channel, Receiver};
use std::thread;
use std::time::{Duration, Instant};

use crate::{process, Outcome};

/// The interval at which a running program is looked at.
const LOOK: Duration = Duration::from_millis(20);
/// The time for the last output of a program that has ended: a child of its own may keep it open.
const LAST_OUTPUT: Duration = Duration::from_secs(1);

/// The words of a command line; quotes keep a word together, and no shell reads it.
pub fn words(line: &str) -> Outcome<Vec<String>> {
    let (mut words, mut word, mut quote) = (Vec::new(), None::<String>, None);
    for character in line.chars() {
        match (quote, character) {
            (Some(end), _) if end == character => quote = None,
            (None, '\'' | '"') => {
                quote = Some(character);
                word.get_or_insert_default();
            }
            (None, ' ' | '\t') => words.extend(word.take()),
            _ => word.get_or_insert_default().push(character),
        }
    }
    words.extend(word);
    match quote {
        Some(quote) => Err(format!("`{line}`: a quote {quote} is not closed.")),
        None if words.is_empty() => Err("a command line is empty.".into()),
        None => Ok(words),
    }
}

/// Whether a program can be found: a path as it stands, a name in the folders of `PATH`.
pub fn is_there(program: &str) -> bool {
    if Path::new(program).components().count() > 1 {
        return Path::new(program).is_file();
    }
    let named = |folder: &Path| {
        let path = folder.join(program);
        path.is_file() || path.with_extension(env::consts::EXE_EXTENSION).is_file()
    };
    env::var_os("PATH").is_some_and(|folders| env::split_paths(&folders).any(|folder| named(&folder)))
}

/// The end of a program.
#[derive(Debug)]
pub struct Ended {
    /// Its exit code; `None` if a signal ended it.
    pub code: Option<i32>,
    /// Its standard output.
    pub said: String,
    /// Its standard error.
    pub errors: String,
}

/// A running program, which is ended when this is dropped.
pub struct Running {
    line: String,
    child: Child,
    said: Option<Receiver<String>>,
    errors: Option<Receiver<String>>,
    started: Instant,
}

impl Running {
    /// Starts a program. With `piped`, the caller reads its standard output ([`Self::child`]).
    pub fn start(command: &mut Command, piped: bool) -> Outcome<Self> {
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().map_err(|error| process::not_started(command, &error))?;
        let said = if piped { None } else { child.stdout.take().map(collect) };
        let errors = child.stderr.take().map(collect);
        Ok(Self { line: process::line(command), child, said, errors, started: Instant::now() })
    }

    /// The program itself.
    pub fn child(&mut self) -> &mut Child {
        &mut self.child
    }

    /// Waits for the end.
    pub fn wait(mut self, limit: Duration) -> Outcome<Ended> {
        loop {
            let status = self.child.try_wait().map_err(|error| format!("`{}`: {error}.", self.line))?;
            if let Some(status) = status {
                let text = |from: &Option<Receiver<String>>| {
                    from.as_ref().and_then(|from| from.recv_timeout(LAST_OUTPUT).ok()).unwrap_or_default()
                };
                return Ok(Ended { code: status.code(), said: text(&self.said), errors: text(&self.errors) });
            }
            if self.started.elapsed() > limit {
                return Err(format!(
                    "`{}` has not ended within {} s, and was stopped.",
                    self.line,
                    limit.as_secs()
                ));
            }
            thread::sleep(LOOK);
        }
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        // It may have ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Runs a program to its end.
pub fn succeed(command: &mut Command, limit: Duration) -> Outcome {
    let ended = Running::start(command, false)?.wait(limit)?;
    match ended.code {
        Some(0) => Ok(()),
        code => {
            let code = code.map_or("a signal".to_owned(), |code| format!("exit code {code}"));
            let said = if ended.errors.trim().is_empty() { &ended.said } else { &ended.errors };
            Err(format!("`{}` failed ({code}): {}", process::line(command), said.trim()))
        }
    }
}

/// Everything that comes out of a pipe, as text.
fn collect(mut pipe: impl Read + Send + 'static) -> Receiver<String> {
    let (sender, receiver) = channel();
    thread::spawn(move || {
        let mut bytes = Vec::new();
        // What came before an error counts.
        let _ = pipe.read_to_end(&mut bytes);
        // The receiver may have given up.
        let _ = sender.send(String::from_utf8_lossy(&bytes).into_owned());
    });
    receiver
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_becomes_words() {
        assert_eq!(words("a  'b c' \"d 'e\" f''"), Ok(["a", "b c", "d 'e", "f"].map(str::to_owned).into()));
        assert!(words("a 'b").unwrap_err().contains("not closed"));
        assert!(words("  ").is_err());
    }

    #[cfg(unix)]
    #[test]
    fn a_program_that_does_not_end_is_stopped_and_a_failure_tells_its_words() {
        let sh = |script: &str| {
            let mut command = Command::new("sh");
            command.args(["-c", script]);
            command
        };
        let problem = succeed(&mut sh("sleep 1000"), Duration::from_millis(50)).unwrap_err();
        assert!(problem.contains("has not ended"), "{problem}");
        let problem = succeed(&mut sh("echo broken >&2; exit 3"), Duration::from_secs(60)).unwrap_err();
        assert!(problem.contains("exit code 3") && problem.ends_with(": broken"), "{problem}");
        assert_eq!(succeed(&mut sh("true"), Duration::from_secs(60)), Ok(()));
    }

    #[cfg(unix)]
    #[test]
    fn programs_are_found_by_name_and_by_path() {
        assert!(is_there("sh") && is_there("/bin/sh"));
        assert!(!is_there("no-such-program-here") && !is_there("/no/such/program"));
    }
}
