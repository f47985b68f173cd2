//! `cargo xtask bench`: measures how fast a program is downloaded, and the load on the host.

use serde_json::{json, Value};

use crate::args::Args;
use crate::setup::{self, Part};
use crate::{build, evidence, outcome::Outcome, process, workspace};

pub const HELP: &str = "\
usage: cargo xtask bench [--json] [--board BOARD]

Measures downloads into emulated boards in virtual time, beside what wire and flash allow; then, in real time,
what a frame costs the host. docs/bench.md has the tables and what they mean.

  --json          prints the tables as JSON: downloads, bus, forms, fleets, host; and keeps them in
                  target/evidence/bench.json
  --board BOARD   the board (default: stm32f407g-disc1)
";

pub fn run(mut args: Args) -> Outcome {
    let board = workspace::board(&mut args)?;
    let json = args.flag("--json");
    args.none_left()?;
    setup::prepare(&[Part::Firmware, Part::Emulator])?;
    build::images(board, &["bootloader", "bootloader-sealed", "app-v1"])?;
    let mut bench = build::tests_program(board, "bench");
    // Optimised, as a user runs it.
    let cost = || {
        process::run(&mut process::cargo("build --release --package coboot-node"))?;
        Ok::<_, String>(process::cargo("run --release --package coboot-node --example cost --"))
    };
    if json {
        let mut facts = process::json(&process::output(bench.arg("--json"))?)?;
        facts["host"] = process::json(&process::output(cost()?.arg("--json"))?)?;
        println!("{facts:#}");
        // The least share of what wire and flash allow, and how many downloads have no measure or no limit.
        let percents = process::list(&facts, "downloads").filter_map(|row| row["percent"].as_u64());
        let numbers = ["percent", "measured_us", "wire_limit_us", "flash_limit_us"];
        let is_whole = |row: &&Value| numbers.iter().all(|name| row[name].as_f64() > Some(0.0));
        let failed = process::list(&facts, "downloads").filter(|row| !is_whole(row)).count();
        (facts["percent"], facts["failed"]) = (json!(percents.min()), json!(failed));
        return evidence::record("bench", facts);
    }
    process::run(&mut bench)?;
    println!();
    process::run(&mut cost()?)
}
