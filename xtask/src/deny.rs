//! `cargo xtask deny`: checks the crates of others with cargo-deny.

use std::process::Command;

use crate::args::Args;
use crate::{process, setup, workspace, Outcome};

pub const HELP: &str = "\
usage: cargo xtask deny [--advisories]

Checks the crates of others against deny.toml, in the workspace with the Python package, and in
tests/fuzz: their licences, where they come from, and that no crate comes twice without a reason.

  --advisories    checks for known vulnerabilities in their place (needs the network)

cargo-deny is installed into target/tools where it is missing, which takes some minutes once.
";

/// The version to install if there is none.
const VERSION: &str = "0.20.2";
/// The packages that are a workspace, by their folders.
const WORKSPACES: [&str; 2] = ["", "tests/fuzz"];

pub fn run(mut args: Args) -> Outcome {
    let advisories = args.flag("--advisories");
    args.none_left()?;
    let program = setup::tool("cargo-deny", VERSION, &[])?;
    let checks: &[&str] = if advisories { &["advisories"] } else { &["licenses", "sources", "bans"] };
    // All workspaces are checked, so that one run shows all problems.
    let mut problems = Vec::new();
    for folder in WORKSPACES {
        let root = workspace::root();
        let mut deny = Command::new(&program);
        deny.current_dir(root).arg("--all-features");
        deny.arg("--manifest-path").arg(root.join(folder).join("Cargo.toml"));
        deny.arg("--config").arg(root.join("deny.toml"));
        // An exception may be for the other workspace.
        let other = ["unmatched-skip", "unnecessary-skip", "unused-wrapper", "parse-error"];
        deny.arg("check").arg("--hide-inclusion-graph").args(other.iter().flat_map(|lint| ["-A", lint]));
        deny.args(checks);
        problems.extend(process::run(&mut deny).err());
    }
    if problems.is_empty() {
        Ok(())
    } else {
        Err(format!("{} Exceptions stand in deny.toml, each with its reason.", problems.join(" ")))
    }
}
