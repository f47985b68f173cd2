//! Electronic data sheets (CiA 306-1): names, types and access of a device's objects.
//!
//! The source of a sheet is not trusted: a sheet that is too large, that is not an INI file or that
//! has no objects is an error. An invalid entry of a single object removes only that object's type
//! or limits.

use std::collections::{BTreeMap, HashMap};

use canopen::Address;
use configparser::ini::Ini;

use super::value::{integer, DataType};
use crate::unicode;

/// The most bytes of a sheet. Sheets of drives with hundreds of objects have about 300 KiB.
pub const MAX: usize = 8 * 1024 * 1024;

/// The objects of a data sheet.
#[derive(Clone, Debug, Default)]
pub struct Eds {
    objects: BTreeMap<(u16, u8), Entry>,
}

/// One object, or one sub-index of an object.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Entry {
    /// Index and sub-index.
    pub at: Address,
    /// Its name, in printable characters.
    pub name: String,
    /// The name of the record or array that contains it.
    pub within: Option<String>,
    /// Its data type; `None` if this tool has no notation for the type.
    pub kind: Option<DataType>,
    /// Whether it may be written.
    pub writable: bool,
    /// The lowest permitted value, if the sheet gives it.
    pub low: Option<i128>,
    /// The highest permitted value, if the sheet gives it.
    pub high: Option<i128>,
}

/// What is wrong with a data sheet.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum EdsError {
    /// It has more than [`MAX`] bytes.
    #[error("it is larger than {} MiB: it is not a data sheet", MAX / (1024 * 1024))]
    TooLarge,
    /// It is not an INI file.
    #[error("it is not an EDS: {0}")]
    Syntax(String),
    /// It contains no object.
    #[error("it is not an EDS: none of its sections is an object, like [1018] or [1018sub1]")]
    NoObjects,
}

/// Why a name selects no object.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum NoObject {
    /// No object has this name.
    #[error("the EDS has no object '{name}'{}", like(.near))]
    Unknown {
        /// The name.
        name: String,
        /// Similar names, which contain it.
        near: Vec<String>,
    },
    /// Several objects have this name.
    #[error("several objects are called '{name}': {}", .all.join(", "))]
    Ambiguous {
        /// The name.
        name: String,
        /// Their addresses.
        all: Vec<String>,
    },
}

fn like(near: &[String]) -> String {
    match near {
        [] => String::new(),
        near => format!("; there is {}", near.join(", ")),
    }
}

/// The most similar names in a message.
const NEAR: usize = 6;

impl Entry {
    /// The full name, which selects only this object: `Identity object/Serial number`.
    #[must_use]
    pub fn path(&self) -> String {
        match &self.within {
            Some(record) => format!("{record}/{}", self.name),
            None => self.name.clone(),
        }
    }
}

impl Eds {
    /// Parses a data sheet: UTF-8, UTF-16 with a byte order mark, or Windows-1252, in which most editors
    /// of data sheets write.
    ///
    /// # Errors
    /// [`EdsError`].
    pub fn parse(bytes: &[u8]) -> Result<Self, EdsError> {
        if bytes.len() > MAX {
            return Err(EdsError::TooLarge);
        }
        let mut ini = Ini::new();
        let mut form = ini.defaults();
        form.delimiters = vec!['='];
        form.comment_symbols = vec![';'];
        // "Motor 1; speed" is a valid name.
        form.inline_comment_symbols = Some(Vec::new());
        ini.load_defaults(form);
        let sections = ini.read(text_of(bytes)).map_err(EdsError::Syntax)?;
        let mut eds = Self::default();
        for (name, keys) in &sections {
            let Some((head, rest)) = name.split_at_checked(4) else { continue };
            let Some(index) = hex16(head) else { continue };
            if rest.is_empty() {
                eds.object(index, keys, &sections);
                continue;
            }
            let sub = rest.strip_prefix("sub").and_then(hex16).and_then(|sub| u8::try_from(sub).ok());
            if let Some(sub) = sub {
                let within = sections.get(head).map(parameter_name);
                eds.objects.insert((index, sub), entry(Address::new(index, sub), within, keys));
            }
        }
        if eds.objects.is_empty() {
            return Err(EdsError::NoObjects);
        }
        Ok(eds)
    }

