//! `cargo xtask emulate`: runs an emulated board for other programs.

use shared_abi::layout;

use crate::args::Args;
use crate::setup::{self, Part};
use crate::{build, outcome::Outcome, process, workspace};

pub const HELP: &str = "\
usage: cargo xtask emulate [--board BOARD] [--log[=WAY] | --virtual-can] [OPTIONS]

Sets the machine up, builds a bootloader and runs the emulated board with it in its flash.

  --board BOARD   the board (default: stm32f407g-disc1), or with --bootloader the file with its memory map,
                  NAME.toml
  --log[=WAY]     the bootloader that tells what it does, and what it tells. WAY: rtt (text for a debug
                  probe; the default), defmt (the same by defmt), uart (text out of the board's UART)
  --virtual-can   the bootloader that speaks CAN over the board's UART, which a pseudo-terminal leads to
  OPTIONS         go to the emulator; `cargo xtask emulate -- --help` lists them. Among them:
                  --socketcand 127.0.0.1:29536    where other programs reach the bus
                  --app FILE                      an application in flash, as a debug probe puts it there
                  --serial pty                    where other programs reach the board's UART
                  --trace FILE                    the bus as a candump log
                  --hse HZ                        the crystal, if it has not 8 MHz
                  --silicon SEED                  a chip that the seed draws, within what the manuals leave open
                  --can NUMBER                    the CAN controller that the transceiver is at
                  --flash FILE                    keeps the flash from one run to the next
                  --control 127.0.0.1:29600       where commands for power, reset and pins are taken
                  --gdb 127.0.0.1:3333            where gdb is let in
                  --bootloader FILE               another bootloader than the one built here
";

pub fn run(mut args: Args) -> Outcome {
    let word = args.value("--board")?.unwrap_or_else(|| layout::DEFAULT.board.to_owned());
    let log = log(&mut args)?;
    let virtual_can = args.flag("--virtual-can");
    let options = args.rest();
    let another = options.iter().any(|word| word == "--bootloader" || word.starts_with("--bootloader="));

    let mut emulator = process::cargo("run");
    emulator.args(["--package", "coboot-emulator", "--bin", "emulate", "--", "--board"]);
    if another {
        // The emulator reads the memory map of any board.
        setup::prepare(&[Part::Emulator])?;
        emulator.arg(&word);
    } else {
        let board = workspace::board_named(&word)?;
        setup::prepare(&[Part::Firmware, Part::Emulator])?;
        let standard = if virtual_can { "bootloader-virtual-can" } else { "bootloader" };
        let bootloader = log.as_deref().unwrap_or(standard);
        let dir = build::images(board, &[bootloader])?;
        emulator.args([board.board, "--bootloader"]).arg(dir.join(format!("{bootloader}.elf")));
    }
    if virtual_can && !options.iter().any(|word| word == "--serial" || word.starts_with("--serial=")) {
        emulator.args(["--serial", "pty"]);
    }
    emulator.args(options.iter().filter(|word| *word != "--"));
    process::run(&mut emulator)
}

/// The ways in which a bootloader can log its work.
const LOGS: [&str; 3] = ["rtt", "defmt", "uart"];

/// The name of the bootloader for the option `--log`.
fn log(args: &mut Args) -> Outcome<Option<String>> {
    let way = if args.flag("--log") { Some(LOGS[0].to_owned()) } else { args.value("--log")? };
    match way {
        Some(way) if !LOGS.contains(&&*way) => {
            Err(format!("--log={way} is no way; there are {}.", LOGS.join(", ")))
        }
        way => Ok(way.map(|way| format!("bootloader-log-{way}"))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::build::VARIANTS;

    #[test]
    fn the_ways_of_the_log_have_a_bootloader() {
        let asked = |words: &str| log(&mut Args::new(words.split_whitespace().map(str::to_owned)));
        assert_eq!(asked(""), Ok(None));
        assert_eq!(asked("--log --verbose"), Ok(Some("bootloader-log-rtt".into())));
        for way in LOGS {
            let name = asked(&format!("--log={way}")).unwrap().unwrap();
            assert!(VARIANTS.iter().any(|variant| variant.name == name), "{name}");
        }
        assert!(asked("--log=smoke").unwrap_err().ends_with("rtt, defmt, uart."));
    }
}
