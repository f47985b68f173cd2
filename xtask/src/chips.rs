//! `cargo xtask chips`: makes a board for every chip and runs it, from `new-board` to an update in
//! the emulator.

use shared_abi::geometry::{self, Geometry, CHIPS};
use shared_abi::layout::DEFAULT;

use crate::args::Args;
use crate::setup::{self, Part};
use crate::{build, outcome::Outcome, process};

pub const HELP: &str = "\
usage: cargo xtask chips [CHIP...]

Lays down a board for each chip in a copy of the repository, builds bootloader and application for it, and plays
the main job on the emulated chip (tests/port/porting.rs). Without a CHIP it takes one of each line and size of
flash: packages differ in nothing that is built. The first chip of a line takes a minute and a half, the next
ones 20 seconds: half an hour for all on two cores. So this is a job of its own and no part of
.ci/run.
";

pub fn run(args: Args) -> Outcome {
    let names = args.remaining();
    let chips = match names.as_slice() {
        [] => kinds(),
        names => names
            .iter()
            .map(|name| geometry::by_name(name).ok_or_else(|| format!("no chip \"{name}\" is known.")))
            .collect::<Outcome<_>>()?,
    };
    setup::prepare(&[Part::Firmware, Part::Emulator])?;
    let chips: Vec<_> = chips.iter().map(|chip| chip.chip).collect();
    println!("{}", chips.join(", "));
    let mut test = build::tests("test", DEFAULT);
    test.args("--test=port -- porting:: --ignored --nocapture".split(' '));
    process::run(test.env("COBOOT_CHIPS", chips.join(",")))
}

/// The first chip of each line and size of flash.
fn kinds() -> Vec<&'static Geometry> {
    let mut kinds: Vec<&Geometry> = Vec::new();
    for chip in CHIPS {
        if !kinds.iter().any(|kind| (kind.line, kind.flash) == (chip.line, chip.flash)) {
            kinds.push(chip);
        }
    }
    kinds
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_line_and_flash_is_tried() {
        let kinds = kinds();
        for chip in CHIPS {
            let alike = kinds.iter().filter(|kind| (kind.line, kind.flash) == (chip.line, chip.flash));
            assert_eq!(alike.count(), 1, "{}", chip.chip);
        }
    }
}
