//! What a release is made of: its folders, its files and its crates.

use std::path::PathBuf;

use crate::{files, outcome::Outcome};

/// Linux; the program does not need a C library of the system.
pub const LINUX: &str = "x86_64-unknown-linux-musl";
pub const WINDOWS: &str = "x86_64-pc-windows-gnu";
/// The version; all members of the workspace have the same one.
pub const VERSION: &str = env!("CARGO_PKG_VERSION");
pub const SUMS: &str = "SHA256SUMS";
/// The images that docs/hardware-checklist.md asks for.
pub const IMAGES: [&str; 5] = ["bootloader", "bootloader-watchdog", "app-v1", "app-v2", "app-test"];

/// The folders of a release, and the time of its files.
pub struct Release {
    /// The folder of the release files.
    pub dist: PathBuf,
    /// Cargo's folder for the release, and intermediate files.
    pub build: PathBuf,
    /// The time of the commit, in seconds since 1970: all files in archives have this time.
    pub epoch: String,
    pub draft: bool,
}

impl Release {
    pub fn file(&self, suffix: &str) -> PathBuf {
        self.dist.join(format!("coflash-{VERSION}{suffix}"))
    }

    pub fn source(&self) -> PathBuf {
        self.dist.join(format!("coboot-{VERSION}.tar.gz"))
    }

    pub fn linux(&self) -> PathBuf {
        self.file("-x86_64-linux.tar.gz")
    }

    pub fn deb(&self) -> PathBuf {
        self.dist.join(format!("coflash_{VERSION}_amd64.deb"))
    }

    pub fn windows(&self) -> PathBuf {
        self.file("-x86_64-windows.exe")
    }

    pub fn firmware(&self) -> PathBuf {
        self.dist.join(format!("bootloader-{VERSION}-{}.tar.gz", shared_abi::layout::DEFAULT.board))
    }

    /// The wheel, whose name has the oldest C library that it runs on.
    pub fn wheel(&self) -> Outcome<PathBuf> {
        let wheel = files::within(&self.dist)?.into_iter().find(|file| files::is(file, "whl"));
        wheel.ok_or_else(|| "target/dist has no wheel; `cargo xtask package python` makes it.".to_owned())
    }

    /// An empty folder with this name among the intermediate files.
    pub fn empty(&self, name: &str) -> Outcome<PathBuf> {
        let folder = self.build.join(name);
        files::remove(&folder)?;
        files::make(&folder)?;
        Ok(folder)
    }
}
