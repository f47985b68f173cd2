//! Proof by power cut, and the proof of the proof.

use coboot_tests::powercut::{reproduce, run, shows, Bug, Point, SCENARIOS};

/// Level 1: `boot-core` on the flash model; every operation, every way, and every operation of the recovery.
#[test]
fn no_cut_bricks_the_device_or_starts_half_a_program() {
    let mut points = 0;
    for scenario in SCENARIOS {
        let report = run(scenario, false).expect("it works without a cut");
        println!(
            "{}: {} operations, {} points, {:?}",
            scenario.name, report.operations, report.points, report.outcomes
        );
        let told: Vec<_> = report.told.iter().map(|(point, what)| format!("{point}: {what}")).collect();
        assert_eq!(report.violations, 0, "{}:\n{}", scenario.name, told.join("\n"));
        points += report.points;
    }
    assert!(points > 20_000, "{points}");
}

#[test]
fn every_seeded_bug_is_caught() {
    for bug in Bug::ALL {
        let caught = SCENARIOS.iter().find(|scenario| shows(scenario, bug));
        println!("{bug:?}: {:?}", caught.map(|scenario| scenario.name));
        assert!(caught.is_some(), "{bug:?}");
    }
}

#[test]
fn a_point_is_written_read_and_told_in_words() {
    for text in ["update:37:torn", "lss-store:3:before:2:unstable"] {
        let point: Point = text.parse().unwrap();
        assert_eq!(point.to_string(), text);
        assert!(reproduce(&point).contains("cut at operation"), "{}", reproduce(&point));
    }
    for wrong in
        ["", "nothing:1:torn", "update", "update:x:torn", "update:1:broken", "update:1:torn:2:torn:3:torn"]
    {
        assert!(wrong.parse::<Point>().is_err(), "{wrong}");
    }
}
