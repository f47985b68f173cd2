//! The file: its ZIP container (APPNOTE.TXT 6.3.10), its manifest, and what is refused.

use coflash_core::file::convert::{convert, Options, Region};
use coflash_core::file::{block_file, ihex, AddressRange};
use coflash_core::machine::zip::{self, Member};
use coflash_core::machine::{make, Fault, Limit, Manifest, Package, Part};
use proptest::prelude::*;

use super::{entry, manifest, package, packed, refused};

/// Two members as Python's zipfile writes them: `a.txt` with `hello`, and `b-2.bin` with 00 01 02.
const PYTHON: &str = "504b03041400000000000000210086a61036050000000500000005000000612e74787468656c6c6f\
    504b03041400000000008f527b5d7f895408030000000300000007000000622d322e62696e000102\
    504b010214031400000000000000210086a610360500000005000000050000000000000000000000800100000000612e747874\
    504b010214031400000000008f527b5d7f8954080300000003000000070000000000000000000000800128000000622d322e62696e\
    504b0506000000000200020068000000500000000000";
/// `a.txt` with four times `hello`, which Python has compressed.
const DEFLATED: &str =
    "504b030414000000080000002100e3513d8d0a0000001700000005000000612e747874cb48cdc9c957c8402701504b010214\
    0314000000080000002100e3513d8d0a00000017000000050000000000000000000000800100000000612e747874504b0506\
    0000000001000100330000002d0000000000";
/// Where the records of [`PYTHON`] begin, counted by hand: headers of 30 and 46 bytes, then name and data.
const SECOND: usize = 30 + 5 + 5;
const DIRECTORY: usize = SECOND + 30 + 7 + 3;
const SECOND_ENTRY: usize = DIRECTORY + 46 + 5;
const END: usize = SECOND_ENTRY + 46 + 7;

fn bytes(digits: &str) -> Vec<u8> {
    coflash_core::file::sealed::key::hexadecimal(digits).unwrap()
}

#[test]
fn what_another_maker_has_stored_is_read() {
    let file = bytes(PYTHON);
    assert_eq!(file.len(), END + 22);
    let members = zip::read(&file).unwrap();
    let expected = [Member { name: "a.txt", bytes: b"hello" }, Member { name: "b-2.bin", bytes: &[0, 1, 2] }];
    assert_eq!(members, expected);
}

/// Each field by APPNOTE 4.3.7, 4.3.12 and 4.3.16; the CRC-32 of `hello` is 3610A686h.
#[test]
fn what_is_written_has_its_fields_where_the_format_says() {
    let file = zip::write(&[Member { name: "a.txt", bytes: b"hello" }]);
    let local =
        "504b0304 0a00 0000 0000 0000 2100 86a61036 05000000 05000000 0500 0000 612e747874 68656c6c6f";
    let central =
        "504b0102 0a00 0a00 0000 0000 0000 2100 86a61036 05000000 05000000 0500 0000 0000 0000 0000 \
                   00000000 00000000 612e747874";
    let end = "504b0506 0000 0000 0100 0100 33000000 28000000 0000";
    let digits: String = [local, central, end].concat().split_whitespace().collect();
    assert_eq!(file, bytes(&digits));
}

