//! Files that are no firmware for this tool, and which their first bytes name.

/// What a file is, and what to do.
pub(super) type Foreign = (&'static str, &'static str);

const UNPACK: &str = "unpack it, and name the file in it";
const LINKED: &str = "name the linker's output (ELF, Intel HEX, S-record)";
const AGAIN: &str = "fetch the file itself, not the page that leads to it";

/// First bytes, after blanks. Letters may be small or capital.
const KNOWN: [(&[u8], Foreign); 13] = [
    (b"\x1F\x8B", ("a gzip archive", UNPACK)),
    (b"BZh", ("a bzip2 archive", UNPACK)),
    (b"\xFD7zXZ\0", ("an xz archive", UNPACK)),
    (b"PK\x03\x04", ("a zip archive", UNPACK)),
    (b"7z\xBC\xAF\x27\x1C", ("a 7z archive", UNPACK)),
    (b"!<arch>\n", ("a library of object files", LINKED)),
    (b"DfuSe", ("a DfuSe file of ST's tools", LINKED)),
    (b"UF2\n", ("a UF2 file", LINKED)),
    (b"@", ("a TI-TXT or Verilog file", LINKED)),
    (b"MZ", ("a program for Windows", LINKED)),
    (b"-----BEGIN ", ("a text in PEM, such as a key or a certificate", LINKED)),
    (b"<!doctype html", ("a page of the web", AGAIN)),
    (b"<html", ("a page of the web", AGAIN)),
];

/// What the first bytes say.
pub(super) fn name(bytes: &[u8]) -> Option<Foreign> {
    let text = bytes.trim_ascii_start();
    let begins = |mark: &[u8]| text.get(..mark.len()).is_some_and(|first| first.eq_ignore_ascii_case(mark));
    KNOWN.iter().find(|(mark, _)| begins(mark)).map(|(_, foreign)| *foreign)
}
