//! The job file of `coflash flash --job`: the devices and their programs.

use std::path::{Path, PathBuf};

use canopen::NodeId;
use serde::Deserialize;

use super::toml_line::line_of;
use crate::device::lss::LssAddress;
use crate::file::board::in_folder;

/// A job file. The settings at its top apply to every device without a setting of its own.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
struct File {
    #[serde(flatten)]
    defaults: Settings,
    #[serde(default, rename = "device")]
    devices: Vec<Device>,
}

/// The settings for all devices, or for one device.
#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub struct Settings {
    /// The firmware file, relative to the job file's folder.
    pub image: Option<PathBuf>,
    /// The board: its name, or the file with its memory map, relative to the job file's folder.
    pub board: Option<String>,
    /// The program's number, 1 to 254.
    pub program: Option<u8>,
    /// Compare the device's identity before the update.
    pub check_target: Option<bool>,
    /// Start the program once and call it back before it is released for autostart.
    pub trial_run: Option<bool>,
    /// Start the program at the end.
    pub start: Option<bool>,
    /// Compare the CRC once more at the very end.
    pub verify: Option<bool>,
}

#[derive(Debug, Deserialize)]
struct Device {
    node: Option<u8>,
    lss: Option<Lss>,
    #[serde(flatten)]
    settings: Settings,
    /// Unknown settings: serde cannot refuse them in flattened structures.
    #[serde(flatten)]
    unknown: toml::Table,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Lss {
    vendor: u32,
    product: u32,
    revision: u32,
    serial: u32,
}

/// One device of a job file, with the file's defaults applied.
#[derive(Debug)]
#[non_exhaustive]
pub struct Entry {
    /// Its node-ID, or the node-ID to set.
    pub node: Option<NodeId>,
    /// Its LSS address, if the file names it by that.
    pub address: Option<LssAddress>,
    /// The settings of its update.
    pub settings: Settings,
}

/// An error in a job file, with its place.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Fault {
    /// In this line.
    #[error("line {0}: {1}")]
    Line(usize, String),
    /// In the device of this number, counted from 1.
    #[error("device {0}: {1}")]
    Device(usize, String),
}

/// Parses a job file in this folder. The result has at least one device. Each device has an image,
/// and a unique node-ID or LSS address.
///
/// # Errors
/// The first error in the file.
pub fn parse(text: &str, folder: &Path) -> Result<Vec<Entry>, Fault> {
    let file: File = toml::from_str(text)
        .map_err(|error| Fault::Line(line_of(text, &error), error.message().to_string()))?;
    let File { defaults, devices } = file;
    let mut entries: Vec<Entry> = Vec::new();
    for (number, device) in (1..).zip(devices) {
        let wrong = |what: String| Fault::Device(number, what);
        if let Some(key) = device.unknown.keys().find(|key| !SETTINGS.contains(&key.as_str())) {
            return Err(wrong(format!("there is no setting '{key}'")));
        }
        let node = match device.node {
            None => None,
            Some(number) => {
                Some(NodeId::new(number).ok_or_else(|| wrong("node-IDs are 1 to 127".to_string()))?)
            }
        };
        let address = device.lss.map(|lss| LssAddress {
            vendor_id: lss.vendor,
            product_code: lss.product,
            revision: lss.revision,
            serial_number: lss.serial,
        });
        if node.is_none() && address.is_none() {
            return Err(wrong("it has neither node nor lss".to_string()));
        }
        let same = |entry: &Entry| {
            (node.is_some() && entry.node == node) || (address.is_some() && entry.address == address)
        };
        if entries.iter().any(same) {
            return Err(wrong("the list contains it twice".to_string()));
        }
        let own = device.settings;
        let image = own.image.or_else(|| defaults.image.clone());
        let settings = Settings {
            image: Some(folder.join(image.ok_or_else(|| wrong("it has no image".to_string()))?)),
            board: own.board.as_ref().or(defaults.board.as_ref()).map(|word| in_folder(word, folder)),
            program: own.program.or(defaults.program),
            check_target: own.check_target.or(defaults.check_target),
            trial_run: own.trial_run.or(defaults.trial_run),
            start: own.start.or(defaults.start),
            verify: own.verify.or(defaults.verify),
        };
        if settings.program.is_some_and(|program| !(1..=254).contains(&program)) {
            return Err(wrong("programs are 1 to 254".to_string()));
        }
        entries.push(Entry { node, address, settings });
    }
    if entries.is_empty() {
        return Err(Fault::Line(1, "it names no device: write a [[device]] for each".to_string()));
    }
    Ok(entries)
}

/// The names of [`Settings`]: serde also puts these into the table of unknown settings.
const SETTINGS: [&str; 7] = ["image", "board", "program", "check-target", "trial-run", "start", "verify"];

#[cfg(test)]
mod tests {
    use super::*;

    fn job(text: &str) -> Result<Vec<Entry>, String> {
        parse(text, Path::new("folder")).map_err(|fault| fault.to_string())
    }

    #[test]
    fn devices_have_their_own_settings_or_the_files() {
        let entries = job("image = 'a.elf'\ntrial-run = true\nprogram = 2\n[[device]]\nnode = 5\n\
                           [[device]]\nlss = { vendor = 0x3F, product = 1, revision = 2, serial = 3 }\n\
                           node = 6\nimage = '/b.elf'\ntrial-run = false\n")
        .unwrap();
        let [first, second] = entries.as_slice() else { panic!("{entries:?}") };
        assert_eq!((first.node, first.address), (NodeId::new(5), None));
        assert_eq!(first.settings.image.as_deref(), Some(Path::new("folder/a.elf")));
        assert_eq!((first.settings.trial_run, first.settings.program), (Some(true), Some(2)));
        assert_eq!(second.settings.image.as_deref(), Some(Path::new("/b.elf")));
        assert_eq!((second.settings.trial_run, second.settings.program), (Some(false), Some(2)));
        let address = LssAddress { vendor_id: 0x3F, product_code: 1, revision: 2, serial_number: 3 };
        assert_eq!((second.node, second.address), (NodeId::new(6), Some(address)));
    }

    #[test]
    fn a_fault_is_named_with_its_place() {
        for (text, words) in [
            ("", "line 1: it names no device"),
            ("image = 'a'\n\nimage = 'b'\n", "line 3: "),
            ("image = 5\n", "line 1: "),
            ("[[device]]\nnode = 5\n", "device 1: it has no image"),
            ("image = 'a'\n[[device]]\n", "device 1: it has neither node nor lss"),
            ("image = 'a'\n[[device]]\nnode = 128\n", "device 1: node-IDs are 1 to 127"),
            ("image = 'a'\n[[device]]\nnode = 300\n", "line "),
            ("image = 'a'\nprogram = 255\n[[device]]\nnode = 1\n", "device 1: programs are 1 to 254"),
            (
                "image = 'a'\n[[device]]\nnode = 1\n[[device]]\nnode = 1\n",
                "device 2: the list contains it twice",
            ),
            ("image = 'a'\n[[device]]\nnode = 1\nspeed = 2\n", "device 1: there is no setting 'speed'"),
            ("speed = 2\nimage = 'a'\n[[device]]\nnode = 1\n", "speed"),
            ("image = 'a'\n[[device]]\nlss = { vendor = 1 }\n", "product"),
        ] {
            let error = job(text).unwrap_err();
            assert!(error.contains(words), "{text:?}: {error}");
        }
    }
}
