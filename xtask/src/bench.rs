//! `cargo xtask bench`: how fast a program gets into the device.

use crate::args::Args;
use crate::setup::{Part, Setup};
use crate::{build, process, workspace, Outcome};

pub const HELP: &str = "\
usage: cargo xtask bench [--json] [--board BOARD] [--yes]

Downloads programs of 64, 256 and 900 KiB at 125 to 1000 kbit/s into an emulated board, in virtual
time, and prints how long that took beside what the wire and the flash allow at best.

  --json          prints the table as JSON
  --board BOARD   the board (default: stm32f407g-disc1)
  --yes           installs what is missing with sudo
";

pub fn run(mut args: Args) -> Outcome {
    let board = workspace::board(&mut args)?;
    let json = args.flag("--json");
    let setup = Setup::from(&mut args);
    args.none_left()?;
    setup.prepare(&[Part::Firmware, Part::Emulator])?;
    let images = build::images(board)?;
    let mut bench = process::cargo("run");
    bench.args(["--package", "coboot-tests", "--bin", "bench", "--"]);
    if json {
        bench.arg("--json");
    }
    bench.env("COBOOT_BOARD", board.board).env("COBOOT_FIRMWARE_DIR", &images.dir);
    process::run(&mut bench)
}
