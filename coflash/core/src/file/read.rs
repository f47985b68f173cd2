//! Readers of firmware files: from bytes to [`Image`] or [`Program`]. Only [`load`] uses the file
//! system, and no reader needs a device.

use std::fmt;
use std::path::Path;

use super::fault::{Cause, FileError, Place, ReadError};
use super::image::Image;
use super::program::Program;
use super::sealed::{blocks, Sealed};
use super::text::encoding;
use super::{block_file, elf, foreign, ihex, limit, raw, srec};

/// The formats of a firmware file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// Intel HEX.
    IntelHex,
    /// Motorola S-record.
    SRecord,
    /// ELF executable, 32 bit, little-endian, Arm.
    Elf,
    /// Block file, ready for 1F50h.
    BlockFile,
    /// Sealed image: sent to the device unchanged; only the device's keys decrypt it.
    Sealed,
    /// The bytes of the flash alone; the address must be given.
    Raw,
}

impl Format {
    /// Detects the format from the first bytes. A raw file has no distinctive bytes and is never
    /// detected.
    #[must_use]
    pub fn detect(bytes: &[u8]) -> Option<Self> {
        let text = bytes.trim_ascii_start();
        match bytes {
            [0x7F, b'E', b'L', b'F', ..] => Some(Self::Elf),
            _ if Sealed::looks_like(bytes) => Some(Self::Sealed),
            _ if block_file::looks_like(bytes) => Some(Self::BlockFile),
            _ if text.starts_with(b":") => Some(Self::IntelHex),
            _ if text.first() == Some(&b'S') && text.get(1).is_some_and(u8::is_ascii_digit) => {
                Some(Self::SRecord)
            }
            _ => None,
        }
    }

    /// The format of a file with this name: that of its first bytes, and without distinctive bytes
    /// that of a raw binary if the name ends with `.bin`.
    #[must_use]
    pub fn of(name: &Path, bytes: &[u8]) -> Option<Self> {
        let is_bin = name.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("bin"));
        Self::detect(bytes).or_else(|| (is_bin && !bytes.is_empty()).then_some(Self::Raw))
    }

    /// Its name.
    const fn name(self) -> &'static str {
        match self {
            Self::IntelHex => "Intel HEX",
            Self::SRecord => "Motorola S-record",
            Self::Elf => "ELF",
            Self::BlockFile => "block file",
            Self::Sealed => "sealed image",
            Self::Raw => "raw binary",
        }
    }
}

impl fmt::Display for Format {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// The contents of a firmware file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Firmware {
    /// Memory contents, of which [`program_of`](super::convert::program_of) makes a program.
    Image(Image),
    /// The program of a block file; every CRC was checked.
    Blocks(Program),
}

/// Reads a firmware file that is already in memory.
///
/// `format` replaces the detection by the first bytes. `raw_address` is the address of a
/// [`Format::Raw`] file.
///
/// # Errors
/// The first fault, with its place.
pub fn read(bytes: &[u8], format: Option<Format>, raw_address: Option<u32>) -> Result<Firmware, ReadError> {
    read_telling(bytes, format, raw_address).map(|(firmware, _)| firmware)
}

/// Reads a firmware file from disk, like [`read`].
///
/// # Errors
/// The first fault, with file and place.
pub fn load(path: &Path, format: Option<Format>, raw_address: Option<u32>) -> Result<Firmware, FileError> {
    load_telling(path, format, raw_address).map(|(firmware, _)| firmware)
}

/// Reads a firmware file from disk; also returns its format.
///
/// # Errors
/// The first fault, with file and place.
pub fn load_telling(
    path: &Path,
    format: Option<Format>,
    raw_address: Option<u32>,
) -> Result<(Firmware, Format), FileError> {
    limit::read(path)
        .map_err(|cause| Place::File.fault(cause))
        .and_then(|bytes| read_telling(&bytes, format.or_else(|| Format::of(path, &bytes)), raw_address))
        .map_err(|error| error.of(path.display()))
}

