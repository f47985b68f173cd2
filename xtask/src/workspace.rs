//! The folders of the repository, and the selected board.

use std::env;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use shared_abi::layout::{self, Layout};

use crate::args::Args;
use crate::Outcome;

/// The target of the firmware: Armv7E-M with the single-precision FPU.
pub const TARGET: &str = "thumbv7em-none-eabihf";
/// Cargo's profile of the firmware.
pub const PROFILE: &str = "firmware";
/// The root of the repository in which cargo runs this program. (A copy of the repository may
/// contain a program that was built in the original.)
pub fn root() -> &'static Path {
    static ROOT: OnceLock<PathBuf> = OnceLock::new();
    ROOT.get_or_init(|| {
        let package = env::var_os("CARGO_MANIFEST_DIR").unwrap_or_else(|| env!("CARGO_MANIFEST_DIR").into());
        Path::new(&package).parent().expect("every crate lies one folder below the root").to_owned()
    })
}

/// Cargo's folder for build results; this program puts the firmware and the Python environment
/// there.
pub fn target_dir() -> PathBuf {
    match env::var_os("CARGO_TARGET_DIR") {
        // A path relative to the folder in which cargo was started, as cargo itself reads it.
        Some(dir) => env::current_dir().unwrap_or_default().join(dir),
        None => root().join("target"),
    }
}

/// The folder of a board's built images.
pub fn firmware_dir(board: &Layout) -> PathBuf {
    target_dir().join("firmware").join(board.board)
}

/// Takes `--board`.
pub fn board(args: &mut Args) -> Outcome<&'static Layout> {
    let Some(name) = args.value("--board")? else { return Ok(layout::DEFAULT) };
    layout::by_name(&name).ok_or_else(|| {
        let known: Vec<_> = layout::BOARDS.iter().map(|layout| layout.board).collect();
        format!("there is no board \"{name}\"; there is: {}.", known.join(", "))
    })
}

/// A path for messages: relative to the root if it is below the root.
pub fn shown(path: &Path) -> String {
    path.strip_prefix(root()).unwrap_or(path).display().to_string()
}
