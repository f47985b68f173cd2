//! The container: a ZIP file (APPNOTE.TXT 6.3.10) whose members are stored and not compressed.
//!
//! The reader takes no other: nothing is unpacked, so no member can grow; each byte of the file is
//! part of exactly one member or of one header, and both headers of a member say the same. Sizes
//! and counts are compared with the limits before any byte of a member is looked at.

use super::fault::{Fault, Limit};
use crate::file::checksum::CRC;

/// Signatures of the records (APPNOTE 4.3.7, 4.3.12, 4.3.16).
const LOCAL: [u8; 4] = *b"PK\x03\x04";
const CENTRAL: [u8; 4] = *b"PK\x01\x02";
const END: [u8; 4] = *b"PK\x05\x06";
/// Sizes of the records without name, extra field and comment.
const LOCAL_SIZE: usize = 30;
const CENTRAL_SIZE: usize = 46;
const END_SIZE: usize = 22;
/// Version 1.0 of the format: stored members.
const VERSION: u16 = 10;
/// The fields that both headers of a member have: flags, method, time, date, CRC-32, two sizes and
/// the two lengths of name and extra field.
const SHARED: usize = 24;
/// 1980-01-01, the first day of the format: the same input gives the same package.
const DATE: u16 = 1 << 5 | 1;

/// The most members.
pub const MAX_MEMBERS: usize = 66;
/// The most bytes of a name.
pub const MAX_NAME: usize = 64;
/// The most bytes of a member. The largest flash of the family has 2 MiB.
pub const MAX_MEMBER: usize = 8 * 1024 * 1024;

/// A member of a package.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Member<'a> {
    /// Its name.
    pub name: &'a str,
    /// Its content.
    pub bytes: &'a [u8],
}

/// Whether a file begins as a ZIP file.
#[must_use]
pub fn looks_like(bytes: &[u8]) -> bool {
    bytes.starts_with(&LOCAL)
}

/// Reads the members of a package, in the order of the file.
///
/// # Errors
/// [`Fault::NotPackage`], [`Fault::Limit`], [`Fault::Name`], [`Fault::Twice`] and [`Fault::Damaged`].
pub fn read(bytes: &[u8]) -> Result<Vec<Member<'_>>, Fault> {
    let (rest, end) = bytes.split_last_chunk::<END_SIZE>().ok_or(Fault::NotPackage("it is too short"))?;
    if end[..4] != END {
        return Err(Fault::NotPackage("it does not end as a ZIP file without a comment"));
    }
    let (count, all) = (half(end, 8), half(end, 10));
    let (size, offset) = (long(end, 12), long(end, 16));
    let is_whole = half(end, 4) == 0 && half(end, 6) == 0 && count == all && half(end, 20) == 0;
    if !is_whole || size.checked_add(offset) != Some(rest.len()) {
        return Err(Fault::NotPackage("its directory is not at its end, or is not the only one"));
    }
    let count = usize::from(count);
    Limit::Members.check(count, MAX_MEMBERS)?;
    let (data, mut directory) = rest.split_at(offset);
    let mut members: Vec<Member<'_>> = Vec::new();
    let mut at = 0;
    for _ in 0..count {
        let central = take(&mut directory, CENTRAL_SIZE)?;
        if central[..4] != CENTRAL {
            return Err(Fault::NotPackage("an entry of its directory is none"));
        }
        let (shared, comment, disk) = (&central[8..8 + SHARED], half(central, 32), half(central, 34));
        let (name_size, extra) = (usize::from(half(central, 28)), half(central, 30));
        if extra != 0 || comment != 0 || disk != 0 {
            return Err(Fault::NotPackage("a member has an extra field or a comment"));
        }
        Limit::Name.check(name_size, MAX_NAME)?;
        let name = name(take(&mut directory, name_size)?)?;
        // Bit 11 says that the name is UTF-8, which ASCII is. Bits 0 and 3 are encryption, and sizes
        // after the data.
        let (flags, method) = (half(shared, 0), half(shared, 2));
        if flags & !(1 << 11) != 0 || method != 0 {
            return Err(Fault::Packed(name.to_owned()));
        }
        let (packed, size) = (long(central, 20), long(central, 24));
        if packed != size {
            return Err(Fault::NotPackage("a stored member has two sizes"));
        }
        Limit::Member.check(size, MAX_MEMBER)?;
        if members.iter().any(|member| member.name.eq_ignore_ascii_case(name)) {
            return Err(Fault::Twice(name.to_owned()));
        }
        if long(central, 42) != at {
            return Err(Fault::NotPackage("its members do not follow one another"));
        }
        let mut rest = data.get(at..).unwrap_or_default();
        let local = take(&mut rest, LOCAL_SIZE)?;
        let of_file = take(&mut rest, name_size)?;
        if local[..4] != LOCAL || local[6..] != *shared || of_file != name.as_bytes() {
            return Err(Fault::NotPackage("the two headers of a member differ"));
        }
        let content = take(&mut rest, size)?;
        if CRC.checksum(content) != word(central, 16) {
            return Err(Fault::Damaged { member: name.to_owned(), what: "CRC-32" });
        }
        at += LOCAL_SIZE + name_size + size;
        members.push(Member { name, bytes: content });
    }
    if at != offset || !directory.is_empty() {
        return Err(Fault::NotPackage("it has bytes that belong to no member"));
    }
    Ok(members)
}

