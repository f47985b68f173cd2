//! Values on the command line, in the notations of the manual's tools.

use std::ops::RangeInclusive;
use std::time::Duration;

use canopen::{Address, NodeId};
use coflash_core::device::value::integer;
use coflash_core::file::sealed::key::hexadecimal;

/// A number of up to 32 bits in C notation: `4096`, `0x1000`, `010000` (octal), optionally with the
/// suffix `u` or `l`.
pub(super) fn number(text: &str) -> Result<u32, String> {
    let bare = text.trim_end_matches(['u', 'U', 'l', 'L']);
    let number = integer(bare).filter(|_| !bare.starts_with('-'));
    let number = number
        .ok_or_else(|| "it is not a number in C notation (4096, 0x1000 or octal 010000)".to_string())?;
    u32::try_from(number).map_err(|_| "it is not a number of up to 32 bits".to_string())
}

pub(super) fn node_id(text: &str) -> Result<NodeId, String> {
    let number = number(text)?;
    u8::try_from(number).ok().and_then(NodeId::new).ok_or_else(|| "node-IDs are 1 to 127".to_string())
}

/// Node-IDs and ranges of node-IDs: `1,5,9-12`. Each appears once, in the given order.
pub(super) fn nodes(text: &str) -> Result<Vec<NodeId>, String> {
    let mut nodes = Vec::new();
    for part in text.split(',') {
        let (first, last) = part.split_once('-').unwrap_or((part, part));
        let (first, last) = (node_id(first.trim())?, node_id(last.trim())?);
        if first > last {
            return Err(format!("the range {part} ends before it starts"));
        }
        let range = (first.get()..=last.get()).filter_map(NodeId::new);
        let new: Vec<NodeId> = range.filter(|node| !nodes.contains(node)).collect();
        nodes.extend(new);
    }
    Ok(nodes)
}

/// A number in a range, or these words.
fn within(text: &str, range: RangeInclusive<u32>, wrong: &str) -> Result<u32, String> {
    Some(number(text)?).filter(|number| range.contains(number)).ok_or_else(|| wrong.to_string())
}

/// A program number: 1 to 254, the sub-indices of 1F50h.
pub(super) fn program_number(text: &str) -> Result<u8, String> {
    within(text, 1..=254, "programs are 1 to 254").map(|number| number as u8)
}

pub(super) fn milliseconds(text: &str) -> Result<Duration, String> {
    let millis = within(text, 1..=u32::MAX, "it must be at least 1 millisecond")?;
    Ok(Duration::from_millis(millis.into()))
}

/// The time for which a program is watched: milliseconds, 0 for not at all.
pub(super) fn watch_time(text: &str) -> Result<Duration, String> {
    Ok(Duration::from_millis(number(text)?.into()))
}

/// A COB-ID to which a node-ID can be added.
pub(super) fn base_id(text: &str) -> Result<u16, String> {
    let wrong = "it must be 0x80 to 0x780, so that a node-ID can be added";
    within(text, 0x80..=0x780, wrong).map(|id| id as u16)
}

/// A number of attempts, at least one.
pub(super) fn attempts(text: &str) -> Result<u32, String> {
    within(text, 1..=u32::MAX, "it must be at least 1")
}

/// An object: `1018/4`, `1018h/4`, `0x1018/0x04`, `100A`.
pub(super) fn address(words: &str) -> Option<Address> {
    let (index, sub) = words.split_once('/').unwrap_or((words, "0"));
    let index = index.strip_prefix("0x").or_else(|| index.strip_prefix("0X")).unwrap_or(index);
    let index = index.strip_suffix(['h', 'H']).unwrap_or(index);
    if index.is_empty() || !index.bytes().all(|digit| digit.is_ascii_hexdigit()) {
        return None;
    }
    let index = u16::from_str_radix(index, 16).ok()?;
    let sub = u8::try_from(number(sub).ok()?).ok()?;
    Some(Address::new(index, sub))
}

/// The unique ID of a chip, in hexadecimal digits.
pub(super) fn unique_id(text: &str) -> Result<[u8; 12], String> {
    let id = hexadecimal(text).and_then(|bytes| bytes.try_into().ok());
    match id {
        Some(id) if id != [0; 12] => Ok(id),
        _ => Err("it must have 24 hexadecimal digits, and must not be 0".to_string()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn objects_are_an_index_and_a_sub_index() {
        for (words, index, sub) in
            [("1018/4", 0x1018, 4), ("100A", 0x100A, 0), ("1f57h/1", 0x1F57, 1), ("0x1F50/0xFE", 0x1F50, 254)]
        {
            assert_eq!(address(words), Some(Address::new(index, sub)), "{words}");
        }
        for words in ["", "/1", "10018", "1018/256", "1018/", "name", "+1018", "1018/1/1"] {
            assert_eq!(address(words), None, "{words}");
        }
    }

    #[test]
    fn numbers_are_those_of_c() {
        for (text, value) in [
            ("0", 0),
            ("00", 0),
            ("0x400", 1024),
            ("0XfF", 255),
            ("4294967295", u32::MAX),
            ("0xFFFFFFFFUL", u32::MAX),
            ("010", 8),
            ("1000u", 1000),
        ] {
            assert_eq!(number(text), Ok(value), "{text}");
        }
        for text in ",0x,-1,+1,0x+1,4294967296,0x100000000,08,1k, 1,12h,ff,UL,0xUL".split(',') {
            assert!(number(text).is_err(), "{text}");
        }
    }

    #[test]
    fn a_unique_id_has_twelve_bytes() {
        assert_eq!(unique_id("00112233445566778899aAbB").map(|id| id[11]), Ok(0xBB));
        for text in
            ["", "00", "000000000000000000000000", "00112233445566778899aabbc", "0x112233445566778899aabb"]
        {
            assert!(unique_id(text).is_err(), "{text}");
        }
    }

    #[test]
    fn nodes_are_a_list_with_ranges() {
        let numbers = |text| nodes(text).map(|nodes| nodes.into_iter().map(NodeId::get).collect::<Vec<_>>());
        assert_eq!(numbers("1,5,9-12").unwrap(), [1, 5, 9, 10, 11, 12]);
        assert_eq!(numbers("5, 0x7F,4-6").unwrap(), [5, 127, 4, 6]);
        assert_eq!(numbers("1-127").unwrap().len(), 127);
        for text in ["", ",", "1,", "0", "128", "5-4", "1-", "-1", "1-128", "1-2-3", "a"] {
            assert!(numbers(text).is_err(), "{text}");
        }
    }

    #[test]
    fn node_ids_and_programs_have_their_ranges() {
        assert_eq!(node_id("0x7F").map(NodeId::get), Ok(127));
        assert_eq!((program_number("1"), program_number("254")), (Ok(1), Ok(254)));
        for (node, program) in [("0", "0"), ("128", "255"), ("257", "257")] {
            assert!(node_id(node).is_err() && program_number(program).is_err());
        }
        assert_eq!(milliseconds("500"), Ok(Duration::from_millis(500)));
        assert!(milliseconds("0").is_err());
    }
}
