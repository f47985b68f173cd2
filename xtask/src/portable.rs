//! `cargo xtask portable`: checks that the code of the host tools compiles for other systems.

use crate::args::Args;
use crate::{outcome::Outcome, process, setup, workspace};

pub const HELP: &str = "\
usage: cargo xtask portable

Checks that coflash and coboot-node compile for Windows and macOS. It compiles and does not link, so it
needs the Rust libraries of those systems (added by rustup) and nothing else of them: coflash without
TLS, which is partly C. Where they cannot be had, a line says so and that system is left out.
";

/// The systems, by Rust's names.
const TARGETS: [&str; 2] = ["x86_64-pc-windows-gnu", "aarch64-apple-darwin"];
/// What must compile there.
const CHECK: &str =
    "check --package coflash --package coboot-node --no-default-features --features coflash/without-c";

pub fn run(args: Args) -> Outcome {
    args.none_left()?;
    let mut broken = Vec::new();
    for target in TARGETS {
        if let Err(problem) = setup::rust_target(target) {
            println!("{target}: LEFT OUT, nothing was checked: {problem}");
            continue;
        }
        let mut check = process::cargo(CHECK);
        // A folder of its own: nobody who builds for this machine has to wait.
        check.args(["--target", target, "--target-dir"]).arg(workspace::target_dir().join("portable"));
        match process::run(&mut check) {
            Ok(()) => println!("{target}: coflash and coboot-node compile."),
            Err(problem) => {
                println!("{target}: FAILED: {problem}");
                broken.push(target);
            }
        }
    }
    match broken.as_slice() {
        [] => Ok(()),
        _ => Err(format!("does not compile for {}.", broken.join(", "))),
    }
}
