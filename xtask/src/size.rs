//! `cargo xtask size`: compares the bootloader's flash with its budget.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;
use std::{cmp, fs};

use shared_abi::geometry::Region;
use shared_abi::layout::{Layout, BOARDS};

use crate::args::Args;
use crate::elf::Elf;
use crate::setup::{Part, Setup};
use crate::{build, evidence, pack, parts, toolchain, workspace, Outcome};

pub const HELP: &str = "\
usage: cargo xtask size [--board BOARD] [--image IMAGE] [--yes]

Builds the bootloader, prints its flash by section, by part, by variant and by board, and fails when
it is over the budget on any board, or with sealed images over what the key block leaves of the
region. What runs from RAM lies in flash packed: sizes are told as they are unpacked (raw) and as the
flash has them (packed). A share of what is packed is an estimate: as much of it as of the raw, but
for long runs of zeros, which take next to nothing.

  --board BOARD   the board of the tables (default: stm32f407g-disc1)
  --image IMAGE   this bootloader alone, bootloader-sealed for one, by section and by part
  --yes           installs what is missing with sudo
";

/// The largest permitted size of the bootloader on any board, in bytes, with every dialect and
/// option in it. The aim is 20 KiB; the region has 32 KiB, and sealed images need the rest.
pub const BUDGET: u32 = 23 * 1024;

pub fn run(mut args: Args) -> Outcome {
    let board = workspace::board(&mut args)?;
    let one = args.value("--image")?;
    let setup = Setup::from(&mut args);
    args.none_left()?;
    setup.prepare(&[Part::Firmware])?;
    let (flash, parts) = tables(board, one.as_deref().unwrap_or("bootloader"))?;
    if one.is_some() {
        return Ok(());
    }
    print!("\n{}", by_variant(board)?);
    println!(
        "\n{} if nothing were packed; {} of flash are kept for it",
        flash.raw(),
        kib(board.bootloader.size)
    );

    println!("\nboard                            bytes  of {BUDGET}");
    let mut within = Ok(());
    let mut images = Vec::new();
    let mut keep = |image: &str, board: &Layout, bytes: u32, budget: u32| {
        images.push(format!(
            "{{\"image\": \"{image}\", \"board\": \"{}\", \"bytes\": {bytes}, \"budget\": {budget}}}",
            board.board
        ));
    };
    for board in BOARDS {
        let path = build::images(board, &["bootloader"])?.join("bootloader.elf");
        let flash = Flash::of(&read(&path)?, board.bootloader)?;
        println!("{:<31} {:>6}", board.board, flash.used);
        keep("bootloader", board, flash.used, BUDGET);
        within = within.and(flash.within(BUDGET).map_err(|problem| format!("{}: {problem}", board.board)));
    }
    println!("\nwith sealed images               bytes     of");
    for board in BOARDS {
        let room = board.bootloader_image();
        let path = build::images(board, &["bootloader-sealed"])?.join("bootloader-sealed.elf");
        let flash = Flash::of(&read(&path)?, room)?;
        println!("{:<31} {:>6}  {}", board.board, flash.used, room.size);
        keep("bootloader-sealed", board, flash.used, room.size);
        within = within.and(flash.within(room.size).map_err(|problem| format!("{}: {problem}", board.board)));
    }
    let parts: Vec<String> = parts.iter().map(Share::json).collect();
    let facts = format!(
        "{{\"images\": [{}], \"parts_of\": \"{}\", \"parts\": [{}]}}",
        images.join(",\n"),
        board.board,
        parts.join(",\n")
    );
    evidence::record("size", &facts)?;
    toolchain::notice();
    within
}

/// Builds an image and prints its flash by section and by part.
fn tables(board: &Layout, name: &str) -> Outcome<(Flash, Vec<Share>)> {
    let path = build::images(board, &[name])?.join(name).with_extension("elf");
    let elf = read(&path)?;
    let flash = Flash::of(&elf, board.bootloader)?;
    print!("\n{}", flash.table());
    let image = elf.sections.iter().find(|section| section.name == pack::IMAGE);
    let image = image.ok_or_else(|| format!("{name} is no bootloader: it has no RAM image."))?;
    let file = fs::read(&path).map_err(|error| format!("{}: {error}.", workspace::shown(&path)))?;
    let contents = &file[image.offset as usize..][..image.size as usize];
    let parts = by_part(&elf, parts::of(&path, image.address, contents)?);
    println!("\npart                               raw  packed (share)");
    for Share { part, raw, packed } in &parts {
        println!("{part:<31} {raw:>6}  {packed:>6}");
    }
    Ok((flash, parts))
}

