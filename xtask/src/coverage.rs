//! `cargo xtask coverage`: which lines of the device's crates the tests reach.

use std::process::Command;

use serde_json::json;

use crate::args::Args;
use crate::setup::{self, Part};
use crate::{evidence, files, outcome::Outcome, process, workspace};

pub const HELP: &str = "\
usage: cargo xtask coverage

Counts which lines of the crates without an operating system are reached by tests on the host: each
crate's own tests, those of the ABI, those of the core with sealed images, random lives, and the tests of
sealed images on the model of the flash. What the built firmware does in the emulator is not counted. The result goes to
target/evidence/coverage.json, and the lines that no test reaches to target/coverage/missing.txt.

A line that is reached may still be wrong: `cargo xtask mutants` asks whether a test would notice.
cargo-llvm-cov comes with the Python environment of the tests, compiled, and llvm-tools by rustup.
";

/// The packages of the device's crates.
pub const PACKAGES: [&str; 5] = ["coboot-abi", "coboot-canopen", "coboot-core", "coboot-app", "coboot-seal"];
/// The folders of the other packages that the tests use, as a regular expression.
const OTHERS: &str = "/(app-template|bootloader|bsp|coflash|linker|sim|tests)/";
/// The tests of sealed images that need no built firmware, in the test program `sealed`.
pub const SEALED_TESTS: [&str; 5] = ["access::", "dictionary::", "model::", "pieces::", "strangers::"];

pub fn run(args: Args) -> Outcome {
    args.none_left()?;
    setup::prepare(&[Part::Emulator, Part::Python])?;
    process::run(Command::new("rustup").args(["component", "add", "llvm-tools"]))?;
    evidence::begin("coverage")?;
    let llvm_cov = |line: &str| {
        let mut llvm_cov = Command::new(setup::python().with_file_name("cargo-llvm-cov"));
        llvm_cov.arg("llvm-cov").args(line.split(' ')).current_dir(workspace::root());
        llvm_cov
    };
    process::run(&mut llvm_cov("clean --workspace"))?;
    let packages = PACKAGES.iter().flat_map(|package| ["--package", package]);
    process::run(llvm_cov("--no-report --quiet").args(packages))?;
    let mut core = llvm_cov("--no-report --quiet --package coboot-core");
    process::run(core.env("COBOOT_TAKES_SEALED", "1"))?;
    process::run(&mut llvm_cov("--no-report --quiet --package coboot-kit --test abi"))?;
    process::run(&mut llvm_cov("--no-report --quiet --package coboot-attack --test lives"))?;
    let mut sealed = llvm_cov("--no-report --quiet --package coboot-tests --test sealed --");
    process::run(sealed.args(SEALED_TESTS))?;

    let others = exactly(&workspace::root().display().to_string()) + OTHERS;
    let report = |line: &str| process::output(llvm_cov(line).args(["--ignore-filename-regex", &others]));
    let missing = report("report --show-missing-lines")?;
    println!("{missing}");
    files::write(&workspace::target_dir().join("coverage/missing.txt"), missing)?;
    // The form of llvm-cov's export.
    let report = process::json(&report("report --json --summary-only")?)?;
    let lines = &report["data"][0]["totals"]["lines"];
    if lines["count"].as_u64().is_none_or(|count| count == 0) {
        return Err("cargo-llvm-cov has counted no line of these crates.".into());
    }
    // With one digit after the point.
    let percent = lines["percent"].as_f64().map(|percent| (percent * 10.0).round() / 10.0);
    let facts = json!({"lines": lines["count"], "reached": lines["covered"], "percent": percent});
    evidence::record("coverage", facts)
}

/// A text as the regular expression that matches it.
pub fn exactly(text: &str) -> String {
    let is_meta = |letter: &char| r"\.+*?()|[]{}^$#&-~".contains(*letter);
    text.chars().flat_map(|letter| is_meta(&letter).then_some('\\').into_iter().chain([letter])).collect()
}
