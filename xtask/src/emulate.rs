//! `cargo xtask emulate`: a board for other programs to talk to.

use crate::args::Args;
use crate::setup::{Part, Setup};
use crate::{build, process, workspace, Outcome};

pub const HELP: &str = "\
usage: cargo xtask emulate [--board BOARD] [--log] [--yes] [OPTIONS]

Sets the machine up, builds the firmware and runs the emulated board with the bootloader in its flash.

  --board BOARD   the board (default: stm32f407g-disc1)
  --log           the bootloader that tells a debug probe what it does, and what it tells
  --yes           installs what is missing with sudo
  OPTIONS         go to the emulator; `cargo xtask emulate -- --help` lists them. Among them:
                  --socketcand 127.0.0.1:29536    where other programs reach the bus
                  --app FILE                      an application in flash, as a debug probe puts it there
                  --trace FILE                    the bus as a candump log
                  --bootloader FILE               another bootloader than the one built here
";

pub fn run(mut args: Args) -> Outcome {
    let board = workspace::board(&mut args)?;
    let log = args.flag("--log");
    let setup = Setup::from(&mut args);
    setup.prepare(&[Part::Firmware, Part::Emulator])?;
    let images = build::images(board)?;

    let options = args.rest();
    let mut emulator = process::cargo("run");
    emulator.args(["--package", "emulator", "--bin", "emulate", "--", "--board", board.board]);
    if !options.iter().any(|word| word == "--bootloader" || word.starts_with("--bootloader=")) {
        emulator.arg("--bootloader").arg(if log { &images.log } else { &images.bootloader });
    }
    emulator.args(options.iter().filter(|word| *word != "--"));
    process::run(&mut emulator)
}
