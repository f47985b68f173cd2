//! `cargo xtask powercut`: tests that no power cut bricks a device.

use std::fs;
use std::process::Command;

use serde_json::json;
use shared_abi::layout::{Layout, BOARDS};

use crate::args::Args;
use crate::setup::{Part, Setup};
use crate::{build, evidence, process, workspace, Outcome};

pub const HELP: &str = "\
usage: cargo xtask powercut [--full] [--every-way] [--json] [--reproduce POINT] [--board BOARD] [--yes]

Cuts the power at flash operations of updates, stores and erasures, in every way, and once more in the
recovery; then looks what the device does. Fails if it finds a device that cannot be reached, half a
program that would start, or a stored value that is gone.

On the model of the flash it cuts every operation; of the real firmware it cuts a sample.

  --full             every operation of an update with the real firmware, and a twentieth of those of
                     the other scenarios; with a twentieth on the board of each other chip, and on the
                     one with two programs
  --every-way        every way also for the second cut on the model; takes an hour
  --json             prints the counts as JSON, an object for each board
  --reproduce POINT  tells one point in words, as update:37:torn:12:after
  --board BOARD      this board alone (default: stm32f407g-disc1)
  --yes              installs what is missing with sudo
";

pub fn run(mut args: Args) -> Outcome {
    let chosen_board = args.has("--board");
    let board = workspace::board(&mut args)?;
    let setup = Setup::from(&mut args);
    let (full, every_way, json) = (args.flag("--full"), args.flag("--every-way"), args.flag("--json"));
    let point = args.value("--reproduce")?;
    args.none_left()?;
    setup.prepare(&[Part::Firmware, Part::Emulator])?;
    let point = point.map(|point| ["--reproduce".to_owned(), point]);
    let only: Vec<String> = [full.then(|| "--full".to_owned()), every_way.then(|| "--every-way".to_owned())]
        .into_iter()
        .flatten()
        .chain(point.iter().flatten().cloned())
        .collect();
    if point.is_some() {
        return process::run(&mut command(board, &only)?);
    }
    evidence::begin("powercut")?;
    let (mut boards, mut problems) = (Vec::new(), Vec::new());
    let mut cut = |board, only: &[String]| -> Outcome {
        let counts = evidence::file_for("powercut");
        let mut powercut = command(board, only)?;
        // A violation is a result, too.
        problems.extend(
            process::run(powercut.args(json.then_some("--json")).arg("--evidence").arg(&counts)).err(),
        );
        let unread = |error| format!("{} cannot be read: {error}.", workspace::shown(&counts));
        boards.push(process::json(&fs::read_to_string(&counts).map_err(unread)?)?);
        Ok(())
    };
    cut(board, &only)?;
    if full && !chosen_board {
        let differs = |other: &&&Layout| other.board != board.board && is_of_its_own(other);
        for other in BOARDS.iter().filter(differs) {
            cut(other, &["--twentieth".to_owned()])?;
        }
    }
    let sum = |name: &str| boards.iter().filter_map(|board| board[name].as_u64()).sum::<u64>();
    let (states, failed) = (sum("states"), sum("violations"));
    evidence::record(
        "powercut",
        json!({"full": full, "states": states, "failed": failed, "boards": boards}),
    )?;
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
fn command(board: &Layout, arguments: &[String]) -> Outcome<Command> {
    let images = build::images(board, &IMAGES)?;
    let mut powercut = process::cargo("run");
    powercut.args(build::tests_args(board)).args(["--bin", "powercut", "--"]).args(arguments);
    powercut.env("COBOOT_BOARD", board.board).env("COBOOT_FIRMWARE_DIR", images);
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
