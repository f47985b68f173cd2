//! `cargo xtask eds`: writes the EDS files, from the object dictionaries of the firmware.

use shared_abi::layout;

use crate::args::Args;
use crate::setup::{self, Part};
use crate::{build, files, process, workspace, Outcome};

pub const HELP: &str = "\
usage: cargo xtask eds [--board BOARD] [--out FOLDER]

Writes the electronic data sheets of bootloader and application template (CiA 306-1), for
configuration tools and masters. They are made from the tables of the object dictionaries; run this
after a change there, a test compares.

  --board BOARD   the board whose identity and bit rates they tell (default: stm32f407g-disc1)
  --out FOLDER    where to (default: docs/eds, which are those of the default board; for another one
                  target/eds/BOARD)
";

pub fn run(mut args: Args) -> Outcome {
    let board = workspace::board(&mut args)?;
    let out = args.value("--out")?;
    args.none_left()?;
    // The crate that makes them is the crate of the emulated tests.
    setup::prepare(&[Part::Emulator])?;
    let folder = match out {
        Some(folder) => folder.into(),
        None if board.board == layout::DEFAULT.board => workspace::root().join("docs/eds"),
        None => workspace::target_dir().join("eds").join(board.board),
    };
    files::make(&folder)?;
    process::run(build::tests_program(board, "eds").arg(&folder))
}
