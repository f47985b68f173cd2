//! `cargo xtask portable`: checks that the code of the host tools compiles for other systems.

use crate::args::Args;
use crate::{outcome::Outcome, process, setup, workspace};

pub const HELP: &str = "\
usage: cargo xtask portable [--strict]

Checks that coflash and coboot-node compile for Windows and macOS. It compiles and does not link, so it
needs the Rust libraries of those systems (added by rustup) and nothing else of them: coflash without
TLS, which is partly C. Where they cannot be had, a line says so and that system is left out.

  --strict        a system that was left out is a failure
";

/// The systems, by Rust's names.
const TARGETS: [&str; 2] = ["x86_64-pc-windows-gnu", "aarch64-apple-darwin"];
/// The packages that must compile there.
const PACKAGES: [&str; 2] = ["coflash", "coboot-node"];
/// The default features of coflash without `tls`.
const FEATURES: &str = "coflash/ui,coflash/agent,coflash/conform,coflash/peak,coflash/kvaser,coflash/gs_usb";

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
        check.args(["--target", target, "--no-default-features", "--features", FEATURES]);
        // A folder of its own: nobody who builds for this machine has to wait.
        check.arg("--target-dir").arg(workspace::target_dir().join("portable"));
        check.args(PACKAGES.iter().flat_map(|package| ["--package", package]));
        match process::run(&mut check) {
            Ok(()) => println!("{target}: {} compile.", PACKAGES.join(" and ")),
            Err(problem) => {
                println!("{target}: FAILED: {problem}");
                broken.push(target);
            }
        }
    }
    if !broken.is_empty() {
        return Err(format!("does not compile for {}.", broken.join(", ")));
    }
    if strict && !left_out.is_empty() {
        return Err(format!("left out: {}.", left_out.join(", ")));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_tls_is_left_out() {
        let manifest = include_str!("../../coflash/cli/Cargo.toml");
        let default = manifest.lines().find_map(|line| line.strip_prefix("default = ")).unwrap();
        let named = FEATURES.split(',').map(|feature| feature.trim_start_matches("coflash/"));
        let mut named: Vec<String> = named.chain(["tls"]).map(|feature| format!("{feature:?}")).collect();
        let mut all: Vec<&str> = default.trim_matches(['[', ']']).split(", ").collect();
        named.sort();
        all.sort_unstable();
        assert_eq!(named, all);
    }
}
