//! `cargo xtask emulate`: a board for other programs to talk to.

use crate::args::Args;
use crate::setup::{Part, Setup};
use crate::{build, process, workspace, Outcome};

pub const HELP: &str = "\
usage: cargo xtask emulate [--board BOARD] [--yes] [OPTIONS]

Sets the machine up, builds the firmware and runs the emulated board with the bootloader in its flash.

  --board BOARD   the board (default: stm32f407g-disc1)
  --yes           installs what is missing with sudo
  OPTIONS         go to the emulator; `cargo xtask emulate -- --help` lists them. Among them:
                  --socketcand 127.0.0.1:29536    where other programs reach the bus
";

pub fn run(mut args: Args) -> Outcome {
    let board = workspace::board(&mut args)?;
    let setup = Setup::from(&mut args);
    setup.prepare(&[Part::Firmware, Part::Emulator])?;
    let images = build::images(board)?;

    let mut emulator = process::cargo("run");
    emulator.args(["--package", "emulator", "--bin", "emulate", "--"]);
    emulator.args(args.rest().iter().filter(|word| *word != "--"));
    emulator.arg(&images.bootloader);
    process::run(&mut emulator)
}