#[test]
fn a_container_that_lies_is_refused() {
    let changed = |changes: &[(usize, &[u8])]| {
        let mut file = bytes(PYTHON);
        for (at, new) in changes {
            file[*at..at + new.len()].copy_from_slice(new);
        }
        zip::read(&file).unwrap_err()
    };
    let not = |fault: Fault, words: &str| {
        assert!(matches!(fault, Fault::NotPackage(why) if why.contains(words)), "{fault}");
        assert_eq!(fault.number(), 0x6000_0400);
    };
    // The end: a comment, two disks, other numbers of members, another place of the directory.
    not(changed(&[(END + 20, &[1])]), "directory");
    not(changed(&[(END + 4, &[1])]), "directory");
    not(changed(&[(END + 8, &[1])]), "directory");
    not(changed(&[(END + 16, &[0x51])]), "directory");
    not(changed(&[(END + 8, &[1, 0, 1, 0])]), "belong to no member");
    not(changed(&[(END + 8, &[3, 0, 3, 0])]), "cut off");
    not(changed(&[(END, b"PK\x05\x07")]), "does not end");
    let many = changed(&[(END + 8, &[0xFF; 4])]);
    assert_eq!(many, Fault::Limit { what: Limit::Members, found: 0xFFFF, most: 66 });
    assert_eq!(many.number(), 0x6000_0402);
    // The directory: an entry that is none, an extra field, a comment, a member over another one.
    not(changed(&[(DIRECTORY, b"XX")]), "is none");
    not(changed(&[(DIRECTORY + 30, &[1])]), "extra field");
    not(changed(&[(DIRECTORY + 32, &[1])]), "comment");
    not(changed(&[(SECOND_ENTRY + 42, &[0])]), "follow one another");
    not(changed(&[(SECOND_ENTRY + 42, &[0xFF; 4])]), "follow one another");
    // Headers that differ: the name, the CRC, the extra field.
    not(changed(&[(30, b"b")]), "headers of a member differ");
    not(changed(&[(14, &[0])]), "headers of a member differ");
    not(changed(&[(28, &[1])]), "headers of a member differ");
    not(changed(&[(0, b"XX")]), "headers of a member differ");
    // Sizes: two for one member; more than the file; more than a member may have.
    not(changed(&[(DIRECTORY + 24, &[4])]), "two sizes");
    let sizes: [&[u8]; 2] = [&[0xFF, 0, 0, 0, 0xFF, 0, 0, 0], &[0xFF; 8]];
    not(changed(&[(18, sizes[0]), (DIRECTORY + 20, sizes[0])]), "cut off");
    let bomb = changed(&[(18, sizes[1]), (DIRECTORY + 20, sizes[1])]);
    assert_eq!(bomb, Fault::Limit { what: Limit::Member, found: 0xFFFF_FFFF, most: 8 * 1024 * 1024 });
    let long = changed(&[(26, &[65]), (DIRECTORY + 28, &[65])]);
    assert_eq!(long, Fault::Limit { what: Limit::Name, found: 65, most: 64 });
    // Encrypted, and with its sizes after the data (APPNOTE 4.4.4, bits 0 and 3); compressed.
    for flag in [1, 8] {
        let fault = changed(&[(6, &[flag]), (DIRECTORY + 8, &[flag])]);
        assert_eq!(fault, Fault::Packed("a.txt".to_owned()));
    }
    assert_eq!(zip::read(&bytes(DEFLATED)).unwrap_err(), Fault::Packed("a.txt".to_owned()));
    // Both CRCs.
    let fault = changed(&[(14, &[0]), (DIRECTORY + 16, &[0])]);
    let damaged = Fault::Damaged { member: "a.txt".to_owned(), what: "CRC-32" };
    assert_eq!((fault.number(), fault), (0x6000_0405, damaged));
    // Names that are paths, on one system or another.
    for name in ["../ab", "/abcd", "a\\bcd", "C:abc", ".hide", "a/b.t", "a\0bcd", "\u{FC}bcd", "a bcd"] {
        let fault = changed(&[(30, name.as_bytes()), (DIRECTORY + 46, name.as_bytes())]);
        assert_eq!((fault.number(), fault), (0x6000_0403, Fault::Name(name.to_owned())));
    }
    // Bytes in front, and after the end.
    not(zip::read(&[&b"#!"[..], &bytes(PYTHON)].concat()).unwrap_err(), "directory");
    not(zip::read(&[&bytes(PYTHON)[..], b"PK"].concat()).unwrap_err(), "does not end");
}

#[test]
fn two_members_have_two_names() {
    for second in ["a.txt", "A.TXT"] {
        let file = zip::write(&[Member { name: "a.txt", bytes: b"1" }, Member { name: second, bytes: b"2" }]);
        let fault = zip::read(&file).unwrap_err();
        assert_eq!((fault.number(), fault), (0x6000_0403, Fault::Twice(second.to_owned())));
    }
}

