//! The size limit of files: only regular files of a plausible size are read.

use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

use super::fault::Cause;

/// The most bytes of a firmware file: 64 MiB. The largest flash of the family has 2 MiB, which
/// takes about 6 MiB as text; the rest is for the symbols of an ELF file.
pub const MAX_FILE_SIZE: u64 = 64 * 1024 * 1024;

/// Reads a whole regular file of at most [`MAX_FILE_SIZE`] bytes.
///
/// # Errors
/// [`Cause::Io`], [`Cause::NoRegularFile`] or [`Cause::TooLarge`].
pub fn read(path: &Path) -> Result<Vec<u8>, Cause> {
    read_at_most(path, MAX_FILE_SIZE)
}

fn read_at_most(path: &Path, most: u64) -> Result<Vec<u8>, Cause> {
    // Checked before opening: to open a FIFO waits for its writer.
    let told = std::fs::metadata(path).map_err(Cause::Io)?;
    if !told.is_file() {
        return Err(Cause::NoRegularFile(if told.is_dir() {
            "a folder"
        } else {
            "a device, pipe or socket"
        }));
    }
    if told.len() > most {
        return Err(Cause::TooLarge { size: told.len(), most });
    }
    let mut bytes = Vec::new();
    // The file may be another one by now, or it may grow during the read.
    File::open(path).and_then(|file| file.take(most + 1).read_to_end(&mut bytes)).map_err(Cause::Io)?;
    match bytes.len() as u64 {
        size if size > most => Err(Cause::TooLarge { size, most }),
        _ => Ok(bytes),
    }
}

/// The most bytes of a settings file.
const MAX_TEXT_SIZE: u64 = 1024 * 1024;

/// Reads a settings file of at most 1 MiB. It may be a pipe.
///
/// # Errors
/// The errors of [`std::fs::read_to_string`], and [`io::ErrorKind::InvalidData`] for a longer file.
pub fn read_text(path: &Path) -> io::Result<String> {
    let mut text = String::new();
    File::open(path)?.take(MAX_TEXT_SIZE + 1).read_to_string(&mut text)?;
    if text.len() as u64 > MAX_TEXT_SIZE {
        let words = format!("it has more than {MAX_TEXT_SIZE} bytes, too much for settings");
        return Err(io::Error::new(io::ErrorKind::InvalidData, words));
    }
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_read_up_to_its_limit_and_not_beyond() {
        let path = std::env::temp_dir().join(format!("coflash-limit-{}", std::process::id()));
        std::fs::write(&path, [7; 9]).unwrap();
        assert_eq!(read_at_most(&path, 9).unwrap(), [7; 9]);
        assert!(matches!(read_at_most(&path, 8), Err(Cause::TooLarge { size: 9, most: 8 })));
        std::fs::remove_file(&path).unwrap();
        assert!(matches!(read_at_most(&std::env::temp_dir(), 8), Err(Cause::NoRegularFile("a folder"))));
    }
}
