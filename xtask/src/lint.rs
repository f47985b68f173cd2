//! `cargo xtask lint`: checks formatting and words, and runs clippy and rustdoc, with warnings denied.

use std::process::Command;

use crate::args::Args;
use crate::setup::{self, Part};
use crate::{build, files, outcome::Outcome, process, product, words, workspace};

pub const HELP: &str = "\
usage: cargo xtask lint [--board BOARD]

Checks the formatting of every crate and the words of sources and pages, runs clippy over host
crates (with their tests; the Python package, too) and over the firmware of a board, and makes the
documentation of the host crates, all with warnings denied.

  --board BOARD   the board (default: stm32f407g-disc1)
";

/// Clippy on the host crates and their tests.
pub const HOST_CRATES: &str = "clippy --all-targets --keep-going";

pub fn run(mut args: Args) -> Outcome {
    let board = workspace::board(&mut args)?;
    args.none_left()?;
    setup::prepare(&[Part::Firmware, Part::Emulator])?;

    // All checks run, so that one run shows all problems.
    let mut problems = formatting()?;
    problems.extend(words::faults()?);
    problems.extend(clippy(process::cargo(HOST_CRATES)));
    // The host tool without the adapters of vendors and the other features; and the package for Python,
    // which is not a default member.
    problems.extend(clippy(process::cargo("clippy --package coflash --no-default-features")));
    problems.extend(clippy(process::cargo("clippy --package coflash-python")));
    // Without sealed images, which its own tests give it above.
    problems.extend(clippy(process::cargo("clippy --package coboot-core --lib")));
    problems.extend(clippy(build::firmware("clippy", "bsp", board, "")));
    for variant in build::Variant::of(board) {
        problems.extend(clippy(build::firmware("clippy", variant.package, board, variant.features)));
    }
    let mut resident = build::firmware("clippy", "bootloader", board, "resident");
    resident.arg("--bin=resident");
    problems.extend(clippy(resident));
    let mut doc = process::cargo("doc --quiet --no-deps --keep-going");
    doc.current_dir(workspace::root()).env("RUSTDOCFLAGS", "--deny=warnings");
    problems.extend(process::run(&mut doc).err());
    all_good(&problems)
}

/// Checks the formatting of all files; returns the problems.
pub fn formatting() -> Outcome<Vec<String>> {
    let mut problems = Vec::new();
    if process::run(&mut process::cargo("fmt --all --check")).is_err() {
        problems.push("some files are not formatted; `cargo fmt --all` does it.".to_owned());
    }
    // The files of the boards and products: build scripts find them, `cargo fmt` does not.
    for folder in build::BOARD_FOLDERS.into_iter().chain([product::FOLDER]) {
        let mut rustfmt = Command::new("rustfmt");
        rustfmt.current_dir(workspace::root()).args(["--check", "--edition", "2021"]);
        if process::run(rustfmt.args(files::within(&workspace::root().join(folder))?)).is_err() {
            problems.push(format!("a file in {folder} is not formatted; `rustfmt` on the file does it."));
        }
    }
    Ok(problems)
}

/// Runs clippy with warnings denied; returns the problem if there is one.
pub fn clippy(mut clippy: Command) -> Option<String> {
    clippy.current_dir(workspace::root()).args(["--", "--deny", "warnings"]);
    process::run(&mut clippy).err()
}

/// The outcome of several checks.
pub fn all_good(problems: &[String]) -> Outcome {
    if problems.is_empty() {
        Ok(())
    } else {
        Err(problems.join("\n       "))
    }
}
