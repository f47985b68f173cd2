//! `--flash`: a file that keeps the flash from one run to the next.

use std::fs::{self, File};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use anyhow::{bail, Context, Result};
use emulator::machine::Machine;
use shared_abi::geometry::Geometry;

/// The file: the bytes of the flash and nothing else.
pub struct FlashFile {
    path: PathBuf,
    /// The content of the file.
    kept: Vec<u8>,
}

impl FlashFile {
    /// Writes the file's bytes into the flash. If the file does not exist, the flash is erased, and
    /// the first [`keep`](Self::keep) creates the file.
    pub fn open(path: &Path, chip: &Geometry, machine: &mut Machine) -> Result<Self> {
        let name = path.display();
        let kept = match fs::metadata(path) {
            Err(error) if error.kind() == ErrorKind::NotFound => Vec::new(),
            Err(error) => return Err(error).with_context(|| format!("{name}")),
            // Do not read the file before its size is known: it may be anything.
            Ok(file) if !file.is_file() || file.len() != u64::from(chip.flash.size) => bail!(
                "{name}: {} bytes are not the flash of this board's chip, which has {}; is it of another \
                 board? name another file, or delete this one to start with an erased flash",
                file.len(),
                chip.flash.size
            ),
            Ok(_) => fs::read(path).with_context(|| format!("{name}"))?,
        };
        if !kept.is_empty() {
            machine.load_bin(chip.flash.base, &kept).with_context(|| format!("{name}"))?;
        }
        let file = Self { path: path.to_path_buf(), kept };
        // Find out now, not at the end, whether the file can be written.
        drop(File::create(file.beside()).with_context(|| format!("{name} cannot be written"))?);
        fs::remove_file(file.beside()).with_context(|| format!("{name}"))?;
        Ok(file)
    }

    /// Whether the file had content for the flash.
    pub fn is_filled(&self) -> bool {
        !self.kept.is_empty()
    }

    fn beside(&self) -> PathBuf {
        let mut name = self.path.as_os_str().to_owned();
        name.push(".new");
        name.into()
    }

    /// Writes the flash to the file if it has changed: all of it or nothing, whatever happens
    /// meanwhile.
    pub fn keep(&mut self, flash: &[u8]) -> Result<()> {
        if self.kept == flash {
            return Ok(());
        }
        let beside = self.beside();
        let written = File::create(&beside).and_then(|mut file| {
            file.write_all(flash)?;
            file.sync_all()?;
            fs::rename(&beside, &self.path)
        });
        written.with_context(|| format!("writing {}", self.path.display()))?;
        self.kept = flash.to_vec();
        Ok(())
    }
}