/// Writes a package with these members, whose names must be [good](is_name).
#[must_use]
pub fn write(members: &[Member<'_>]) -> Vec<u8> {
    let (mut file, mut directory) = (Vec::new(), Vec::new());
    for Member { name, bytes } in members {
        let mut shared = Vec::new();
        for value in [0, 0, 0, DATE] {
            shared.extend(u16::to_le_bytes(value));
        }
        for value in [CRC.checksum(bytes), bytes.len() as u32, bytes.len() as u32] {
            shared.extend(value.to_le_bytes());
        }
        for value in [name.len() as u16, 0] {
            shared.extend(value.to_le_bytes());
        }
        let at = file.len() as u32;
        directory.extend(CENTRAL);
        directory.extend([VERSION.to_le_bytes(), VERSION.to_le_bytes()].concat());
        directory.extend(&shared);
        // No comment, first disk, no attributes.
        directory.extend([0; 10]);
        directory.extend(at.to_le_bytes());
        directory.extend(name.as_bytes());
        file.extend(LOCAL);
        file.extend(VERSION.to_le_bytes());
        file.extend(&shared);
        file.extend(name.as_bytes());
        file.extend(*bytes);
    }
    let (offset, size, count) = (file.len() as u32, directory.len() as u32, members.len() as u16);
    file.extend(directory);
    file.extend(END);
    file.extend([0; 4]);
    file.extend([count.to_le_bytes(), count.to_le_bytes()].concat());
    file.extend([size.to_le_bytes(), offset.to_le_bytes()].concat());
    file.extend([0; 2]);
    file
}

/// Whether a member may have this name: letters, digits, `-`, `_` and `.`, and no `.` in front. So no
/// name is a path, on any system.
#[must_use]
pub fn is_name(name: &str) -> bool {
    let is_good = |byte: u8| byte.is_ascii_alphanumeric() || b"-_.".contains(&byte);
    (1..=MAX_NAME).contains(&name.len()) && !name.starts_with('.') && name.bytes().all(is_good)
}

fn name(bytes: &[u8]) -> Result<&str, Fault> {
    let bad = || Fault::Name(String::from_utf8_lossy(bytes).into_owned());
    std::str::from_utf8(bytes).ok().filter(|name| is_name(name)).ok_or_else(bad)
}

/// The next bytes of a record or a member.
fn take<'a>(bytes: &mut &'a [u8], size: usize) -> Result<&'a [u8], Fault> {
    let cut = Fault::NotPackage("it is cut off, or a size in it is wrong");
    let (first, rest) = bytes.split_at_checked(size).ok_or(cut)?;
    *bytes = rest;
    Ok(first)
}

fn half(bytes: &[u8], at: usize) -> u16 {
    u16::from_le_bytes([bytes[at], bytes[at + 1]])
}

fn word(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
}

/// A size or an offset; one beyond the address space is beyond the file, too.
fn long(bytes: &[u8], at: usize) -> usize {
    usize::try_from(word(bytes, at)).unwrap_or(usize::MAX)
}
