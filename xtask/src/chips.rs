//! `cargo xtask chips`: makes a board for every chip and runs it, from `new-board` to an update in
//! the emulator.

use std::time::{SystemTime, UNIX_EPOCH};

use shared_abi::geometry::{self, Geometry, CHIPS};
use shared_abi::layout::DEFAULT;

use crate::args::Args;
use crate::setup::{Part, Setup};
use crate::{build, process, Outcome};

pub const HELP: &str = "\
usage: cargo xtask chips [CHIP...] [--turn] [--yes]

Lays down a board for each chip in a copy of the repository, builds bootloader and application for it, and plays
the main job on the emulated chip (tests/tests/porting.rs). Without a CHIP it takes one of each line and size of
flash: packages differ in nothing that is built. That is some minutes for each.

  --turn   only the two whose turn it is today, for a job that runs every day
  --yes    installs what is missing with sudo
";

pub fn run(mut args: Args) -> Outcome {
    let setup = Setup::from(&mut args);
    let turn = args.flag("--turn");
    let names = args.rest();
    let chips = match names.as_slice() {
        [] if turn => {
            let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
            of_day(&kinds(), since.as_secs() / 86_400)
        }
        [] => kinds(),
        _ if turn => return Err("--turn and names do not go together.".into()),
        names => names
            .iter()
            .map(|name| geometry::by_name(name).ok_or_else(|| format!("no chip \"{name}\" is known.")))
            .collect::<Outcome<_>>()?,
    };
    setup.prepare(&[Part::Firmware, Part::Emulator])?;
    let chips: Vec<_> = chips.iter().map(|chip| chip.chip).collect();
    println!("{}", chips.join(", "));
    let mut test = process::cargo("test");
    test.args(build::tests_args(DEFAULT)).args(["--test=porting", "--", "--ignored", "--nocapture"]);
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

/// Two of them: different ones every day, until all have been used.
fn of_day<'a>(kinds: &[&'a Geometry], day: u64) -> Vec<&'a Geometry> {
    let first = (2 * day % kinds.len() as u64) as usize;
    vec![kinds[first], kinds[(first + 1) % kinds.len()]]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_line_and_flash_is_tried_and_has_its_turn() {
        let kinds = kinds();
        for chip in CHIPS {
            let alike = kinds.iter().filter(|kind| (kind.line, kind.flash) == (chip.line, chip.flash));
            assert_eq!(alike.count(), 1, "{}", chip.chip);
        }
        let round: Vec<_> =
            (20_000..20_000 + kinds.len() as u64).flat_map(|day| of_day(&kinds, day)).collect();
        assert!(kinds.iter().all(|kind| round.contains(kind)));
    }
}
