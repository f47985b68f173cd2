//! The service station (`coflash ui --service`): a page for people who update machines and need to know
//! nothing about CANopen. Package, options and folder of the reports are fixed; there is no LSS, no erase
//! and no choice of a file.
//!
//! `coflash_core::machine` scans, matches, plans and writes; [`work`] calls it, and the page shows what is
//! in [`station`]. All texts for people are in one table, `page/words.json`, in each language.
//!
//! | module | what it does |
//! |---|---|
//! | `station` | what the page shows |
//! | `requests` | what is answered to which request |
//! | `work` | the search and the update, by `coflash-core` |
//! | `message` | a key of the table, with its values |
//! | `trouble` | which message an error has |
//! | `report` | what became of a device, in HTML and CSV |
//! | `folder` | the folder of the reports |
//! | `words` | the table of texts |

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::{fs, io};

use coflash_core::machine::Package;

use self::folder::Folder;
use self::station::Station;
use super::http::Page;

mod folder;
mod message;
mod report;
mod requests;
mod station;
mod trouble;
mod words;
mod work;

/// The most bytes of the file with the adapter.
const URL_MAX: usize = 1000;

/// What a service station works with.
#[derive(Clone)]
pub struct Service {
    package: Arc<Package>,
    /// The name of the package's file.
    file: String,
    /// Whether a root that the user trusts has signed it.
    is_trusted: bool,
    folder: Folder,
    /// The file with the adapter that was used last.
    memory: Option<PathBuf>,
}

impl std::fmt::Debug for Service {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { file, folder, .. } = self;
        f.debug_struct("Service").field("file", file).field("folder", folder).finish_non_exhaustive()
    }
}

impl Service {
    /// A station for this package, which was read from `file`. `is_trusted` says whether a root that the user has
    /// named has signed it. The reports go into a folder, which is made if it is not there.
    ///
    /// # Errors
    /// The folder cannot be made, or no file can be written into it.
    pub fn new(package: Package, file: &Path, is_trusted: bool, report_dir: &Path) -> io::Result<Self> {
        let file = file.file_name().unwrap_or(file.as_os_str()).to_string_lossy().into_owned();
        let folder = Folder::new(report_dir)?;
        Ok(Self { package: Arc::new(package), file, is_trusted, folder, memory: None })
    }

    /// Remembers the adapter that was used last, with its bit rate, in this file.
    #[must_use]
    pub fn memory(mut self, file: Option<PathBuf>) -> Self {
        self.memory = file;
        self
    }

    /// The folder of the reports.
    #[must_use]
    pub fn report_dir(&self) -> &Path {
        self.folder.path()
    }

    /// The adapter that was used last.
    pub(super) fn last_bus(&self) -> Option<String> {
        let text = fs::read_to_string(self.memory.as_ref()?).ok()?;
        let url = text.trim();
        let is_url = !url.is_empty() && url.len() <= URL_MAX && !url.contains(char::is_control);
        is_url.then(|| url.to_owned())
    }

    /// Notes an adapter as the one that was used last. Without the file it is chosen again at the next start.
    fn note_bus(&self, url: &str) {
        if let Some(file) = &self.memory {
            let _ = fs::write(file, url);
        }
    }

    /// The page, and what becomes of its reports at the end.
    pub(super) fn open(self) -> (Page, AtEnd) {
        let station = Arc::new(Station::new(self));
        let page = requests::page(&station);
        (page, AtEnd(station))
    }
}

/// A station at its end.
pub(super) struct AtEnd(Arc<Station>);

impl AtEnd {
    /// Saves the reports that are not saved yet. What cannot be saved is returned in words.
    pub(super) fn save(&self) -> Option<String> {
        self.0.save();
        self.0.unsaved_words()
    }
}
