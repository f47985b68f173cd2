//! `coflash read`: reads the values of objects.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use coflash_core::advice::Advice;
use coflash_core::device::value::visible;
use coflash_core::device::{Dialect, Session};
use coflash_core::update::dialect::read_locked;
use serde_json::{json, Value};

use super::context::Context;
use super::device::Device;
use super::dialect::Access;
use super::objects::{self, Names, Object};
use super::output::{Exit, Failure};
use super::output_file;
use super::units::hex;

/// Reads objects; a program if the device allows it.
///
/// An object is a hexadecimal index and, after a slash, a decimal sub-index: 1018/4, or 100A for
/// sub-index 0. 1018/1..4 is a range of sub-indices. With --eds an object may be named: "Program
/// control/1". If the device refuses one object, the others are still read.
///
/// 1F50/1 is a program. With --unlock the tool calls a lift device into its bootloader, unlocks it and restarts it
/// afterwards, so that you can save its program (1F50/1) and its parameter set (1F50/2).
#[derive(Debug, Args)]
pub(super) struct Read {
    /// The objects: INDEX, INDEX/SUB, INDEX/FIRST..LAST, or names with --eds.
    #[arg(value_name = "OBJECT", required_unless_present = "file")]
    objects: Vec<String>,

    /// Read the objects in this file, one on each line; # begins a comment.
    #[arg(long, value_name = "LIST")]
    file: Option<PathBuf>,

    #[command(flatten)]
    names: Names,

    #[command(flatten)]
    device: Device,

    #[command(flatten)]
    access: Access,

    /// The form of the values.
    #[arg(long = "as", value_name = "KIND", default_value = "auto", value_enum)]
    kind: Kind,

    /// Write the bytes of a single object to this file instead.
    #[arg(long, short, value_name = "FILE")]
    output: Option<PathBuf>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Kind {
    /// Up to four bytes as a number, printable bytes as text, anything else as bytes.
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
        let mut words = self.objects.clone();
        if let Some(list) = &self.file {
            words.extend(objects::list(list)?);
        }
        let objects = self.names.objects(&words)?;
        if let (Some(_), [_, _, ..]) = (&self.output, objects.as_slice()) {
            let advice = "read one object at a time with --output";
            return Err(Failure::usage("--output takes only one object", advice));
        }
        self.output.as_deref().map_or(Ok(()), output_file::ready)?;
        let mut link = context.link()?;
        let mut session = self.device.session(&mut link)?;
        let node = session.node().get();
        let mut values = Vec::new();
        let mut refused = None;
        for object in &objects {
            match self.one(context, &mut session, object) {
                Ok(value) => values.push(value),
                // The next object may be readable.
                Err(failure) if objects.len() > 1 && failure.exit == Exit::Device => {
                    if !context.out.for_programs() {
                        context.out.failure(&failure);
                    }
                    let mut value = object.value();
                    value["error"] = failure.value()["error"].clone();
                    values.push(value);
                    refused.get_or_insert(failure);
                }
                Err(failure) => return Err(failure),
            }
        }
        if session.is_answered_twice().unwrap_or_default() {
            context.out.warn(Advice::TwoDevices { node: session.node() });
        }
        match values.as_mut_slice() {
            [value] if objects.len() == 1 => {
                value["node"] = node.into();
                context.value(std::mem::take(value));
            }
            values => context.value(json!({ "node": node, "objects": values })),
        }
        match refused {
            None => Ok(()),
            Some(first) => {
                let failed = values.iter().filter(|value| value.get("error").is_some()).count();
                Err(Failure::unread(&first, failed, objects.len()))
            }
        }
    }

    /// Reads one object and shows it to people; returns the JSON value.
    fn one(&self, context: &Context, session: &mut Session<'_>, object: &Object) -> Result<Value, Failure> {
        let (node, at) = (session.node(), object.at);
        let (dialect, unlock) = (self.access.dialect(), self.access.unlock());
        let waiting = context.waiting(format!("{at} of node {node} has been read"));
        let bytes = match (dialect, unlock) {
            (dialect, None) if !dialect.is_some_and(Dialect::has_password) => session.upload(at, &mut |_| {}),
            _ => read_locked(session, at, dialect, unlock, &mut |event| context.out.detail(event)),
        }
        .map_err(|error| Failure::diagnosed(error, session))?;
        drop(waiting);
        if let Some(path) = &self.output {
            output_file::write(path, &bytes)?;
        }
        let typed = || object.kind().filter(|_| self.kind == Kind::Auto)?.show(&bytes);
        let shown = match &self.output {
            Some(path) => format!("{} bytes to {}", bytes.len(), path.display()),
            None => match typed() {
                Some(shown) => shown,
                None => show(&bytes, self.kind)?,
            },
        };
        context.out.say(format_args!("node {node}, {object}: {shown}"));
        let mut value = object.value();
        value["size"] = bytes.len().into();
        value["hex"] = self.output.is_none().then(|| hex(&bytes, "")).into();
        value["number"] = number(&bytes).into();
        value["text"] = visible(&bytes).into();
        value["file"] = self.output.as_ref().map(|path| path.display().to_string()).into();
        Ok(value)
    }
}

fn show(bytes: &[u8], kind: Kind) -> Result<String, Failure> {
    let as_number =
        || number(bytes).map(|number| format!("{number} ({number:0digits$X}h)", digits = bytes.len() * 2));
    let as_text = || visible(bytes).map(|text| format!("{text:?}"));
    let wrong = |what: &str| {
        Failure::usage(format!("{} bytes are not a {what}", bytes.len()), "show them with --as hex")
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

#[cfg(test)]
mod tests {
    use super::*;

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
