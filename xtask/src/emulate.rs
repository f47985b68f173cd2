//! `cargo xtask emulate`: runs an emulated board for other programs.

use crate::args::Args;
use crate::build::VARIANTS;
use crate::setup::{Part, Setup};
use crate::{build, process, workspace, Outcome};

pub const HELP: &str = "\
usage: cargo xtask emulate [--board BOARD] [--log[=WAY] | --virtual-can] [--yes] [OPTIONS]

Sets the machine up, builds a bootloader and runs the emulated board with it in its flash.

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
                  --hse HZ                        the crystal, if it has not 8 MHz
                  --can NUMBER                    the CAN controller that the transceiver is at
                  --flash FILE                    keeps the flash from one run to the next
                  --control 127.0.0.1:29600       where commands for power, reset and pins are taken
                  --gdb 127.0.0.1:3333            where gdb is let in
                  --bootloader FILE               another bootloader than the one built here
";

pub fn run(mut args: Args) -> Outcome {
    let board = workspace::board(&mut args)?;
    let log = log(&mut args)?;
    let virtual_can = args.flag("--virtual-can");
    let setup = Setup::from(&mut args);
    let options = args.rest();
    let another = options.iter().any(|word| word == "--bootloader" || word.starts_with("--bootloader="));
    let needed: &[Part] = if another { &[Part::Emulator] } else { &[Part::Firmware, Part::Emulator] };
    setup.prepare(needed)?;

    let mut emulator = process::cargo("run");
    emulator.args(["--package", "coboot-emulator", "--bin", "emulate", "--", "--board", board.board]);
    if !another {
        let standard = if virtual_can { "bootloader-virtual-can" } else { "bootloader" };
        let bootloader = log.unwrap_or(standard);
        let dir = build::images(board, &[bootloader])?;
        emulator.arg("--bootloader").arg(dir.join(format!("{bootloader}.elf")));
    }
    if virtual_can && !options.iter().any(|word| word == "--serial" || word.starts_with("--serial=")) {
        emulator.args(["--serial", "pty"]);
    }
    emulator.args(options.iter().filter(|word| *word != "--"));
    process::run(&mut emulator)
}

/// The prefix of the names of the bootloaders with a log.
const LOG: &str = "bootloader-log-";

/// The name of the bootloader for the option `--log`.
fn log(args: &mut Args) -> Outcome<Option<&'static str>> {
    let wanted = if args.flag("--log") { Some("rtt".to_owned()) } else { args.value("--log")? };
    let Some(wanted) = wanted else { return Ok(None) };
    // Those with another dialect are only for the tests.
    let standard = || VARIANTS.iter().filter(|variant| variant.product.is_none());
    let ways = || standard().filter_map(|variant| Some((variant.name.strip_prefix(LOG)?, variant.name)));
    let found = ways().find(|(way, _)| *way == wanted);
    found.map(|(_, name)| Some(name)).ok_or_else(|| {
        let ways: Vec<_> = ways().map(|(way, _)| way).collect();
        format!("--log={wanted} is no way; there are {}.", ways.join(", "))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn asked(words: &str) -> Outcome<Option<&'static str>> {
        log(&mut Args::new(words.split_whitespace().map(str::to_owned)))
    }

    #[test]
    fn the_ways_of_the_log() {
        assert_eq!(asked(""), Ok(None));
        assert_eq!(asked("--log --verbose"), Ok(Some("bootloader-log-rtt")));
        assert_eq!(asked("--log=uart"), Ok(Some("bootloader-log-uart")));
        assert_eq!(asked("--log=defmt"), Ok(Some("bootloader-log-defmt")));
        assert!(asked("--log=smoke").unwrap_err().ends_with("rtt, defmt, uart."));
    }
}
