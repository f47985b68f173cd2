//! Files and images that are no program for this tool, and which their first or last bytes name.

use crate::advice::Advice;

/// What it is, and what to do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Foreign {
    /// The rest of a sentence: "it is ...".
    pub what: &'static str,
    /// What to give instead.
    pub advice: &'static Advice,
}

/// The header of an image for MCUboot (bootutil/image.h: `IMAGE_MAGIC`); `IMAGE_MAGIC_V1` begins with 3Ch.
pub(super) const MCUBOOT: [u8; 4] = *b"\x3D\xB8\xF3\x96";

const TEXT_WITH_PLACES: Foreign = Foreign { what: "a TI-TXT or Verilog file", advice: &Advice::Linked };

/// First bytes. Letters may be small or capital. No initial stack pointer, a multiple of 8 in the RAM, begins so.
static KNOWN: [(&[u8], Foreign); 22] = [
    (b"\x1F\x8B", Foreign { what: "a gzip archive", advice: &Advice::Unpack }),
    (b"BZh", Foreign { what: "a bzip2 archive", advice: &Advice::Unpack }),
    (b"\xFD7zXZ\0", Foreign { what: "an xz archive", advice: &Advice::Unpack }),
    (b"\x28\xB5\x2F\xFD", Foreign { what: "a Zstandard archive", advice: &Advice::Unpack }),
    (b"PK\x03\x04", Foreign { what: "a zip archive", advice: &Advice::Unpack }),
    (b"7z\xBC\xAF\x27\x1C", Foreign { what: "a 7z archive", advice: &Advice::Unpack }),
    (b"!<arch>\n", Foreign { what: "a library of object files", advice: &Advice::Linked }),
    (b"DfuSe", Foreign { what: "a DfuSe file of ST's tools", advice: &Advice::Linked }),
    (b"UF2\n", Foreign { what: "a UF2 file", advice: &Advice::Linked }),
    (&MCUBOOT, Foreign { what: "an image for MCUboot (96F3B83Dh)", advice: &Advice::Unsigned }),
    (b"\x3C\xB8\xF3\x96", Foreign { what: "an image for MCUboot (96F3B83Ch)", advice: &Advice::Unsigned }),
    (b"SFU1", Foreign { what: "an image for ST's secure boot (SBSFU)", advice: &Advice::Linked }),
    (b"0000000", Foreign { what: "a dump in hexadecimal digits (xxd, hexdump)", advice: &Advice::Linked }),
    (b"@08", TEXT_WITH_PLACES),
    (b"@00", TEXT_WITH_PLACES),
    (b"MZ", Foreign { what: "a program for Windows", advice: &Advice::Linked }),
    (b"-----BEGIN ", Foreign { what: "a text in PEM: a key or a certificate", advice: &Advice::Linked }),
    (b"version https:", Foreign { what: "a pointer of Git LFS (git lfs pull)", advice: &Advice::FetchAgain }),
    (b"<!", Foreign { what: "a page of the web, or XML", advice: &Advice::FetchAgain }),
    (b"<?", Foreign { what: "a page of the web, or XML", advice: &Advice::FetchAgain }),
    (b"<h", Foreign { what: "a page of the web, or XML", advice: &Advice::FetchAgain }),
    (b"{\"", Foreign { what: "a text in JSON", advice: &Advice::FetchAgain }),
];

/// A HEX file with block records (micro:bit universal hex format, 0Ah to 0Eh).
pub(super) static UNIVERSAL_HEX: Foreign =
    Foreign { what: "a universal HEX file, with programs for several boards", advice: &Advice::OneBoard };
static DFU: Foreign = Foreign {
    what: "a file for USB DFU: its last 16 bytes are a suffix, and no part of the program",
    advice: &Advice::DfuSuffix,
};

static TAR: Foreign = Foreign { what: "a tar archive", advice: &Advice::Unpack };
static ESP: Foreign = Foreign { what: "an image for an ESP32 or ESP8266", advice: &Advice::Linked };

/// What the first bytes of a file say, after blanks.
pub(super) fn name(bytes: &[u8]) -> Option<Foreign> {
    match bytes.trim_ascii_start() {
        [b'@', digit, ..] if digit.is_ascii_hexdigit() => Some(TEXT_WITH_PLACES),
        bytes => of_image(bytes),
    }
}

/// What the first bytes of an image say.
pub(super) fn of_image(bytes: &[u8]) -> Option<Foreign> {
    let begins = |mark: &[u8]| bytes.get(..mark.len()).is_some_and(|first| first.eq_ignore_ascii_case(mark));
    match bytes {
        // POSIX.1, pax: the field `magic`.
        _ if bytes.get(257..262) == Some(b"ustar") => Some(TAR),
        // esptool, "Firmware image format": magic, number of segments, mode of the SPI flash.
        [0xE9, 1..=16, 0..=5, ..] => Some(ESP),
        _ => KNOWN.iter().find(|(mark, _)| begins(mark)).map(|(_, foreign)| *foreign),
    }
}

/// What the last bytes of a file say (USB DFU 1.1, appendix B: "UFD", the length 16, the CRC).
pub(super) fn by_end(bytes: &[u8]) -> Option<Foreign> {
    let suffix: &[u8; 16] = bytes.last_chunk()?;
    (suffix[8..12] == *b"UFD\x10").then_some(DFU)
}
