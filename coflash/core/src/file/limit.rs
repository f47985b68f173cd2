//! The size limit of files: only regular files of a plausible size are read.

use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

use super::fault::Cause;
use crate::unicode;

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
    let metadata = std::fs::metadata(path).map_err(Cause::Io)?;
    if !metadata.is_file() {
        return Err(Cause::NoRegularFile(if metadata.is_dir() {
            "a folder"
        } else {
            "a device, pipe or socket"
        }));
    }
    if metadata.len() > most {
        return Err(Cause::TooLarge { size: metadata.len(), most });
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

/// Reads a settings file of at most 1 MiB, in UTF-8, or in UTF-16 with a byte order mark. It may be a
/// pipe.
///
/// # Errors
/// The errors of [`std::fs::read`], and [`io::ErrorKind::InvalidData`] for a longer file, or another
/// encoding.
pub fn read_text(path: &Path) -> io::Result<String> {
    let mut bytes = Vec::new();
    File::open(path)?.take(MAX_TEXT_SIZE + 1).read_to_end(&mut bytes)?;
    let invalid = |words: String| io::Error::new(io::ErrorKind::InvalidData, words);
    if bytes.len() as u64 > MAX_TEXT_SIZE {
        return Err(invalid(format!("it has more than {MAX_TEXT_SIZE} bytes, the limit for this file")));
    }
    unicode::text(&bytes).ok_or_else(|| invalid("it is not a text in UTF-8: store it as UTF-8".to_string()))
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

    /// Editors and shells of Windows write UTF-16; the bytes are those of Python's `encode`.
    #[test]
    fn settings_are_text_in_unicode() {
        let path = std::env::temp_dir().join(format!("coflash-text-{}", std::process::id()));
        let read = |bytes: &[u8]| {
            std::fs::write(&path, bytes).unwrap();
            read_text(&path).map_err(|error| error.to_string())
        };
        for bytes in
            [&b"n=\xC3\xBC"[..], b"\xEF\xBB\xBFn=\xC3\xBC", b"\xFF\xFEn\0=\0\xFC\0", b"\xFE\xFF\0n\0=\0\xFC"]
        {
            assert_eq!(read(bytes).unwrap(), "n=ü", "{bytes:?}");
        }
        for bytes in [&b"n=\xFC"[..], b"\xFF\xFEn\0=", b"\xFF\xFE\0\xD8", b"n\0=\0"] {
            let words = read(bytes).unwrap_err();
            assert!(words.contains("store it as UTF-8"), "{bytes:?}: {words}");
        }
        std::fs::remove_file(&path).unwrap();
    }
}
