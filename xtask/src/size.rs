//! `cargo xtask size`: compares the bootloader's flash with its budget.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::{cmp, fs};

use serde_json::{json, Value};
use shared_abi::layout::{Layout, BOARDS};

use crate::args::Args;
use crate::elf::Elf;
use crate::footprint::{kib, read, Flash};
use crate::setup::{self, Part};
use crate::{build, evidence, outcome::Outcome, parts, ram_image, toolchain, workspace};

pub const HELP: &str = "\
usage: cargo xtask size [--board BOARD] [--image IMAGE]

Builds the bootloader, prints its flash by section, by part, by variant and by board, and fails when
it is over the budget on any board.

  --board BOARD   the board of the tables (default: stm32f407g-disc1)
  --image IMAGE   this bootloader alone, bootloader-sealed for one, by section and by part
";

/// The largest permitted sizes in bytes: of resident part, header and RAM image together in the
/// compact map, and of the two in the split map (of 16 and 64 KiB).
const COMPACT: u32 = 32_256;
const RESIDENT: u32 = 12 * 1024;
const RAM_IMAGE: u32 = 56 * 1024;

pub fn run(mut args: Args) -> Outcome {
    let board = workspace::board(&mut args)?;
    let one = args.value("--image")?;
    args.none_left()?;
    setup::prepare(&[Part::Firmware])?;
    let parts = tables(board, one.as_deref().unwrap_or("bootloader"))?;
    if one.is_some() {
        return Ok(());
    }
    print!("\n{}", by_variant(board)?);

    println!("\nboard                    image                      at         bytes     of");
    let mut problems = Vec::new();
    let (mut images, mut count) = (Vec::new(), 0);
    for board in BOARDS {
        for name in ["bootloader", "bootloader-sealed"] {
            if board.home.is_none() && name == "bootloader-sealed" {
                continue;
            }
            count += 1;
            let path = build::images(board, &[name])?.join(name).with_extension("elf");
            let flash = Flash::of(&read(&path)?, &build::bootloader_flash(board))?;
            for ((region, bytes), budget) in flash.used.iter().zip(budgets(board)) {
                println!("{:<23}  {name:<25}  {:#010x}  {bytes:>5}  {budget:>5}", board.board, region.base);
                images.push(json!({"image": name, "board": board.board, "bytes": bytes, "budget": budget}));
                problems.extend(
                    within(*bytes, budget).err().map(|problem| format!("{}: {problem}", board.board)),
                );
            }
        }
    }
    let parts: Vec<Value> = parts.iter().map(Share::json).collect();
    let facts = json!({
        "bootloaders": count,
        "failed": problems.len(),
        "images": images,
        "parts_of": board.board,
        "parts": parts,
    });
    evidence::record("size", facts)?;
    toolchain::notice();
    problems.into_iter().next().map_or(Ok(()), Err)
}

/// The budgets of a bootloader's regions ([`build::bootloader_flash`]).
pub fn budgets(board: &Layout) -> &'static [u32] {
    match board.home {
        Some(_) => &[RESIDENT, RAM_IMAGE],
        None => &[COMPACT],
    }
}

/// The size gate.
///
/// # Errors
/// When an image uses more than the budget.
pub fn within(used: u32, budget: &u32) -> Outcome {
    match used.checked_sub(*budget) {
        None | Some(0) => Ok(()),
        Some(over) => Err(format!(
            "the bootloader is {over} bytes over its budget of {}; `cargo xtask size` shows where they are.",
            kib(*budget)
        )),
    }
}

/// Builds an image and prints its flash by section and by part.
fn tables(board: &Layout, name: &str) -> Outcome<Vec<Share>> {
    let path = build::images(board, &[name])?.join(name).with_extension("elf");
    let elf = read(&path)?;
    print!("\n{}", Flash::of(&elf, &build::bootloader_flash(board))?.table());
    let image = elf.sections.iter().find(|section| section.name == ram_image::IMAGE);
    let image = image.ok_or_else(|| format!("{name} is no bootloader: it has no RAM image."))?;
    let file = fs::read(&path).map_err(|error| format!("{}: {error}.", workspace::shown(&path)))?;
    let contents = &file[image.offset as usize..][..image.size as usize];
    let parts = by_part(&elf, parts::of(&path, &file, image.address, contents)?);
    println!("\npart                             bytes");
    for Share { part, bytes } in &parts {
        println!("{part:<31} {bytes:>6}");
    }
    Ok(parts)
}

/// The sizes of the bootloaders of other products, and of those with features that no product has.
fn by_variant(board: &Layout) -> Outcome<String> {
    let mut text = String::from("bootloader                      bytes\n");
    for variant in build::Variant::of(board).filter(|variant| variant.is_bootloader()) {
        let elf = build::to_look_at(board, variant.features, &variant.product()?)?;
        let flash = Flash::of(&Elf::parse(&elf)?, &build::bootloader_flash(board))?;
        let used: Vec<String> = flash.used.iter().map(|(_, bytes)| bytes.to_string()).collect();
        let _ = writeln!(text, "{:<31} {}", variant.name, used.join(" + "));
    }
    Ok(text)
}

/// What a part of the bootloader takes, in bytes.
struct Share {
    part: String,
    bytes: u32,
}

impl Share {
    fn json(&self) -> Value {
        json!({"part": self.part, "bytes": self.bytes})
    }
}

/// Flash by part, the largest first. `image` has the parts of the RAM image; what else is in flash is
/// listed by its section.
fn by_part(elf: &Elf, image: BTreeMap<String, u32>) -> Vec<Share> {
    let others = elf.sections.iter().filter(|section| section.loaded && section.name != ram_image::IMAGE);
    let others =
        others.map(|section| Share { part: format!("{} (in flash)", section.name), bytes: section.size });
    let mut rows: Vec<_> =
        image.into_iter().map(|(part, bytes)| Share { part, bytes }).chain(others).collect();
    let bytes = rows.iter().map(|row| row.bytes).sum();
    rows.push(Share { part: "(all)".to_owned(), bytes });
    rows.sort_by_key(|row| cmp::Reverse(row.bytes));
    rows
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::elf::tests::by_hand;

    #[test]
    fn the_budget_itself_is_allowed_and_one_more_is_not() {
        assert_eq!(within(RESIDENT, &RESIDENT), Ok(()));
        assert!(within(RESIDENT + 1, &RESIDENT).unwrap_err().contains("1 bytes over its budget of 12 KiB"));
    }

    #[test]
    fn the_parts_add_up() {
        let image = [("a/b".to_owned(), 6), ("core".to_owned(), 2)].into();
        let rows: Vec<_> = by_part(&Elf::parse(&by_hand()).unwrap(), image).iter().map(Share::json).collect();
        let expected = [
            json!({"part": "(all)", "bytes": 40}),
            json!({"part": ".vectors (in flash)", "bytes": 32}),
            json!({"part": "a/b", "bytes": 6}),
            json!({"part": "core", "bytes": 2}),
        ];
        assert_eq!(rows, expected);
    }
}
