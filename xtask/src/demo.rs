//! `cargo xtask demo`: the main job, end to end.

use crate::args::Args;
use crate::setup::{Part, Setup};
use crate::{build, process, workspace, Outcome};

pub const HELP: &str = "\
usage: cargo xtask demo [--trace FILE] [--board BOARD] [--yes]

Sets the machine up, builds bootloader and application and plays the main job on an emulated board: power on, flash
version 1 over CANopen, start it, call it back, flash version 2, cut the power, see version 2 start.

  --trace FILE    writes the bus to FILE, as candump logs it
  --board BOARD   the board (default: stm32f407g-disc1)
  --yes           installs what is missing with sudo
";

pub fn run(mut args: Args) -> Outcome {
    let board = workspace::board(&mut args)?;
    let trace = args.value("--trace")?;
    let setup = Setup::from(&mut args);
    args.none_left()?;
    setup.prepare(&[Part::Firmware, Part::Emulator])?;
    let images = build::images(board, &build::MAIN)?;

    let mut demo = process::cargo("run");
    demo.args(build::tests_args(board)).args(["--bin", "demo", "--"]);
    if let Some(trace) = trace {
        demo.args(["--trace", &trace]);
    }
    demo.env("COBOOT_BOARD", board.board).env("COBOOT_FIRMWARE_DIR", images);
    process::run(&mut demo)
}
