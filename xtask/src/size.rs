//! `cargo xtask size`: compares the bootloader's flash and stack with their budgets.

use std::process::Command;

use serde_json::json;
use shared_abi::layout::{Layout, BOARDS};

use crate::args::Args;
use crate::build::{self, Variant};
use crate::setup::{self, Part};
use crate::{elf, evidence, outcome::Outcome, process, toolchain, workspace};

pub const HELP: &str = "\
usage: cargo xtask size [--board BOARD]

Builds the plain and the sealed bootloader for every board, and prints the flash of each, and the stack that it
can need (tests/python/stack_depth.py). Fails when one is over the budget. What is in it by function:
arm-none-eabi-nm --demangle --size-sort target/firmware/BOARD/bootloader.elf

  --board BOARD   before that, every bootloader of this board
";

/// The largest permitted sizes in bytes: of resident part, header and RAM image together in the
/// compact map, and of the two in the split map (of 16 and 64 KiB).
const COMPACT: u32 = 32_256;
/// What the largest product leaves free of it, so that the next mistake can be mended.
const SPARE: u32 = 512;
const RESIDENT: u32 = 12 * 1024;
const RAM_IMAGE: u32 = 56 * 1024;

/// The bootloaders that are compared, in each map.
const COMPACT_MAP: &str = "bootloader";
const SPLIT_MAP: &str = "bootloader bootloader-sealed";

pub fn run(mut args: Args) -> Outcome {
    let chosen = workspace::chosen_board(&mut args)?;
    args.none_left()?;
    setup::prepare(&[Part::Firmware, Part::Python])?;
    if let Some(board) = chosen {
        // It prints the sizes.
        let all = Variant::of(board).filter(|variant| variant.is_bootloader()).map(|variant| variant.name);
        build::images(board, &all.collect::<Vec<_>>())?;
    }

    let names = |board: &Layout| if board.home.is_some() { SPLIT_MAP } else { COMPACT_MAP };
    let gated: Vec<_> = BOARDS.iter().map(|board| (*board, names(board))).collect();
    let mut stacks = Command::new(setup::python());
    stacks.arg(workspace::root().join("tests/python/stack_depth.py"));
    for (board, names) in &gated {
        let names: Vec<_> = names.split(' ').collect();
        let folder = build::images(board, &names)?;
        stacks.args(names.iter().map(|name| folder.join(name).with_extension("elf")));
    }
    println!("board                    image                      at         bytes     of");
    let mut problems = Vec::new();
    let (mut images, mut count) = (Vec::new(), 0);
    for (board, names) in gated {
        for name in names.split(' ') {
            count += 1;
            let used = build::size_of(board, name)
                .map_err(|problem| format!("{}, {name}: {problem}", board.board))?;
            let regions = build::bootloader_flash(board);
            for ((bytes, region), budget) in used.iter().zip(regions).zip(budgets(board)) {
                println!("{:<23}  {name:<25}  {:#010x}  {bytes:>5}  {budget:>5}", board.board, region.base);
                images.push(json!({"image": name, "board": board.board, "bytes": bytes, "budget": budget}));
                problems.extend(
                    within(*bytes, budget).err().map(|problem| format!("{}: {problem}", board.board)),
                );
            }
        }
    }
    let facts = json!({"bootloaders": count, "failed": problems.len(), "images": images});
    evidence::record("size", facts)?;
    println!("board                    image                      stack of    bytes     of");
    process::run(&mut stacks)?;
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
            "the bootloader is {over} bytes over its budget of {}; docs/porting.md has what to leave out.",
            elf::kib(*budget)
        )),
    }
}

/// The gate of the compact map: `used` bytes leave [`SPARE`].
///
/// # Errors
/// When they do not.
pub fn spare(used: u32) -> Outcome {
    let free = COMPACT.saturating_sub(used);
    (free >= SPARE).then_some(()).ok_or_else(|| format!(
        "{free} of {COMPACT} bytes are free on the compact map, and {SPARE} have to be. Make the code smaller, or leave \
         something out there by name: a field of Product, its default, and its rule in `checked` (docs/product.md)."
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_budget_itself_is_allowed_and_one_more_is_not() {
        assert_eq!(within(RESIDENT, &RESIDENT), Ok(()));
        assert!(within(RESIDENT + 1, &RESIDENT).unwrap_err().contains("1 bytes over its budget of 12 KiB"));
        assert_eq!(spare(31_744), Ok(()));
        assert!(spare(31_745).unwrap_err().starts_with("511 of 32256 bytes are free"));
        assert!(spare(u32::MAX).unwrap_err().starts_with("0 of"));
    }
}
