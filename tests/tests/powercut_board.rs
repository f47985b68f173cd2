//! Proof by power cut, level 2: the built firmware on the emulated chip.

use coboot_tests::powercut::board::{Effort, Point, Story};

#[test]
fn no_cut_of_the_sample_bricks_the_board_or_starts_half_a_program() {
    let story = Story::new().expect("it works without a cut");
    let report = story.run(Effort::Sample(24));
    println!("{} operations, {} points, {:?}", report.operations, report.points, report.outcomes);
    let told: Vec<_> = report.told.iter().map(|(point, what)| format!("{point}: {what}")).collect();
    assert_eq!(report.violations, 0, "\n{}", told.join("\n"));
    assert!(report.operations > 1000 && report.points >= 40, "{report:?}");
    // Nothing lost yet, something lost, and all complete: the sample has met each state.
    assert_eq!(report.outcomes.len(), 3, "{:?}", report.outcomes);
}

#[test]
fn a_point_of_the_board_is_written_and_read() {
    for text in ["board:37:torn", "board:3:before:2:after"] {
        assert_eq!(text.parse::<Point>().unwrap().to_string(), text);
    }
    for wrong in ["", "board", "board:1", "update:1:torn", "board:x:torn", "board:1:broken", "board:1:torn:2"]
    {
        assert!(wrong.parse::<Point>().is_err(), "{wrong}");
    }
}
