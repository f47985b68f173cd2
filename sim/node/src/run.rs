//! The program of a node as a process of the host (`--run`): a fixed command with the downloaded
//! program in a file, started without a shell.
//!
//! On the bus the [stand-in](crate::stand_in) answers for the process. The device leaves the program
//! when the stand-in does, and the process is ended first: by SIGTERM, and by SIGKILL if it is still
//! there [`TO_END`] later. A process that ends by itself is a crash of the program.

use std::ffi::OsStr;
use std::fmt;
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};
use std::process::{Child, ExitStatus, Stdio};
use std::time::{Duration, Instant};
use std::{env, fs, process};

/// How long a process has to end itself after SIGTERM. A host waits some seconds for a restart.
pub const TO_END: Duration = Duration::from_secs(1);
/// How long it may take after SIGKILL, which no process can ignore: the kernel may still hold one that
/// waits for a device.
pub const TO_DIE: Duration = Duration::from_secs(5);

/// The command that is started as the program of a node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Command {
    /// The file of the host.
    file: PathBuf,
}

impl Command {
    /// The command with this name: a path, or a name that is found in `PATH`.
    ///
    /// # Errors
    /// There is no such file, or it cannot be started.
    pub fn find(name: &str) -> Result<Self, String> {
        let named = Path::new(name);
        let is_path = named.components().count() != 1 || name.contains(['/', '\\']);
        let folders = if is_path { None } else { env::var_os("PATH") };
        let found = match &folders {
            None => Some(named.to_owned()).filter(|path| path.exists()),
            Some(folders) => env::split_paths(folders)
                .flat_map(|folder| {
                    [folder.join(name), folder.join(name).with_extension(env::consts::EXE_EXTENSION)]
                })
                .find(|path| path.is_file()),
        };
        let Some(file) = found else {
            let place = if is_path { "" } else { " in the folders of PATH" };
            return Err(format!(
                "there is no such file{place}: name a program of this computer, without arguments"
            ));
        };
        if !file.is_file() {
            return Err("it is not a file: name a program of this computer, without arguments".to_owned());
        }
        if !may_be_executed(&file) {
            return Err(
                "it must not be executed: allow it (chmod +x), or name the program that reads it".to_owned()
            );
        }
        Ok(Self { file })
    }
}

#[cfg(unix)]
fn may_be_executed(file: &Path) -> bool {
    use std::os::unix::fs::PermissionsExt;
    fs::metadata(file).is_ok_and(|about| about.permissions().mode() & 0o111 != 0)
}

#[cfg(not(unix))]
fn may_be_executed(_: &Path) -> bool {
    true
}

/// What a process is told of its node.
#[derive(Clone, Copy, Debug)]
pub struct Place {
    /// The serial number of the node.
    pub serial_number: u32,
    /// The node-ID; 255 for none.
    pub node_id: u8,
    /// The number of the program.
    pub program: u8,
}

/// How a process ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ending {
    /// It did not start, for this reason and with this number of the system.
    NotStarted(ErrorKind, Option<i32>),
    /// It ended without a request: the program has crashed.
    ByItself(ExitStatus),
    /// SIGTERM ended it.
    Asked,
    /// Only SIGKILL ended it.
    Killed,
    /// The process with this number is there even after SIGKILL. The node goes on without it.
    Remains(u32),
}

impl fmt::Display for Ending {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NotStarted(kind, code) => {
                write!(
                    f,
                    "did not start: {}",
                    code.map_or_else(|| (*kind).into(), io::Error::from_raw_os_error)
                )
            }
            Self::ByItself(status) => write!(f, "has ended by itself: {status}"),
            Self::Asked => f.write_str("was ended"),
            Self::Killed => {
                write!(f, "was killed, as it was still there {} s after SIGTERM", TO_END.as_secs())
            }
            Self::Remains(process) => {
                let time = TO_DIE.as_secs();
                write!(f, "cannot be ended: process {process} is still there {time} s after SIGKILL; end it by hand")
            }
        }
    }
}

/// A program that runs as a process of the host.
#[derive(Debug)]
pub struct Process {
    child: Result<Child, (ErrorKind, Option<i32>)>,
    end: End,
}

impl Process {
    /// Writes the program to `file` and starts the command with this file as its only argument.
    /// The process has the output of the node, and its standard input ends with the node.
    #[must_use]
    pub fn start(command: &Command, file: &Path, program: &[u8], place: Place) -> Self {
        let child = fs::write(file, program).and_then(|()| spawn(command, file.as_os_str(), place));
        Self { child: child.map_err(|error| (error.kind(), error.raw_os_error())), end: End::default() }
    }

