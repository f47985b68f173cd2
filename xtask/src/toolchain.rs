//! The compiler: which one is here, and which one a release is made with.

use std::env;
use std::process::{Command, Stdio};

use crate::{process, workspace, Outcome};

/// The Rust toolchain of a release. Size and bytes of the firmware depend on it
/// (docs/adr/0018-toolchain-of-a-release.md); `.github/workflows` installs it.
pub const RELEASE: &str = "1.95.0";

/// The line of `rustc --version` of the compiler that cargo uses here.
pub fn line() -> String {
    let mut rustc = Command::new(env::var_os("RUSTC").unwrap_or_else(|| "rustc".into()));
    let said = process::output(rustc.arg("--version").current_dir(workspace::root()).stdin(Stdio::null()));
    said.map_or_else(|_| "unknown".to_owned(), |said| said.trim().to_owned())
}

/// Whether this is the compiler of a release.
///
/// # Errors
/// When it is another one; with what that means and what to do.
pub fn check(line: &str) -> Outcome {
    let version = line.split_whitespace().nth(1).unwrap_or("unknown");
    if version == RELEASE {
        return Ok(());
    }
    Err(format!(
        "this is Rust {version}. A release is made with {RELEASE}: with another one the firmware has other bytes and \
         another size. `rustup toolchain install {RELEASE} --profile minimal` installs it, and `cargo +{RELEASE} xtask` \
         uses it."
    ))
}

/// Says so if this is another compiler than that of a release.
pub fn notice() {
    if let Err(other) = check(&line()) {
        println!("\nnote: {other}");
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    #[test]
    fn only_the_compiler_of_a_release_passes() {
        assert_eq!(check(&format!("rustc {RELEASE} (59807616e 2026-04-14)")), Ok(()));
        for other in ["rustc 1.94.0 (4a4ef493e 2026-03-02)", "rustc 1.95.0-nightly", "unknown", ""] {
            assert!(check(other).is_err_and(|words| words.contains(RELEASE)), "{other}");
        }
    }

    #[test]
    fn the_workflow_of_a_release_has_its_compiler() {
        let file = workspace::root().join(".github/workflows/release.yml");
        let workflow = fs::read_to_string(file).unwrap();
        assert!(workflow.contains(&format!("RUSTUP_TOOLCHAIN: \"{RELEASE}\"")), "{RELEASE}");
    }
}
