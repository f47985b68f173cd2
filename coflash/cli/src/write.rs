//! `coflash write`: writes a value into an object.

use std::path::Path;

use clap::builder::PossibleValuesParser;
use clap::error::ErrorKind;
use clap::Args;
use coboot_can::redact::is_password;
use coflash_core::device::session::UPLOAD_MAX;
use coflash_core::device::value::DataType;
use coflash_core::device::Doing;

use super::context::Context;
use super::device::Device;
use super::objects::{bytes_of, Names, Object};
use super::output::Failure;
use super::secrets::HIDDEN;
use super::values::address;

/// The type with the name of a file as its value.
const FROM_FILE: &str = "domain-from-file";

/// Writes a value into an object.
///
/// The value is checked against the type before anything is sent; a refusal of the device is shown
/// with its reason. Numbers are in C notation (4096, 0x1000, octal 010000), optionally with a minus
/// sign.
#[derive(Debug, Args)]
pub(super) struct Write {
    /// The object: hexadecimal index and decimal sub-index, like 1017 or 1F51/1, or its name with
    /// --eds.
    #[arg(value_name = "OBJECT")]
    object: String,

    /// The value: a number, true or false, a text, bytes like "DE AD BE EF", or the name of a file
    /// with --type domain-from-file.
    #[arg(allow_hyphen_values = true)]
    value: String,

    /// The value's type; by default the type in the EDS.
    #[arg(long = "type", value_name = "TYPE", value_parser = PossibleValuesParser::new(
        DataType::names().chain([FROM_FILE])))]
    kind: Option<String>,

    #[command(flatten)]
    names: Names,

    #[command(flatten)]
    device: Device,
}

impl Write {
    /// The words that may be a password. What an object with a name is, only the sheet says, and
    /// both words may have been exchanged.
    pub(super) fn passwords(&self) -> Vec<&str> {
        match address(&self.object) {
            Some(at) if !is_password(at) => Vec::new(),
            Some(_) => vec![&self.value],
            None => vec![&self.value, &self.object],
        }
    }

    pub(super) fn run(&self, context: &Context) -> Result<(), Failure> {
        // The word may be the password, if both were exchanged.
        let object = self.names.object(&self.object);
        let object = object.map_err(|failure| failure.quoting(ErrorKind::InvalidValue))?;
        let bytes = self.bytes(&object)?;
        let mut link = context.link()?;
        let mut session = self.device.session(&mut link)?;
        let waiting = context.waiting(format!("{} of node {} has been written", object.at, session.node()));
        session
            .write(object.at, &bytes, Doing::Write(object.at), &mut |_| {})
            .map_err(|error| Failure::diagnosed(error, &mut session))?;
        drop(waiting);
        let node = session.node();
        let (size, plural) = (bytes.len(), if bytes.len() == 1 { "" } else { "s" });
        context.result(format_args!("node {node}, {object}: written, {size} byte{plural}"), || {
            let mut value = object.value();
            value["node"] = node.get().into();
            value["size"] = size.into();
            value
        });
        Ok(())
    }

    /// The bytes to send, after every check that needs no device.
    fn bytes(&self, object: &Object) -> Result<Vec<u8>, Failure> {
        if let Some(entry) = object.entry.as_ref().filter(|entry| !entry.writable) {
            let advice =
                "name an object that may be written; if the sheet is wrong, leave --eds out and give --type";
            return Err(Failure::usage(
                format!("{}, '{}', is read-only by the EDS", entry.at, entry.path()),
                advice,
            ));
        }
        let kind = match self.kind.as_deref() {
            Some(FROM_FILE) => return from_file(Path::new(&self.value)),
            Some(name) => DataType::by_name(name),
            None => object.kind(),
        };
        let Some(kind) = kind else {
            let advice = "give --type u8, u16, u32, string and so on, or --eds FILE, which knows it";
            return Err(Failure::usage(format!("the type of {object} is unknown"), advice));
        };
        let refused = |mut why: String| {
            // Messages go into records.
            if is_password(object.at) && !self.value.is_empty() {
                why = why.replace(&self.value, HIDDEN);
            }
            Failure::usage(
                format!("{object}: {why}"),
                "nothing was sent; give a value that the object accepts",
            )
        };
        let bytes = kind.encode(&self.value).map_err(|error| refused(error.to_string()))?;
        if let (Some(entry), Some(number)) =
            (&object.entry, coflash_core::device::value::integer(&self.value))
        {
            let (low, high) = (entry.low.unwrap_or(i128::MIN), entry.high.unwrap_or(i128::MAX));
            if kind.range().is_some() && !(low..=high).contains(&number) {
                let limit = |limit: Option<i128>| limit.map_or("any".to_string(), |limit| limit.to_string());
                let (low, high) = (limit(entry.low), limit(entry.high));
                return Err(refused(format!(
                    "{} is outside the limits of the EDS: {low} to {high}",
                    self.value
                )));
            }
        }
        Ok(bytes)
    }
}

fn from_file(path: &Path) -> Result<Vec<u8>, Failure> {
    let bytes = bytes_of(path, UPLOAD_MAX as u64)?;
    if bytes.is_empty() {
        return Err(Failure::file(path, "it is empty, and an empty value cannot be written"));
    }
    Ok(bytes)
}