/// Reads an ELF file.
///
/// # Errors
/// When it cannot be read or is not an ELF file; the message names the file.
pub fn read(path: &Path) -> Outcome<Elf> {
    let file =
        fs::read(path).map_err(|error| format!("{} cannot be read: {error}.", workspace::shown(path)))?;
    Elf::parse(&file).map_err(|problem| format!("{}: {problem}", workspace::shown(path)))
}

/// The part of its flash region that an image occupies.
#[derive(Debug, PartialEq, Eq)]
pub struct Flash {
    /// Name, load address and length of each loaded section, in the order of addresses.
    pub sections: Vec<(String, u32, u32)>,
    /// Bytes from the region's base to the last loaded one, gaps included: they are written, and
    /// the CRC covers them.
    pub used: u32,
    /// The packed part, if there is one.
    pub packed: Option<Packed>,
}

/// The part of an image that is packed in flash (`pack.rs`).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Packed {
    /// Bytes in flash.
    pub stored: u32,
    /// Bytes in RAM.
    pub raw: u32,
}

impl Packed {
    /// The packed part of an image.
    fn of(elf: &Elf) -> Option<Self> {
        let size_of = |name| Some(elf.sections.iter().find(|section| section.name == name)?.size);
        Some(Self { stored: size_of(pack::PACKED)?, raw: size_of(pack::IMAGE)? })
    }

    /// The share of `raw` bytes in the packed bytes, with `zeros` of all raw bytes taking no room.
    fn share(self, raw: u32, zeros: u32) -> u32 {
        let counted = u64::from(self.raw.saturating_sub(zeros).max(1));
        (u64::from(raw) * u64::from(self.stored)).div_ceil(counted) as u32
    }
}

impl Flash {
    /// Measures an image.
    ///
    /// # Errors
    /// When the image loads nothing, or loads a byte outside its region.
    pub fn of(elf: &Elf, region: Region) -> Outcome<Self> {
        let mut used = 0;
        for segment in elf.segments.iter().filter(|segment| segment.file_size > 0) {
            let behind = segment.load_address.saturating_add(segment.file_size);
            if region.contains(segment.load_address, 1) && behind > region.end() {
                return Err(format!(
                    "it needs {} bytes of flash{}, and has {}: {} too many.",
                    behind - region.base,
                    if Packed::of(elf).is_some() { ", packed" } else { "" },
                    region.size,
                    behind - region.end()
                ));
            }
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
        Ok(Self { sections, used, packed: Packed::of(elf) })
    }

    /// Bytes as in [`used`](Self::used), if nothing were packed.
    pub fn raw(&self) -> u32 {
        self.packed.map_or(self.used, |packed| self.used - packed.stored + packed.raw)
    }

    /// The size gate.
    ///
    /// # Errors
    /// When the image uses more than the budget.
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
        let mut text = String::from("section             flash at     bytes      raw\n");
        for (name, address, size) in &self.sections {
            let raw = self.packed.filter(|_| name == pack::PACKED).map_or(*size, |packed| packed.raw);
            let (upper, lower) = (address >> 16, address & 0xFFFF);
            let _ = writeln!(text, "{name:<18}  {upper:04X}_{lower:04X}  {size:>7}  {raw:>7}");
        }
        text
    }
}

/// The sizes of the bootloaders of other products, and of those with features that no product has.
fn by_variant(board: &Layout) -> Outcome<String> {
    let measure = |variant: &build::Variant| -> Outcome<Flash> {
        let elf = build::to_look_at(board, variant.features, &variant.product()?)?;
        Flash::of(&Elf::parse(&elf)?, board.bootloader)
    };
    let mut text = String::new();
    let _ = writeln!(text, "bootloader                      packed     raw");
    for variant in build::Variant::of(board).filter(|variant| variant.is_bootloader()) {
        let flash = measure(variant)?;
        let _ = writeln!(text, "{:<31} {:>6}  {:>6}", variant.name, flash.used, flash.raw());
    }
    Ok(text)
}

/// What a part of the bootloader takes, in bytes.
struct Share {
    part: String,
    raw: u32,
    packed: u32,
}

impl Share {
    fn json(&self) -> String {
        let Self { part, raw, packed } = self;
        format!("{{\"part\": \"{part}\", \"raw\": {raw}, \"packed\": {packed}}}")
    }
}

