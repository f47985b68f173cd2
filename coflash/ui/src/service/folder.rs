//! The folder of the reports.

use std::fs::{self, OpenOptions};
use std::io::{self, ErrorKind, Write as _};
use std::path::{Path, PathBuf};

use tempfile::NamedTempFile;

/// The most reports with one name: those of one device in one second.
const SAME: u32 = 100;
/// The files of one report.
const FILES: usize = 2;
/// More than one of them has, in bytes.
const ROOM: usize = 16 * 1024;

/// A folder that files can be written into, or could be at the start.
#[derive(Clone, Debug)]
pub(super) struct Folder(PathBuf);

impl Folder {
    /// A folder, which is made if it is not there.
    ///
    /// # Errors
    /// It cannot be made, or no file can be written into it.
    pub(super) fn new(path: &Path) -> io::Result<Self> {
        fs::create_dir_all(path)?;
        let folder = Self(std::path::absolute(path)?);
        folder.check(1)?;
        Ok(folder)
    }

    pub(super) fn path(&self) -> &Path {
        &self.0
    }

    /// Checks that this number of reports can be written: nothing is begun whose outcome would be lost.
    ///
    /// # Errors
    /// The error of the system.
    pub(super) fn check(&self, reports: usize) -> io::Result<()> {
        self.fill(FILES * reports)?.into_iter().try_for_each(NamedTempFile::close)
    }

    /// Writes files of the size of a report's: a file system may have room in bytes, and for no more files.
    fn fill(&self, files: usize) -> io::Result<Vec<NamedTempFile>> {
        let file = |_| {
            let mut file = NamedTempFile::new_in(&self.0)?;
            file.write_all(&[0; ROOM])?;
            file.as_file().sync_all().map(|()| file)
        };
        (0..files).map(file).collect()
    }

    /// The table with this ending whose name has this part, the latest one: its name, and what is
    /// in it.
    pub(super) fn latest(&self, part: &str, ending: &str) -> Option<(String, String)> {
        let names =
            fs::read_dir(&self.0).ok()?.filter_map(|entry| entry.ok()?.file_name().into_string().ok());
        let name = names.filter(|name| name.contains(part) && name.ends_with(ending)).max()?;
        let text = fs::read_to_string(self.0.join(&name)).ok()?;
        Some((name, text))
    }

    /// Removes a report. One that stays says of an update that it was begun, which is so.
    pub(super) fn remove(&self, name: &str, endings: [&str; FILES]) {
        endings.iter().for_each(|ending| drop(fs::remove_file(self.0.join(format!("{name}.{ending}")))));
    }

    /// Saves contents as files of one name, each with its ending, and returns the name. No file is replaced; if one
    /// cannot be written, none is left.
    ///
    /// # Errors
    /// The error of the system.
    pub(super) fn save(&self, name: &str, contents: &[(&str, String)]) -> io::Result<String> {
        let names = (1..=SAME).map(|count| match count {
            1 => name.to_owned(),
            count => format!("{name}_{count}"),
        });
        for name in names {
            let path = |ending: &str| self.0.join(format!("{name}.{ending}"));
            let mut made = Vec::new();
            let written = contents.iter().try_for_each(|(ending, text)| {
                let path = path(ending);
                let mut file = OpenOptions::new().write(true).create_new(true).open(&path)?;
                made.push(path);
                file.write_all(text.as_bytes())?;
                file.sync_all()
            });
            match written {
                Ok(()) => return Ok(name),
                Err(error) => {
                    made.iter().for_each(|path| drop(fs::remove_file(path)));
                    if error.kind() != ErrorKind::AlreadyExists {
                        return Err(error);
                    }
                }
            }
        }
        Err(ErrorKind::AlreadyExists.into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two stations may save into one folder, and no report replaces another one.
    #[test]
    fn no_file_is_replaced_and_none_is_left_alone() {
        let place = tempfile::tempdir().unwrap();
        let place = place.path();
        let folder = Folder::new(&place.join("new")).unwrap();
        let both = [("html", "h".to_owned()), ("csv", "c".to_owned())];
        assert_eq!(folder.save("a", &both).unwrap(), "a");
        assert_eq!(folder.save("a", &both).unwrap(), "a_2");
        // Of the third one only the second file is there.
        fs::write(folder.path().join("b.csv"), "precious").unwrap();
        assert_eq!(folder.save("b", &both).unwrap(), "b_2");
        let mut names: Vec<_> =
            fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
        names.sort();
        assert_eq!(names, ["a.csv", "a.html", "a_2.csv", "a_2.html", "b.csv", "b_2.csv", "b_2.html"]);
        assert_eq!(fs::read_to_string(folder.path().join("b.csv")).unwrap(), "precious");
        // Two reports need room for four files.
        let made = folder.fill(FILES * 2).unwrap();
        assert!(made.len() == 4 && made.iter().all(|file| file.path().exists()), "{made:?}");
        drop(made);
        assert!(folder.check(2).is_ok() && fs::read_dir(folder.path()).unwrap().count() == 7);
        // A file where the folder was.
        fs::remove_dir_all(folder.path()).unwrap();
        fs::write(place.join("new"), "").unwrap();
        assert!(folder.check(1).is_err() && folder.save("a", &both).is_err());
        assert!(Folder::new(&place.join("new")).is_err());
    }
}
