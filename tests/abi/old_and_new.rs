//! What a reader of today makes of an older record, of one of the future, and of noise. The rules are
//! those on the page of `shared-abi`.

use shared_abi::check_word;

use crate::layout::{golden, named, read, word};

/// What a reader makes of a record.
enum Expected {
    /// The same as of the golden one.
    Same,
    /// That, with these words replaced.
    But(&'static [(&'static str, &'static str)]),
    /// This.
    Is(&'static str),
}
use Expected::{But, Is, Same};

/// A golden record, what is else in it, the words that are changed, and what its reader makes of it.
type Row = (&'static str, &'static str, &'static [(usize, u32)], Expected);

const CELL: &str = "warm-start cell: answer owed";
const HEADER: &str = "RAM image header";
const SERVICES: &str = "services and facts";
const JOURNAL: &str = "journal: header";
const PROGRAM: &str = "journal: program, released and confirmed";
const RAM_IMAGE: &str = "journal: RAM image, staged";
const NODE: &str = "journal: node-ID and bit rate";

/// Without what later versions have added.
const FIRST_HANDOFF: &[(&str, &str)] = &[
    ("fresh: true", "fresh: false"),
    ("nameplate: true", "nameplate: false"),
    ("Some(2)", "None"),
    ("request: 1664, response: 1152", "request: 1536, response: 1408"),
    ("program_date: 1795804215", "program_date: 0"),
];

#[rustfmt::skip]
const ROWS: &[Row] = &[
    // No request: the boot stage counts a crash.
    (CELL, "a request of the future", &[(4, 17)], Is("None")),
    (CELL, "install, which no resident part has", &[(4, 15), (8, 1)], Is("None")),
    (CELL, "more in the argument", &[(8, 0x017F_0302)], Is("None")),
    (CELL, "a damage of the future", &[(4, 8), (8, 7)], Is("None")),
    (CELL, "a step of a trial of the future", &[(4, 13), (8, 4)], Is("None")),
    (CELL, "another layout", &[(0, u32::from_le_bytes(*b"CBW2"))], Is("None")),

    ("handoff", "a later version: more flags, a reserved word", &[(4, 0x30_0006), (24, !0), (40, !0)], Same),
    ("handoff", "the last version", &[(4, 0x30_FFFF)], Same),
    ("handoff", "the first version", &[(4, 0x30_0001), (24, 0), (28, 0), (32, 0), (36, 0)], But(FIRST_HANDOFF)),
    ("handoff", "no version", &[(4, 0x30_0000)], Is("None")),
    ("handoff", "a smaller one", &[(4, 0x2C_0005)], Is("None")),
    ("handoff", "a larger one", &[(4, 0x34_0005)], Is("None")),
    ("handoff", "a cause of the future", &[(8, 0x0109_0105)], But(&[("Software", "Unknown")])),
    ("handoff", "a trial of another kind", &[(8, 0x0203_0105)], Same),
    ("handoff", "node-ID 0", &[(8, 0x0103_0100)], Is("None")),
    ("handoff", "node-ID 128", &[(8, 0x0103_0180)], Is("None")),
    ("handoff", "a number that no sub-index is", &[(28, 0x102)], But(&[("Some(2)", "None")])),
    ("handoff", "COB-IDs of other services", &[(32, 0x0480_0000)], But(&[FIRST_HANDOFF[3]])),

    ("boot report", "a later version: the reserved words", &[(4, 0x30_0002), (28, 1), (32, !0), (36, !0), (40, !0)], Same),
    ("boot report", "a later version: the padding", &[(20, 0xFFFF_FF0D), (24, 0xFF04_0302)], Same),
    ("boot report", "version 256", &[(4, 0x30_0100)], Same),
    ("boot report", "no version", &[(4, 0x30_0000)], Is("None")),
    ("boot report", "a smaller one", &[(4, 0x2C_0001)], Is("None")),
    ("boot report", "a larger one", &[(4, 0x34_0001)], Is("None")),
    ("boot report", "a reason of the future", &[(8, 0x0403_020F)], But(&[("reason: 14", "reason: 15"), ("Some(Compaction)", "None")])),
    ("boot report", "an origin of the future", &[(24, 0x04_0304)], But(&[("Confirmed", "Home")])),
    ("boot report", "an end of the future", &[(24, 0x04_0502)], But(&[("Reset(IndependentWatchdog)", "None")])),
    ("boot report", "a reset of the future", &[(24, 0x09_0302)], But(&[("IndependentWatchdog", "Unknown")])),

    ("nameplate", "the reserved words", &[(20, 1), (24, !0)], Same),
    ("nameplate", "another layout", &[(0, u32::from_le_bytes(*b"CBN2"))], Is("None")),
    ("label", "the reserved words", &[(20, 1), (24, !0)], Same),
    ("label", "another layout", &[(0, u32::from_le_bytes(*b"CBL2"))], Is("None")),

    ("callgate", "a later version", &[(4, 0x10_0002)], Same),
    ("callgate", "the last version", &[(4, 0x10_FFFF)], Same),
    ("callgate", "no version", &[(4, 0x10_0000)], Is("Err(Version(0))")),
    ("callgate", "a smaller one", &[(4, 0x0C_0001)], Is("Err(Absent)")),
    ("callgate", "a larger one", &[(4, 0x14_0001)], Same),

    (HEADER, "the reserved word", &[(60, !0)], Same),
    (HEADER, "no abilities", &[(28, 0)], Same),
    (HEADER, "an ability that the device has not", &[(28, 0x0B)], Is("Err(Services)")),
    (HEADER, "the ability install", &[(28, 0x1A)], Is("Err(Services)")),
    (HEADER, "abilities of the future", &[(28, 0xFFFF_000A)], Is("Err(Services)")),
    (HEADER, "older services", &[(24, 1)], Same),
    (HEADER, "newer services", &[(24, 3)], Is("Err(Services)")),
    (HEADER, "a smaller one", &[(8, 60)], Is("Err(Header)")),
    (HEADER, "a larger one", &[(8, 68)], Is("Err(Header)")),
    (HEADER, "another number of the format", &[(8, 1 << 16 | 64)], Is("Err(Header)")),
    (HEADER, "another layout", &[(0, u32::from_le_bytes(*b"CBI3"))], Is("Err(Header)")),
    (HEADER, "other facts", &[(56, 0x0FAC_7501)], Is("Err(Facts)")),

    (SERVICES, "a later version: a larger table", &[(0, 3), (4, 48)], But(&[("Some((2", "Some((3")])),
    (SERVICES, "abilities of the future", &[(56, 0xFFFF_01FF)], But(&[("abilities: 10", "abilities: 65535")])),
    (SERVICES, "larger facts", &[(48, 0x0201_0018)], But(&[("size: 20", "size: 24")])),
    (SERVICES, "smaller facts", &[(48, 0x0201_0013)], Is("None")),
    (SERVICES, "no facts", &[(36, 0)], Is("None")),
    (SERVICES, "facts outside of it", &[(36, 0x0900_0000)], Is("None")),
    (SERVICES, "facts over its end", &[(36, 0x0800_03F0)], Is("None")),

    (JOURNAL, "an older format", &[(12, 0)], Same),
    (JOURNAL, "a newer format", &[(12, 2)], Is("None")),
    (JOURNAL, "the reserved word", &[(16, 0)], Same),
    (PROGRAM, "a key of the future", &[(0, 0x8_0001)], Is("[00012340, CAFEF00D, 314E5552, 0000004D]")),
    (PROGRAM, "a release of the future", &[(12, u32::from_le_bytes(*b"RUN2"))], But(&[("signed: true, confirmed: true", "signed: false, confirmed: false")])),
    (RAM_IMAGE, "a state of the future", &[(4, u32::from_le_bytes(*b"STG2"))], Is("None")),
    (NODE, "a bit rate of the future", &[(8, 10)], But(&[("NodeId(127)", "NodeId(1)"), ("K125", "K10")])),
    (NODE, "more words", &[(12, !0), (16, !0)], Same),

    ("key block", "more flags, and the reserved bytes", &[(4, !0), (196, 1), (248, !0)], Same),
];

/// Makes the check word or the CRC of a record right; false if it has none.
fn seal(name: &str, bytes: &mut [u8]) -> bool {
    let (at, check) = match name.split(':').next() {
        Some("warm-start cell" | "handoff" | "boot report" | "nameplate" | "label") => {
            let at = bytes.len() - 4;
            let words: Vec<u32> = (0..at).step_by(4).map(|at| word(bytes, at)).collect();
            (at, check_word(&words))
        }
        Some("journal") => (20, boot_core::crc32(&bytes[..20])),
        Some("key block") => (252, boot_core::crc32(&bytes[..252])),
        _ => return false,
    };
    bytes[at..at + 4].copy_from_slice(&check.to_le_bytes());
    true
}

/// Every record of this test with its name and what it is: those of the table, and noise.
pub fn records() -> Vec<(&'static str, String, Vec<u8>)> {
    let mut all = Vec::new();
    for (name, what, words, _) in ROWS {
        let mut bytes = named(name).bytes.clone();
        for (at, word) in *words {
            bytes[*at..at + 4].copy_from_slice(&word.to_le_bytes());
        }
        seal(name, &mut bytes);
        all.push((*name, (*what).to_owned(), bytes));
    }
    for record in golden().iter().filter(|record| !record.name.starts_with("arguments")) {
        for byte in [0, 0xFF] {
            all.push((record.name, format!("bytes {byte:02X}h"), vec![byte; record.bytes.len()]));
        }
        // The last word of a record in the journal is its mark.
        let is_checked = seal(record.name, &mut record.bytes.clone()) && record.name != "key block";
        let checked = if record.name.starts_with("journal") { 24 } else { record.bytes.len() };
        for bit in (0..8 * checked).filter(|_| is_checked) {
            let mut bytes = record.bytes.clone();
            bytes[bit / 8] ^= 1 << (bit % 8);
            all.push((record.name, format!("bit {bit}"), bytes));
        }
    }
    all
}

#[test]
fn a_record_of_another_time_is_read_by_the_rules_and_noise_is_none() {
    for (at, (name, what, bytes)) in records().iter().enumerate() {
        let golden = read(name, &named(name).bytes);
        let expected = match ROWS.get(at) {
            Some((.., Same)) => golden,
            Some((.., But(words))) => words.iter().fold(golden, |seen, (from, to)| {
                assert!(seen.contains(from), "{seen} has no {from}");
                seen.replace(from, to)
            }),
            Some((.., Is(this))) => (*this).to_owned(),
            None => match *name {
                "warm-start cell: mark" => "false",
                "callgate" => "Err(Absent)",
                HEADER => "Err(Header)",
                "key block" => "([None, None], [None, None])",
                _ => "None",
            }
            .to_owned(),
        };
        assert_eq!(read(name, bytes), expected, "{name}: {what}");
    }
}
