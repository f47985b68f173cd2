//! Proof by power cut, level 2: the built firmware on the emulated chip.

use coboot_tests::firmware;
use coboot_tests::powercut::{operations, prove, run, scenarios, Effort};
use emulator::machine::{Cut, Operation};

#[test]
fn no_cut_of_the_sample_bricks_the_board_or_starts_half_a_program() {
    let mut states = 0;
    for scenario in scenarios() {
        let report = run(scenario, Effort::SAMPLE).expect("it works without a cut");
        println!("{}: {report:?}", scenario.name);
        let reported: Vec<_> =
            report.reported.iter().map(|(point, what)| format!("{point}: {what}")).collect();
        assert_eq!(report.violations, 0, "{}:\n{}", scenario.name, reported.join("\n"));
        assert!(report.operations > 0 && report.recoveries > 0, "{report:?}");
        if scenario.name == "update" {
            // Nothing lost yet, something lost, and all complete: the sample has met each state.
            assert_eq!(report.outcomes.len(), 3, "{report:?}");
        }
        states += report.states;
    }
    assert!(states > 1000, "{states}");
}

/// The operations of an update in another order, as a bootloader with a bug would have them.
#[test]
fn a_cut_shows_an_order_of_operations_that_is_wrong() {
    let scenario = scenarios().find(|scenario| scenario.name == "update").unwrap();
    let story = scenario.story().unwrap();
    let sound = operations(&story).unwrap();
    let parameters = firmware::board().parameters;
    let base = firmware::board().chip.flash.base;
    let is_parameter = |operation: &Operation| match operation {
        Operation::Program { offset, .. } => {
            parameters.iter().any(|region| region.contains(base + offset, 4))
        }
        _ => false,
    };
    // The ends and nothing else.
    let effort = Effort { cut: (20, usize::MAX), recovered: (0, usize::MAX), cut_again: (0, usize::MAX) };
    let reported = |operations: &[Operation]| {
        let report = prove("update", &story, operations, effort);
        report.reported.into_iter().map(|(_, what)| what).collect::<Vec<_>>()
    };
    assert_eq!(reported(&sound), Vec::<String>::new());

    // The record of the new program before its last words.
    let last_data = sound.iter().rposition(|operation| !is_parameter(operation)).unwrap();
    let mut early = sound.clone();
    early[last_data - 3..].rotate_left(4);
    // The sectors are erased before the record of the old program is withdrawn.
    let erase = sound.iter().position(|operation| matches!(operation, Operation::Erase { .. })).unwrap();
    assert!(erase > 0 && sound[..erase].iter().all(is_parameter));
    let mut late = sound.clone();
    late[..=erase].rotate_right(1);
    for wrong in [early, late] {
        let reported = reported(&wrong);
        assert!(reported.iter().any(|what| what.contains("is not what it says")), "{reported:?}");
    }
}

/// The same in a renewal: home is erased before the record says that staging is confirmed.
#[test]
#[cfg_attr(not(staging), ignore = "needs a region for staging")]
fn a_cut_shows_a_home_that_is_erased_too_early() {
    let scenario = scenarios().find(|scenario| scenario.name == "renewal").unwrap();
    let mut story = scenario.story().unwrap();
    let sound = operations(&story).unwrap();
    let board = firmware::board();
    let home = board.home.unwrap();
    let is_erase = |operation: &Operation| match operation {
        Operation::Erase { sectors } => sectors.iter().any(|sector| sector.region.base == home.base),
        _ => false,
    };
    let erase = sound.iter().position(is_erase).unwrap();
    // Since the last word of staging there were the records alone.
    let staged = sound[..erase].iter().rposition(|operation| match operation {
        Operation::Program { offset, .. } => {
            board.staging.unwrap().contains(board.chip.flash.base + offset, 4)
        }
        _ => false,
    });
    let from = staged.unwrap() + 1;
    for operation in &sound[..from] {
        story.start.apply(operation, board.chip, Cut::After);
    }
    let effort = Effort { cut: (usize::MAX / 2, 1), recovered: (0, usize::MAX), cut_again: (0, usize::MAX) };
    let reported = |operations: &[Operation]| {
        let report = prove("renewal", &story, operations, effort);
        report.reported.into_iter().map(|(_, what)| what).collect::<Vec<_>>()
    };
    let mut records = sound[from..=erase].to_vec();
    assert_eq!(reported(&records), Vec::<String>::new());
    records.rotate_right(1);
    let reported = reported(&records);
    assert!(reported.iter().any(|what| what.contains("bootloader does not answer")), "{reported:?}");
}