#[test]
fn a_package_has_its_programs_in_order() {
    let valve =
        r#""identity": {"vendor": 1, "product": 1234}, "count": 3, "trial_run": false, "dialect": "raw""#;
    let file = packed(&[
        ("drive", r#""nodes": [5, 6], "identity": {"vendor": 63, "product": 1234, "revision": 2}"#),
        ("valve", valve),
        ("panel", r#""nodes": [9], "verify": true"#),
    ]);
    let package = Package::parse(&file).unwrap();
    let names: Vec<&str> = package.programs().map(|(entry, _)| entry.name.as_str()).collect();
    assert_eq!(names, ["drive", "valve", "panel"]);
    let whom: Vec<String> = package.programs().map(|(entry, _)| entry.whom()).collect();
    assert_eq!(whom[0], "nodes 5, 6 (vendor 0000003Fh, product 000004D2h, revision 00000002h)");
    assert_eq!((whom[1].as_str(), whom[2].as_str()), ("vendor 00000001h, product 000004D2h", "node 9"));
    // In expected.py the program has FA1h bytes.
    assert!(package.programs().all(|(_, program)| program.size() == 0xFA1));
}

const NODE: &str = r#""nodes": [5]"#;

#[test]
fn a_manifest_that_lies_is_refused() {
    let one = || manifest(&[entry("a", NODE)]);
    assert!(Package::parse(&package(&one(), &["a.blk"])).is_ok());
    refused(&package(&one(), &[]), 0x6000_0404, "no member \"a.blk\"");
    let other = package(&one(), &["a.blk", "b.blk"]);
    refused(&other, 0x6000_0404, "a member \"b.blk\" that its manifest does not list");
    refused(&package(&one(), &["a.blk", "signatures.bin"]), 0x6000_0404, "signatures.bin");
    let changed = |from: &str, to: &str| {
        assert!(one().contains(from));
        package(&one().replacen(from, to, 1), &["a.blk"])
    };
    refused(&changed("883", "882"), 0x6000_0405, "another size of");
    refused(&changed("883", "18446744073709551615"), 0x6000_0405, "another size of");
    refused(&changed("36d4", "36d5"), 0x6000_0405, "another SHA-256 of");
    refused(&changed("36d4", "36d"), 0x6000_0406, "64 hexadecimal digits");
    refused(&changed("36d4", "\u{FC}d4"), 0x6000_0406, "64 hexadecimal digits");
    refused(&changed("\"version\": 1", "\"version\": 2, \"cloud\": true"), 0x6000_0401, "format 2");
    refused(&changed("\"version\": 1", "\"version\": 0"), 0x6000_0406, "no format 0");
    refused(&changed("\"version\": 1", "\"version\": 1, \"cloud\": true"), 0x6000_0406, "cloud");
    // The message has the name of the field, and a terminal must not obey it.
    let fault = Package::parse(&changed("\"version\": 1", "\"version\": 1, \"\\u001b[2J\": 1")).unwrap_err();
    assert!(!fault.to_string().contains('\u{1B}') && fault.number() == 0x6000_0406, "{fault}");
    refused(&changed("\"version\": 1", "\"version\": 1, \"version\": 1"), 0x6000_0406, "version");
    refused(&changed("coboot machine", "another"), 0x6000_0406, "not that of a package");
    refused(&changed("a.blk", "../a.blk"), 0x6000_0403, "../a.blk");
    refused(&changed("[5]", "[5, 5]"), 0x6000_0406, "twice");
    refused(&changed("[5]", "[128]"), 0x6000_0406, "1 to 127");
    refused(&changed("[5]", "[0]"), 0x6000_0406, "1 to 127");
    refused(&changed("[5]", "[]"), 0x6000_0406, "neither nodes nor an identity");
    refused(&changed("\"nodes\": [5]", "\"nodes\": [5], \"count\": 1"), 0x6000_0406, "nodes and a count");
    refused(&changed("\"program\": 1", "\"program\": 0"), 0x6000_0406, "1 to 254");
    refused(&changed("\"program\": 1", "\"program\": 255"), 0x6000_0409, "neither a block file");
    refused(&changed("\"program\": 1", "\"program\": 1, \"dialect\": \"x\""), 0x6000_0406, "no such dialect");
    refused(&changed("\"name\": \"a\"", "\"name\": \"a\\u001b[2J\""), 0x6000_0406, "control");
    refused(&changed("\"name\": \"a\"", "\"name\": \"\""), 0x6000_0406, "1 to 200");
    refused(&package(&manifest(&[]), &[]), 0x6000_0406, "no program");
    refused(&package("{", &[]), 0x6000_0406, "manifest");
    let large = one().replacen('{', &format!("{{{}", " ".repeat(64 * 1024)), 1);
    refused(&package(&large, &["a.blk"]), 0x6000_0402, "bytes in its manifest");
    let many: Vec<String> =
        (0..65).map(|n| entry(&format!("p{n}"), &format!(r#""nodes": [{}]"#, n + 1))).collect();
    refused(&package(&manifest(&many), &[]), 0x6000_0402, "65 programs");
    // The manifest is the first member.
    let late = zip::write(&[Member { name: "a.blk", bytes: super::BLOCKS }]);
    refused(&late, 0x6000_0400, "first member is not its manifest");
}

#[test]
fn two_programs_for_one_node_are_refused() {
    let identity = |revision: &str| format!(r#""identity": {{"vendor": 63, "product": 1234{revision}}}"#);
    let (any, second, third) = (identity(""), identity(r#", "revision": 2"#), identity(r#", "revision": 3"#));
    let both = |one: &str, other: &str| packed(&[("a", one), ("b", other)]);
    for (one, other) in [
        (r#""nodes": [5, 6]"#, r#""nodes": [6, 7]"#),
        (any.as_str(), any.as_str()),
        (any.as_str(), second.as_str()),
        (&format!(r#""nodes": [5], {any}"#), second.as_str()),
    ] {
        refused(&both(one, other), 0x6000_0407, "\"a\" and \"b\" both write program 1");
        refused(&both(other, one), 0x6000_0407, "two programs for one node");
    }
    for (one, other) in [
        (r#""nodes": [5, 6]"#, r#""nodes": [7]"#),
        (second.as_str(), third.as_str()),
        // The same nodes, with one device or another at them.
        (&format!(r#""nodes": [5], {second}"#), &format!(r#""nodes": [5], {third}"#)),
    ] {
        assert!(Package::parse(&both(one, other)).is_ok(), "{one} {other}");
    }
    let twice = manifest(&[entry("a", NODE), entry("a", r#""nodes": [6]"#)]);
    refused(&package(&twice, &["a.blk"]), 0x6000_0406, "two programs have the name");
}

#[test]
fn a_program_is_checked_before_it_is_used() {
    // 919 bytes, for vendor 0 (any) and product 1234; its SHA-256 by coreutils.
    let blocks = data!("identity-110.blk");
    let hash = "6e03527de3a9fa2f50678e923eda0f5b2da873e2ed1f01899a730c6326a611a2";
    let with = |identity: &str| {
        let text = manifest(&[entry("a", identity)]).replace(super::HASH, hash).replace("883", "919");
        let first = Member { name: "manifest.json", bytes: text.as_bytes() };
        zip::write(&[first, Member { name: "a.blk", bytes: blocks }])
    };
    assert!(Package::parse(&with(r#""identity": {"vendor": 63, "product": 1234}"#)).is_ok());
    let other = with(r#""identity": {"vendor": 63, "product": 1235}"#);
    refused(&other, 0x6000_0409, "it is for vendor 00000000h, product 000004D2h");
    // A block file whose last byte, its CRC, was changed; the hash was changed with it (sha256sum).
    let mut blocks = super::BLOCKS.to_vec();
    *blocks.last_mut().unwrap() ^= 1;
    let text = manifest(&[entry("a", NODE)])
        .replace(super::HASH, "123e73700dc425e8ac418fe611864fee08289e2758e3231420b00954914a4db4");
    let members =
        [Member { name: "manifest.json", bytes: text.as_bytes() }, Member { name: "a.blk", bytes: &blocks }];
    refused(&zip::write(&members), 0x6000_0409, "CRC of block");
}

proptest! {
    /// No input causes a panic, and what is accepted has what its manifest says.
    #[test]
    fn any_change_is_refused_or_harmless(
        changes in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..4),
        cut in any::<prop::sample::Index>(),
    ) {
        let good = packed(&[("a", NODE), ("b", r#""nodes": [6]"#)]);
        let mut file = good.clone();
        for (at, byte) in changes {
            let at = at.index(file.len());
            file[at] = byte;
        }
        if let Ok(package) = Package::parse(&file) {
            prop_assert!(package.programs().all(|(entry, _)| entry.size == 883));
        }
        prop_assert!(Package::parse(&good[..cut.index(good.len())]).is_err());
    }

    #[test]
    fn any_bytes_are_read_or_refused(bytes in proptest::collection::vec(any::<u8>(), 0..300)) {
        let _ = zip::read(&bytes);
        let _ = Package::parse(&[&bytes[..], &[0; 22]].concat());
    }
}

/// What the user confirms is a line of a terminal: no text of a package hides a part of it or turns it round.
#[test]
fn a_text_that_changes_how_a_line_looks_is_refused() {
    let hidden =
        ['\u{200B}', '\u{200F}', '\u{2028}', '\u{202E}', '\u{2060}', '\u{2066}', '\u{206F}', '\u{FEFF}'];
    for letter in hidden {
        let text = entry("a", NODE).replace(r#""name": "a""#, &format!(r#""name": "a{letter}b""#));
        refused(&package(&manifest(&[text]), &["a.blk"]), 0x6000_0406, "none for control");
        let field = entry("a", &format!(r#""nodes": [5], "x{letter}": 1"#));
        let fault = Package::parse(&package(&manifest(&[field]), &["a.blk"])).unwrap_err();
        assert!(!fault.to_string().contains(letter), "{fault}");
    }
    for good in ["\u{FC}b", "\u{200A}", "\u{2030}", "\u{205F}", "\u{2070}"] {
        let text = entry("a", r#""nodes": [5]"#).replace(r#""name": "a""#, &format!(r#""name": "a{good}""#));
        assert!(Package::parse(&package(&manifest(&[text]), &["a.blk"])).is_ok(), "{good:?}");
    }
}

/// Two blocks far apart are a small file with a large program, whose CRC takes its time.
#[test]
fn a_program_of_a_huge_span_is_refused() {
    let far = |upper: u16| {
        let line = |bytes: &[u8]| {
            let sum = bytes.iter().fold(0u8, |sum, byte| sum.wrapping_add(*byte));
            let digits: String = bytes.iter().map(|byte| format!("{byte:02X}")).collect();
            format!(":{digits}{:02X}\n", sum.wrapping_neg())
        };
        let [high, low] = upper.to_be_bytes();
        [
            line(&[2, 0, 0, 4, 8, 0]),
            line(&[8, 0, 0, 0, 0, 0, 2, 0x20, 1, 2, 0, 8]),
            line(&[2, 0, 0, 4, high, low]),
            line(&[4, 0, 0, 0, 1, 2, 3, 4]),
            line(&[0, 0, 0, 1]),
        ]
        .concat()
    };
    // Program 2 may be data, which are not judged as a program for the flash.
    let region = AddressRange { first: 0x0800_0000, last: 0x08FF_FFFF };
    let options = Options::default().region(Region::Strict(region));
    let refusal = |upper| {
        let image = ihex::read(far(upper).as_bytes()).unwrap();
        let blocks = convert(image, &options).unwrap().program;
        let said =
            Manifest::parse(manifest(&[entry("a", r#""nodes": [5], "program": 2"#)]).as_bytes()).unwrap();
        let part = Part { entry: said.programs[0].clone(), bytes: block_file::emit(&blocks) };
        make(None, None, &[part], &[]).err().map(|fault| (fault.number(), fault.to_string()))
    };
    // 8 MiB are 80h pages of 64 KiB.
    assert_eq!(refusal(0x087F), None);
    let (number, words) = refusal(0x0880).unwrap();
    assert_eq!(number, 0x6000_0409);
    assert!(words.contains("extends over 8388612 bytes, and at most 8388608 are allowed"), "{words}");
}
