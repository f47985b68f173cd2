//! `cargo xtask bench`: measures how fast a program is downloaded, and the load on the host.

use crate::args::Args;
use crate::setup::{Part, Setup};
use crate::{build, evidence, process, workspace, Outcome};

pub const HELP: &str = "\
usage: cargo xtask bench [--json] [--board BOARD] [--yes]

Downloads programs of 64, 256 and 900 KiB at 125 to 1000 kbit/s into an emulated board, in virtual
time, and prints how long that took beside what the wire and the flash allow at best; how busy the
bus is while `coflash flash` sends a program; what it costs or gains to seal and to compress one; and
how long several boards on one bus take.
Then, in real time: what a frame costs the host, in an update over socketcand into a node whose flash
is a file.

  --json          prints the tables as JSON: downloads, bus, forms, fleets, host; and keeps them in
                  target/evidence/bench.json
  --board BOARD   the board (default: stm32f407g-disc1)
  --yes           installs what is missing with sudo
";

pub fn run(mut args: Args) -> Outcome {
    let board = workspace::board(&mut args)?;
    let json = args.flag("--json");
    let setup = Setup::from(&mut args);
    args.none_left()?;
    setup.prepare(&[Part::Firmware, Part::Emulator])?;
    let images = build::images(board, &["bootloader", "bootloader-sealed", "app-v1"])?;
    let mut bench = process::cargo("run");
    bench.args(build::tests_args(board)).args(["--bin", "bench"]);
    bench.env("COBOOT_BOARD", board.board).env("COBOOT_FIRMWARE_DIR", images);
    // Optimised, as a user runs it.
    let cost = || {
        process::run(process::cargo("build").args(["--release", "--package", "coboot-node"]))?;
        let mut cost = process::cargo("run");
        cost.args(["--release", "--package", "coboot-node", "--example", "cost"]);
        Ok::<_, String>(cost)
    };
    if json {
        let emulated = process::output(bench.args(["--", "--json"]))?;
        let host = process::output(cost()?.args(["--", "--json"]))?;
        // The first result is an object; the second one is added to it.
        let emulated =
            emulated.trim_end().strip_suffix('}').ok_or("the bench printed something unexpected.")?;
        let rows = format!("{emulated},\n\"host\": {}}}", host.trim_end());
        println!("{rows}");
        return evidence::record("bench", &rows).map(drop);
    }
    process::run(&mut bench)?;
    println!();
    process::run(&mut cost()?)
}
