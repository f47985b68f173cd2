//! `coflash flash` with a bootloader: finds it in a file.

use std::path::Path;

use coflash_core::file::read::{self, Format};
use coflash_core::update::NewBootloader;

use super::output::Failure;
use super::verify::{self, is_sealed};

/// The bootloader in a file; `None` for any other file, also for one that cannot be read: the update of a
/// program says why.
pub(super) fn bootloader_in(path: &Path, format: Option<Format>) -> Result<Option<NewBootloader>, Failure> {
    if is_sealed(path) {
        return Ok(NewBootloader::of_sealed(&verify::read(path)?.image));
    }
    let Ok((firmware, _)) = read::load_telling(path, format, Some(0)) else { return Ok(None) };
    NewBootloader::of(&firmware).map_err(|fault| Failure::file(path, &format!("it {fault}")))
}
