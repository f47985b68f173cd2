//! A folder of a test's own. Tests of one process, and of two runs at once, do not meet in it.

use std::fs::{self, File};
use std::ops::Deref;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};
use std::{process, thread};

/// An empty folder with a name that nobody else has. It is removed at the end, unless the test
/// fails: then it can be looked at.
pub struct Folder(PathBuf);

/// A [`Folder`](crate::folder::Folder) for a test outside of its crate, in cargo's folder for such tests.
#[macro_export]
macro_rules! folder {
    ($name:expr) => {
        $crate::folder::Folder::below(env!("CARGO_TARGET_TMPDIR"), $name)
    };
}

impl Folder {
    /// Makes it; its name begins as given.
    ///
    /// # Panics
    /// When it cannot be made.
    pub fn below(folder: impl AsRef<Path>, name: &str) -> Self {
        static NUMBER: AtomicU32 = AtomicU32::new(0);
        let number = NUMBER.fetch_add(1, Ordering::Relaxed);
        let path = folder.as_ref().join(format!("{name}-{}-{number}", process::id()));
        // Of a process with the same number, long ago.
        let _ = fs::remove_dir_all(&path);
        fs::create_dir_all(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        Self(path)
    }

    /// Writes a file in it; returns its path.
    ///
    /// # Panics
    /// When it cannot be written.
    pub fn write(&self, name: impl AsRef<Path>, bytes: impl AsRef<[u8]>) -> PathBuf {
        let path = self.0.join(name);
        fs::write(&path, bytes).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        path
    }

    /// Writes a file in it; returns its path as an argument of a command.
    ///
    /// # Panics
    /// When it cannot be written.
    pub fn file(&self, name: &str, bytes: &[u8]) -> String {
        self.write(name, bytes);
        self.path(name)
    }

    /// The path of a file in it, as an argument of a command.
    ///
    /// # Panics
    /// When the path is not UTF-8.
    pub fn path(&self, name: &str) -> String {
        self.0.join(name).to_str().expect("a path in UTF-8").to_owned()
    }
}

impl Deref for Folder {
    type Target = Path;

    fn deref(&self) -> &Path {
        &self.0
    }
}

impl AsRef<Path> for Folder {
    fn as_ref(&self) -> &Path {
        &self.0
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        if !thread::panicking() {
            let _ = fs::remove_dir_all(&self.0);
        }
    }
}

/// The only one at a place that lasts longer than a test, in this process and in all others, until
/// it is dropped.
pub struct Alone(#[allow(dead_code, reason = "it holds the lock")] File);

impl Alone {
    /// Waits for whoever is there.
    ///
    /// # Panics
    /// When the folder of this file, or the file, cannot be made.
    pub fn at(file: &Path) -> Self {
        let locked = || {
            fs::create_dir_all(file.parent().unwrap_or(file))?;
            let file = File::create(file)?;
            file.lock().map(|()| file)
        };
        Self(locked().unwrap_or_else(|error| panic!("{}: {error}", file.display())))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_is_alone_until_it_is_dropped() {
        let folder = Folder::below(std::env::temp_dir(), "kit-alone");
        let file = folder.join("lock");
        let first = Alone::at(&file);
        let other = File::open(&file).unwrap();
        assert!(other.try_lock().is_err());
        drop(first);
        assert!(other.try_lock().is_ok());
    }

    #[test]
    fn two_folders_of_one_name_are_two_and_are_removed() {
        let base = std::env::temp_dir();
        let (one, other) = (Folder::below(&base, "kit"), Folder::below(&base, "kit"));
        assert_ne!(*one, *other);
        let file = one.write("file", "text");
        assert_eq!(fs::read(&file).unwrap(), b"text");
        drop(one);
        assert!(!file.exists() && other.is_dir());
    }
}