fn read_telling(
    bytes: &[u8],
    format: Option<Format>,
    raw_address: Option<u32>,
) -> Result<(Firmware, Format), ReadError> {
    if bytes.is_empty() {
        return Err(Place::File.fault(Cause::Empty));
    }
    let found = Format::detect(bytes);
    let format = format.or(found);
    if matches!(format, None | Some(Format::IntelHex | Format::SRecord)) {
        if let Some(encoding) = encoding(bytes) {
            return Err(Place::File.fault(Cause::Encoding(encoding)));
        }
    }
    let other = |otherwise| Place::File.fault(foreign::name(bytes).map_or(otherwise, Cause::Foreign));
    // What follows the segments of an ELF file does no harm.
    if let Some(foreign) = foreign::by_end(bytes).filter(|_| found != Some(Format::Elf)) {
        return Err(other(Cause::Foreign(foreign)));
    }
    let format = format.ok_or_else(|| other(Cause::NotFirmware))?;
    // A text with a damaged first line has another fault than a file that is none of the kind, so
    // only the first character counts.
    if matches!(format, Format::IntelHex | Format::SRecord) && found != Some(format) {
        return Err(other(Cause::NotNamedFormat { named: format.name(), found: found.map(Format::name) }));
    }
    let firmware = match format {
        Format::IntelHex => ihex::read(bytes).map(Firmware::Image),
        Format::SRecord => srec::read(bytes).map(Firmware::Image),
        Format::Elf => elf::read(bytes).map(Firmware::Image),
        Format::Raw => raw::read(bytes, raw_address).map(Firmware::Image).map_err(|fault| {
            foreign::of_image(bytes).map_or(fault, |foreign| Place::File.fault(Cause::Foreign(foreign)))
        }),
        Format::BlockFile if !blocks::looks_like(bytes) => block_file::read(bytes).map(Firmware::Blocks),
        // The contents of the blocks are not a program for the flash.
        Format::BlockFile | Format::Sealed => Err(Place::File.fault(Cause::Sealed)),
    };
    Ok((firmware?, format))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The record of a HEX file for address 0, with its end.
    const HEX: &str = ":0100000001FE\n:00000001FF\n";

    fn fault(bytes: &[u8], format: Option<Format>) -> String {
        read(bytes, format, Some(0)).unwrap_err().to_string()
    }

    #[test]
    fn what_is_detected_can_be_read() {
        let segments = |text: &str, format| match read(text.as_bytes(), format, None) {
            Ok(Firmware::Image(image)) => {
                image.segments().map(|(address, data)| (address, data.into_owned())).collect::<Vec<_>>()
            }
            other => panic!("{other:?}"),
        };
        for blanks in ["", " ", "\t", "\n \n\t ", "\r\n"] {
            let indented = format!("{blanks}{}", HEX.replace('\n', &format!("\n{blanks}")));
            for format in [None, Some(Format::IntelHex)] {
                assert_eq!(segments(&indented, format), [(0, vec![1])], "{indented:?}");
            }
            let records = format!("{blanks}S1040000AA51\n{blanks}S9030000FC");
            assert!(read(records.as_bytes(), None, None).is_ok(), "{records:?}");
        }
    }

    #[test]
    fn a_byte_order_mark_is_named() {
        let wide = |mark: [u8; 2], bytes: fn(u16) -> [u8; 2]| {
            let text = HEX.encode_utf16().flat_map(bytes);
            mark.into_iter().chain(text).collect::<Vec<u8>>()
        };
        let texts = [
            ("UTF-8", [b"\xEF\xBB\xBF", HEX.as_bytes()].concat()),
            ("UTF-8", [b"\xEF\xBB\xBF\r\n", HEX.as_bytes()].concat()),
            ("UTF-8", b"\xEF\xBB\xBFS1040000AA51\nS9030000FC".to_vec()),
            ("UTF-16", wide([0xFF, 0xFE], u16::to_le_bytes)),
            ("UTF-16", wide([0xFE, 0xFF], u16::to_be_bytes)),
        ];
        for (encoding, text) in texts {
            for format in [None, Some(Format::IntelHex), Some(Format::SRecord)] {
                let words = format!("the file: begins with a byte order mark of {encoding}");
                assert!(fault(&text, format).starts_with(&words), "{}", fault(&text, format));
            }
        }
        // Another text with a mark is no firmware, and the bytes of a raw binary are its own.
        assert!(fault(b"\xEF\xBB\xBF<html>", None).contains("is not a firmware file"));
        assert!(read(b"\xEF\xBB\xBF:", Some(Format::Raw), Some(0x0801_0000)).is_ok());
    }

    #[test]
    fn the_name_shows_a_raw_binary_if_its_bytes_show_nothing() {
        for (name, bytes, format) in [
            ("app.bin", &[0, 0, 2, 0x20][..], Some(Format::Raw)),
            ("APP.BIN", &[0xFF; 4], Some(Format::Raw)),
            ("app.bin", HEX.as_bytes(), Some(Format::IntelHex)),
            ("app.bin", b"", None),
            ("app.dat", &[0, 0, 2, 0x20], None),
            ("bin", &[0, 0, 2, 0x20], None),
        ] {
            assert_eq!(Format::of(Path::new(name), bytes), format, "{name}");
        }
    }
}
