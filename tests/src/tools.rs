//! The programs that `cargo xtask test` has built or installed for the tests.

use std::env;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// The path in a variable.
///
/// # Panics
/// If the variable is not set.
pub fn given(variable: &str) -> PathBuf {
    let path = env::var_os(variable);
    path.unwrap_or_else(|| panic!("{variable} is not set: run the tests by `cargo xtask test`")).into()
}

/// The command line `coflash`, without a configuration of the user.
///
/// # Panics
/// If the tests do not run by `cargo xtask test`.
pub fn coflash() -> Command {
    let mut coflash = Command::new(given("COBOOT_COFLASH"));
    coflash.env_remove("COFLASH_CONFIG");
    coflash
}

/// Python with the pinned packages of others.
///
/// # Panics
/// As [`coflash`].
pub fn python() -> Command {
    Command::new(given("COBOOT_PYTHON"))
}

/// The same with a script of `tests/python`.
///
/// # Panics
/// As [`coflash`].
pub fn script(name: &str) -> Command {
    let mut python = python();
    python.arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("python").join(name));
    python
}

/// What a program has printed, first on standard output and then on standard error.
pub fn text(output: &Output) -> String {
    String::from_utf8_lossy(&[&output.stdout[..], &output.stderr].concat()).into_owned()
}

/// The same of one that must have succeeded.
///
/// # Panics
/// If it has failed; the message has its output.
#[track_caller]
pub fn succeeded(output: &Output) -> String {
    assert!(output.status.success(), "{}: {}", output.status, text(output));
    text(output)
}
