//! The manifest of a package: which programs it has, and for which devices, in the order of the update.

use std::fmt;

use canopen::NodeId;
use seal::wire::BOOTLOADER;
use serde::{Deserialize, Serialize};

use super::fault::{Fault, Limit};
use super::zip::{is_name, MAX_MEMBERS};
use crate::device::Dialect;

/// The name of its member, which is the first one.
pub const NAME: &str = "manifest.json";
/// The word that says what the file is.
const FORMAT: &str = "coboot machine package";
/// The version of the format.
pub const VERSION: u32 = 1;
/// The most programs of a package: the other members are the manifest and the signatures.
pub const MAX_PROGRAMS: usize = MAX_MEMBERS - 2;
/// The most bytes of a manifest.
pub const MAX_SIZE: usize = 64 * 1024;
/// The most characters of a text for people.
const MAX_TEXT: usize = 200;

/// The manifest.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    format: String,
    version: u32,
    /// The machine, for people.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// The release of the package, for people.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub release: Option<String>,
    /// The programs, in the order of the update.
    pub programs: Vec<Entry>,
}

/// A program, and the devices that get it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Entry {
    /// Its name, for people.
    pub name: String,
    /// Its member.
    pub file: String,
    /// The bytes of the member.
    pub size: u64,
    /// SHA-256 of the member, in 64 hexadecimal digits.
    pub sha256: String,
    /// The node-IDs of the devices. Without them, all nodes with the identity.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub nodes: Vec<u8>,
    /// The identity of the devices. Without it, the nodes with these node-IDs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub identity: Option<Identity>,
    /// How many devices there have to be.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub count: Option<u8>,
    /// The program number: 1 to 254, or 255 for the bootloader of the device.
    pub program: u8,
    /// The dialect of the devices; without it, it is detected.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub dialect: Option<String>,
    /// Whether the program is tried before it is released for autostart.
    #[serde(default = "yes")]
    pub trial_run: bool,
    /// Whether the CRC is compared once more at the very end.
    #[serde(default)]
    pub verify: bool,
}

/// The identity of a type of device (1018h).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Identity {
    /// 1018h/1.
    pub vendor: u32,
    /// 1018h/2.
    pub product: u32,
    /// 1018h/3; without it, any revision.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub revision: Option<u32>,
}

/// What every version of the format has.
#[derive(Deserialize)]
struct Head {
    format: String,
    version: u32,
}

const fn yes() -> bool {
    true
}

impl Manifest {
    /// A manifest of this version.
    ///
    /// # Errors
    /// The rule that it breaks.
    pub fn new(name: Option<String>, release: Option<String>, programs: Vec<Entry>) -> Result<Self, Fault> {
        let manifest = Self { format: FORMAT.to_owned(), version: VERSION, name, release, programs };
        manifest.check()?;
        Ok(manifest)
    }

    /// Parses a manifest and checks its values.
    ///
    /// # Errors
    /// [`Fault::Newer`], [`Fault::Limit`], [`Fault::Manifest`], [`Fault::Name`] or [`Fault::TwoPrograms`].
    pub fn parse(bytes: &[u8]) -> Result<Self, Fault> {
        Limit::Manifest.check(bytes.len(), MAX_SIZE)?;
        let invalid = |error: serde_json::Error| Fault::Manifest(printable(&error.to_string()));
        // A later version may have other fields.
        let head: Head = serde_json::from_slice(bytes).map_err(invalid)?;
        if head.format != FORMAT {
            return Err(Fault::Manifest(format!(
                "it is not that of a package: {:?}",
                shortened(&head.format)
            )));
        }
        match head.version {
            0 => return Err(Fault::Manifest("there is no format 0".to_owned())),
            VERSION => {}
            found => return Err(Fault::Newer { found, known: VERSION }),
        }
        let manifest: Self = serde_json::from_slice(bytes).map_err(invalid)?;
        manifest.check()?;
        Ok(manifest)
    }

    /// Its bytes, which are signed.
    #[must_use]
    pub fn emit(&self) -> Vec<u8> {
        // Strings, numbers and lists have a form in JSON.
        let mut text = serde_json::to_string_pretty(self).unwrap_or_default();
        text.push('\n');
        text.into_bytes()
    }

    fn check(&self) -> Result<(), Fault> {
        Limit::Programs.check(self.programs.len(), MAX_PROGRAMS)?;
        if self.programs.is_empty() {
            return Err(Fault::Manifest("it lists no program".to_owned()));
        }
        for text in [&self.name, &self.release].into_iter().flatten() {
            check_text(text)?;
        }
        for (at, entry) in self.programs.iter().enumerate() {
            entry.check()?;
            for earlier in &self.programs[..at] {
                if earlier.name == entry.name || earlier.file.eq_ignore_ascii_case(&entry.file) {
                    let what = format!("two programs have the name or the member of {:?}", entry.name);
                    return Err(Fault::Manifest(what));
                }
                if earlier.conflicts(entry) {
                    return Err(Fault::TwoPrograms {
                        first: earlier.name.clone(),
                        second: entry.name.clone(),
                        number: entry.program,
                        whom: entry.whom(),
                    });
                }
            }
        }
        Ok(())
    }
}

