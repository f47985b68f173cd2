//! The folder for what the tool remembers between starts.

use std::path::PathBuf;

/// A file in this folder, which is made if it is not there; `None` if it cannot be made.
pub(super) fn file(name: &str) -> Option<PathBuf> {
    let state = std::env::var_os("XDG_STATE_HOME").map(PathBuf::from);
    let home = || std::env::home_dir().map(|home| home.join(".local").join("state"));
    let folder = state.filter(|path| path.is_absolute()).or_else(home)?.join("coflash");
    std::fs::create_dir_all(&folder).ok()?;
    Some(folder.join(name))
}
