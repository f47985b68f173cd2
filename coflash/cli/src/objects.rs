//! The options that name objects, by index and sub-index or by the names of an EDS.

use std::fmt;
use std::io::Read as _;
use std::path::{Path, PathBuf};

use canopen::Address;
use clap::Args;
use coflash_core::device::eds::{Eds, Entry};
use coflash_core::device::value::DataType;
use coflash_core::file::limit::read_text;
use serde_json::{json, Value};

use super::output::Failure;
use super::values::{address, number};

/// The source of objects' names.
#[derive(Debug, Args)]
pub(super) struct Names {
    /// The device's electronic data sheet: objects may be named as in the sheet ("Program
    /// control/1"), and have the data types of the sheet.
    #[arg(long, value_name = "FILE", env = "COFLASH_EDS")]
    eds: Option<PathBuf>,
}

/// An object, with its entry in the EDS if there is one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Object {
    pub(super) at: Address,
    pub(super) entry: Option<Entry>,
}

/// The objects that a file lists.
pub(super) fn list(path: &Path) -> Result<Vec<String>, Failure> {
    let text = read_text(path).map_err(|error| Failure::unreadable(path, &error))?;
    // A number sign may be part of a name, but a blank and a number sign begin a comment.
    let object = |line: &str| {
        let end = line
            .match_indices('#')
            .map(|(at, _)| at)
            .find(|at| line[..*at].trim_end().len() < *at || *at == 0);
        line[..end.unwrap_or(line.len())].trim().to_string()
    };
    let objects: Vec<String> = text.lines().map(object).filter(|object| !object.is_empty()).collect();
    if objects.is_empty() {
        let what = format!("{} lists no object", path.display());
        return Err(Failure::usage(what, "write one object a line, like 1018/4"));
    }
    Ok(objects)
}

/// Reads a file of at most `max` bytes; devices and pipes may never end.
pub(super) fn bytes_of(path: &Path, max: u64) -> Result<Vec<u8>, Failure> {
    let mut bytes = Vec::new();
    let read = std::fs::File::open(path).and_then(|file| file.take(max + 1).read_to_end(&mut bytes));
    read.map_err(|error| Failure::unreadable(path, &error))?;
    if bytes.len() as u64 > max {
        return Err(Failure::file(
            path,
            format_args!("it has more than {max} bytes, the limit for this file"),
        ));
    }
    Ok(bytes)
}

impl Names {
    /// The objects that the user named.
    pub(super) fn objects(&self, words: &[String]) -> Result<Vec<Object>, Failure> {
        let eds = match &self.eds {
            Some(path) => {
                let bytes = bytes_of(path, coflash_core::device::eds::MAX as u64)?;
                Some(Eds::parse(&bytes).map_err(|error| Failure::file(path, error))?)
            }
            None => None,
        };
        let mut objects = Vec::new();
        for word in words {
            for one in spread(word)? {
                objects.push(resolve(&one, eds.as_ref())?);
            }
        }
        Ok(objects)
    }

    /// The single object that the user named.
    pub(super) fn object(&self, word: &str) -> Result<Object, Failure> {
        let several = || Failure::usage(format!("'{word}' is more than one object"), "name one: 1018/4");
        let mut objects = self.objects(&[word.to_string()])?;
        match (objects.pop(), objects.is_empty()) {
            (Some(object), true) => Ok(object),
            _ => Err(several()),
        }
    }
}

impl Object {
    /// Its data type, if it is known.
    pub(super) fn kind(&self) -> Option<DataType> {
        self.entry.as_ref()?.kind
    }

    /// The JSON value.
    pub(super) fn value(&self) -> Value {
        let name = self.entry.as_ref().map(Entry::path);
        json!({ "index": self.at.index, "sub": self.at.sub, "name": name })
    }
}

impl fmt::Display for Object {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.at)?;
        match &self.entry {
            Some(entry) if !entry.name.is_empty() => write!(f, " ({})", entry.path()),
            _ => Ok(()),
        }
    }
}

/// Expands a range: `1018/1..4` is four objects.
fn spread(word: &str) -> Result<Vec<String>, Failure> {
    let range = word.rsplit_once('/').and_then(|(head, subs)| Some((head, subs.split_once("..")?)));
    let Some((head, (first, last))) = range else { return Ok(vec![word.to_string()]) };
    let sub = |text| number(text).ok().and_then(|sub| u8::try_from(sub).ok());
    match (sub(first), sub(last)) {
        (Some(first), Some(last)) if first <= last => {
            Ok((first..=last).map(|sub| format!("{head}/{sub}")).collect())
        }
        _ => {
            let advice = "a range of sub-indices goes from the lower to the higher one, like 1018/1..4";
            Err(Failure::usage(format!("'{word}' is not a range"), advice))
        }
    }
}

fn resolve(word: &str, eds: Option<&Eds>) -> Result<Object, Failure> {
    match (address(word), eds) {
        (Some(at), eds) => Ok(Object { at, entry: eds.and_then(|eds| eds.at(at)).cloned() }),
        (None, Some(eds)) => match eds.find(word) {
            Ok(entry) => Ok(Object { at: entry.at, entry: Some(entry.clone()) }),
            Err(error) => {
                let advice =
                    "name it as the EDS does, with its sub-index: \"Program control/1\"; or give index and \
                              sub-index: 1F51/1";
                Err(Failure::usage(error.to_string(), advice))
            }
        },
        (None, None) => {
            let advice =
                "an object is a hexadecimal index and a sub-index, like 1018/4; names need --eds FILE";
            Err(Failure::usage(format!("'{word}' is not an object"), advice))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_range_is_every_sub_index_of_it() {
        let all = |word| spread(word).map_err(|failure| failure.to_string());
        assert_eq!(all("1018/1..3").unwrap(), ["1018/1", "1018/2", "1018/3"]);
        assert_eq!(all("Gain/2..2").unwrap(), ["Gain/2"]);
        assert_eq!(all("1018/4").unwrap(), ["1018/4"]);
        assert_eq!(all("1018/0..255").unwrap().len(), 256);
        for wrong in ["1018/3..1", "1018/..4", "1018/1..", "1018/1..256", "1018/1..4..5"] {
            assert!(all(wrong).unwrap_err().contains("is not a range"), "{wrong}");
        }
    }
}