impl Entry {
    fn check(&self) -> Result<(), Fault> {
        check_text(&self.name)?;
        let wrong = |what: &str| Err(Fault::Manifest(format!("{:?}: {what}", self.name)));
        if !is_name(&self.file) {
            return Err(Fault::Name(self.file.clone()));
        }
        Limit::Nodes.check(self.nodes.len(), 127)?;
        let mut sorted = self.nodes.clone();
        sorted.sort_unstable();
        sorted.dedup();
        match () {
            () if self.nodes.is_empty() && self.identity.is_none() => {
                wrong("it has neither nodes nor an identity")
            }
            () if self.nodes.iter().any(|node| NodeId::new(*node).is_none()) => {
                wrong("node-IDs are 1 to 127")
            }
            () if sorted.len() != self.nodes.len() => wrong("it has a node-ID twice"),
            () if self.program == 0 => wrong("programs are 1 to 254, and 255 is the bootloader"),
            () if self.count.is_some() && !self.nodes.is_empty() => wrong("it has nodes and a count"),
            () if self.count == Some(0) => wrong("a count is 1 at least"),
            () if self.is_bootloader() && !self.trial_run => {
                wrong("a bootloader is never installed without its trial")
            }
            () if self.dialect.is_some() && self.dialect().is_none() => wrong("there is no such dialect"),
            () if hash(&self.sha256).is_none() => wrong("its SHA-256 does not have 64 hexadecimal digits"),
            () => Ok(()),
        }
    }

    /// Whether it is the bootloader of the devices.
    #[must_use]
    pub const fn is_bootloader(&self) -> bool {
        self.program == BOOTLOADER
    }

    /// The dialect of the devices, if the package names it.
    #[must_use]
    pub fn dialect(&self) -> Option<Dialect> {
        Dialect::named(self.dialect.as_deref()?)
    }

    /// The hash of its member.
    pub(super) fn hash(&self) -> Option<[u8; 32]> {
        hash(&self.sha256)
    }

    /// Whether each node that one of the two matches can be one that the other matches.
    fn conflicts(&self, other: &Self) -> bool {
        if self.program != other.program {
            return false;
        }
        let (ours, theirs) = (&self.nodes, &other.nodes);
        if !ours.is_empty() && !theirs.is_empty() {
            return ours.iter().any(|node| theirs.contains(node)) && self.meets(other);
        }
        // One with nodes alone and one with an identity alone are compared with the devices of the bus.
        self.identity.is_some() && other.identity.is_some() && self.meets(other)
    }

    /// Whether a device can have the identity of both.
    fn meets(&self, other: &Self) -> bool {
        let (Some(one), Some(other)) = (self.identity, other.identity) else { return true };
        let same = |one: Option<u32>, other: Option<u32>| one.is_none() || other.is_none() || one == other;
        (one.vendor, one.product) == (other.vendor, other.product) && same(one.revision, other.revision)
    }

    /// The devices that get it, in words.
    #[must_use]
    pub fn whom(&self) -> String {
        let nodes: Vec<String> = self.nodes.iter().map(u8::to_string).collect();
        let nodes = match nodes.as_slice() {
            [] => String::new(),
            [node] => format!("node {node}"),
            nodes => format!("nodes {}", nodes.join(", ")),
        };
        match (self.identity, nodes.as_str()) {
            (None, _) => nodes,
            (Some(identity), "") => identity.to_string(),
            (Some(identity), _) => format!("{nodes} ({identity})"),
        }
    }
}

impl fmt::Display for Identity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "vendor {:08X}h, product {:08X}h", self.vendor, self.product)?;
        match self.revision {
            Some(revision) => write!(f, ", revision {revision:08X}h"),
            None => Ok(()),
        }
    }
}

/// The bytes of a SHA-256 in hexadecimal digits.
fn hash(digits: &str) -> Option<[u8; 32]> {
    let is_hash = digits.len() == 64 && digits.bytes().all(|digit| digit.is_ascii_hexdigit());
    let bytes = is_hash.then(|| crate::file::sealed::key::hexadecimal(digits)).flatten()?;
    bytes.try_into().ok()
}

/// A text is shown on terminals, in a line that the user confirms: it has no control characters, and none that
/// is invisible or changes the direction of the text.
fn check_text(text: &str) -> Result<(), Fault> {
    if text.is_empty() || text.chars().count() > MAX_TEXT || text.chars().any(changes_line) {
        let what =
            format!("a name has 1 to {MAX_TEXT} characters and none for control: {:?}", shortened(text));
        return Err(Fault::Manifest(what));
    }
    Ok(())
}

fn changes_line(letter: char) -> bool {
    letter.is_control()
        || matches!(letter, '\u{200B}'..='\u{200F}' | '\u{2028}'..='\u{202E}' | '\u{2060}'..='\u{206F}' | '\u{FEFF}')
}

/// A message with the name of a field of the file, which may have any characters.
fn printable(text: &str) -> String {
    text.chars()
        .map(|letter| if changes_line(letter) { char::REPLACEMENT_CHARACTER } else { letter })
        .collect()
}

/// The beginning of a text from a file, for a message.
fn shortened(text: &str) -> String {
    text.chars().take(40).collect()
}