/// Flash by part: raw, and the share of the packed bytes, the largest first. `image` has the parts
/// of the RAM image; code that runs from flash is listed by its section.
fn by_part(elf: &Elf, image: BTreeMap<String, u32>) -> Vec<Share> {
    let packed = Packed::of(elf);
    let zeros = image.get(parts::ZEROS).copied().unwrap_or(0);
    let share = |part: &str, raw| match packed {
        Some(_) if part == parts::ZEROS => 0,
        Some(packed) => packed.share(raw, zeros),
        None => raw,
    };
    let plain = elf.sections.iter().filter(|section| section.loaded);
    let plain = plain.filter(|section| section.name != pack::PACKED && section.name != pack::IMAGE);
    let plain = plain.map(|section| Share {
        part: format!("{} (in flash)", section.name),
        raw: section.size,
        packed: section.size,
    });
    let row = |(part, raw): (String, u32)| Share { packed: share(&part, raw), part, raw };
    let mut rows: Vec<_> = image.into_iter().map(row).chain(plain).collect();
    let sum = |of: fn(&Share) -> u32| rows.iter().map(of).sum();
    let all = Share { part: "(all)".to_owned(), raw: sum(|row| row.raw), packed: sum(|row| row.packed) };
    rows.push(all);
    rows.sort_by_key(|row| cmp::Reverse(row.raw));
    rows
}

/// A number of bytes, in KiB if it is a whole number of them.
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
        let flash = |used| Flash { sections: Vec::new(), used, packed: None };
        assert_eq!(flash(BUDGET).within(BUDGET), Ok(()));
        assert!(flash(BUDGET + 1).within(BUDGET).unwrap_err().contains("1 bytes over"));
    }

    #[test]
    fn an_image_outside_its_region_is_refused() {
        let elf = Elf::parse(&by_hand()).unwrap();
        let elsewhere = Region::new(0x0801_0000, 0x1000);
        assert!(Flash::of(&elf, elsewhere).unwrap_err().contains("outside"));
        let small = Region::new(0x0800_0000, 0x27);
        let problem = Flash::of(&elf, small).unwrap_err();
        assert_eq!(problem, "it needs 40 bytes of flash, and has 39: 1 too many.");
        let mut empty = elf;
        empty.segments.clear();
        assert!(Flash::of(&empty, REGION).unwrap_err().contains("nothing"));
    }

    /// Of 40 bytes in RAM 10 are in flash: a quarter of each part, rounded up.
    #[test]
    fn what_is_packed_counts_by_its_share() {
        let packed = Packed { stored: 10, raw: 40 };
        let share = |raw| packed.share(raw, 0);
        assert_eq!((share(40), share(8), share(9), share(0)), (10, 2, 3, 0));
        assert_eq!(packed.share(8, 20), 4, "half of all are zeros");
        let flash = Flash { sections: Vec::new(), used: 100, packed: Some(packed) };
        assert_eq!(flash.raw(), 130);

        let mut elf = Elf::parse(&by_hand()).unwrap();
        // `.data` of 8 bytes is the image, of which 4 are stored.
        let mut stored = elf.sections[1].clone();
        (stored.name, stored.size) = (pack::PACKED.into(), 4);
        elf.sections.push(stored);
        let rows = |image: &[(&str, u32)]| {
            let image = image.iter().map(|(part, raw)| ((*part).to_owned(), *raw)).collect();
            by_part(&elf, image).iter().map(Share::json).collect::<Vec<_>>()
        };
        let of_a = rows(&[("a/b", 6), ("core", 2)]);
        let expected = [
            r#"{"part": "(all)", "raw": 40, "packed": 36}"#,
            r#"{"part": ".vectors (in flash)", "raw": 32, "packed": 32}"#,
            r#"{"part": "a/b", "raw": 6, "packed": 3}"#,
            r#"{"part": "core", "raw": 2, "packed": 1}"#,
        ];
        assert_eq!(of_a, expected);
        let with_zeros = rows(&[("a/b", 4), (parts::ZEROS, 4)]);
        assert!(
            with_zeros.contains(&r#"{"part": "a/b", "raw": 4, "packed": 4}"#.to_owned()),
            "{with_zeros:?}"
        );
        assert!(
            with_zeros.contains(&r#"{"part": "(zeros)", "raw": 4, "packed": 0}"#.to_owned()),
            "{with_zeros:?}"
        );
    }
}
