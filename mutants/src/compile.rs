//! Builds the tests of the rewritten sources, and takes out what does not compile.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{bail, ensure, Context, Result};
use serde_json::Value;

use crate::list::Change;
use crate::rewrite::{change_at, rewrite, Left, SWITCH};

/// The tests to build.
pub struct Tests<'a> {
    /// The package that is changed.
    pub package: &'a str,
    /// Features; may be empty.
    pub features: &'a str,
    /// The packages with the tests, separated by commas; `None` for the changed one.
    pub packages: Option<&'a str>,
    /// Further arguments for `cargo test`.
    pub arguments: &'a [String],
    /// Cargo's folder for what it builds.
    pub target: PathBuf,
}

/// A built test program, and the folder to run it in.
pub type Program = (PathBuf, PathBuf);

/// What was built.
pub struct Built {
    /// The test programs.
    pub programs: Vec<Program>,
    /// The changes that are branches in them.
    pub active: Vec<usize>,
    /// The changes that do not compile.
    pub unviable: BTreeSet<usize>,
}

/// The most rounds of building: each one takes out what the one before has shown.
const ROUNDS: usize = 40;

/// Writes all changes into the copy of the sources, and builds its tests.
///
/// # Errors
/// When something does not compile that is no change.
pub fn build(tests: &Tests<'_>, copy: &Path, changes: &[Change]) -> Result<Built> {
    let mut by_file = BTreeMap::<&str, Vec<(usize, &Change)>>::new();
    for (number, change) in changes.iter().enumerate() {
        by_file.entry(&change.file).or_default().push((number, change));
    }
    // Functions lose their `const` in all files of the crate: one may call another.
    let sources = sources_of(changes)?;
    let mut left = Left::default();
    for round in 1..=ROUNDS {
        let mut active = Vec::new();
        for file in &sources {
            let text = fs::read_to_string(file).with_context(|| file.clone())?;
            let there = by_file.get(file.as_str()).map_or(&[][..], Vec::as_slice);
            let (mut new, of_file) = rewrite(&text, there, &left).with_context(|| file.clone())?;
            active.extend(of_file);
            if file.ends_with("src/lib.rs") {
                new += SWITCH;
            }
            fs::write(copy.join(file), new).with_context(|| file.clone())?;
        }
        let said = cargo(tests, copy)?;
        if said.errors.is_empty() {
            return Ok(Built { programs: said.programs, active, unviable: left.changes });
        }
        let before = (left.changes.len(), left.constants.len());
        for error in &said.errors {
            blame(error, copy, &mut left);
        }
        let now = (left.changes.len(), left.constants.len());
        println!("  round {round}: {} changes do not compile, {} functions stay const", now.0, now.1);
        if now == before {
            let rendered = |error: &Value| error["rendered"].as_str().unwrap_or_default().to_owned();
            bail!("this is no change's fault:\n{}", said.errors.iter().map(rendered).collect::<String>());
        }
    }
    bail!("after {ROUNDS} rounds there is still something that does not compile")
}

/// All Rust files of the crate that the changes are in, from the root of the workspace on.
fn sources_of(changes: &[Change]) -> Result<Vec<String>> {
    let Some(first) = changes.first() else { return Ok(Vec::new()) };
    let folder = first.file.split_once("/src/").map_or("", |(folder, _)| folder);
    let said = Command::new("git").args(["ls-files", &format!("{folder}/src/*.rs")]).output()?;
    ensure!(said.status.success(), "git: {}", String::from_utf8_lossy(&said.stderr));
    Ok(String::from_utf8(said.stdout)?.lines().map(str::to_owned).collect())
}

/// What cargo has to say.
struct Said {
    programs: Vec<Program>,
    errors: Vec<Value>,
}

fn cargo(tests: &Tests<'_>, copy: &Path) -> Result<Said> {
    let mut cargo = Command::new("cargo");
    cargo.args(["test", "--no-run", "--quiet", "--message-format=json"]);
    for package in tests.packages.unwrap_or(tests.package).split(',') {
        cargo.args(["--package", package]);
    }
    if tests.arguments.is_empty() {
        cargo.args(["--lib", "--tests"]);
    }
    if !tests.features.is_empty() {
        cargo.args(["--features", tests.features]);
    }
    cargo.args(tests.arguments).current_dir(copy).env("CARGO_TARGET_DIR", &tests.target);
    // A branch may be odd; and nobody debugs it.
    cargo.env("RUSTFLAGS", "--cap-lints=allow").env("CARGO_PROFILE_DEV_DEBUG", "0");
    let said = cargo.output().context("cargo cannot be started")?;
    let (mut programs, mut errors) = (Vec::new(), Vec::new());
    for line in String::from_utf8_lossy(&said.stdout).lines() {
        let Ok(message) = serde_json::from_str::<Value>(line) else { continue };
        if let (Some(program), Some(manifest)) =
            (message["executable"].as_str(), message["manifest_path"].as_str())
        {
            if message["profile"]["test"] == true {
                let folder = Path::new(manifest).parent().unwrap_or(copy);
                programs.push((program.into(), folder.to_owned()));
            }
        }
        if message["message"]["level"].as_str().is_some_and(|level| level.starts_with("error")) {
            errors.push(message["message"].clone());
        }
    }
    ensure!(said.status.success() || !errors.is_empty(), "cargo: {}", String::from_utf8_lossy(&said.stderr));
    Ok(Said { programs, errors })
}

/// Finds what an error of the compiler is about, and leaves it as it was.
fn blame(error: &Value, copy: &Path, left: &mut Left) {
    let words = error["message"].as_str().unwrap_or_default();
    if let Some(name) = constant_function(words) {
        left.constants.insert(name);
    }
    for span in error["spans"].as_array().into_iter().flatten().filter(|span| span["is_primary"] == true) {
        let text = fs::read_to_string(copy.join(span["file_name"].as_str().unwrap_or_default()));
        let number = |name: &str| span[name].as_u64().and_then(|at| usize::try_from(at).ok()).unwrap_or(0);
        let places = [number("byte_start"), number("byte_end").saturating_sub(1)];
        let text = text.unwrap_or_default();
        left.changes.extend(places.iter().find_map(|at| change_at(&text, *at)));
    }
}

/// The name of a function that has to stay `const`: ``cannot call non-const associated function
/// `Entry::<1>::new` in constants``.
fn constant_function(words: &str) -> Option<String> {
    let (_, rest) = words.strip_prefix("cannot call non-const ")?.split_once('`')?;
    let (path, _) = rest.split_once('`')?;
    let mut depth = 0;
    let plain: String = path
        .chars()
        .filter(|letter| {
            depth += i32::from(*letter == '<');
            let is_outside = depth == 0;
            depth -= i32::from(*letter == '>');
            is_outside
        })
        .collect();
    let name = plain.rsplit("::").find(|part| !part.is_empty())?;
    // The switch itself is no constant: that is the change's fault.
    (name != "on").then(|| name.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The words of rustc 1.95.
    #[test]
    fn the_compiler_names_what_has_to_stay_constant() {
        for (words, name) in [
            ("cannot call non-const associated function `Entry::new` in constants", Some("new")),
            (
                "cannot call non-const function `boot_core::bootloader::entries::<36>` in statics",
                Some("entries"),
            ),
            ("cannot call non-const method `Table::<LEN>::with::<3>` in constant functions", Some("with")),
            ("cannot call non-const function `mutant_switch::on` in constants", None),
            ("mismatched types", None),
        ] {
            assert_eq!(constant_function(words).as_deref(), name, "{words}");
        }
    }
}
