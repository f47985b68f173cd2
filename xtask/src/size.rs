//! `cargo xtask size`: the bootloader's flash against its budget.

use std::collections::{BTreeMap, HashSet};
use std::fmt::Write as _;
use std::path::Path;
use std::{cmp, fs};

use shared_abi::geometry::Region;
use shared_abi::layout::Layout;

use crate::args::Args;
use crate::elf::Elf;
use crate::setup::{Part, Setup};
use crate::{build, symbols, workspace, Outcome};

pub const HELP: &str = "\
usage: cargo xtask size [--board BOARD] [--yes]

Builds the bootloader, prints its flash by section, by crate and by optional feature, and fails when
it is over the budget.

  --board BOARD   the board (default: stm32f407g-disc1)
  --yes           installs what is missing with sudo
";

/// What the bootloader may take of its region, in bytes: so much less than all of it that this is
/// told before the linker fails. The aim is 24 KiB (docs/adr/0007-resident-part.md).
pub const BUDGET: u32 = 31 * 1024 + 512;

pub fn run(mut args: Args) -> Outcome {
    let board = workspace::board(&mut args)?;
    let setup = Setup::from(&mut args);
    args.none_left()?;
    setup.prepare(&[Part::Firmware])?;
    let elf = read(&build::bootloader(board)?)?;
    let flash = Flash::of(&elf, board.bootloader)?;
    print!("\n{}", flash.table());
    print!("\n{}", by_crate(&elf));
    print!("\n{}", by_feature(board)?);
    println!(
        "\nbootloader: {} of {} bytes ({} of flash kept for it)",
        flash.used,
        BUDGET,
        kib(board.bootloader.size)
    );
    flash.within(BUDGET)
}

/// Reads an ELF file.
///
/// # Errors
/// When it cannot be read or is none; the message names the file.
pub fn read(path: &Path) -> Outcome<Elf> {
    let file =
        fs::read(path).map_err(|error| format!("{} cannot be read: {error}.", workspace::shown(path)))?;
    Elf::parse(&file).map_err(|problem| format!("{}: {problem}", workspace::shown(path)))
}

/// What an image occupies of its flash region.
#[derive(Debug, PartialEq, Eq)]
pub struct Flash {
    /// Name, load address and length of each loaded section, in the order of addresses.
    pub sections: Vec<(String, u32, u32)>,
    /// Bytes from the region's base to the last loaded one: what has to be written and what the CRC
    /// runs over, gaps included.
    pub used: u32,
}

impl Flash {
    /// Measures an image.
    ///
    /// # Errors
    /// When the image loads nothing, or anything outside its region.
    pub fn of(elf: &Elf, region: Region) -> Outcome<Self> {
        let mut used = 0;
        for segment in elf.segments.iter().filter(|segment| segment.file_size > 0) {
            if !region.contains(segment.load_address, segment.file_size) {
                return Err(format!(
                    "{} bytes are loaded at {:#010x}, outside the image's flash ({:#010x}, {}); \
                     the linker script and the layout do not agree.",
                    segment.file_size,
                    segment.load_address,
                    region.base,
                    kib(region.size)
                ));
            }
            used = cmp::max(used, segment.load_address - region.base + segment.file_size);
        }
        if used == 0 {
            return Err("the image loads nothing into flash.".into());
        }
        let mut sections: Vec<_> = elf
            .sections
            .iter()
            .filter_map(|section| Some((section.name.clone(), elf.load_address(section)?, section.size)))
            .collect();
        sections.sort_by_key(|&(_, address, _)| address);
        Ok(Self { sections, used })
    }

    /// The gate.
    ///
    /// # Errors
    /// When more is used than the budget allows.
    pub fn within(&self, budget: u32) -> Outcome {
        match self.used.checked_sub(budget) {
            None | Some(0) => Ok(()),
            Some(over) => Err(format!(
                "the bootloader is {over} bytes over its budget of {}; the tables above show where they are.",
                kib(budget)
            )),
        }
    }

    fn table(&self) -> String {
        let mut text = String::from("section             flash at     bytes\n");
        for (name, address, size) in &self.sections {
            let _ = writeln!(text, "{name:<18}  {:04X}_{:04X}  {size:>7}", address >> 16, address & 0xFFFF);
        }
        text
    }
}

