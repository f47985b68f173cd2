//! `cargo xtask demo`: runs the main job, end to end.

use crate::args::Args;
use crate::setup::{self, Part};
use crate::{build, process, workspace, Outcome};

pub const HELP: &str = "\
usage: cargo xtask demo [--sealed] [--trace FILE] [--board BOARD]

Sets the machine up, builds bootloader and application and plays the main job on an emulated board: power on, flash
version 1 over CANopen, start it, call it back, flash version 2, cut the power, see version 2 start.

  --sealed        shows the sealed device instead: keys go into the board, which then takes signed programs
                  alone; a flipped bit, an old counter and a foreign key are refused, and the old program
                  starts each time
  --trace FILE    writes the bus to FILE, as candump logs it
  --board BOARD   the board (default: stm32f407g-disc1)
";

pub fn run(mut args: Args) -> Outcome {
    let board = workspace::board(&mut args)?;
    let trace = args.value("--trace")?;
    let is_sealed = args.flag("--sealed");
    args.none_left()?;
    setup::prepare(&[Part::Firmware, Part::Emulator])?;
    let bootloader = if is_sealed { "bootloader-sealed" } else { "bootloader" };
    build::images(board, &[bootloader, "app-v1", "app-v2"])?;
    let mut demo = build::tests_program(board, "demo");
    if is_sealed {
        demo.arg("--sealed");
    }
    if let Some(trace) = trace {
        demo.args(["--trace", &trace]);
    }
    process::run(&mut demo)
}
