//! Proof by power cut, level 2: the built firmware on the emulated chip.

use coboot_tests::powercut::board::{run, Effort, Point, SCENARIOS};

#[test]
fn no_cut_of_the_sample_bricks_the_board_or_starts_half_a_program() {
    let mut states = 0;
    for scenario in SCENARIOS {
        let report = run(scenario, Effort::SAMPLE).expect("it works without a cut");
        println!("{}: {report:?}", scenario.name);
        let told: Vec<_> = report.told.iter().map(|(point, what)| format!("{point}: {what}")).collect();
        assert_eq!(report.violations, 0, "{}:\n{}", scenario.name, told.join("\n"));
        assert!(report.operations > 0 && report.recoveries > 0, "{report:?}");
        if scenario.name == "update" {
            // Nothing lost yet, something lost, and all complete: the sample has met each state.
            assert_eq!(report.outcomes.len(), 3, "{report:?}");
        }
        states += report.states;
    }
    assert!(states > 1000, "{states}");
}

#[test]
fn a_point_of_the_board_is_written_and_read() {
    for text in ["board:update:37:torn", "board:store:3:before:2:after"] {
        assert_eq!(text.parse::<Point>().unwrap().to_string(), text);
    }
    for wrong in [
        "",
        "board",
        "board:update:1",
        "update:1:torn",
        "board:nothing:1:torn",
        "board:raw:x:torn",
        "board:raw:1:broken",
        "board:raw:1:torn:2",
    ] {
        assert!(wrong.parse::<Point>().is_err(), "{wrong}");
    }
}
