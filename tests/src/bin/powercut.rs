//! `cargo xtask powercut`: cuts the power at every flash operation, and checks the device after the
//! power returns.

use std::collections::BTreeMap;
use std::process::ExitCode;

use attack::cuts::{self, Cuts, Point, Report};
use coboot_tests::powercut::{self, Effort};
use serde_json::{json, Value};

/// What to do.
#[derive(Default)]
struct Wish {
    /// Every operation of the real firmware.
    full: bool,
    /// Every way for the second cut on the model, too.
    every_way: bool,
    json: bool,
    /// Writes the counts as JSON to this file, too.
    evidence: Option<String>,
    /// Level 2 alone, with a twentieth of the cuts.
    twentieth: bool,
    /// This scenario alone.
    scenario: Option<String>,
    point: Option<Point>,
}

impl Wish {
    fn has(&self, name: &str) -> bool {
        self.scenario.as_ref().is_none_or(|scenario| scenario == name)
    }
}

fn wish(mut arguments: impl Iterator<Item = String>) -> Result<Wish, String> {
    let mut wish = Wish::default();
    while let Some(argument) = arguments.next() {
        match argument.as_str() {
            "--full" => wish.full = true,
            "--every-way" => wish.every_way = true,
            "--json" => wish.json = true,
            "--evidence" => wish.evidence = Some(arguments.next().ok_or("--evidence wants a file.")?),
            "--twentieth" => wish.twentieth = true,
            "--scenario" => wish.scenario = Some(arguments.next().ok_or("--scenario wants a name.")?),
            "--reproduce" => {
                let text = arguments.next().ok_or("--reproduce wants a point, as update:37:torn.")?;
                let boards: Vec<_> = powercut::scenarios().map(|scenario| scenario.name).collect();
                wish.point = Some(Point::parse(&text, &boards)?);
            }
            other => {
                return Err(format!(
                    "{other:?} is no option; there are --full, --every-way, --twentieth, --scenario NAME, --json, --evidence FILE and --reproduce POINT."
                ))
            }
        }
    }
    Ok(wish)
}

/// The counts of all scenarios.
#[derive(Default)]
struct Sum {
    rows: Vec<Value>,
    points: u64,
    states: u64,
    violations: u64,
}

impl Sum {
    fn add(&mut self, level: u8, name: &str, report: &Report, json: bool) {
        self.points += report.points;
        self.states += report.states;
        self.violations += report.violations;
        self.rows.push(as_json(level, name, report));
        if !json {
            println!("{}", as_text(name, report));
        }
    }
}

fn main() -> ExitCode {
    let wish = match wish(std::env::args().skip(1)) {
        Ok(wish) => wish,
        Err(why) => return refuse(&why),
    };
    if let Some(point) = wish.point {
        print!("{}", if point.is_board { powercut::reproduce(point) } else { cuts::reproduce(&point) });
        return ExitCode::SUCCESS;
    }
    let mut sum = Sum::default();
    let head =
        "scenario           operations    points   states  recoveries   bootloader  old program  new program  violations";
    if !wish.twentieth {
        if !wish.json {
            println!("Level 1: boot-core on the flash model. Each point is a cut at a flash operation, or two: the second one in the recovery.\n\n{head}");
        }
        let cuts = if wish.every_way { Cuts::EveryWay } else { Cuts::EveryOperation };
        for scenario in cuts::SCENARIOS.iter().filter(|scenario| wish.has(scenario.name)) {
            match cuts::run(scenario, cuts) {
                Ok(report) => sum.add(1, scenario.name, &report, wish.json),
                Err(why) => return refuse(&format!("{} fails without any cut: {why}", scenario.name)),
            }
        }
    }
    if !wish.json {
        println!(
            "\nLevel 2: the built firmware of {} in the emulator. Points that leave the same flash are one state; the board is looked at in each.\n\n{head}",
            coboot_tests::firmware::board().board
        );
    }
    for scenario in powercut::scenarios().filter(|scenario| wish.has(scenario.name)) {
        // Every operation once; the other scenarios share most of those of an update.
        let has_its_own = matches!(scenario.name, "update" | "renewal");
        let effort = match (wish.full && has_its_own, wish.full || wish.twentieth) {
            (true, _) => Effort::FULL,
            (_, true) => Effort::TWENTIETH,
            _ => Effort::SAMPLE,
        };
        match powercut::run(scenario, effort) {
            Ok(report) => sum.add(2, scenario.name, &report, wish.json),
            Err(why) => return refuse(&format!("{} fails without any cut: {why}", scenario.name)),
        }
    }
    let Sum { rows, points, states, violations } = sum;
    if rows.is_empty() {
        return refuse("there is no such scenario; docs/powercut.md names them.");
    }
    let board = coboot_tests::firmware::board().board;
    let object = json!({ "board": board, "points": points, "states": states, "violations": violations, "scenarios": rows });
    if let Some(file) = &wish.evidence {
        if let Err(error) = std::fs::write(file, object.to_string()) {
            return refuse(&format!("{file} cannot be written: {error}"));
        }
    }
    if wish.json {
        println!("{object}");
    } else {
        println!("\n{points} points, {states} states of the real firmware's flash, {violations} violations.");
        println!("To see one: cargo xtask powercut --reproduce update:37:torn");
    }
    if violations == 0 {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    }
}

fn refuse(why: &str) -> ExitCode {
    eprintln!("powercut: {why}");
    ExitCode::FAILURE
}

fn outcomes(report: &Report) -> [u64; 3] {
    ["bootloader", "old program", "new program"].map(|what| report.outcomes.get(what).copied().unwrap_or(0))
}

fn as_text(name: &str, report: &Report) -> String {
    let [bootloader, old, new] = outcomes(report);
    let mut text = format!(
        "{name:<18} {:>10} {:>9} {:>8} {:>11} {bootloader:>12} {old:>12} {new:>12} {:>11}",
        report.operations, report.points, report.states, report.recoveries, report.violations
    );
    for (point, what) in &report.reported {
        text += &format!("\n  {point}: {what}");
    }
    text
}

fn as_json(level: u8, name: &str, report: &Report) -> Value {
    let [bootloader, old, new] = outcomes(report);
    let reported: Vec<_> = report.reported.iter().map(|(point, what)| format!("{point}: {what}")).collect();
    let map = report.map.iter().map(|(way, letters)| (*way, String::from_utf8_lossy(letters)));
    json!({
        "level": level,
        "scenario": name,
        "operations": report.operations,
        "points": report.points,
        "states": report.states,
        "recoveries": report.recoveries,
        "bootloader": bootloader,
        "old_program": old,
        "new_program": new,
        "violations": report.violations,
        "told": reported,
        "map": map.collect::<BTreeMap<_, _>>(),
    })
}
