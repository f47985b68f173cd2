//! `cargo xtask portable`: checks that the code of the host tools compiles for other systems.

use crate::args::Args;
use crate::{files, outcome::Outcome, process, setup, workspace};

pub const HELP: &str = "\
usage: cargo xtask portable

Checks that coflash and coboot-node compile for Windows and macOS. It compiles and does not link, so it
needs the Rust libraries of those systems (added by rustup) and nothing else of them: coflash without
TLS, which is partly C. Where they cannot be had, a line says so and that system is left out.
";

/// The systems, by Rust's names.
const TARGETS: [&str; 2] = ["x86_64-pc-windows-gnu", "aarch64-apple-darwin"];
/// The packages that must compile there.
const PACKAGES: [&str; 2] = ["coflash", "coboot-node"];

pub fn run(args: Args) -> Outcome {
    args.none_left()?;
    let features = features(&files::ours("coflash/cli/Cargo.toml")?)?;
    let mut broken = Vec::new();
    for target in TARGETS {
        if let Err(problem) = setup::rust_target(target) {
            println!("{target}: LEFT OUT, nothing was checked: {problem}");
            continue;
        }
        let mut check = process::cargo("check");
        check.args(["--target", target, "--no-default-features", "--features", &features]);
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
    match broken.as_slice() {
        [] => Ok(()),
        _ => Err(format!("does not compile for {}.", broken.join(", "))),
    }
}

/// The default features of coflash without `tls`, from its manifest, as cargo takes them.
fn features(manifest: &str) -> Outcome<String> {
    let default = manifest.lines().find_map(|line| line.strip_prefix("default = [")?.strip_suffix(']'));
    let default = default.ok_or("coflash/cli/Cargo.toml has no line with its default features.")?;
    let names = default.split(", ").map(|name| name.trim_matches('"')).filter(|name| *name != "tls");
    Ok(names.map(|name| format!("coflash/{name}")).collect::<Vec<_>>().join(","))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_tls_is_left_out() {
        let manifest = "[features]\ndefault = [\"ui\", \"tls\", \"peak\"]\ntls = []\n";
        assert_eq!(features(manifest).unwrap(), "coflash/ui,coflash/peak");
        assert!(features("[features]\n").is_err());
    }
}
