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
        (facts["percent"], facts["failed"]) = verdict(&facts);
        return evidence::record("bench", facts);
    }
    process::run(&mut bench)?;
    println!();
    process::run(&mut cost()?)
}

/// The least share of what wire and flash allow, in percent, and how many downloads have no measure
/// or no limit.
fn verdict(facts: &Value) -> (Value, Value) {
    let downloads = facts["downloads"].as_array().map_or(&[][..], Vec::as_slice);
    let names = ["percent", "measured_us", "wire_limit_us", "flash_limit_us"];
    let is_whole =
        |row: &&Value| names.iter().all(|name| row[name].as_f64().is_some_and(|number| number > 0.0));
    let failed = downloads.iter().filter(|row| !is_whole(row)).count();
    let least = downloads.iter().filter_map(|row| row["percent"].as_u64()).min();
    (json!(least), json!(failed))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn speed_is_good_if_each_download_has_its_limits() {
        let good = json!({"measured_us": 30, "wire_limit_us": 20, "flash_limit_us": 9, "percent": 66});
        for (member, value, expected) in [
            ("percent", json!(50), (json!(50), json!(0))),
            ("flash_limit_us", json!(null), (json!(66), json!(1))),
            ("wire_limit_us", json!(null), (json!(66), json!(1))),
            ("measured_us", json!(null), (json!(66), json!(1))),
            ("wire_limit_us", json!(0), (json!(66), json!(1))),
        ] {
            let mut row = good.clone();
            row[member] = value;
            assert_eq!(verdict(&json!({"downloads": [good, row]})), expected, "{member}");
        }
    }
}
