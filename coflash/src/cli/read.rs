//! `coflash read`: the value of any object.

use std::path::PathBuf;

use canopen::Address;
use clap::{Args, ValueEnum};
use coflash::device::Dialect;
use coflash::update::dialect::read_locked;
use serde_json::json;

use super::context::Context;
use super::device::Device;
use super::dialect::Access;
use super::output::Failure;

/// Reads an object, or a program where the device allows it (1F50/1).
///
/// With --unlock a lift device is brought into its bootloader, unlocked there and restarted
/// afterwards, so that its program (1F50/1) and its parameter set (1F50/2) can be saved.
#[derive(Debug, Args)]
pub(super) struct Read {
    /// The object: hexadecimal index and, behind a slash, decimal sub-index: 1018/4, or 100A for
    /// sub-index 0.
    #[arg(value_name = "INDEX[/SUB]", value_parser = address)]
    object: Address,

    #[command(flatten)]
    device: Device,

    #[command(flatten)]
    access: Access,

    /// How to show the value.
    #[arg(long = "as", value_name = "KIND", default_value = "auto", value_enum)]
    kind: Kind,

    /// Write the bytes to this file instead.
    #[arg(long, short, value_name = "FILE")]
    output: Option<PathBuf>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Kind {
    /// Up to four bytes as a number, what is printable as text, anything else as bytes.
    Auto,
    /// Unsigned, little-endian, up to 8 bytes.
    Number,
    /// Text.
    Text,
    /// Bytes.
    Hex,
}

impl Read {
    pub(super) fn run(&self, context: &Context) -> Result<(), Failure> {
        let mut link = context.link()?;
        let mut session = self.device.session(&mut link)?;
        let (node, object) = (session.node(), self.object);
        let (dialect, unlock) = (self.access.dialect(), self.access.unlock());
        let bytes = match (dialect, unlock) {
            (None | Some(Dialect::Block | Dialect::Raw | Dialect::Hex), None) => {
                session.upload(object, &mut |_| {})
            }
            _ => read_locked(&mut session, object, dialect, unlock, &mut |event| context.out.detail(event)),
        }
        .map_err(|error| Failure::diagnosed(error, &mut session))?;
        if let Some(path) = &self.output {
            std::fs::write(path, &bytes).map_err(|error| {
                Failure::system(format!("{}: cannot be written: {error}", path.display()))
            })?;
        }
        let shown = match &self.output {
            Some(path) => format!("{} bytes to {}", bytes.len(), path.display()),
            None => show(&bytes, self.kind)?,
        };
        context.out.result(format_args!("node {node}, {object}: {shown}"), || {
            json!({
                "command": "read",
                "node": node.get(),
                "index": object.index,
                "sub": object.sub,
                "size": bytes.len(),
                "hex": self.output.is_none().then(|| hex(&bytes, "")),
                "number": number(&bytes),
                "text": text(&bytes),
                "file": self.output.as_ref().map(|path| path.display().to_string()),
            })
        });
        Ok(())
    }
}

fn show(bytes: &[u8], kind: Kind) -> Result<String, Failure> {
    let as_number =
        || number(bytes).map(|number| format!("{number} ({number:0digits$X}h)", digits = bytes.len() * 2));
    let as_text = || text(bytes).map(|text| format!("{text:?}"));
    let wrong = |what: &str| {
        Failure::usage(format!("{} bytes are no {what}", bytes.len()), "show them with --as hex")
    };
    Ok(match kind {
        Kind::Number => as_number().ok_or_else(|| wrong("number"))?,
        Kind::Text => as_text().ok_or_else(|| wrong("text"))?,
        Kind::Hex => hex(bytes, " "),
        Kind::Auto if bytes.len() <= 4 => as_number().unwrap_or_default(),
        Kind::Auto => as_text().unwrap_or_else(|| hex(bytes, " ")),
    })
}

fn number(bytes: &[u8]) -> Option<u64> {
    if !(1..=8).contains(&bytes.len()) {
        return None;
    }
    Some(bytes.iter().rev().fold(0, |number, byte| number << 8 | u64::from(*byte)))
}

/// The text, if all of it is printable ASCII; a zero may end it.
fn text(bytes: &[u8]) -> Option<String> {
    let bytes = bytes.strip_suffix(&[0]).unwrap_or(bytes);
    let printable = !bytes.is_empty() && bytes.iter().all(|byte| matches!(byte, b' '..=b'~'));
    printable.then(|| bytes.iter().map(|byte| char::from(*byte)).collect())
}

fn hex(bytes: &[u8], between: &str) -> String {
    let pairs: Vec<String> = bytes.iter().map(|byte| format!("{byte:02X}")).collect();
    pairs.join(between)
}

/// `1018/4`, `1018h/4`, `0x1018/0x04`, `100A`.
fn address(words: &str) -> Result<Address, String> {
    let (index, sub) = words.split_once('/').unwrap_or((words, "0"));
    let index = index.strip_prefix("0x").or_else(|| index.strip_prefix("0X")).unwrap_or(index);
    let index = index.strip_suffix(['h', 'H']).unwrap_or(index);
    let wrong = || "an object is a hexadecimal index and a sub-index, like 1018/4".to_string();
    if index.is_empty() || !index.bytes().all(|digit| digit.is_ascii_hexdigit()) {
        return Err(wrong());
    }
    let index = u16::from_str_radix(index, 16).map_err(|_| wrong())?;
    let sub = super::values::number(sub).ok().and_then(|sub| u8::try_from(sub).ok()).ok_or_else(wrong)?;
    Ok(Address::new(index, sub))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn objects_are_an_index_and_a_sub_index() {
        for (words, index, sub) in
            [("1018/4", 0x1018, 4), ("100A", 0x100A, 0), ("1f57h/1", 0x1F57, 1), ("0x1F50/0xFE", 0x1F50, 254)]
        {
            assert_eq!(address(words), Ok(Address::new(index, sub)), "{words}");
        }
        for words in ["", "/1", "10018", "1018/256", "1018/", "name", "+1018", "1018/1/1"] {
            assert!(address(words).is_err(), "{words}");
        }
    }

    #[test]
    fn a_value_is_shown_as_what_it_looks_like() {
        let shown = |bytes: &[u8], kind| show(bytes, kind).map_err(|failure| failure.to_string());
        assert_eq!(shown(&[0x92, 1, 2, 0], Kind::Auto).unwrap(), "131474 (00020192h)");
        assert_eq!(shown(&[7], Kind::Auto).unwrap(), "7 (07h)");
        assert_eq!(shown(b"coboot\0", Kind::Auto).unwrap(), "\"coboot\"");
        assert_eq!(shown(&[1, 2, 3, 4, 0xFF], Kind::Auto).unwrap(), "01 02 03 04 FF");
        assert_eq!(shown(b"abc", Kind::Text).unwrap(), "\"abc\"");
        assert_eq!(
            shown(&[1, 0, 0, 0, 0, 0, 0, 0x80], Kind::Number).unwrap(),
            "9223372036854775809 (8000000000000001h)"
        );
        assert!(shown(&[0; 9], Kind::Number).is_err() && shown(&[1], Kind::Text).is_err());
        assert_eq!(shown(&[], Kind::Auto).unwrap(), "");
    }
}
