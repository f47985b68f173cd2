//! `cargo xtask emulate`: runs an emulated board for other programs.

use shared_abi::layout;

use crate::args::Args;
use crate::setup::{self, Part};
use crate::{build, outcome::Outcome, process, workspace};

pub const HELP: &str = "\
usage: cargo xtask emulate [--board BOARD] [--log[=WAY] | --virtual-can] [OPTIONS]

Sets the machine up, builds a bootloader and runs the emulated board with it in its flash.

  --board BOARD   the board (default: stm32f407g-disc1), or with --bootloader its file, which `cargo xtask build`
                  writes beside the images: BOARD.toml
  --log[=WAY]     the bootloader that logs what it does, and its log. WAY: rtt (text for a debug
                  probe; the default), defmt (the same by defmt), uart (text out of the board's UART)
  --virtual-can   the bootloader that speaks CAN over the board's UART, which a pseudo-terminal leads to
  OPTIONS         go to the emulator; `cargo xtask emulate -- --help` lists them. Among them:
                  --socketcand 127.0.0.1:29536    where other programs reach the bus
                  --app FILE                      an application in flash, as a debug probe puts it there
                  --serial pty                    where other programs reach the board's UART
                  --trace FILE                    the bus as a candump log
                  --hse HZ                        another crystal than the board's
                  --silicon SEED                  a chip that the seed draws, within what the manuals leave open
                  --can NUMBER                    another CAN controller for the transceiver
                  --flash FILE                    keeps the flash from one run to the next
                  --control 127.0.0.1:29600       where commands for power, reset and pins are taken
                  --gdb 127.0.0.1:3333            where gdb is let in
                  --bootloader FILE               another bootloader than the one built here
";

pub fn run(mut args: Args) -> Outcome {
    let word = args.value("--board")?.unwrap_or_else(|| layout::DEFAULT.board.to_owned());
    let log = if args.flag("--log") { Some("rtt".to_owned()) } else { args.value("--log")? };
    let virtual_can = args.flag("--virtual-can");
    let options = args.remaining();
    let has = |name: &str| options.iter().any(|word| word.split('=').next() == Some(name));

    let mut emulator = process::cargo("run --package coboot-emulator --bin emulate -- --board");
    if has("--bootloader") {
        // The emulator reads the memory map of any board.
        setup::prepare(&[Part::Emulator])?;
        emulator.arg(&word);
    } else {
        let board = workspace::board_named(&word)
            .map_err(|problem| format!("{problem} The map of another one goes with --bootloader FILE."))?;
        let bootloader = match log {
            Some(way) => format!("bootloader-log-{way}"),
            None if virtual_can => "bootloader-virtual-can".to_owned(),
            None => "bootloader".to_owned(),
        };
        // A way that there is not is refused before anything is installed.
        build::Variant::by_name(board, &bootloader)?;
        setup::prepare(&[Part::Firmware, Part::Emulator])?;
        let dir = build::images(board, &[&bootloader])?;
        emulator.arg(build::file_of(board)).arg("--bootloader").arg(dir.join(format!("{bootloader}.elf")));
    }
    if virtual_can && !has("--serial") {
        emulator.args(["--serial", "pty"]);
    }
    process::run(emulator.args(options.iter().filter(|word| *word != "--")))
}
