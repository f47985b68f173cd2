//! `cargo xtask powercut`: cuts the power at every flash operation, and checks the device after the
//! power returns.

use std::fmt::Display;
use std::process::ExitCode;
use std::str::FromStr;

use coboot_tests::powercut::board::{self, Effort, Story};
use coboot_tests::powercut::{reproduce, run, Point, Report, SCENARIOS};

/// The number of points of level 2 between the first and the last ones, without `--full`.
const SAMPLE: u64 = 24;

/// A point of one of the levels.
enum AnyPoint {
    Model(Point),
    Board(board::Point),
}

impl FromStr for AnyPoint {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text.split(':').next() == Some(board::NAME) {
            text.parse().map(Self::Board)
        } else {
            text.parse().map(Self::Model)
        }
    }
}

fn main() -> ExitCode {
    let mut arguments = std::env::args().skip(1);
    let (mut full, mut json, mut point) = (false, false, None);
    while let Some(argument) = arguments.next() {
        match argument.as_str() {
            "--full" => full = true,
            "--json" => json = true,
            "--reproduce" => match arguments.next().map(|text| text.parse::<AnyPoint>()) {
                Some(Ok(given)) => point = Some(given),
                Some(Err(why)) => return refuse(&why),
                None => return refuse("--reproduce wants a point, as update:37:torn."),
            },
            other => {
                return refuse(&format!(
                    "{other:?} is no option; there are --full, --json and --reproduce POINT."
                ))
            }
        }
    }
    if let Some(point) = point {
        match point {
            AnyPoint::Model(point) => print!("{}", reproduce(&point)),
            AnyPoint::Board(point) => match Story::new() {
                Ok(story) => print!("{}", story.reproduce(point)),
                Err(why) => return refuse(&format!("the board fails without any cut: {why}")),
            },
        }
        return ExitCode::SUCCESS;
    }

    if !json {
        println!("Level 1: boot-core on the flash model. Each point is a cut at a flash operation, or two: the second one in the recovery.\n");
        println!(
            "scenario           operations    points   bootloader  old program  new program  violations"
        );
    }
    let mut rows = Vec::new();
    let (mut points, mut violations) = (0, 0);
    for scenario in SCENARIOS {
        let report = match run(scenario, full) {
            Ok(report) => report,
            Err(why) => return refuse(&format!("{} fails without any cut: {why}", scenario.name)),
        };
        points += report.points;
        violations += report.violations;
        if json {
            rows.push(as_json(1, scenario.name, &report));
        } else {
            println!("{}", as_text(scenario.name, &report));
        }
    }
    let report = match Story::new() {
        Ok(story) => story.run(if full { Effort::Full } else { Effort::Sample(SAMPLE) }),
        Err(why) => return refuse(&format!("the board fails without any cut: {why}")),
    };
    points += report.points;
    violations += report.violations;
    if json {
        rows.push(as_json(2, board::NAME, &report));
    } else {
        println!("\nLevel 2: the built firmware in the emulator; what it did behind each cut.\n");
        println!("{}", as_text(board::NAME, &report));
    }
    if json {
        println!(
            "{{\"points\": {points}, \"violations\": {violations}, \"scenarios\": [\n{}\n]}}",
            rows.join(",\n")
        );
    } else {
        println!("\n{points} points, {violations} violations.");
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

fn outcomes<P>(report: &Report<P>) -> [u64; 3] {
    ["bootloader", "old program", "new program"].map(|what| report.outcomes.get(what).copied().unwrap_or(0))
}

fn as_text<P: Display>(name: &str, report: &Report<P>) -> String {
    let [bootloader, old, new] = outcomes(report);
    let mut text = format!(
        "{name:<18} {:>10} {:>9} {bootloader:>12} {old:>12} {new:>12} {:>11}",
        report.operations, report.points, report.violations
    );
    for (point, what) in &report.told {
        text += &format!("\n  {point}: {what}");
    }
    text
}

fn as_json<P: Display>(level: u8, name: &str, report: &Report<P>) -> String {
    let [bootloader, old, new] = outcomes(report);
    let told: Vec<_> =
        report.told.iter().map(|(point, what)| format!("{:?}", format!("{point}: {what}"))).collect();
    format!(
        "  {{\"level\": {level}, \"scenario\": \"{name}\", \"operations\": {}, \"points\": {}, \"bootloader\": {bootloader}, \"old_program\": {old}, \"new_program\": {new}, \"violations\": {}, \"told\": [{}]}}",
        report.operations,
        report.points,
        report.violations,
        told.join(", ")
    )
}
