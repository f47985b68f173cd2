//! `cargo xtask eds`: writes the EDS files, from the object dictionaries of the firmware.

use shared_abi::layout;

use crate::args::Args;
use crate::product::Product;
use crate::setup::{self, Part};
use crate::{build, files, outcome::Outcome, process, workspace};

pub const HELP: &str = "\
usage: cargo xtask eds [--product FILE|NAME] [--board BOARD]

Writes the electronic data sheets of bootloaders and application template (CiA 306-1) to target/eds/BOARD. They are
made from the tables of the object dictionaries. Run this after a change there: it renews those in docs/eds, and a
test compares.

  --product FILE  those of this product, as for `build`: the bootloader, and the one for sealed images
  --board BOARD   the board whose identity and bit rates they have (default: stm32f407g-disc1)
";

pub fn run(mut args: Args) -> Outcome {
    let board = workspace::board(&mut args)?;
    let product = args.value("--product")?.map_or(Ok(Product::default()), |word| Product::chosen(&word))?;
    let is_kept = board.board == layout::DEFAULT.board && product.is_default();
    let folder = workspace::target_dir().join("eds").join(board.board);
    args.none_left()?;
    // The crate that makes them is the crate of the emulated tests.
    setup::prepare(&[Part::Emulator])?;
    let mut cargo = build::tests("run", board);
    cargo.args(product.args()).args(["--bin", "eds", "--"]);
    process::run(cargo.arg(&folder))?;
    for kept in files::within(&workspace::root().join("docs/eds"))?.into_iter().filter(|_| is_kept) {
        let made = folder.join(kept.file_name().unwrap_or_default());
        files::write(&kept, files::text(&made)?)?;
    }
    Ok(())
}