    /// Adds the object of a section without sub-index: a variable, an array in short form, or the
    /// head of an object with further sections.
    fn object(&mut self, index: u16, keys: &Keys, sections: &HashMap<String, Keys>) {
        let variable =
            !matches!(number(keys, "objecttype"), Some(0x8 | 0x9)) && number(keys, "subnumber").is_none();
        if variable {
            self.objects.insert((index, 0), entry(Address::new(index, 0), None, keys));
            return;
        }
        let Some(count) = number(keys, "compactsubobj").and_then(|count| u8::try_from(count).ok()) else {
            return;
        };
        let names = sections.get(&format!("{index:04x}name"));
        for sub in 1..=count {
            let given = names.and_then(|names| names.get(&sub.to_string())?.clone());
            let record = parameter_name(keys);
            let name = given.map_or_else(|| format!("{record}{sub}"), |name| printable(&name));
            let mut entry = entry(Address::new(index, sub), Some(record), keys);
            entry.name = name;
            // A section for this sub-index takes precedence.
            if !sections.contains_key(&format!("{index:04x}sub{sub:x}")) {
                self.objects.insert((index, sub), entry);
            }
        }
    }

    /// The object at this address.
    #[must_use]
    pub fn at(&self, at: Address) -> Option<&Entry> {
        self.objects.get(&(at.index, at.sub))
    }

    /// Finds an object by its name, in upper or lower case: the name of a variable, `RECORD/SUB`
    /// with the number or the name of the sub-index, or the name of a sub-index that only one
    /// object has.
    ///
    /// # Errors
    /// [`NoObject`].
    pub fn find(&self, name: &str) -> Result<&Entry, NoObject> {
        let wanted = name.trim().to_lowercase();
        let exact = |entry: &&Entry| {
            let by_number = entry.within.as_ref().map(|record| format!("{record}/{}", entry.at.sub));
            entry.path().to_lowercase() == wanted
                || by_number.is_some_and(|path| path.to_lowercase() == wanted)
        };
        let mut found: Vec<&Entry> = self.objects.values().filter(exact).collect();
        if found.is_empty() {
            found = self.objects.values().filter(|entry| entry.name.to_lowercase() == wanted).collect();
        }
        match found.as_slice() {
            [entry] => Ok(entry),
            [] => {
                let near = self.objects.values().map(Entry::path);
                let near = near.filter(|path| !wanted.is_empty() && path.to_lowercase().contains(&wanted));
                let near = near.take(NEAR).map(|path| format!("'{path}'")).collect();
                Err(NoObject::Unknown { name: name.to_string(), near })
            }
            several => {
                let all = several.iter().take(NEAR).map(|entry| format!("{} ('{}')", entry.at, entry.path()));
                Err(NoObject::Ambiguous { name: name.to_string(), all: all.collect() })
            }
        }
    }
}

/// The text of a sheet, with LF at the end of each line. CiA 306-1 wants ASCII, and does not name
/// another encoding.
fn text_of(bytes: &[u8]) -> String {
    let text = unicode::text(bytes).unwrap_or_else(|| bytes.iter().copied().map(windows_1252).collect());
    text.replace("\r\n", "\n").replace('\r', "\n")
}

/// A character of Windows-1252: ISO 8859-1 with other characters from 80h to 9Fh (Unicode's mapping
/// file CP1252.TXT). The five bytes without a character stay the controls that they are there.
fn windows_1252(byte: u8) -> char {
    const FROM_80H: [char; 32] = [
        '€', '\u{81}', '‚', 'ƒ', '„', '…', '†', '‡', 'ˆ', '‰', 'Š', '‹', 'Œ', '\u{8d}', 'Ž', '\u{8f}',
        '\u{90}', '‘', '’', '“', '”', '•', '–', '—', '˜', '™', 'š', '›', 'œ', '\u{9d}', 'ž', 'Ÿ',
    ];
    match byte {
        0x80..=0x9F => FROM_80H[usize::from(byte - 0x80)],
        byte => char::from(byte),
    }
}

/// The keys of a section, in lower case.
type Keys = HashMap<String, Option<String>>;

