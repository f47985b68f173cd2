//! The compiler: which one is here, and which one a release is made with.

use std::env;
use std::process::{Command, Stdio};

use crate::{outcome::Outcome, process, workspace};

/// The file that names the toolchain of a release, for rustup and for us. Size and bytes of the
/// firmware depend on it (docs/adr/0018-toolchain-of-a-release.md).
const FILE: &str = include_str!("../../rust-toolchain.toml");

/// The version of Rust that a release is made with.
fn release() -> &'static str {
    let channel = FILE.lines().find_map(|line| line.strip_prefix("channel = \"")?.strip_suffix('"'));
    channel.expect("rust-toolchain.toml names a channel")
}

/// The line of `rustc --version` of the compiler that cargo uses here.
pub fn line() -> String {
    let mut rustc = Command::new(env::var_os("RUSTC").unwrap_or_else(|| "rustc".into()));
    let version = process::output(rustc.arg("--version").current_dir(workspace::root()).stdin(Stdio::null()));
    version.map_or_else(|_| "unknown".to_owned(), |version| version.trim().to_owned())
}

/// Whether this is the compiler of a release.
pub fn check(line: &str) -> Outcome {
    let version = line.split_whitespace().nth(1).unwrap_or("unknown");
    let release = release();
    if version == release {
        return Ok(());
    }
    Err(format!(
        "this is Rust {version}. A release is made with {release}, which rust-toolchain.toml names: with another one \
         the firmware has other bytes and another size. rustup installs and uses it by itself; here something else \
         chose the compiler: RUSTUP_TOOLCHAIN, `cargo +TOOLCHAIN`, RUSTC, or a Rust that is not rustup's. `rustup toolchain \
         install {release} --profile minimal` installs it, and `cargo +{release} xtask` uses it."
    ))
}

/// Says so if this is another compiler than that of a release.
pub fn notice() {
    if let Err(other) = check(&line()) {
        eprintln!("\nnote: {other}");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_compiler_of_a_release_passes() {
        let release = release();
        assert_eq!(check(&format!("rustc {release} (59807616e 2026-04-14)")), Ok(()));
        for other in ["rustc 1.94.0 (4a4ef493e 2026-03-02)", "rustc 1.95.0-nightly", "unknown", ""] {
            assert!(check(other).is_err_and(|words| words.contains(release)), "{other}");
        }
    }
}
