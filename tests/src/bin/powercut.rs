//! `cargo xtask powercut`: the power cut at every flash operation, and what is there when it comes back.

use std::process::ExitCode;

use coboot_tests::powercut::{reproduce, run, Point, Report, SCENARIOS};

fn main() -> ExitCode {
    let mut arguments = std::env::args().skip(1);
    let (mut full, mut json, mut point) = (false, false, None);
    while let Some(argument) = arguments.next() {
        match argument.as_str() {
            "--full" => full = true,
            "--json" => json = true,
            "--reproduce" => match arguments.next().map(|text| text.parse::<Point>()) {
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
        print!("{}", reproduce(&point));
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
            rows.push(as_json(scenario.name, &report));
        } else {
            println!("{}", as_text(scenario.name, &report));
        }
    }
    if json {
        println!(
            "{{\"level\": 1, \"points\": {points}, \"violations\": {violations}, \"scenarios\": [\n{}\n]}}",
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

fn outcomes(report: &Report) -> [u64; 3] {
    ["bootloader", "old program", "new program"].map(|what| report.outcomes.get(what).copied().unwrap_or(0))
}

fn as_text(name: &str, report: &Report) -> String {
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

fn as_json(name: &str, report: &Report) -> String {
    let [bootloader, old, new] = outcomes(report);
    let told: Vec<_> =
        report.told.iter().map(|(point, what)| format!("{:?}", format!("{point}: {what}"))).collect();
    format!(
        "  {{\"scenario\": \"{name}\", \"operations\": {}, \"points\": {}, \"bootloader\": {bootloader}, \"old_program\": {old}, \"new_program\": {new}, \"violations\": {}, \"told\": [{}]}}",
        report.operations,
        report.points,
        report.violations,
        told.join(", ")
    )
}
