//! `cargo xtask emulate`: a board for other programs to talk to.

use crate::args::Args;
use crate::setup::{Part, Setup};
use crate::{build, process, workspace, Outcome};

pub const HELP: &str = "\
usage: cargo xtask emulate [--board BOARD] [--log[=WAY] | --virtual-can] [--yes] [OPTIONS]

Sets the machine up, builds the firmware and runs the emulated board with the bootloader in its flash.

  --board BOARD   the board (default: stm32f407g-disc1)
  --log[=WAY]     the bootloader that tells what it does, and what it tells. WAY: rtt (text for a debug
                  probe; the default), defmt (the same by defmt), uart (text out of the board's UART)
  --virtual-can   the bootloader that speaks CAN over the board's UART, which a pseudo-terminal leads to
  --yes           installs what is missing with sudo
  OPTIONS         go to the emulator; `cargo xtask emulate -- --help` lists them. Among them:
                  --socketcand 127.0.0.1:29536    where other programs reach the bus
                  --app FILE                      an application in flash, as a debug probe puts it there
                  --serial pty                    where other programs reach the board's UART
                  --trace FILE                    the bus as a candump log
                  --bootloader FILE               another bootloader than the one built here
";

pub fn run(mut args: Args) -> Outcome {
    let board = workspace::board(&mut args)?;
    let log = log(&mut args)?;
    let virtual_can = args.flag("--virtual-can");
    let setup = Setup::from(&mut args);
    setup.prepare(&[Part::Firmware, Part::Emulator])?;
    let images = build::images(board)?;

    let options = args.rest();
    let mut emulator = process::cargo("run");
    emulator.args(["--package", "emulator", "--bin", "emulate", "--", "--board", board.board]);
    if !options.iter().any(|word| word == "--bootloader" || word.starts_with("--bootloader=")) {
        let standard = if virtual_can { &images.virtual_can } else { &images.bootloader };
        emulator.arg("--bootloader").arg(log.map_or(standard, |way| &images.logs[way]));
    }
    if virtual_can && !options.iter().any(|word| word == "--serial" || word.starts_with("--serial=")) {
        emulator.args(["--serial", "pty"]);
    }
    emulator.args(options.iter().filter(|word| *word != "--"));
    process::run(&mut emulator)
}

/// The bootloader that is asked for, as a place in [`build::LOGS`].
fn log(args: &mut Args) -> Outcome<Option<usize>> {
    if args.flag("--log") {
        return Ok(Some(0));
    }
    let Some(wanted) = args.value("--log")? else { return Ok(None) };
    let ways = build::LOGS.map(|(way, _)| way);
    let found = ways.iter().position(|way| *way == wanted);
    found.map(Some).ok_or_else(|| format!("--log={wanted} is no way; there are {}.", ways.join(", ")))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn asked(words: &str) -> Outcome<Option<usize>> {
        log(&mut Args::new(words.split_whitespace().map(str::to_owned)))
    }

    #[test]
    fn the_ways_of_the_log() {
        assert_eq!(asked(""), Ok(None));
        assert_eq!(asked("--log --verbose"), Ok(Some(0)));
        assert_eq!(asked("--log=uart").map(|way| build::LOGS[way.unwrap()].1), Ok("emcy,lss,log-uart"));
        assert_eq!(asked("--log=defmt").map(|way| build::LOGS[way.unwrap()].1), Ok("emcy,lss,log-defmt"));
        assert!(asked("--log=smoke").unwrap_err().contains("rtt, defmt, uart"));
    }
}
