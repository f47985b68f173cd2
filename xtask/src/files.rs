//! Files and folders, with errors that name the path.

use std::fs::{self, File};
use std::io::{Error, ErrorKind};
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::{outcome::Outcome, process, workspace};

/// The bytes of a file.
pub fn bytes(file: &Path) -> Outcome<Vec<u8>> {
    fs::read(file).map_err(failed("read", file))
}

/// The text of a file.
pub fn text(file: &Path) -> Outcome<String> {
    fs::read_to_string(file).map_err(failed("read", file))
}

/// The text of a file of the repository, by its path from the root.
pub fn ours(file: impl AsRef<Path>) -> Outcome<String> {
    text(&workspace::root().join(file))
}

/// Writes a file, in a folder that need not be there.
pub fn write(file: &Path, contents: impl AsRef<[u8]>) -> Outcome {
    make(file.parent().unwrap_or(file))?;
    fs::write(file, contents).map_err(failed("written", file))
}

/// Copies a file, into a folder that need not be there.
pub fn copy(from: &Path, to: &Path) -> Outcome {
    make(to.parent().unwrap_or(to))?;
    fs::copy(from, to).map(drop).map_err(failed("copied", from))
}

/// Makes a folder, and those that it is in.
pub fn make(folder: &Path) -> Outcome {
    fs::create_dir_all(folder).map_err(failed("made", folder))
}

/// Removes a folder with all in it, if it is there.
pub fn remove(folder: &Path) -> Outcome {
    match fs::remove_dir_all(folder) {
        Err(error) if error.kind() != ErrorKind::NotFound => Err(failed("removed", folder)(error)),
        _ => Ok(()),
    }
}

/// Waits until no other job in this clone has the lock of this name. It is held as long as the file is
/// open; `busy` is printed for the wait.
pub fn lock(name: &str, busy: &str) -> Outcome<File> {
    let path = workspace::target_dir().join(name).with_extension("lock");
    make(&workspace::target_dir())?;
    let file = File::options().create(true).truncate(false).write(true).open(&path);
    let file = file.map_err(failed("locked", &path))?;
    if file.try_lock().is_err() {
        eprintln!("{busy} This one waits for its end; Ctrl-C gives up.");
        file.lock().map_err(failed("locked", &path))?;
    }
    Ok(file)
}

/// What is in a folder, sorted.
pub fn within(folder: &Path) -> Outcome<Vec<PathBuf>> {
    let entries = fs::read_dir(folder).map_err(failed("read", folder))?;
    let mut paths: Vec<_> = entries.flatten().map(|entry| entry.path()).collect();
    paths.sort();
    Ok(paths)
}

/// All files below a folder, sorted, but those in folders with these names.
pub fn below(folder: &Path, but: &[&str]) -> Outcome<Vec<PathBuf>> {
    let mut files = Vec::new();
    for path in within(folder)? {
        if !path.is_dir() {
            files.push(path);
        } else if !but.iter().any(|name| path.ends_with(name)) {
            files.extend(below(&path, but)?);
        }
    }
    Ok(files)
}

/// Packs a file or folder of `folder` into an archive. The same contents give the same bytes: all files have
/// this time, in seconds since 1970.
pub fn pack(folder: &Path, what: &str, time: &str, archive: &Path) -> Outcome {
    make(archive.parent().unwrap_or(archive))?;
    let mut tar = Command::new("tar");
    tar.args(["--sort=name", "--owner=0", "--group=0", "--numeric-owner", "--mode=u+rw,go+r-w"]);
    tar.arg(format!("--mtime=@{time}")).args(["--use-compress-program", "gzip -9n", "--create", "--file"]);
    process::run(tar.arg(archive).arg("--directory").arg(folder).arg(what))
}

/// Unpacks an archive into a folder.
pub fn unpack(archive: &Path, folder: &Path) -> Outcome {
    process::run(
        Command::new("tar").arg("--extract").arg("--file").arg(archive).arg("--directory").arg(folder),
    )
}

/// Whether a path has this extension.
pub fn is(path: &Path, extension: &str) -> bool {
    path.extension().is_some_and(|found| found == extension)
}

fn failed<'p>(done: &'static str, path: &'p Path) -> impl FnOnce(Error) -> String + 'p {
    move |error| format!("{} cannot be {done}: {error}.", workspace::shown(path))
}
