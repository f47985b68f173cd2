//! What cargo-mutants would change, and a copy of the sources to change it in.

use std::fs;
use std::path::Path;
use std::process::Command;

use anyhow::{ensure, Context, Result};
use serde::Deserialize;

/// A change, as `cargo-mutants --list --json` names it.
#[derive(Debug, Deserialize)]
pub struct Change {
    /// File, place and change in words.
    pub name: String,
    /// The file, from the root of the workspace on.
    pub file: String,
    /// The function that it is in.
    pub function: Option<Function>,
    /// The place of the text that is replaced.
    pub span: Span,
    /// The new text.
    pub replacement: String,
    /// The kind of change.
    pub genre: Genre,
}

/// A function that is changed.
#[derive(Debug, Deserialize)]
pub struct Function {
    /// All of it, with its body.
    pub span: Span,
}

/// A range of text.
#[derive(Clone, Copy, Debug, Deserialize)]
pub struct Span {
    /// The place of the first character.
    pub start: Place,
    /// The place behind the last one.
    pub end: Place,
}

/// A place in a text.
#[derive(Clone, Copy, Debug, Deserialize)]
pub struct Place {
    /// From 1 on.
    pub line: usize,
    /// From 1 on, in characters.
    pub column: usize,
}

/// The kinds of changes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
pub enum Genre {
    /// Another operator between two values.
    BinaryOperator,
    /// An operator in front of a value is left out.
    UnaryOperator,
    /// The body of a function is replaced by a value.
    FnValue,
    /// An arm of a match is left out.
    MatchArm,
    /// The guard of an arm is replaced by `true` or `false`.
    MatchArmGuard,
    /// Any other.
    #[serde(other)]
    Other,
}

/// The list, with the arguments that select a part of it.
///
/// # Errors
/// When cargo-mutants does not answer.
pub fn changes(package: &str, selection: &[String]) -> Result<Vec<Change>> {
    let mut mutants = Command::new("cargo-mutants");
    mutants.args(["mutants", "--list", "--json", "--package", package]).args(selection);
    let said = mutants.output().context("cargo-mutants cannot be started")?;
    ensure!(said.status.success(), "cargo-mutants: {}", String::from_utf8_lossy(&said.stderr));
    serde_json::from_slice(&said.stdout).context("the list of cargo-mutants cannot be read")
}

/// Copies the files that git knows from this folder.
///
/// # Errors
/// When git does not answer, or a file cannot be written.
pub fn copy_sources(to: &Path) -> Result<()> {
    let said = Command::new("git").args(["ls-files", "-z"]).output().context("git cannot be started")?;
    ensure!(said.status.success(), "git: {}", String::from_utf8_lossy(&said.stderr));
    for file in String::from_utf8(said.stdout)?.split('\0').filter(|file| Path::new(file).is_file()) {
        let copy = to.join(file);
        let text = fs::read(file).with_context(|| file.to_owned())?;
        // An unchanged file keeps its time, so that cargo builds it once.
        if fs::read(&copy).is_ok_and(|there| there == text) {
            continue;
        }
        fs::create_dir_all(copy.parent().unwrap_or(to))?;
        fs::write(&copy, text).with_context(|| copy.display().to_string())?;
    }
    Ok(())
}

/// The offset of a place in bytes.
pub fn offset(text: &str, place: Place) -> usize {
    let line: usize = text.split_inclusive('\n').take(place.line - 1).map(str::len).sum();
    let rest = &text[line..];
    line + rest.char_indices().nth(place.column - 1).map_or(rest.len(), |(at, _)| at)
}
