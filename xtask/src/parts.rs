//! Finds the part of the sources for each byte of a program, from its debug information.

use std::collections::BTreeMap;
use std::path::Path;

use addr2line::gimli::{Dwarf, EndianSlice, Error, LittleEndian};
use addr2line::Context;
use object::{Object, ObjectSection};

use crate::{outcome::Outcome, workspace};

/// The part for long runs of zeros: statics that start as zero.
pub const ZEROS: &str = "(zeros)";
/// A shorter run of zeros belongs to the code or data around it.
const LONG: usize = 64;

/// The number of bytes of each part, for these contents at this address of the ELF file `elf`, which
/// contains `file`. A part is a
/// module of one of our crates (`boot-core/intake`), or another author's crate.
///
/// # Errors
/// When the file has no debug information that can be read.
pub fn of(elf: &Path, file: &[u8], address: u32, contents: &[u8]) -> Outcome<BTreeMap<String, u32>> {
    /// The length of the shortest instruction.
    const STEP: usize = 2;
    let unreadable = |error: &dyn std::fmt::Display| {
        format!("the debug information of {} cannot be read: {error}.", workspace::shown(elf))
    };
    let object = object::File::parse(file).map_err(|error| unreadable(&error))?;
    let section = |name: &str| object.section_by_name(name).and_then(|section| section.data().ok());
    let dwarf = Dwarf::load(|id| {
        Ok::<_, Error>(EndianSlice::new(section(id.name()).unwrap_or_default(), LittleEndian))
    });
    let context = dwarf.and_then(Context::from_dwarf).map_err(|error| unreadable(&error))?;
    let root = workspace::root();
    let mut parts = BTreeMap::new();
    let mut at = 0;
    while at < contents.len() {
        let zeros = contents[at..].iter().take_while(|byte| **byte == 0).count();
        if zeros >= LONG {
            *parts.entry(ZEROS.to_owned()).or_default() += zeros as u32;
            at += zeros;
            continue;
        }
        let frames = context.find_frames(u64::from(address) + at as u64).skip_all_loads();
        let mut frames = frames.map_err(|error| unreadable(&error))?;
        let mut files = Vec::new();
        while let Some(frame) = frames.next().map_err(|error| unreadable(&error))? {
            files.extend(frame.location.and_then(|location| location.file).map(str::to_owned));
        }
        let step = STEP.min(contents.len() - at);
        *parts.entry(part(&files, root)).or_default() += step as u32;
        at += step;
    }
    Ok(parts)
}

/// The part of code: the innermost file of ours, otherwise the outermost file.
fn part(files: &[String], root: &Path) -> String {
    let ours = files.iter().find_map(|file| {
        // The firmware's debug information may name files relative to the workspace.
        let file = Path::new(file).strip_prefix(root).unwrap_or(Path::new(file));
        let names: Vec<&str> = file.iter().filter_map(|name| name.to_str()).collect();
        let src = names.iter().position(|name| *name == "src").filter(|_| file.is_relative())?;
        let (krate, module) = (names.get(src.checked_sub(1)?)?, names.get(src + 1)?);
        Some(format!("{krate}/{}", module.trim_end_matches(".rs")))
    });
    let theirs = || {
        let file = files.last()?;
        // A crate of a registry (…/registry/src/HOST/NAME-VERSION/…), or the standard library.
        let behind = file.split_once("/registry/src/").map(|(_, rest)| rest)?;
        let name = behind.split('/').nth(1)?;
        Some(name.rsplit_once('-').map_or(name, |(name, _)| name).to_owned())
    };
    let nobodys = || (if files.is_empty() { "(data, vectors, assembly)" } else { "core" }).to_owned();
    ours.or_else(theirs).unwrap_or_else(nobodys)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn code_counts_for_the_innermost_file_of_ours() {
        let root = Path::new("/house");
        let part =
            |files: &[&str]| super::part(&files.iter().map(ToString::to_string).collect::<Vec<_>>(), root);
        assert_eq!(part(&[]), "(data, vectors, assembly)");
        assert_eq!(part(&["/rustc/1/library/core/src/option.rs"]), "core");
        let bxcan = "/home/me/.cargo/registry/src/index-1/bxcan-0.8.0/src/lib.rs";
        assert_eq!(part(&["/rustc/1/library/core/src/option.rs", bxcan]), "bxcan");
        let files = [bxcan, "/house/bsp/src/can.rs", "/house/bootloader/src/main.rs"];
        assert_eq!(part(&files), "bsp/can");
        assert_eq!(part(&["/house/core/boot-core/src/intake/ihex.rs"]), "boot-core/intake");
        assert_eq!(part(&["core/canopen/src/lss.rs"]), "canopen/lss");
    }
}
