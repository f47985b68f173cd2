//! `cargo xtask opinion`: the emulated CPU beside one that others wrote.

use std::process::Command;

use crate::args::Args;
use crate::setup::{Part, Setup};
use crate::{process, workspace, Outcome};

pub const HELP: &str = "\
usage: cargo xtask opinion [--json] [--yes]

Runs the programs of emulator/tests/second_opinion on the emulator's CPU and on QEMU's Cortex-M4
(mps2-an386), and compares their results word for word. A difference that is not explained in the
table of the programs is a failure.

  --json          also writes the result to target/evidence/cpu.json: commit, counts, differences
  --yes           installs what is missing with sudo
";

pub fn run(mut args: Args) -> Outcome {
    let json = args.flag("--json");
    let setup = Setup::from(&mut args);
    args.none_left()?;
    setup.prepare(&[Part::Firmware, Part::Emulator, Part::Qemu])?;
    let mut test = process::cargo("test");
    test.args(["--quiet", "--package", "coboot-emulator", "--test", "second_opinion"]);
    test.args(["--", "--include-ignored", "--nocapture", "--test-threads=1"]);
    if json {
        let folder = workspace::target_dir().join("evidence");
        std::fs::create_dir_all(&folder).map_err(|error| format!("{}: {error}.", folder.display()))?;
        let mut git = Command::new("git");
        let commit = process::output(git.args(["rev-parse", "HEAD"]).current_dir(workspace::root()))?;
        test.env("COBOOT_CPU_EVIDENCE", folder.join("cpu.json")).env("COBOOT_COMMIT", commit.trim());
    }
    process::run(&mut test)
}
