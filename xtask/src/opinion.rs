//! `cargo xtask opinion`: the emulated CPU and board beside ones that others wrote.

use shared_abi::layout::DEFAULT;

use crate::args::Args;
use crate::setup::{self, Part};
use crate::{build, evidence, outcome::Outcome, process};

pub const HELP: &str = "\
usage: cargo xtask opinion

Runs the same programs on the emulator's CPU and on QEMU's, and the same update on the emulated board and
on QEMU's, and compares what comes of them. A difference that is not explained is a failure. docs/testing.md
has the differences. Counts and differences of the programs go to target/evidence/cpu.json.
";

pub fn run(args: Args) -> Outcome {
    args.none_left()?;
    setup::prepare(&[Part::Firmware, Part::Emulator, Part::Qemu])?;
    let cpu = cpu();
    let board = board();
    cpu.and(board)
}

fn cpu() -> Outcome {
    let mut test = process::cargo("test --quiet --package coboot-emulator --test it");
    test.args("-- second_opinion:: --include-ignored --nocapture --test-threads=1".split(' '));
    evidence::of_program("cpu", |file| process::run(test.env("COBOOT_CPU_EVIDENCE", file)))
}

fn board() -> Outcome {
    build::images(DEFAULT, &["bootloader-virtual-can", "app-virtual-can"])?;
    let line = "--quiet --test foreign second_board:: -- --include-ignored --nocapture";
    process::run(build::tests("test", DEFAULT).args(line.split(' ')))
}