fn entry(at: Address, within: Option<String>, keys: &Keys) -> Entry {
    let access = keys.get("accesstype").cloned().flatten().unwrap_or_default().to_lowercase();
    Entry {
        at,
        name: parameter_name(keys),
        within,
        kind: number(keys, "datatype")
            .and_then(|index| u32::try_from(index).ok())
            .and_then(DataType::from_index),
        writable: !matches!(access.as_str(), "ro" | "const"),
        low: number(keys, "lowlimit"),
        high: number(keys, "highlimit"),
    }
}

fn parameter_name(keys: &Keys) -> String {
    printable(keys.get("parametername").and_then(Option::as_deref).unwrap_or_default())
}

/// Names are shown on terminals: control characters are replaced.
fn printable(text: &str) -> String {
    text.trim().chars().map(|c| if c.is_control() { '?' } else { c }).collect()
}

/// `None` for a value that is not a number, such as `$NODEID+0x600`.
fn number(keys: &Keys, key: &str) -> Option<i128> {
    integer(keys.get(key)?.as_deref()?.trim())
}

fn hex16(digits: &str) -> Option<u16> {
    let all = !digits.is_empty() && digits.bytes().all(|digit| digit.is_ascii_hexdigit());
    all.then(|| u16::from_str_radix(digits, 16).ok()).flatten()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The format of CiA 306-1, with features of sheets in the field: capitals anywhere, blanks, a
    /// name with a number sign, an array in short form.
    const SHEET: &[u8] = b"; a comment\n[FileInfo]\nFileName=x.eds\n\n[1000]\nParameterName=Device type\n\
        ObjectType=0x7\nDataType=0x0007\nAccessType=ro\n\
        [1017]\nPARAMETERNAME = Producer heartbeat time\nobjecttype=7\nDataType=6\nAccessType=rw\n\
        LowLimit=10\nHighLimit=0x7FFF\n\
        [1018]\nParameterName=Identity object\nObjectType=0x9\nSubNumber=3\n\
        [1018sub0]\nParameterName=Highest sub-index\nObjectType=0x7\nDataType=0x0005\nAccessType=const\n\
        [1018Sub1]\nParameterName=Vendor-ID\nObjectType=0x7\nDataType=0x0007\nAccessType=ro\n\
        [1018sub4]\nParameterName=Serial number\nObjectType=0x7\nDataType=0x0007\nAccessType=ro\n\
        [2000]\nParameterName=Motor #1; speed = max\nObjectType=0x7\nDataType=0x0003\nAccessType=rww\nLowLimit=$NODEID+1\n\
        [2001]\nParameterName=Gain\nObjectType=0x8\nDataType=0x0008\nAccessType=rw\nCompactSubObj=3\n\
        [2001Name]\nNrOfEntries=1\n2=Gain of the middle\n\
        [2002]\nParameterName=Other\nObjectType=0x9\nSubNumber=1\n\
        [2002subA]\nParameterName=Serial number\nDataType=0x0009\n";

    fn address(index: u16, sub: u8) -> Address {
        Address::new(index, sub)
    }

    #[test]
    fn objects_are_found_by_name() {
        let eds = Eds::parse(SHEET).unwrap();
        for (name, at) in [
            ("Device type", address(0x1000, 0)),
            ("producer HEARTBEAT time", address(0x1017, 0)),
            ("Identity object/1", address(0x1018, 1)),
            ("Identity object/Serial number", address(0x1018, 4)),
            ("Vendor-ID", address(0x1018, 1)),
            ("Motor #1; speed = max", address(0x2000, 0)),
            ("Gain/3", address(0x2001, 3)),
            ("Gain/Gain of the middle", address(0x2001, 2)),
            ("Other/10", address(0x2002, 10)),
        ] {
            assert_eq!(eds.find(name).map(|entry| entry.at), Ok(at), "{name}");
        }
        let error = eds.find("Serial number").unwrap_err().to_string();
        assert!(error.contains("1018h/4 ('Identity object/Serial number'), 2002h/10"), "{error}");
        let error = eds.find("identity").unwrap_err().to_string();
        assert!(
            error.contains("no object 'identity'; there is 'Identity object/Highest sub-index'"),
            "{error}"
        );
        assert!(eds.find("").is_err() && eds.find("Gain/4").is_err());
    }

    #[test]
    fn types_access_and_limits_are_the_sheets() {
        let eds = Eds::parse(SHEET).unwrap();
        let heartbeat = eds.at(address(0x1017, 0)).unwrap();
        assert_eq!((heartbeat.kind, heartbeat.writable), (Some(DataType::Unsigned(2)), true));
        assert_eq!((heartbeat.low, heartbeat.high), (Some(10), Some(0x7FFF)));
        let vendor = eds.at(address(0x1018, 1)).unwrap();
        assert_eq!((vendor.kind, vendor.writable), (Some(DataType::Unsigned(4)), false));
        let speed = eds.at(address(0x2000, 0)).unwrap();
        assert_eq!((speed.kind, speed.low), (Some(DataType::Integer(2)), None));
        assert_eq!(eds.at(address(0x2001, 1)).unwrap().kind, Some(DataType::Real32));
        assert_eq!(eds.at(address(0x1018, 9)), None);
    }

    /// The bytes of each encoding by Python's `encode`: cp1252, utf-8, utf-8-sig, utf-16.
    #[test]
    fn a_name_is_read_in_the_encoding_that_its_editor_wrote() {
        const HEAD: &[u8] =
            b"[1018]\nParameterName=Identity object\nSubNumber=1\nObjectType=9\n[1018sub1]\nParameterName=";
        let sheet = |name: &[u8]| [HEAD, name, b"\nDataType=7\n"].concat();
        let wide = |mark: [u8; 2], of: fn(u16) -> [u8; 2]| {
            let text = String::from_utf8(sheet("Größe in €".as_bytes())).unwrap();
            mark.into_iter().chain(text.encode_utf16().flat_map(of)).collect::<Vec<u8>>()
        };
        for (name, bytes) in [
            ("Vendor-ID ü", sheet(b"Vendor-ID \xFC")),
            ("Größe in €", sheet(b"Gr\xF6\xDFe in \x80")),
            ("‚Š’ – 10 °C", sheet(b"\x82\x8A\x92 \x96 10 \xB0C")),
            ("Vendor-ID ü", sheet(b"Vendor-ID \xC3\xBC")),
            ("Vendor-ID", [b"\xEF\xBB\xBF", &sheet(b"Vendor-ID")[..]].concat()),
            ("Größe in €", wide([0xFF, 0xFE], u16::to_le_bytes)),
            ("Größe in €", wide([0xFE, 0xFF], u16::to_be_bytes)),
        ] {
            let eds = Eds::parse(&bytes).unwrap();
            let path = format!("Identity object/{name}");
            assert_eq!(eds.find(&path).map(|entry| entry.at), Ok(address(0x1018, 1)), "{name}");
            assert_eq!(eds.find(name).map(|entry| entry.at), Ok(address(0x1018, 1)), "{name}");
        }
    }

    #[test]
    fn a_sheet_has_any_line_end() {
        for end in ["\n", "\r\n", "\r"] {
            let sheet = "[1018]\nParameterName=Identity\nObjectType=7\nDataType=7\n".replace('\n', end);
            let eds = Eds::parse(sheet.as_bytes()).unwrap();
            assert_eq!(eds.find("Identity").map(|entry| entry.at), Ok(address(0x1018, 0)), "{end:?}");
        }
    }

    #[test]
    fn a_sheet_that_is_none_is_an_error() {
        for bytes in
            [&b""[..], b"hello", b"[1000", b"<html>\n</html>", &[0xFF; 64], b"\0\0\0\0", b"[FileInfo]\na=b\n"]
        {
            assert!(Eds::parse(bytes).is_err(), "{:?}", String::from_utf8_lossy(bytes));
        }
        assert_eq!(Eds::parse(&vec![b'a'; MAX + 1]).unwrap_err(), EdsError::TooLarge);
        // An invalid object is left out.
        let odd = b"[1000]\nParameterName=A\x1B[2J\nDataType=0xFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFF\n[1018sub100]\n\
                    ParameterName=B\n[10sub]\n[1018subx]\n[\xC3\xA4\xC3\xB6\xC3\xBC]\n[2001]\nObjectType=8\nCompactSubObj=900\n";
        let eds = Eds::parse(odd).unwrap();
        assert_eq!(
            eds.at(address(0x1000, 0)).map(|entry| (entry.name.as_str(), entry.kind)),
            Some(("A?[2J", None))
        );
        assert_eq!(eds.objects.len(), 1);
    }
}
