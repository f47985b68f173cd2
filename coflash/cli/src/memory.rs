//! The folder for what the tool remembers between starts.

use std::fs::{self, OpenOptions};
use std::path::PathBuf;

/// A file in this folder, which is made if it is not there.
///
/// # Errors
/// It cannot be written: why, and what to do.
pub(super) fn file(name: &str) -> Result<PathBuf, String> {
    let state = std::env::var_os("XDG_STATE_HOME").map(PathBuf::from);
    let home = || std::env::home_dir().map(|home| home.join(".local").join("state"));
    let folder = state.filter(|path| path.is_absolute()).or_else(home);
    let path = folder.ok_or("there is no home folder: set XDG_STATE_HOME")?.join("coflash").join(name);
    let made = path.parent().map_or(Ok(()), fs::create_dir_all);
    let opened = made.and_then(|()| OpenOptions::new().create(true).append(true).open(&path));
    let advice = "make that folder writable, or name another one with XDG_STATE_HOME";
    opened.map_err(|error| format!("{} cannot be written ({error}): {advice}", path.display()))?;
    Ok(path)
}
