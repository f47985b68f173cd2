//! Sets `COFLASH_VERSION`, what `coflash --version` prints: the version, and the commit of the
//! sources where they say which one it is.

use std::path::Path;
use std::process::Command;
use std::{env, fs};

use serde_json::Value;

/// Digits of a commit's name that are shown.
const DIGITS: usize = 12;

fn main() {
    let version = env::var("CARGO_PKG_VERSION").expect("cargo sets it");
    let commit = archived().or_else(packaged).or_else(checked_out);
    let commit = commit.filter(|name| name.len() >= DIGITS && name.bytes().all(|b| b.is_ascii_hexdigit()));
    let shown = commit.map(|name| format!(" ({})", &name[..DIGITS])).unwrap_or_default();
    println!("cargo:rustc-env=COFLASH_VERSION={version}{shown}");
    println!("cargo:rerun-if-changed=build.rs");
    // The pages, and the kit that reads them, are in the repository and in no package.
    println!("cargo:rustc-check-cfg=cfg(repository)");
    if Path::new("tests").exists() {
        println!("cargo:rustc-cfg=repository");
    }
}

/// In the archive of the sources: `git archive` has written it into this file.
fn archived() -> Option<String> {
    println!("cargo:rerun-if-changed=commit.txt");
    let text = fs::read_to_string("commit.txt").ok()?;
    Some(text.trim().to_owned()).filter(|text| !text.starts_with('$'))
}

/// In the package of the registry: `cargo package` has added this file.
fn packaged() -> Option<String> {
    let info: Value = serde_json::from_str(&fs::read_to_string(".cargo_vcs_info.json").ok()?).ok()?;
    Some(info["git"]["sha1"].as_str()?.to_owned())
}

/// In a clone: the commit that is checked out, whatever was changed since.
fn checked_out() -> Option<String> {
    let git = |words: &[&str]| {
        let output =
            Command::new("git").args(words).output().ok().filter(|output| output.status.success())?;
        Some(String::from_utf8(output.stdout).ok()?.trim().to_owned())
    };
    // It grows with each commit and each checkout.
    let moves = git(&["rev-parse", "--git-path", "logs/HEAD"])?;
    if Path::new(&moves).exists() {
        println!("cargo:rerun-if-changed={moves}");
    }
    git(&["rev-parse", "HEAD"])
}
