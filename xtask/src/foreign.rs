//! `cargo xtask foreign`: firmware of others, unmodified, in the emulator.

use shared_abi::layout::DEFAULT;

use crate::args::Args;
use crate::{build, outcome::Outcome, process};

pub const HELP: &str = "\
usage: cargo xtask foreign NAME=FILE.elf...

Runs firmware of others in the emulator, unmodified, and plays a check with it. You build it from their
sources, with their tool chain; docs/foreign.md says which configuration, and what ran when. Names:
katapult, klipper, chibios, openblt, stm32f4xx-hal, canopennode; and
klipper-katapult=KATAPULT.elf,KLIPPER.elf for Klipper that Katapult starts.
";

pub fn run(args: Args) -> Outcome {
    let firmware = args.rest();
    if firmware.is_empty() {
        return Err("give a firmware at least: NAME=FILE.elf. Nothing was run.".into());
    }
    process::run(build::tests_program(DEFAULT, "foreign").args(firmware))
}