/// What each optional feature costs on top of a bootloader without any, and what whole dialects
/// take.
fn by_feature(board: &Layout) -> Outcome<String> {
    let used = |features: &[&str]| -> Outcome<u32> {
        Ok(Flash::of(&read(&build::bootloader_with(board, features)?)?, board.bootloader)?.used)
    };
    let bare = used(&[])?;
    let mut text = String::from("feature                          bytes, on top of none\n");
    for feature in build::OPTIONAL {
        let _ = writeln!(text, "{feature:<31} {:>6}", i64::from(used(&[feature])?) - i64::from(bare));
    }
    let _ = writeln!(text, "\nbootloader                       bytes\n{:<31} {bare:>6}", "without features");
    for features in [build::STANDARD, build::COMPLETE, "profile-paulus", "profile-esacademy", "profile-lift"]
    {
        let _ = writeln!(text, "{features:<31} {:>6}", used(&[features])?);
    }
    Ok(text)
}

/// Flash by crate, as the symbols tell. Code that was inlined counts for the crate it ended up in.
fn by_crate(elf: &Elf) -> String {
    let mut seen = HashSet::new();
    let mut crates: BTreeMap<&str, u32> = BTreeMap::new();
    let mut named = 0;
    for symbol in &elf.symbols {
        let loaded = elf.sections.get(symbol.section).is_some_and(|section| section.loaded);
        // Aliases (the default handlers are many names of one function) count once.
        if loaded && symbol.size > 0 && seen.insert(symbol.address & !1) {
            let name = match symbols::crate_of(&symbol.name) {
                Some(name) => name,
                // Tasks, handlers and memcpy carry plain names; the large ones are worth a row.
                None if symbol.size >= 64 => &symbol.name,
                None => "(small symbols)",
            };
            *crates.entry(name).or_default() += symbol.size;
            named += symbol.size;
        }
    }
    let all: u32 = elf.sections.iter().filter(|section| section.loaded).map(|section| section.size).sum();
    let mut rows: Vec<_> = crates.into_iter().collect();
    rows.push(("(no symbol)", all.saturating_sub(named)));
    rows.sort_by_key(|&(_, size)| cmp::Reverse(size));
    let mut text = String::from("crate, or plain symbol           bytes\n");
    for (name, size) in rows {
        let _ = writeln!(text, "{name:<31} {size:>6}");
    }
    text
}

/// A number of bytes, in KiB where it is whole.
pub fn kib(bytes: u32) -> String {
    if bytes.is_multiple_of(1024) {
        format!("{} KiB", bytes / 1024)
    } else {
        format!("{bytes} bytes")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::elf::tests::by_hand;

    const REGION: Region = Region::new(0x0800_0000, 0x1000);

    #[test]
    fn sections_count_where_they_are_loaded_not_where_they_run() {
        let flash = Flash::of(&Elf::parse(&by_hand()).unwrap(), REGION).unwrap();
        assert_eq!(
            flash.sections,
            [(".vectors".into(), 0x0800_0000, 0x20), (".data".into(), 0x0800_0020, 8)]
        );
        assert_eq!(flash.used, 0x28);
    }

    #[test]
    fn a_gap_counts_as_used() {
        let mut elf = Elf::parse(&by_hand()).unwrap();
        elf.segments[1].load_address = 0x0800_0200;
        assert_eq!(Flash::of(&elf, REGION).unwrap().used, 0x208);
    }

    #[test]
    fn the_budget_itself_is_allowed_and_one_more_is_not() {
        let flash = |used| Flash { sections: Vec::new(), used };
        assert_eq!(flash(BUDGET).within(BUDGET), Ok(()));
        assert!(flash(BUDGET + 1).within(BUDGET).unwrap_err().contains("1 bytes over"));
    }

    #[test]
    fn an_image_outside_its_region_is_refused() {
        let elf = Elf::parse(&by_hand()).unwrap();
        for region in [Region::new(0x0801_0000, 0x1000), Region::new(0x0800_0000, 0x27)] {
            assert!(Flash::of(&elf, region).unwrap_err().contains("outside"));
        }
        let mut empty = elf;
        empty.segments.clear();
        assert!(Flash::of(&empty, REGION).unwrap_err().contains("nothing"));
    }

    #[test]
    fn crates_and_what_no_symbol_claims_add_up() {
        let mut elf = Elf::parse(&by_hand()).unwrap();
        let alias = elf.symbols[0].clone();
        elf.symbols.push(alias);
        elf.symbols[1].name = "alias".into();
        let table = by_crate(&elf);
        // 0x20 + 8 bytes are loaded, 0x10 of them are `start`, counted once.
        assert!(table.contains("(no symbol)                         24\n"), "{table}");
        assert!(table.contains("(small symbols)                     16\n"), "{table}");
        elf.symbols[0].size = 64;
        assert!(by_crate(&elf).contains("start                               64\n"), "{table}");
    }
}
