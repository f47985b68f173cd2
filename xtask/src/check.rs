//! `cargo xtask check`: what to run before each commit.

use crate::args::Args;
use crate::setup::{self, Part};
use crate::{arrows, lint, outcome::Outcome, process, workspace};

pub const HELP: &str = "\
usage: cargo xtask check

What to run before each commit, some two minutes on two cores when the crates of others are compiled: formatting,
clippy over the host crates with their tests, who depends on whom, and the unit tests of the crates
without hardware.
";

/// The crates that need neither a chip nor an emulator to be tested.
const PURE: [&str; 6] =
    ["coboot-abi", "coboot-canopen", "coboot-seal", "coboot-core", "coboot-app", "coboot-linker"];

pub fn run(args: Args) -> Outcome {
    args.none_left()?;
    setup::prepare(&[Part::Emulator])?;
    // All checks run, so that one run shows all problems.
    let mut problems = lint::formatting()?;
    problems.extend(lint::clippy(process::cargo(lint::HOST_CRATES)));
    problems.extend(arrows::run(Args::new(std::iter::empty())).err());
    let mut tests = process::cargo("test --quiet --lib");
    tests.args(PURE.iter().flat_map(|package| ["--package", package]));
    problems.extend(process::run(tests.current_dir(workspace::root())).err());
    lint::all_good(&problems)
}
