//! What a service station works with.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::{fs, io};

use coflash_core::machine::{Package, Signer};

use super::folder::Folder;

/// The most bytes of the file with the adapter.
const URL_MAX: usize = 1000;

/// Where the programs of a station come from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Origin {
    /// A package that a root which the user trusts has signed, with the signers of these roots.
    Trusted(Vec<Signer>),
    /// Any other package.
    Package,
    /// A job file.
    Job,
}

impl Origin {
    /// The key of what the file is.
    pub(super) const fn key(&self) -> &'static str {
        match self {
            Self::Trusted(_) | Self::Package => "package",
            Self::Job => "job-file",
        }
    }
}

/// What a service station works with.
#[derive(Clone)]
pub struct Service {
    pub(super) package: Arc<Package>,
    /// The name of the file.
    pub(super) file: String,
    pub(super) origin: Origin,
    pub(super) folder: Folder,
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
    /// A station for this package, which was read from `file`, or made of the job in it. The reports go into a
    /// folder, which is made if it is not there.
    ///
    /// # Errors
    /// The folder cannot be made, or no file can be written into it.
    pub fn new(package: Package, file: &Path, origin: Origin, report_dir: &Path) -> io::Result<Self> {
        let file = file.file_name().unwrap_or(file.as_os_str()).to_string_lossy().into_owned();
        let folder = Folder::new(report_dir)?;
        Ok(Self { package: Arc::new(package), file, origin, folder, memory: None })
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
    pub(crate) fn last_bus(&self) -> Option<String> {
        let text = fs::read_to_string(self.memory.as_ref()?).ok()?;
        let url = text.trim();
        let is_url = !url.is_empty() && url.len() <= URL_MAX && !url.contains(char::is_control);
        is_url.then(|| url.to_owned())
    }

    /// Notes an adapter as the one that was used last. Without the file it is chosen again at the next start.
    pub(super) fn note_bus(&self, url: &str) {
        if let Some(file) = &self.memory {
            let _ = fs::write(file, url);
        }
    }
}