    /// Looks after the process: `leaving`, the device waits for its end. Gives the end.
    pub fn poll(&mut self, leaving: bool) -> Option<Ending> {
        let child = match &mut self.child {
            Ok(child) => child,
            Err((kind, code)) => return Some(Ending::NotStarted(*kind, *code)),
        };
        // An error of the system does not say that it has ended.
        let ended = child.try_wait().ok().flatten();
        match self.end.next(leaving, ended, Instant::now()) {
            Deed::Wait => None,
            Deed::Terminate => {
                signal(child, Signal::Terminate);
                None
            }
            Deed::Kill => {
                signal(child, Signal::Kill);
                None
            }
            Deed::Over => {
                // What it has started itself goes with it.
                signal(child, Signal::Kill);
                Some(match (self.end, ended) {
                    (End::Runs, Some(status)) => Ending::ByItself(status),
                    (End::Terminated { .. }, Some(_)) => Ending::Asked,
                    (_, Some(_)) => Ending::Killed,
                    (_, None) => Ending::Remains(child.id()),
                })
            }
        }
    }
}

/// A node that ends takes its program with it.
impl Drop for Process {
    fn drop(&mut self) {
        if let Ok(child) = &mut self.child {
            if matches!(child.try_wait(), Ok(None)) {
                signal(child, Signal::Kill);
            }
        }
    }
}

fn spawn(command: &Command, file: &OsStr, place: Place) -> io::Result<Child> {
    let mut spawned = process::Command::new(&command.file);
    spawned
        .arg(file)
        .env("COBOOT_SERIAL_NUMBER", place.serial_number.to_string())
        .env("COBOOT_NODE_ID", place.node_id.to_string())
        .env("COBOOT_PROGRAM", place.program.to_string())
        .stdin(Stdio::piped());
    // A group of its own: a signal then reaches what it has started, too.
    #[cfg(unix)]
    std::os::unix::process::CommandExt::process_group(&mut spawned, 0);
    spawned.spawn()
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Signal {
    Terminate,
    Kill,
}

#[cfg(unix)]
fn signal(child: &mut Child, signal: Signal) {
    use nix::sys::signal;
    use nix::unistd::Pid;
    let number = match signal {
        Signal::Terminate => signal::Signal::SIGTERM,
        Signal::Kill => signal::Signal::SIGKILL,
    };
    // The only error here is that nobody is left.
    if let Ok(group) = i32::try_from(child.id()) {
        let _ = signal::killpg(Pid::from_raw(group), number);
    }
}

/// There is no signal to ask for the end.
#[cfg(not(unix))]
fn signal(child: &mut Child, _: Signal) {
    let _ = child.kill();
}

/// How far the end of a process is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum End {
    /// Nobody has asked for it.
    #[default]
    Runs,
    /// SIGTERM was sent.
    Terminated {
        /// The time of SIGKILL.
        until: Instant,
    },
    /// SIGKILL was sent.
    Killed {
        /// The time at which the process is given up.
        until: Instant,
    },
}

/// What to do for the end of a process.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Deed {
    Wait,
    Terminate,
    Kill,
    /// It has ended, or it is given up.
    Over,
}

impl End {
    fn next(&mut self, leaving: bool, ended: Option<ExitStatus>, now: Instant) -> Deed {
        if ended.is_some() {
            return Deed::Over;
        }
        match *self {
            Self::Runs if leaving => {
                *self = Self::Terminated { until: now + TO_END };
                Deed::Terminate
            }
            Self::Terminated { until } if now >= until => {
                *self = Self::Killed { until: now + TO_DIE };
                Deed::Kill
            }
            Self::Killed { until } if now >= until => Deed::Over,
            Self::Runs | Self::Terminated { .. } | Self::Killed { .. } => Deed::Wait,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// In virtual time: a process that nothing ends gets each signal once, and is given up.
    #[test]
    fn a_process_that_cannot_be_ended_is_given_up() {
        let (mut end, start) = (End::default(), Instant::now());
        let mut at = |ms, leaving| end.next(leaving, None, start + Duration::from_millis(ms));
        assert_eq!(at(0, false), Deed::Wait);
        assert_eq!(at(100_000, false), Deed::Wait);
        assert_eq!(at(100_000, true), Deed::Terminate);
        assert_eq!(at(100_999, true), Deed::Wait);
        assert_eq!(at(101_000, true), Deed::Kill);
        assert_eq!(at(105_999, true), Deed::Wait);
        assert_eq!(at(106_000, true), Deed::Over);
        assert!(Ending::Remains(77).to_string().contains("process 77 is still there 5 s after SIGKILL"));
    }

    #[test]
    fn an_end_is_an_end_at_any_time() {
        let (start, ended) = (Instant::now(), Some(ExitStatus::default()));
        for leaving in [false, true] {
            assert_eq!(End::Runs.next(leaving, ended, start), Deed::Over);
            assert_eq!(End::Terminated { until: start }.next(leaving, ended, start), Deed::Over);
            assert_eq!(End::Killed { until: start }.next(leaving, ended, start), Deed::Over);
        }
    }
}
