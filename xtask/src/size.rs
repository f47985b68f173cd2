//! `cargo xtask size`: compares the bootloader's flash with its budget.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::{cmp, fs};

use serde_json::{json, Value};
use shared_abi::layout::{Layout, BOARDS};

use crate::args::Args;
use crate::elf::Elf;
use crate::footprint::{kib, read, Flash, Packed};
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
    let (mut images, mut over) = (Vec::new(), 0);
    let mut keep = |image: &str, board: &Layout, bytes: u32, budget: u32| {
        over += u32::from(bytes > budget);
        images.push(json!({"image": image, "board": board.board, "bytes": bytes, "budget": budget}));
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
    let parts: Vec<Value> = parts.iter().map(Share::json).collect();
    let facts = json!({
        "bootloaders": images.len(),
        "failed": over,
        "images": images,
        "parts_of": board.board,
        "parts": parts,
    });
    evidence::record("size", facts)?;
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
    let parts = by_part(&elf, parts::of(&path, &file, image.address, contents)?);
    println!("\npart                               raw  packed (share)");
    for Share { part, raw, packed } in &parts {
        println!("{part:<31} {raw:>6}  {packed:>6}");
    }
    Ok((flash, parts))
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
    fn json(&self) -> Value {
        json!({"part": self.part, "raw": self.raw, "packed": self.packed})
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::elf::tests::by_hand;

    #[test]
    fn the_budget_itself_is_allowed_and_one_more_is_not() {
        let flash = |used| Flash { sections: Vec::new(), used, packed: None };
        assert_eq!(flash(BUDGET).within(BUDGET), Ok(()));
        assert!(flash(BUDGET + 1).within(BUDGET).unwrap_err().contains("1 bytes over"));
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
            json!({"part": "(all)", "raw": 40, "packed": 36}),
            json!({"part": ".vectors (in flash)", "raw": 32, "packed": 32}),
            json!({"part": "a/b", "raw": 6, "packed": 3}),
            json!({"part": "core", "raw": 2, "packed": 1}),
        ];
        assert_eq!(of_a, expected);
        let with_zeros = rows(&[("a/b", 4), (parts::ZEROS, 4)]);
        assert!(with_zeros.contains(&json!({"part": "a/b", "raw": 4, "packed": 4})), "{with_zeros:?}");
        assert!(with_zeros.contains(&json!({"part": "(zeros)", "raw": 4, "packed": 0})), "{with_zeros:?}");
    }
}
