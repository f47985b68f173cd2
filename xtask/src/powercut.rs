//! `cargo xtask powercut`: tests that no power cut bricks a device.

use crate::args::Args;
use crate::setup::{Part, Setup};
use crate::{build, process, workspace, Outcome};

pub const HELP: &str = "\
usage: cargo xtask powercut [--full] [--json] [--reproduce POINT] [--board BOARD] [--yes]

Cuts the power at every flash operation of updates, stores and erasures, in every way, and once more
in the recovery; then looks what the device does. Fails if it finds a device that cannot be reached,
half a program that would start, or a stored value that is gone.

  --full             every way also for the second cut, and every operation of the real firmware
  --json             prints the counts as JSON
  --reproduce POINT  tells one point in words, as update:37:torn:12:after
  --board BOARD      the board (default: stm32f407g-disc1)
  --yes              installs what is missing with sudo
";

pub fn run(mut args: Args) -> Outcome {
    let board = workspace::board(&mut args)?;
    let setup = Setup::from(&mut args);
    let (full, json) = (args.flag("--full"), args.flag("--json"));
    let point = args.value("--reproduce")?;
    args.none_left()?;
    setup.prepare(&[Part::Firmware, Part::Emulator])?;
    let images = build::all(board)?;
    let mut powercut = process::cargo("run");
    powercut.args(build::tests_args(board)).args(["--bin", "powercut", "--"]);
    powercut.args(full.then_some("--full")).args(json.then_some("--json"));
    if let Some(point) = point {
        powercut.args(["--reproduce", &point]);
    }
    powercut.env("COBOOT_BOARD", board.board).env("COBOOT_FIRMWARE_DIR", images);
    process::run(&mut powercut)
}
