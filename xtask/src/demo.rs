//! `cargo xtask demo`: runs the main job, end to end.

use crate::args::Args;
use crate::setup::{self, Part};
use crate::{build, outcome::Outcome, process, workspace};

pub const HELP: &str = "\
usage: cargo xtask demo [--sealed | --renew] [--trace FILE] [--board BOARD]

Sets the machine up, builds bootloader and application and plays the main job on an emulated board: power on, flash
version 1 over CANopen, start it, call it back, flash version 2, cut the power, see version 2 start.

  --sealed        shows the sealed device instead: keys go into the board, which then takes signed programs
                  alone; a flipped bit, an old counter and a foreign key are refused, and the old program
                  starts each time
  --renew         shows a new bootloader instead, installed over CAN while the program stays; one that
                  nobody can reach ends by itself; the power fails in the middle; a sealed device refuses
                  one without a signature
  --trace FILE    writes the bus to FILE, as candump logs it
  --board BOARD   the board (default: stm32f407g-disc1)
";

pub fn run(mut args: Args) -> Outcome {
    let board = workspace::board(&mut args)?;
    let trace = args.value("--trace")?;
    let is_sealed = args.flag("--sealed");
    let renews = !is_sealed && args.flag("--renew");
    args.none_left()?;
    setup::prepare(&[Part::Firmware, Part::Emulator])?;
    let bootloaders: &[&str] = match (is_sealed, renews) {
        (true, _) => &["bootloader-sealed"],
        (_, true) => &["bootloader", "bootloader-watchdog", "bootloader-sealed"],
        _ => &["bootloader"],
    };
    build::images(board, &[bootloaders, &["app-v1", "app-v2"]].concat())?;
    let mut demo = build::tests_program(board, "demo");
    demo.args(is_sealed.then_some("--sealed")).args(renews.then_some("--renew"));
    process::run(demo.args(trace.iter().flat_map(|file| ["--trace", file])))
}
