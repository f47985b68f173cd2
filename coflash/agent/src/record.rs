//! What an agent must know about a device after a restart, in a file that is always whole.

use std::fmt::Display;
use std::fs::{self, File};
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use tempfile::NamedTempFile;

use super::ddi::is_id;
use coflash_core::file::sealed::show::digits;

/// The number of ended actions that are kept.
const ENDED_MOST: usize = 16;

/// What is known about the actions of a device.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Record {
    /// The root resource of the device on its server: actions of another server are others.
    pub(super) of: String,
    /// The action that changes the device, from just before the first request to the device.
    pub(super) begun: Option<RunningAction>,
    /// The actions that have ended, the last one last.
    pub(super) ended: Vec<Finish>,
}

/// An action that changes the device.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct RunningAction {
    pub(super) action: String,
    /// Whether the device is known to keep the program: it was released, or it was started last.
    pub(super) kept: bool,
}

/// How an action ended.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Finish {
    pub(super) action: String,
    pub(super) ok: bool,
    /// The lines for the server.
    pub(super) details: Vec<String>,
    /// Whether the server has heard of it.
    pub(super) reported: bool,
}

impl Record {
    pub(super) fn new(of: impl Into<String>) -> Self {
        Self { of: of.into(), ..Self::default() }
    }

    pub(super) fn finish_of(&self, action: &str) -> Option<&Finish> {
        self.ended.iter().find(|finish| finish.action == action)
    }

    /// Whether this action has begun to change the device, and has not ended.
    pub(super) fn has_begun(&self, action: &str) -> bool {
        self.begun.as_ref().is_some_and(|begun| begun.action == action)
    }

    /// Adds the end of an action.
    pub(super) fn end(&mut self, finish: Finish) {
        if self.has_begun(&finish.action) {
            self.begun = None;
        }
        self.ended.retain(|other| other.action != finish.action);
        self.ended.push(finish);
        let excess = self.ended.len().saturating_sub(ENDED_MOST);
        self.ended.drain(..excess);
    }
}

/// The files of the devices.
#[derive(Clone, Debug)]
pub(super) struct Store {
    folder: PathBuf,
}

impl Store {
    pub(super) fn new(folder: &Path) -> io::Result<Self> {
        fs::create_dir_all(folder)?;
        Ok(Self { folder: folder.to_path_buf() })
    }

    /// Checks that a file can be written: what must survive a restart is in files alone.
    pub(super) fn check(&self) -> io::Result<()> {
        let mut file = NamedTempFile::new_in(&self.folder)?;
        file.write_all(&[0; 4096])?;
        file.as_file().sync_all()
    }

    /// The path of a device's file with this extension. The name is readable, and is no other
    /// device's even if the system does not distinguish small letters and capitals.
    pub(super) fn path(&self, controller: &str, extension: &str) -> PathBuf {
        let safe = |c: char| if c.is_ascii_alphanumeric() || c == '-' { c } else { '_' };
        let name: String = controller.chars().take(40).map(safe).collect();
        let digest = digits(&Sha256::digest(controller.as_bytes()));
        self.folder.join(format!("{name}-{}.{extension}", &digest[..16]))
    }

    /// The record of a device. A missing file, or one of another server, is an empty record.
    ///
    /// # Errors
    /// In words, with the path and what to do, for a file that cannot be read or is none of ours.
    pub(super) fn load(&self, controller: &str, of: &str) -> Result<Record, String> {
        let path = self.path(controller, "json");
        let damaged = |what: &dyn Display| {
            format!(
                "{}: {what}: delete it, and the agent asks the server anew for this device",
                path.display()
            )
        };
        let text = match coflash_core::file::limit::read_text(&path) {
            Ok(text) => text,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Record::new(of)),
            Err(error) => return Err(damaged(&error)),
        };
        let record: Record = serde_json::from_str(&text)
            .map_err(|error| damaged(&format!("it is no state file ({error})")))?;
        let mut actions = record.begun.iter().map(|begun| &begun.action);
        let mut ended = record.ended.iter().map(|finish| &finish.action);
        if !actions.all(|action| is_id(action)) || !ended.all(|action| is_id(action)) {
            return Err(damaged(&"it is no state file (an action with an impossible id)"));
        }
        Ok(if record.of == of { record } else { Record::new(of) })
    }

    /// Replaces the record of a device: after a loss of power the file is the old or the new one.
    ///
    /// # Errors
    /// In words, with the path.
    pub(super) fn save(&self, controller: &str, record: &Record) -> Result<(), String> {
        let path = self.path(controller, "json");
        let replace = || {
            let text = serde_json::to_vec_pretty(record)?;
            let mut file = NamedTempFile::new_in(&self.folder)?;
            file.write_all(&text)?;
            file.as_file().sync_all()?;
            file.persist(&path)?;
            // Windows opens no folder as a file; its file system writes names in order.
            #[cfg(unix)]
            File::open(&self.folder)?.sync_all()?;
            Ok::<_, io::Error>(())
        };
        replace().map_err(|error| format!("{}: {error}", path.display()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn finish(action: impl ToString) -> Finish {
        Finish { action: action.to_string(), ok: true, details: vec!["done".to_string()], reported: false }
    }

    #[test]
    fn a_record_survives_and_a_foreign_one_does_not_count() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::new(folder.path()).unwrap();
        assert_eq!(store.load("door", "here").unwrap(), Record::new("here"));
        let mut record = Record::new("here");
        record.begun = Some(RunningAction { action: "20".to_string(), kept: false });
        (0..40).for_each(|action| record.end(finish(action)));
        assert_eq!(record.begun, None, "20 has ended");
        assert_eq!((record.ended.len(), record.ended[0].action.as_str()), (16, "24"));
        // Machines of many devices, of which each has failed.
        let long = super::super::ddi::lines(&vec!["x".repeat(1000); 1000]);
        (40..80).for_each(|action| record.end(Finish { details: long.clone(), ..finish(action) }));
        store.save("door", &record).unwrap();
        // A new file that was not finished when the power went does not count.
        fs::write(store.path("door", "new"), "{").unwrap();
        assert_eq!(store.load("door", "here").unwrap(), record);
        assert_eq!(store.load("Door", "here").unwrap(), Record::new("here"));
        assert_eq!(store.load("door", "another server").unwrap(), Record::new("another server"));
        fs::write(store.path("door", "json"), "{\"of\":").unwrap();
        assert!(store.load("door", "here").unwrap_err().contains("delete it"));
        let strange = r#"{"of":"here","begun":{"action":"../../x","kept":false},"ended":[]}"#;
        fs::write(store.path("door", "json"), strange).unwrap();
        assert!(store.load("door", "here").unwrap_err().contains("impossible id"));
        fs::write(store.path("door", "json"), "[".repeat((1 << 20) + 1)).unwrap();
        assert!(store.load("door", "here").unwrap_err().contains("more than 1048576 bytes"));
        fs::remove_file(store.path("door", "json")).unwrap();
        fs::create_dir(store.path("door", "json")).unwrap();
        let why = store.save("door", &record).unwrap_err();
        assert!(why.contains(&store.path("door", "json").display().to_string()), "{why}");
        assert!(!store.path("../../etc/passwd", "json").display().to_string().contains(".."));
    }
}
