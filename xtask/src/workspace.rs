//! The folders of the repository, and the selected board.

use std::env;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use shared_abi::layout::{self, Layout};

use crate::args::Args;
use crate::outcome::Outcome;

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
    Ok(chosen_board(args)?.unwrap_or(layout::DEFAULT))
}

/// The same; nothing without `--board`.
pub fn chosen_board(args: &mut Args) -> Outcome<Option<&'static Layout>> {
    args.value("--board")?.map(|name| board_named(&name)).transpose()
}

/// The board of a word after `--board`.
pub fn board_named(name: &str) -> Outcome<&'static Layout> {
    layout::by_name(name).ok_or_else(|| {
        let known: Vec<_> = layout::BOARDS.iter().map(|layout| layout.board).collect();
        format!("there is no board \"{name}\"; there is: {}.", known.join(", "))
    })
}

/// A path for messages: relative to the root if it is below the root.
pub fn shown(path: &Path) -> String {
    path.strip_prefix(root()).unwrap_or(path).display().to_string()
}

/// The packages that are built for a chip, or by another tool.
pub const NOT_ON_HOST: [&str; 6] =
    ["bsp", "bootloader", "app-template", "app-template-v2", "test-app", "coflash-python"];

/// Selects the packages that are built for this machine. What cargo builds at one time has the features
/// of all selected packages: calls that select the same build the crates of others once.
pub fn on_host() -> Vec<String> {
    let without = NOT_ON_HOST.iter().chain(&["xtask", "coboot-zencan"]);
    let without = without.flat_map(|package| ["--exclude", package]).map(str::to_owned);
    ["--workspace".to_owned()].into_iter().chain(without).collect()
}

#[test]
fn an_unknown_board_lists_those_that_there_are() {
    assert_eq!(board_named("nucleo-f446re").unwrap().board, "nucleo-f446re");
    assert!(board_named("arduino").unwrap_err().contains("there is: nucleo-f446re"));
}
