//! Proof by power cut, and the proof of the proof.

use coboot_tests::powercut::{reproduce, run, shows, Bug, Cuts, Point, Scenario, Shown, SCENARIOS};

fn scenario(name: &str) -> &'static Scenario {
    SCENARIOS.iter().find(|scenario| scenario.name == name).expect("a scenario of this name")
}

/// Level 1, `boot-core` on the flash model: these cuts in each scenario. Returns the number of points.
fn prove(cuts: Cuts) -> u64 {
    let mut points = 0;
    for scenario in SCENARIOS {
        let report = run(scenario, cuts).expect("it works without a cut");
        println!(
            "{}: {} operations, {} points, {:?}",
            scenario.name, report.operations, report.points, report.outcomes
        );
        let told: Vec<_> = report.told.iter().map(|(point, what)| format!("{point}: {what}")).collect();
        assert_eq!(report.violations, 0, "{}:\n{}", scenario.name, told.join("\n"));
        points += report.points;
    }
    points
}

#[test]
fn no_cut_of_the_sample_bricks_the_device_or_starts_half_a_program() {
    let points = prove(Cuts::Sample(20));
    assert!(points > 4_000, "{points}");
}

/// Every operation, every way, and every operation of the recovery.
#[test]
fn no_cut_bricks_the_device_or_starts_half_a_program() {
    let points = prove(Cuts::EveryOperation);
    assert!(points > 20_000, "{points}");
}

/// By a power cut, and in the scenario for this bug: a scenario that fails anyway would prove
/// nothing about cuts.
#[test]
fn a_cut_shows_every_seeded_bug_where_it_should() {
    for bug in Bug::ALL {
        let (name, within) = match bug {
            Bug::SignatureBeforeData | Bug::EraseBeforeInvalidating => ("update", "is not what it says"),
            // CLEAR alone loses nothing: a cut in it leaves the old program.
            Bug::EraseBeforeCheck => ("update", "Bootloader, where [Runs(163)] may be"),
            Bug::JournalWithoutCrc | Bug::CompactionInPlace => ("compaction", ", where "),
            Bug::BlankAtFirstSight => ("update", "the recovery does not complete: status 00000008h"),
            Bug::TouchedForgotten => {
                ("erase-and-install", "the recovery does not complete: status 00000008h")
            }
        };
        let shown = shows(scenario(name), bug);
        println!("{bug:?} in {name}: {shown:?}");
        let Shown::ByCut(_, what) = &shown else { panic!("{bug:?} in {name}: {shown:?}") };
        assert!(what.contains(within), "{bug:?} in {name}: {what}");
    }
}

/// A refusal in time needs no flash operation, so there is nothing to cut; an erase before the
/// check is detected at once.
#[test]
fn a_program_for_another_product_costs_nothing() {
    let scenario = scenario("wrong-product");
    assert_eq!(run(scenario, Cuts::EveryOperation).expect("it works without a cut").operations, 0);
    let shown = shows(scenario, Bug::EraseBeforeCheck);
    assert!(matches!(shown, Shown::Uncut(_)), "{shown:?}");
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
