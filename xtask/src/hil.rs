//! `cargo xtask hil`: runs the main job and the update suite on a real board (hardware in the loop).
//!
//! A probe puts the bootloader into the flash, a relay switches the power, and everything else goes
//! over the bus by the command line of `coflash`, as a user of the product does it.

mod bench;
mod coflash;
mod command;
mod steps;

use std::path::Path;
use std::time::Instant;

use serde_json::{json, Value};

use crate::args::Args;
use crate::setup::{self, Part};
use crate::{build, files, process, workspace, Outcome};
use bench::{Bench, Done};
use coflash::Coflash;
use command::CommandLine;

pub const HELP: &str = "\
usage: cargo xtask hil --bus URL [--board BOARD] [--probe COMMAND] [--power-command COMMAND] [--node N]
                       [--json FILE]

Hardware in the loop: builds the images, flashes the bootloader into a real board through a debug probe and plays
the main job and the update suite on its CAN bus. Programs that are in the board are overwritten.

  --bus URL       the bus, as coflash takes it, for example socketcan:can0
  --board BOARD   the board (default: stm32f407g-disc1)
  --probe COMMAND the command line for the debug probe (default: 'probe-rs {action} --chip {chip} {elf}').
                  {action} becomes download or reset, {chip} the chip, {elf} the file; for a reset the
                  words with {elf} are left out. No shell reads it; quotes keep words together
  --power-command COMMAND
                  the command line that switches the board's supply: {state} becomes on or off.
                  Without it the probe resets the board, and the power is not cut in mid-update
  --node N        the node-ID of the board, 1 to 127 (default: 1)
  --json FILE     writes the report to FILE
";

pub fn run(mut args: Args) -> Outcome {
    let board = workspace::board(&mut args)?;
    let bus = args.value("--bus")?.ok_or("--bus is missing: name the bus, for example socketcan:can0.")?;
    let node = args.number("--node", 1..=127)?.unwrap_or(1);
    let probe = args.value("--probe")?.unwrap_or("probe-rs {action} --chip {chip} {elf}".into());
    let probe = CommandLine::new("--probe", &probe)?;
    let power = args.value("--power-command")?;
    if power.as_ref().is_some_and(|line| !line.contains("{state}")) {
        return Err("--power-command needs {state}; on and off stand in its place.".into());
    }
    let power = power.map(|line| CommandLine::new("--power-command", &line)).transpose()?;
    let report = args.value("--json")?;
    args.none_left()?;
    setup::prepare(&[Part::Firmware])?;

    let started = Instant::now();
    let images = build::images(board, &build::MAIN)?;
    process::run(process::cargo("build").current_dir(workspace::root()).args(["--package", "coflash"]))?;
    let built = Done::Passed(workspace::shown(&images));
    let mut lines = vec![line("build the images and coflash", started, Ok(built))];
    let work = workspace::target_dir().join("hil").join(board.board);
    let coflash = Coflash { bus, node };
    let mut bench = Bench { board, probe, power, coflash, images, work, installed: None, conform: None };
    let mut stopped_by = None;
    for step in steps::STEPS {
        let started = Instant::now();
        let ended = match stopped_by {
            Some(name) => Ok(Done::LeftOut(format!("\"{name}\" failed"))),
            None => (step.run)(&mut bench),
        };
        if step.others_need_it && ended.is_err() {
            stopped_by = Some(step.name);
        }
        lines.push(line(step.name, started, ended));
    }
    let count = |outcome: &str| lines.iter().filter(|line| line["outcome"] == outcome).count();
    let failed = count("failed");
    println!("{} passed, {failed} failed, {} left out", count("passed"), count("left out"));
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
        1 => Err("1 step failed; its line above says what to do.".into()),
        failed => Err(format!("{failed} steps failed; their lines above say what to do.")),
    }
}

/// Prints how a step ended; returns it for the report.
fn line(name: &str, started: Instant, ended: Outcome<Done>) -> Value {
    let (outcome, text) = match ended {
        Ok(Done::Passed(text)) => ("passed", text),
        Ok(Done::LeftOut(text)) => ("left out", text),
        Err(text) => ("failed", text),
    };
    let seconds = (started.elapsed().as_secs_f64() * 10.0).round() / 10.0;
    println!("{outcome:<8} {seconds:>6} s  {name}  {text}");
    json!({"step": name, "outcome": outcome, "text": text, "seconds": seconds})
}
