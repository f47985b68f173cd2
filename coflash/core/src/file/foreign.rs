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

/// First bytes, after blanks. Letters may be small or capital.
static KNOWN: [(&[u8], Foreign); 17] = [
    (b"\x1F\x8B", Foreign { what: "a gzip archive", advice: &Advice::Unpack }),
    (b"BZh", Foreign { what: "a bzip2 archive", advice: &Advice::Unpack }),
    (b"\xFD7zXZ\0", Foreign { what: "an xz archive", advice: &Advice::Unpack }),
    (b"PK\x03\x04", Foreign { what: "a zip archive", advice: &Advice::Unpack }),
    (b"7z\xBC\xAF\x27\x1C", Foreign { what: "a 7z archive", advice: &Advice::Unpack }),
    (b"!<arch>\n", Foreign { what: "a library of object files", advice: &Advice::Linked }),
    (b"DfuSe", Foreign { what: "a DfuSe file of ST's tools", advice: &Advice::Linked }),
    (b"UF2\n", Foreign { what: "a UF2 file", advice: &Advice::Linked }),
    // MCUboot, bootutil/image.h: IMAGE_MAGIC and IMAGE_MAGIC_V1.
    (b"\x3D\xB8\xF3\x96", Foreign { what: "an image for MCUboot (96F3B83Dh)", advice: &Advice::Unsigned }),
    (b"\x3C\xB8\xF3\x96", Foreign { what: "an image for MCUboot (96F3B83Ch)", advice: &Advice::Unsigned }),
    (b"SFU1", Foreign { what: "an image for ST's secure boot (SBSFU)", advice: &Advice::Linked }),
    (b"0000000", Foreign { what: "a dump in hexadecimal digits (xxd, hexdump)", advice: &Advice::Linked }),
    (b"@", Foreign { what: "a TI-TXT or Verilog file", advice: &Advice::Linked }),
    (b"MZ", Foreign { what: "a program for Windows", advice: &Advice::Linked }),
    (b"-----BEGIN ", Foreign { what: "a text in PEM: a key or a certificate", advice: &Advice::Linked }),
    (b"<!doctype html", Foreign { what: "a page of the web", advice: &Advice::FetchAgain }),
    (b"<html", Foreign { what: "a page of the web", advice: &Advice::FetchAgain }),
];

/// A HEX file with block records (micro:bit universal hex format, 0Ah to 0Eh).
pub(super) static UNIVERSAL_HEX: Foreign =
    Foreign { what: "a universal HEX file, with programs for several boards", advice: &Advice::OneBoard };
static DFU: Foreign = Foreign {
    what: "a file for USB DFU: its last 16 bytes are a suffix, and no part of the program",
    advice: &Advice::DfuSuffix,
};

/// What the first bytes of a file say.
pub(super) fn name(bytes: &[u8]) -> Option<Foreign> {
    let text = bytes.trim_ascii_start();
    let begins = |mark: &[u8]| text.get(..mark.len()).is_some_and(|first| first.eq_ignore_ascii_case(mark));
    KNOWN.iter().find(|(mark, _)| begins(mark)).map(|(_, foreign)| *foreign)
}

/// What the first bytes of an image say. A mark of few bytes may be there by accident.
pub(super) fn of_image(bytes: &[u8]) -> Option<Foreign> {
    KNOWN.iter().find(|(mark, _)| mark.len() >= 4 && bytes.starts_with(mark)).map(|(_, foreign)| *foreign)
}

/// What the last bytes of a file say (USB DFU 1.1, appendix B: "UFD", the length 16, the CRC).
pub(super) fn by_end(bytes: &[u8]) -> Option<Foreign> {
    let suffix: &[u8; 16] = bytes.last_chunk()?;
    (suffix[8..12] == *b"UFD\x10").then_some(DFU)
}
