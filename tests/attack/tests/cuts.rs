//! Proof by power cut, and the proof of the proof.

use attack::cuts::{reproduce, run, shows, Cuts, Point, Scenario, Shown, SCENARIOS};
use attack::mistakes::Mistake;
use kit::rig::sealed::STANDARD_2;

fn scenario(name: &str) -> &'static Scenario {
    SCENARIOS.iter().find(|scenario| scenario.name == name).expect("a scenario of this name")
}

/// These cuts in each scenario. Returns the number of points.
fn prove(cuts: Cuts) -> u64 {
    let (mut points, mut wrong) = (0, Vec::new());
    for scenario in SCENARIOS {
        let name = scenario.name;
        let report = match run(scenario, cuts) {
            Ok(report) => report,
            Err(what) => {
                wrong.push(format!("{name} without a cut: {what}"));
                continue;
            }
        };
        println!("{name}: {} operations, {} points, {:?}", report.operations, report.points, report.outcomes);
        wrong.extend(report.reported.iter().map(|(point, what)| format!("{point}: {what}")));
        points += report.points;
        // An update leaves nothing of the old program, or all of it; or the new one. The sample has too
        // few points of a sealed one to meet each.
        let kinds = match (name, cuts) {
            ("update" | "raw", _) => 3,
            ("sealed" | "compressed", Cuts::EveryOperation) => 4,
            _ => continue,
        };
        assert_eq!(report.outcomes.len(), kinds, "{report:?}");
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
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

/// Often enough that the journal changes to its other region meanwhile, wherever it was before.
#[test]
fn nor_while_the_journal_changes_over() {
    let all = (0..22).map(|stores| scenario("sealed").on(&STANDARD_2, stores));
    let mut changed = 0;
    for (seed, scenario) in (0..).zip(all.filter(Scenario::changes_over)) {
        changed += 1;
        let report = run(&scenario, Cuts::Sample(seed)).expect("it works without a cut");
        assert_eq!(report.reported, [], "{seed}");
    }
    assert!(changed > 2, "{changed}");
}

/// In the scenario for this mistake: by a cut, unless a probe would find it after an action, too.
#[test]
fn a_cut_shows_every_seeded_bug_where_it_should() {
    use Mistake::*;
    let changed = "data are not changed while a record for them is valid";
    let unfinished = "the recovery does not complete";
    for (mistake, name, by_cut, within) in [
        (SignatureBeforeData, "update", false, changed),
        (EraseBeforeInvalidating, "update", false, changed),
        // CLEAR alone loses nothing: a cut in it leaves the old program.
        (EraseBeforeCheck, "update", false, "a program is lost by CLEAR or by accepted data alone"),
        (JournalWithoutCrc, "compaction", true, "not true that"),
        (CompactionInPlace, "compaction", true, "not true that"),
        (BlankAtFirstSight, "update", true, unfinished),
        (TouchedForgotten, "erase-and-install", true, unfinished),
    ] {
        let shown = shows(scenario(name), mistake);
        println!("{mistake:?} in {name}: {shown:?}");
        let what = match &shown {
            Shown::ByCut(_, what) => what,
            Shown::Uncut(what) if !by_cut => what,
            _ => panic!("{mistake:?} in {name}: {shown:?}"),
        };
        assert!(what.contains(within), "{mistake:?} in {name}: {what}");
    }
}

/// A refusal in time needs no flash operation, so there is nothing to cut; an erase before the
/// check is detected at once.
#[test]
fn a_program_for_another_product_costs_nothing() {
    let scenario = scenario("wrong-product");
    assert_eq!(run(scenario, Cuts::EveryOperation).expect("it works without a cut").operations, 0);
    let shown = shows(scenario, Mistake::EraseBeforeCheck);
    assert!(matches!(shown, Shown::Uncut(_)), "{shown:?}");
}

#[test]
fn a_point_is_written_read_and_told_in_words() {
    let boards = ["update", "store", "raw"];
    for text in ["update:37:torn", "lss-store:3:before:2:unstable"] {
        let point = Point::parse(text, &boards).unwrap();
        assert_eq!(point.to_string(), text);
        assert!(reproduce(&point).contains("cut at operation"), "{}", reproduce(&point));
    }
    for text in ["board:update:37:torn", "board:store:3:before:2:after"] {
        assert_eq!(Point::parse(text, &boards).unwrap().to_string(), text);
    }
    let wrong = [
        "",
        "nothing:1:torn",
        "update",
        "update:x:torn",
        "update:1:broken",
        "update:1:torn:2:torn:3:torn",
        "store:1:torn",
        "board",
        "board:update:1",
        "board:nothing:1:torn",
        "board:raw:x:torn",
        "board:raw:1:broken",
        "board:raw:1:all-but-one-bit",
        "board:raw:1:torn:2",
    ];
    for text in wrong {
        assert!(Point::parse(text, &boards).is_err(), "{text}");
    }
}
