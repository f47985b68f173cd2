//! `cargo xtask hil`: runs on a real board what nothing else can show (hardware in the loop).
//!
//! A probe puts the bootloader into the flash, a relay switches the power, and everything else goes
//! over the bus by the command line of `coflash`, as a user of the product does it.

mod bench;
mod coflash;
mod command;
mod steps;

use std::path::{Path, PathBuf};
use std::time::Instant;

use serde_json::{json, Value};

use crate::args::Args;
use crate::setup::{self, Part};
use crate::{build, files, outcome::Outcome, process, workspace};
use bench::{Bench, Done, HANDS};
use coflash::Coflash;
use command::CommandLine;

pub const HELP: &str = "\
usage: cargo xtask hil --bus URL [--board BOARD] [--elf FILE [--coflash FILE]] [--probe COMMAND] [--node N]
                       [--power-command COMMAND] [--strap-command COMMAND] [--short-command COMMAND]
                       [--crystal-command COMMAND] [--json FILE]

Hardware in the loop: builds the images, flashes the bootloader into a real board through a debug probe and plays
on its CAN bus what nothing but a board can show. Programs that are in the board are overwritten. The first step
that fails ends it. A step that needs a hand asks for it at the terminal, or is not run, and says so.

  --bus URL       the bus, as coflash takes it: socketcan:can0. With {rate} in the place of the bit rate,
                  gs_usb:0@{rate}k or slcan:/dev/ttyACM0@{rate}k, the bit rates are tried, too
  --board BOARD   the board (default: stm32f407g-disc1)
  --elf FILE      builds nothing: this bootloader, and app-v1.elf, app-v2.elf, app-test.elf and bootloader-watchdog.elf
                  in the same folder (target/firmware/BOARD of a build, or of a release)
  --coflash FILE  the host tool for --elf (default: the one of this repository if it is built, or that of PATH)
  --probe COMMAND the command line for the debug probe (default: 'probe-rs {action} --chip {chip} {elf}').
                  {action} becomes download or reset, {chip} the chip, {elf} the file; for a reset the
                  words with {elf} are left out. No shell reads it; quotes keep words together
  --power-command COMMAND
                  the command line that switches the board's supply: {state} becomes on or off.
                  Without it the probe resets the board, and the power is not cut in mid-update
  --strap-command, --short-command, --crystal-command
                  the same for the entry strap, a short of CAN_H and CAN_L, and one of OSC_IN to ground
  --node N        the node-ID of the board, 1 to 127 (default: 1)
  --json FILE     writes the report to FILE
";

pub fn run(mut args: Args) -> Outcome {
    let board = workspace::board(&mut args)?;
    let bus = args.value("--bus")?.ok_or("--bus is missing: name the bus, for example socketcan:can0.")?;
    let node = args.number("--node", 1..=127)?.unwrap_or(1);
    let probe = args.value("--probe")?.unwrap_or("probe-rs {action} --chip {chip} {elf}".into());
    let probe = CommandLine::new("--probe", &probe)?;
    let mut hands = [const { None }; HANDS.len()];
    let mut power_line = None;
    for ((option, ..), hand) in HANDS.iter().zip(&mut hands).rev() {
        power_line = args.value(option)?;
        if power_line.as_ref().is_some_and(|line| !line.contains("{state}")) {
            return Err(format!("{option} needs {{state}}; on and off take its place."));
        }
        *hand = power_line.as_ref().map(|line| CommandLine::new(option, line)).transpose()?;
    }
    let (elf, own) = (args.value("--elf")?, args.value("--coflash")?);
    let report = args.value("--json")?;
    args.none_left()?;

    let started = Instant::now();
    let built = workspace::target_dir().join("debug/coflash");
    let (bootloader, program) = match elf {
        Some(elf) if !Path::new(&elf).is_file() => {
            return Err(format!("--elf {elf}: there is no such file."))
        }
        Some(elf) => {
            (elf.into(), own.map_or(if built.exists() { built } else { "coflash".into() }, PathBuf::from))
        }
        None => {
            setup::prepare(&[Part::Firmware])?;
            let images =
                build::images(board, &[&build::MAIN[..], &["app-test", "bootloader-watchdog"]].concat())?;
            process::run(process::cargo("build --package coflash").current_dir(workspace::root()))?;
            (images.join("bootloader.elf"), built)
        }
    };
    let images = bootloader.parent().unwrap_or(Path::new("")).to_owned();
    let ready = Done::Passed(workspace::shown(&images));
    let mut lines = vec![line("images and coflash", started, Ok(ready))];
    let work = workspace::target_dir().join("hil").join(board.board);
    let bootloader = bootloader.display().to_string();
    let coflash = Coflash { program, bus, node, rate: 125 };
    let (installed, conform) = (None, Vec::new());
    let mut bench =
        Bench { board, probe, hands, power_line, coflash, bootloader, images, work, installed, conform };
    for (name, run) in steps::STEPS {
        let started = Instant::now();
        lines.push(line(name, started, run(&mut bench)));
        if lines.last().is_some_and(|line| line["outcome"] == "failed") {
            break;
        }
    }
    let count = |outcome: &str| lines.iter().filter(|line| line["outcome"] == outcome).count();
    let failed = count("failed");
    println!("{} passed, {failed} failed, {} not run", count("passed"), count("not run"));
    if let Some(file) = report {
        let report = json!({
            "board": board.board,
            "bus": bench.coflash.bus,
            "node": node,
            "passed": failed == 0,
            "steps": lines,
            "conform": bench.conform,
        });
        files::write(Path::new(&file), format!("{report:#}\n"))?;
    }
    match failed {
        0 => Ok(()),
        _ => Err("a step failed; its line above says what to do. The steps after it were not run.".into()),
    }
}

/// Prints how a step ended; returns it for the report.
fn line(name: &str, started: Instant, ended: Outcome<Done>) -> Value {
    let (outcome, text) = match ended {
        Ok(Done::Passed(text)) => ("passed", text),
        Ok(Done::NotRun(text)) => ("not run", text),
        Err(text) => ("failed", text),
    };
    let seconds = (started.elapsed().as_secs_f64() * 10.0).round() / 10.0;
    println!("{outcome:<7} {seconds:>6} s  {name}  {text}");
    json!({"step": name, "outcome": outcome, "text": text, "seconds": seconds})
}
