//! `cargo xtask hil`: runs the main job and the update suite on a real board (hardware in the loop).
//!
//! A probe puts the bootloader into the flash, a relay switches the power, and everything else goes
//! over the bus by the command line of `coflash`, as a user of the product does it.

mod bench;
mod coflash;
mod command;
mod power;
mod probe;
mod report;
mod steps;

use std::fs;
use std::time::Instant;

use crate::args::Args;
use crate::setup::{Part, Setup};
use crate::{build, process, workspace, Outcome};
use bench::Bench;
use coflash::Coflash;
use power::Power;
use probe::Probe;
use report::{Line, Report, Verdict};

pub const HELP: &str = "\
usage: cargo xtask hil --bus URL [--board BOARD] [--probe COMMAND] [--power-command COMMAND] [--node N]
                       [--json FILE] [--yes]

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
  --yes           installs what is missing with sudo
";

pub fn run(mut args: Args) -> Outcome {
    let board = workspace::board(&mut args)?;
    let bus = args.value("--bus")?.ok_or("--bus is missing: name the bus, for example socketcan:can0.")?;
    let node = node(args.value("--node")?)?;
    let probe = Probe::new(args.value("--probe")?.as_deref(), board)?;
    let power = args.value("--power-command")?.map(|line| Power::new(&line)).transpose()?;
    let json = args.value("--json")?;
    let setup = Setup::from(&mut args);
    args.none_left()?;
    // The build takes minutes; a program that is missing is reported before.
    probe.is_there()?;
    if let Some(power) = &power {
        power.is_there()?;
    }
    setup.prepare(&[Part::Firmware])?;

    let started = Instant::now();
    build::images(board, &build::MAIN)?;
    process::run(process::cargo("build").current_dir(workspace::root()).args(["--package", "coflash"]))?;
    let mut report = Report::new(board.board, &bus, node);
    report.take(Line {
        name: "build the images and coflash",
        verdict: Verdict::Passed(workspace::shown(&workspace::firmware_dir(board))),
        seconds: started.elapsed().as_secs_f64(),
    });

    let work = workspace::target_dir().join("hil").join(board.board);
    fs::create_dir_all(&work).map_err(|error| format!("{}: {error}.", workspace::shown(&work)))?;
    let images = workspace::firmware_dir(board);
    let coflash = Coflash::new(bus, node);
    let mut bench = Bench { board, probe, power, coflash, images, work, installed: None, conform: None };
    play(&mut bench, &mut report);

    report.conform = bench.conform;
    print!("{}", report.summary());
    if let Some(file) = json {
        fs::write(&file, format!("{:#}\n", report.json()))
            .map_err(|error| format!("{file} cannot be written: {error}."))?;
    }
    report.outcome()
}

/// Carries out all steps. Those after a failed step that they rest on are left out.
fn play(bench: &mut Bench, report: &mut Report) {
    let mut stopped_by = None;
    for step in steps::STEPS {
        let started = Instant::now();
        let verdict = match stopped_by {
            Some(name) => Verdict::LeftOut(format!("\"{name}\" failed")),
            None => (step.run)(bench).unwrap_or_else(Verdict::Failed),
        };
        if step.others_need_it && matches!(verdict, Verdict::Failed(_)) {
            stopped_by = Some(step.name);
        }
        report.take(Line { name: step.name, verdict, seconds: started.elapsed().as_secs_f64() });
    }
}

/// The node-ID; 1 if none is given.
fn node(text: Option<String>) -> Outcome<u8> {
    let Some(text) = text else { return Ok(1) };
    let number = text.parse().ok().filter(|number| (1..=127).contains(number));
    number.ok_or_else(|| format!("--node {text}: a node-ID is a number from 1 to 127."))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_node_id_is_1_to_127() {
        assert_eq!(node(None), Ok(1));
        assert_eq!(node(Some("127".into())), Ok(127));
        for wrong in ["0", "128", "x", "-1", ""] {
            assert!(node(Some(wrong.into())).unwrap_err().contains("1 to 127"), "{wrong}");
        }
    }
}
