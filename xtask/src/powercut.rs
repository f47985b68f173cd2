//! `cargo xtask powercut`: tests that no power cut bricks a device.

use std::path::Path;
use std::process::Command;

use serde_json::json;
use shared_abi::layout::{Layout, BOARDS, DEFAULT};

use crate::args::Args;
use crate::setup::{self, Part};
use crate::{build, evidence, outcome::Outcome, process, workspace};

pub const HELP: &str = "\
usage: cargo xtask powercut [--full] [--scenario NAME] [--reproduce POINT] [--board BOARD]

Cuts the power at flash operations of updates, stores and erasures, in every way, and once more in the
recovery; then looks what the device does. Fails if it finds a device that cannot be reached, half a
program that would start, or a stored value that is gone.

On the model of the flash it cuts every operation; of the real firmware it cuts a sample.

  --full             every operation of an update and of a renewal with the real firmware, and a
                     twentieth of those of the other scenarios; with a twentieth on the board of each other chip, and on the
                     one with two programs
  --reproduce POINT  says one point in words, as update:37:torn:12:after
  --scenario NAME    this scenario alone (docs/powercut.md)
  --board BOARD      this board alone (default: stm32f407g-disc1)
";

pub fn run(mut args: Args) -> Outcome {
    let chosen = workspace::chosen_board(&mut args)?;
    let board = chosen.unwrap_or(DEFAULT);
    let full = args.flag("--full");
    let point = args.value("--reproduce")?;
    let scenario = args.value("--scenario")?;
    args.none_left()?;
    setup::prepare(&[Part::Firmware, Part::Emulator])?;
    if let Some(point) = point {
        return process::run(&mut command(board, &["--reproduce", &point])?);
    }
    let mut only: Vec<_> = full.then_some("--full").into_iter().collect();
    if let Some(scenario) = &scenario {
        only.extend(["--scenario", scenario]);
    }
    evidence::begin("powercut")?;
    let (mut boards, mut problems) = (Vec::new(), Vec::new());
    let mut cut = |board, only: &[&str]| -> Outcome {
        let mut powercut = command(board, only)?;
        let run = |file: &Path| process::run(powercut.arg("--evidence").arg(file));
        let (facts, ended) = evidence::facts_of("powercut", run)?;
        boards.push(facts);
        problems.extend(ended.err());
        Ok(())
    };
    cut(board, &only)?;
    if full && chosen.is_none() {
        let differs = |other: &&&Layout| other.board != board.board && is_of_its_own(other);
        for other in BOARDS.iter().filter(differs) {
            cut(other, &["--twentieth"])?;
        }
    }
    let sum = |name: &str| boards.iter().filter_map(|board| board[name].as_u64()).sum::<u64>();
    let (states, failed) = (sum("states"), sum("violations"));
    let facts = json!({"full": full, "states": states, "failed": failed, "boards": boards});
    evidence::record("powercut", facts)?;
    problems.into_iter().next().map_or(Ok(()), Err)
}

/// Whether a board has a chip or a number of programs that no board before it has.
fn is_of_its_own(board: &Layout) -> bool {
    let alike =
        |other: &&&Layout| (other.chip.chip, other.programs.len()) == (board.chip.chip, board.programs.len());
    BOARDS.iter().find(alike).is_some_and(|first| first.board == board.board)
}

/// The images of the scenarios on a board.
const IMAGES: [&str; 4] = ["bootloader", "bootloader-sealed", "app-v1", "app-v2"];

/// The program that cuts the power on a board, after its images were built.
fn command(board: &Layout, arguments: &[&str]) -> Outcome<Command> {
    let has = |name: &&str| build::Variant::of(board).any(|variant| variant.name == *name);
    build::images(board, &IMAGES.into_iter().filter(has).collect::<Vec<_>>())?;
    let mut powercut = build::tests_program(board, "powercut");
    powercut.args(arguments);
    Ok(powercut)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_chip_and_number_of_programs_has_a_board() {
        let boards: Vec<_> =
            BOARDS.iter().filter(|board| is_of_its_own(board)).map(|board| board.board).collect();
        assert!(boards.len() >= 4 && boards.contains(&"stm32f407g-disc1-two"), "{boards:?}");
    }
}
