//! `cargo xtask portable`: checks that the code of the host tools compiles for other systems.

use crate::args::Args;
use crate::{process, setup, Outcome};

pub const HELP: &str = "\
usage: cargo xtask portable [--strict]

Checks that coflash and coboot-node compile for Windows and macOS. It compiles and does not link, so it
needs the Rust libraries of those systems (added by rustup) and nothing else of them. Where they cannot
be had, a line says so and that system is left out.

  --strict        a system that was left out is a failure
";

/// The systems, by Rust's names.
const TARGETS: [&str; 2] = ["x86_64-pc-windows-gnu", "aarch64-apple-darwin"];
/// The packages that must compile there.
const PACKAGES: [&str; 2] = ["coflash", "coboot-node"];

pub fn run(mut args: Args) -> Outcome {
    let strict = args.flag("--strict");
    args.none_left()?;
    let mut left_out = Vec::new();
    let mut broken = Vec::new();
    for target in TARGETS {
        if let Err(problem) = setup::rust_target(target) {
            println!("{target}: LEFT OUT, nothing was checked: {problem}");
            left_out.push(target);
            continue;
        }
        let mut check = process::cargo("check");
        check.args(["--target", target]);
        for package in PACKAGES {
            check.args(["--package", package]);
        }
        match process::run(&mut check) {
            Ok(()) => println!("{target}: {} compile.", PACKAGES.join(" and ")),
            Err(problem) => {
                println!("{target}: FAILED: {problem}");
                broken.push(target);
            }
        }
    }
    match (&broken[..], &left_out[..]) {
        ([], []) => Ok(()),
        ([], missing) if strict => Err(format!("left out: {}.", missing.join(", "))),
        ([], _) => Ok(()),
        (broken, _) => Err(format!("does not compile for {}.", broken.join(", "))),
    }
}
