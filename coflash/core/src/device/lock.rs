//! A lock for a node of a bus among the processes of one computer: a second process notices the
//! first one before it changes the device.
//!
//! The operating system holds the lock during the life of the process; a file that is left over has
//! no effect. If the file cannot be created, there is no lock.

use std::collections::btree_map::Entry;
use std::collections::BTreeMap;
use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use canopen::NodeId;
use crc::{Crc, CRC_64_XZ};

use super::error::{Error, Intruder};

/// The most digits of a process id.
const DIGITS: u64 = 20;

/// A node that no other process uses, until this value is dropped.
#[derive(Debug)]
pub struct Lock {
    _file: Option<File>,
}

impl Lock {
    /// Locks a node of the bus with this URL.
    ///
    /// # Errors
    /// [`Error::NotAlone`] with the process that holds the lock. A file that cannot be created or
    /// locked is not an error.
    pub fn of(url: &str, node: NodeId) -> Result<Self, Error> {
        let folder = std::env::var_os("XDG_RUNTIME_DIR").filter(|folder| !folder.is_empty());
        Self::in_folder(&folder.map_or_else(std::env::temp_dir, PathBuf::from), url, node)
    }

    /// Locks these nodes of the bus too, beside those that are in `locks`.
    ///
    /// # Errors
    /// The errors of [`of`](Self::of), for the first node on which another process works.
    pub fn more(
        url: &str,
        nodes: impl Iterator<Item = NodeId>,
        locks: &mut BTreeMap<NodeId, Self>,
    ) -> Result<(), Error> {
        for node in nodes {
            if let Entry::Vacant(free) = locks.entry(node) {
                free.insert(Self::of(url, node)?);
            }
        }
        Ok(())
    }

    /// Locks a node by a file in this folder.
    ///
    /// # Errors
    /// The errors of [`of`](Self::of).
    pub fn in_folder(folder: &Path, url: &str, node: NodeId) -> Result<Self, Error> {
        let Some(mut file) = open(&folder.join(name(url, node))) else { return Ok(Self { _file: None }) };
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                let mut text = String::new();
                // Windows locks the file's content, too.
                let _ = file.take(DIGITS).read_to_string(&mut text);
                return Err(Error::NotAlone { node, who: Intruder::Process(text.trim().parse().ok()) });
            }
            Err(TryLockError::Error(_)) => return Ok(Self { _file: None }),
        }
        // The process id is information for other processes; the lock works without it.
        let _ = file.set_len(0);
        let _ = file.seek(SeekFrom::Start(0));
        let _ = write!(file, "{}", std::process::id());
        Ok(Self { _file: Some(file) })
    }
}

/// Opens or creates the file. Refuses anything but a regular file: in a folder that all users
/// share, another user may have put something else in its place.
fn open(path: &Path) -> Option<File> {
    match fs::symlink_metadata(path) {
        Ok(there) if !there.is_file() => return None,
        _ => {}
    }
    OpenOptions::new().read(true).write(true).create(true).truncate(false).open(path).ok()
}

/// The same name for every URL of a bus: the bit rate after `@` is left out, and the speed after `?`.
fn name(url: &str, node: NodeId) -> String {
    let url = url.split('?').next().unwrap_or_default();
    let bus = url.rsplit_once('@').map_or(url, |(bus, _)| bus);
    format!("coflash-{:016x}-{node}.lock", Crc::<u64>::new(&CRC_64_XZ).checksum(bus.as_bytes()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_node_is_locked_until_it_is_let_go() {
        let folder = std::env::temp_dir().join(format!("coflash-lock-{}", std::process::id()));
        fs::create_dir_all(&folder).unwrap();
        let node = |number| NodeId::new(number).unwrap();
        let take = |url: &str, number| Lock::in_folder(&folder, url, node(number));
        let held = take("slcan:/dev/ttyACM0@500k", 5).unwrap();
        assert!(take("slcan:/dev/ttyACM0?baud=57600", 5).is_err());
        let error = take("slcan:/dev/ttyACM0", 5).unwrap_err();
        let this = std::process::id();
        assert!(
            matches!(error, Error::NotAlone { who: Intruder::Process(Some(id)), .. } if id == this),
            "{error:?}"
        );
        let others = [take("slcan:/dev/ttyACM0", 6), take("slcan:/dev/ttyACM1", 5)];
        assert!(others.iter().all(Result::is_ok));
        drop(held);
        // A file with a number that is left over locks nothing.
        let path = folder.join(name("slcan:/dev/ttyACM0", node(5)));
        assert_eq!(fs::read_to_string(&path).unwrap(), this.to_string());
        fs::write(&path, "4294967295999999999999999999").unwrap();
        let held = take("slcan:/dev/ttyACM0", 5).unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), this.to_string());
        drop(held);
        // Without a folder there is no lock and no error.
        assert!(Lock::in_folder(&folder.join("none"), "can0", node(5)).is_ok());
        fs::remove_dir_all(&folder).unwrap();
    }

    #[cfg(unix)]
    #[test]
    fn what_is_no_file_is_left_alone() {
        let folder = std::env::temp_dir().join(format!("coflash-link-{}", std::process::id()));
        fs::create_dir_all(&folder).unwrap();
        let (node, precious) = (NodeId::new(5).unwrap(), folder.join("precious"));
        fs::write(&precious, "precious").unwrap();
        std::os::unix::fs::symlink(&precious, folder.join(name("can0", node))).unwrap();
        assert!(Lock::in_folder(&folder, "can0", node).is_ok());
        assert_eq!(fs::read_to_string(&precious).unwrap(), "precious");
        fs::remove_dir_all(&folder).unwrap();
    }
}
