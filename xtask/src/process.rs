//! Starts other programs.

use std::collections::BTreeSet;
use std::env;
use std::ffi::OsStr;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use serde_json::Value;

use crate::outcome::Outcome;
use crate::workspace;

/// Whether Ctrl-C ends this program, as soon as those that it has started have ended.
pub static IS_ENDING: AtomicBool = AtomicBool::new(false);

/// The cargo that started this program, on this workspace, in the caller's folder. `line` is the subcommand with
/// its arguments, with blanks between them.
pub fn cargo(line: &str) -> Command {
    cargo_on(workspace::root(), line)
}

/// The cargo that started this program, on the package in a folder, in the caller's folder.
pub fn cargo_on(folder: &Path, line: &str) -> Command {
    on_workspace(bare_cargo(), folder, line)
}

/// The same for a program that takes the words of cargo.
pub fn on_workspace(mut command: Command, folder: &Path, line: &str) -> Command {
    // The crate ring is compiled again, with all that depends on it, when those of the package change that cargo runs.
    for (name, _) in env::vars_os() {
        if ["CARGO_PKG_", "CARGO_MANIFEST_"].iter().any(|of| name.to_string_lossy().starts_with(of)) {
            command.env_remove(name);
        }
    }
    let mut words = line.split_ascii_whitespace();
    command.args(words.next()).arg("--manifest-path").arg(folder.join("Cargo.toml")).args(words);
    if env::var_os("CARGO_TARGET_DIR").is_some() {
        // The path may be relative, and a job may start cargo in another folder.
        command.env("CARGO_TARGET_DIR", workspace::target_dir());
    }
    command
}

/// The cargo that started this program, on the package in the caller's folder.
pub fn bare_cargo() -> Command {
    Command::new(env::var_os("CARGO").unwrap_or_else(|| "cargo".into()))
}

/// What cargo says of the crates of the workspace.
pub fn metadata() -> Outcome<Value> {
    json(&output(&mut cargo("metadata --no-deps --format-version 1"))?)
}

/// The crates that `cargo tree` lists, as `NAME VERSION`.
pub fn tree(words: &[&str]) -> Outcome<BTreeSet<String>> {
    let tree = output(cargo("tree --locked --prefix none --no-dedupe --format {p}").args(words))?;
    // `name v1.2.3`, and more.
    let krate = |line: &str| {
        let mut words = line.split(' ');
        Some(format!("{} {}", words.next()?, words.next()?.strip_prefix('v')?))
    };
    Ok(tree.lines().filter_map(krate).collect())
}

/// git in the repository; returns what it prints.
pub fn git(words: &[&str]) -> Outcome<String> {
    output(Command::new("git").current_dir(workspace::root()).args(words))
}

/// The C compiler for the chip: clang, or the program in the variable `CLANG`.
pub fn clang() -> Command {
    Command::new(env::var_os("CLANG").unwrap_or_else(|| "clang".into()))
}

/// A program that is ended after this time, with the exit code 124.
pub fn within(limit: Duration, program: impl AsRef<OsStr>) -> Command {
    let mut command = Command::new("timeout");
    // In the foreground it passes signals on to the program alone.
    command.arg("--foreground").arg(limit.as_secs_f64().to_string()).arg(program);
    command
}

/// Runs a program to its end; its output is shown.
pub fn run(command: &mut Command) -> Outcome {
    let status = command.status().map_err(|error| not_started(command, &error))?;
    if status.success() {
        Ok(())
    } else {
        Err(format!("`{}` failed ({status}); what it printed above says why.", line(command)))
    }
}

/// Runs a program to its end and returns its standard output.
pub fn output(command: &mut Command) -> Outcome<String> {
    String::from_utf8(ended(command)?.stdout)
        .map_err(|_| format!("`{}` printed what is no text.", line(command)))
}

/// Reads JSON that a program has printed.
pub fn json(text: &str) -> Outcome<Value> {
    serde_json::from_str(text).map_err(|error| format!("a program printed what is no JSON: {error}."))
}

/// The entries of a list in a JSON object; none if there is no list of this name.
pub fn list<'v>(value: &'v Value, name: &str) -> impl Iterator<Item = &'v Value> {
    value[name].as_array().into_iter().flatten()
}

/// Runs a program to its end and returns its standard error.
pub fn messages(command: &mut Command) -> Outcome<String> {
    Ok(String::from_utf8_lossy(&ended(command)?.stderr).into_owned())
}

fn ended(command: &mut Command) -> Outcome<Output> {
    let output = command.stdin(Stdio::null()).output().map_err(|error| not_started(command, &error))?;
    if output.status.success() {
        return Ok(output);
    }
    let text = if output.stderr.is_empty() { &output.stdout } else { &output.stderr };
    let text = String::from_utf8_lossy(text);
    Err(format!("`{}` failed ({}): {}", line(command), output.status, text.trim()))
}

/// Whether a program can be started and succeeds; its output is not shown.
pub fn succeeds(program: impl AsRef<OsStr>, args: &[&str]) -> bool {
    let mut command = Command::new(program);
    command.args(args).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    command.status().is_ok_and(|status| status.success())
}

/// The message for a program that could not be started.
pub fn not_started(command: &Command, error: &std::io::Error) -> String {
    format!("`{}` could not be started: {error}.", line(command))
}

/// The command as text, with enough of it to recognise it.
pub fn line(command: &Command) -> String {
    let name = Path::new(command.get_program()).file_name().unwrap_or(command.get_program());
    let mut line = name.to_string_lossy().into_owned();
    let mut args = command.get_args().peekable();
    while let Some(arg) = args.next() {
        if arg == "--manifest-path" {
            args.next();
            continue;
        }
        line.push(' ');
        line += &arg.to_string_lossy();
    }
    line
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failing_program_is_named_with_its_arguments() {
        let problem = run(Command::new("sh").args(["-c", "exit 3"])).unwrap_err();
        assert!(problem.contains("`sh -c exit 3`") && problem.contains('3'), "{problem}");
        let problem = run(&mut Command::new("no-such-program-here")).unwrap_err();
        assert!(problem.contains("no-such-program-here"), "{problem}");
    }

    #[test]
    fn output_is_the_standard_output_and_an_error_brings_the_other_one() {
        assert_eq!(output(Command::new("sh").args(["-c", "echo a; echo b >&2"])), Ok("a\n".into()));
        let problem = output(Command::new("sh").args(["-c", "echo a; echo b >&2; exit 1"])).unwrap_err();
        assert!(problem.ends_with(": b"), "{problem}");
    }
}
