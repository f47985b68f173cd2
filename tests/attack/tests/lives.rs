//! The random lives of devices of each product, with and without a renewal of the bootloader:
//!
//! ```sh
//! COBOOT_ATTACKS=2000 cargo test -p coboot-attack --test lives    # seeds for each product
//! COBOOT_ATTACK_SEED=4711 cargo test -p coboot-attack --test lives    # one, with its actions
//! ```

use attack::device::{Action, Trouble};
use attack::files::{file, Content, Extent, Part};
use attack::mistakes::Mistake;
use attack::model::Model;
use attack::play::{attack, play, Failure, Met};
use attack::script;
use kit::rig::{
    sealed, Setup, AT_ONCE_2, ESACADEMY_1, ESACADEMY_2, LARGE_JOURNAL, LIFT_1, LIFT_2, PAULUS_1, PAULUS_2,
    RENEWALS, STANDARD_1, STANDARD_2,
};

fn environment(name: &str) -> Option<u64> {
    std::env::var(name).ok().map(|value| value.parse().unwrap_or_else(|_| panic!("{name} is no number")))
}

/// Attacks these products with so many seeds; each with this buffer and so many values in its journal, in turn.
fn attacks(setups: impl IntoIterator<Item = &'static Setup>, seeds: u64, kinds: &[(usize, u32)]) -> Met {
    let one = environment("COBOOT_ATTACK_SEED");
    let seeds = one.map_or(0..environment("COBOOT_ATTACKS").unwrap_or(seeds), |seed| seed..seed + 1);
    let mut met = Met::default();
    let mut failures: Vec<(&str, Box<Failure>)> = Vec::new();
    for setup in setups {
        let before = met.lives;
        for seed in seeds.clone() {
            if one.is_some() {
                println!("{}: {:#?}", setup.name, script::of(setup, seed));
            }
            let (buffer, stores) = kinds[seed as usize % kinds.len()];
            let new = || Model::new(setup, buffer, stores);
            let Err(failure) = attack(new, seed, &mut met) else { continue };
            // One for each rule.
            if failures
                .iter()
                .all(|(name, reported)| (*name, reported.broken.0) != (setup.name, failure.broken.0))
            {
                failures.push((setup.name, failure));
            }
        }
        println!("{}: {} attacks, {} lives", setup.name, seeds.end - seeds.start, met.lives - before);
    }
    let reported: Vec<_> = failures.iter().map(|(setup, failure)| format!("{setup}, {failure}")).collect();
    assert!(reported.is_empty(), "{} rules:\n{}", reported.len(), reported.join("\n"));
    met
}

#[test]
fn no_action_takes_the_bootloader_or_a_program() {
    let met = attacks(&RENEWALS, 40, &[(2048, 0)]);
    // Each state of the record, and each place that an image can come from.
    for wanted in [(0, 0), (1, 0), (1, 1), (2, 2), (3, 0), (3, 3)] {
        let is_met = met.states.contains(&wanted) || environment("COBOOT_ATTACK_SEED").is_some();
        assert!(is_met, "{wanted:?} was not met: {:?}", met.states);
    }
}

#[test]
fn no_action_breaks_a_rule_of_other_devices() {
    let of_one = [&STANDARD_1, &PAULUS_1, &ESACADEMY_1, &LIFT_1];
    let of_two = [&STANDARD_2, &AT_ONCE_2, &PAULUS_2, &ESACADEMY_2, &LIFT_2];
    attacks(of_one.into_iter().chain(of_two), 100, &[(256, 0), (1024, 0)]);
    // From 64 of its 585 places on the journal is compacted when the device is idle, and soon from 256 on.
    attacks([&LARGE_JOURNAL], 40, &[50, 240, 560].map(|stores| (2048, stores)));
}

#[test]
fn whatever_is_done_what_starts_is_authentic() {
    let of_two = [&sealed::STANDARD_2, &sealed::CONFIRMED_2, &sealed::ESACADEMY_2, &sealed::LIFT_2];
    let met = attacks([&sealed::STANDARD_1].into_iter().chain(of_two), 100, &[(2048, 0)]);
    // The attack is on a working device.
    assert!(environment("COBOOT_ATTACK_SEED").is_some() || met.programs > 300, "{}", met.programs);
}

/// No cut shows these: the rules find them in the lives of a device that has one.
#[test]
fn a_life_shows_a_seeded_bug_by_its_rule() {
    for (mistake, setup, rule) in [
        (
            Mistake::ReleasedByItself,
            &STANDARD_2,
            "a program is released by 83h or by a transfer of all of it",
        ),
        (Mistake::CounterForgotten, &sealed::STANDARD_2, "no program is there before its security counter"),
    ] {
        let flash = Model::new(setup, 2048, 0).flash();
        let new = || Model::on(setup, 2048, flash.clone(), Some(mistake));
        let found =
            (0..100).find_map(|seed| play(new(), &script::of(setup, seed), &mut Met::default()).err());
        let (_, broken) = found.unwrap_or_else(|| panic!("nothing shows {mistake:?}"));
        assert_eq!(broken.0, rule, "{mistake:?}: {broken}");
    }
}

/// On a device that takes a download without CLEAR a session outlives what it has relied on when it began: an
/// installation fails (`Some`: in this operation), or a program takes staging. Then it goes on, or begins again.
#[test]
fn what_a_session_relies_on_is_asked_again() {
    let device = RENEWALS.iter().find(|setup| setup.name == "RENEWS_LIFT_1").expect("there is one");
    let (image, program) = (Content::Image(1), Content::Program(1, Extent::Untold));
    let unlock = Action::Password { sub: 3, is_right: true };
    let all = file(device, program).blocks.len();
    let blocks = |sub, content, count| {
        let send = move |block| [Action::send(sub, content, Part::Block(block)), Action::Settle];
        (0..count).flat_map(send).collect::<Vec<_>>()
    };
    let destroys = [vec![unlock], blocks(3, image, 2), blocks(1, program, all), blocks(3, image, 3)];
    let bricks = (1..40).map(|after| {
        let fails =
            [Action::Command { sub: 3, value: 0x83 }, Action::Flash(after, Trouble::Dip), Action::Settle];
        let begin = vec![unlock, Action::Renew(image), Action::Renew(image), unlock];
        let goes_on = [vec![Action::Supply], blocks(1, program, all)].concat();
        [begin, blocks(1, program, 2), fails.to_vec(), goes_on]
    });
    for actions in bricks.chain([destroys]) {
        let actions = actions.concat();
        let played = play(Model::new(device, 2048, 0), &actions, &mut Met::default());
        assert!(played.is_ok(), "{actions:?}: {played:?}");
    }
}
