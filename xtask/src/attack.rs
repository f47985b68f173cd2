//! `cargo xtask attack`: the standing attacker of the bus, and the main scenarios on drawn chips.

use shared_abi::layout::stm32f407g_disc1_two::LAYOUT as TWO;
use shared_abi::layout::DEFAULT;

use crate::args::Args;
use crate::setup::{self, Part};
use crate::{build, evidence, outcome::Outcome, process};

pub const HELP: &str = "\
usage: cargo xtask attack [--frames N | --silicon N] [--seed S]

Attacks emulated boards with the built firmware, and nodes without a chip, in virtual time (docs/testing.md
has the rules). Fails if one is broken, and prints the seed and the last frames. The same seed gives the same
attack. The counts go to target/evidence/attacker.json.

  --frames N      the frames of the masters on the boards (default: 200000, about two minutes); the
                  nodes, which are faster, get twenty times as many
  --silicon N     plays stories of a device (main job, hangs, stores, power, crystal, supply, renewal, ...) on N
                  chips that seeds draw, in place of the attack; the counts go to target/evidence/silicon.json
  --seed S        the first seed (default: 1)
";

/// The images of the attack, on the board with two programs.
const IMAGES: &str =
    "bootloader bootloader-esacademy bootloader-lift bootloader-sealed bootloader-virtual-can app-v1 \
    app-v2 app-test app-program-2 app-lift app-lift-v2 app-virtual-can app-virtual-can-v2";
/// The images of the stories, on the default board.
pub const STORIES: &str = "bootloader bootloader-watchdog bootloader-sealed app-v1 app-v2 app-test";

pub fn run(mut args: Args) -> Outcome {
    let (frames, seed) = (args.value("--frames")?, args.value("--seed")?);
    let silicon = args.value("--silicon")?;
    args.none_left()?;
    let record = if silicon.is_some() { "silicon" } else { "attacker" };
    setup::prepare(&[Part::Firmware, Part::Emulator])?;
    let (board, images) = if silicon.is_some() { (DEFAULT, STORIES) } else { (&TWO, IMAGES) };
    build::images(board, &images.split_whitespace().collect::<Vec<_>>())?;
    let mut attack = build::tests_program(DEFAULT, "attack");
    for (option, value) in [("--frames", frames), ("--seed", seed), ("--silicon", silicon)] {
        attack.args(value.map(|value| [option.to_owned(), value]).into_iter().flatten());
    }
    evidence::of_program(record, |file| process::run(attack.arg("--evidence").arg(file)))
}
