//! The files that commands write. None takes the place of a key, and a secret is for its owner alone.

use std::fs;
use std::io::{self, Write as _};
use std::path::Path;

use super::file::front;
use super::output::Failure;

/// The most bytes that a file with a key may have.
pub(super) const LARGEST_KEY: u64 = 16 * 1024;

/// Writes a file that everyone may read. It takes the place of another one, but of [no key](spare).
pub(super) fn write(path: &Path, bytes: &[u8]) -> Result<(), Failure> {
    spare(path)?;
    fs::write(path, bytes).map_err(|error| unwritable(path, &error))
}

/// Checks before the first frame that a file can be written at the end. What is in it stays.
pub(super) fn ready(path: &Path) -> Result<(), Failure> {
    spare(path)?;
    let there = fs::metadata(path);
    if there.as_ref().is_ok_and(|there| !there.is_file() && !there.is_dir()) {
        // A pipe waits for its reader.
        return Ok(());
    }
    let opened = fs::OpenOptions::new().append(true).create(true).open(path);
    opened.map_err(|error| unwritable(path, &error))?;
    if there.is_err() {
        let _ = fs::remove_file(path);
    }
    Ok(())
}

/// Refuses to let an output take the place of a private key or a key-encryption key: nobody could make it again.
pub(super) fn spare(path: &Path) -> Result<(), Failure> {
    if !is_secret_key(path) {
        return Ok(());
    }
    let what = format!("{} is a key, which would be lost", path.display());
    Err(Failure::usage(what, "name another file; if the key is no longer needed, delete it first"))
}

/// Whether a file has a private key or a key-encryption key in PEM.
fn is_secret_key(path: &Path) -> bool {
    let front = front(path, LARGEST_KEY as usize);
    let begins = |line: &str| line.starts_with("-----BEGIN ") && line.contains("KEY-----");
    String::from_utf8_lossy(&front).lines().any(|line| begins(line) && !line.contains("PUBLIC"))
}

/// Writes a file that only its owner may read. Replaces an existing file only if `overwrite` is
/// set.
pub(super) fn write_secret(path: &Path, text: impl AsRef<[u8]>, overwrite: bool) -> Result<(), Failure> {
    if overwrite {
        // A new file gets the right mode; an existing one would keep its own mode.
        match fs::remove_file(path) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(unwritable(path, &error)),
            _ => {}
        }
    }
    let mut options = fs::OpenOptions::new();
    options.write(true).create_new(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    let written = options.open(path).and_then(|mut file| file.write_all(text.as_ref()));
    written.map_err(|error| match error.kind() {
        io::ErrorKind::AlreadyExists => exists(path),
        _ => unwritable(path, &error),
    })
}

/// An output that would take the place of another one, which only `--force` does.
pub(super) fn exists(path: &Path) -> Failure {
    let what = format!("{} exists already", path.display());
    Failure::usage(what, "name another file; --force replaces it, and the old key is gone then")
}

/// A file that cannot be written.
pub(super) fn unwritable(path: &Path, error: &io::Error) -> Failure {
    Failure::system(format!("{}: cannot be written: {error}", path.display()))
}
