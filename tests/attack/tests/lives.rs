//! The random lives of devices that are renewed, of each product:
//!
//! ```sh
//! COBOOT_ATTACKS=2000 cargo test -p coboot-attack    # seeds for each product
//! COBOOT_ATTACK_SEED=4711 cargo test -p coboot-attack    # one, with its actions
//! ```

use attack::device::{Action, Trouble};
use attack::files::{file, Content, Extent};
use attack::model::Model;
use attack::play::{attack, play, Failure, Met};
use attack::script;
use kit::rig::RENEWALS;

fn environment(name: &str) -> Option<u64> {
    std::env::var(name).ok().map(|value| value.parse().unwrap_or_else(|_| panic!("{name} is no number")))
}

/// The seeds of each product.
const ATTACKS: u64 = 40;

#[test]
fn no_action_takes_the_bootloader_or_a_program() {
    let one = environment("COBOOT_ATTACK_SEED");
    let seeds = one.map_or(0..environment("COBOOT_ATTACKS").unwrap_or(ATTACKS), |seed| seed..seed + 1);
    let mut met = Met::default();
    let mut failures: Vec<(&str, Box<Failure>)> = Vec::new();
    for setup in &RENEWALS {
        let before = met.lives;
        for seed in seeds.clone() {
            if one.is_some() {
                println!("{}: {:#?}", setup.name, script::of(setup, seed));
            }
            let Err(failure) = attack(|| Model::new(setup), seed, &mut met) else { continue };
            // One for each rule.
            if failures.iter().all(|(name, told)| (*name, told.broken.0) != (setup.name, failure.broken.0)) {
                failures.push((setup.name, failure));
            }
        }
        println!("{}: {} attacks, {} lives", setup.name, seeds.end - seeds.start, met.lives - before);
    }
    let told: Vec<_> = failures.iter().map(|(setup, failure)| format!("{setup}, {failure}")).collect();
    assert!(told.is_empty(), "{} rules:\n{}", told.len(), told.join("\n"));
    // Each state of the record, and each place that an image can come from.
    for wanted in [(0, 0), (1, 0), (1, 1), (2, 2), (3, 0), (3, 3)] {
        assert!(one.is_some() || met.states.contains(&wanted), "{wanted:?} was not met: {:?}", met.states);
    }
}

/// On a device that takes a download without CLEAR a session outlives what it has relied on when it began: an
/// installation fails (`Some`: in this operation), or a program takes staging. Then it goes on, or begins again.
#[test]
fn what_a_session_relies_on_is_asked_again() {
    let device = RENEWALS.iter().find(|setup| setup.name == "LIFT_1").expect("there is one");
    let (image, program) = (Content::Image(1), Content::Program(1, Extent::Untold));
    let unlock = Action::Password { sub: 3 };
    let all = file(device, program).blocks.len();
    let blocks = |sub, content, count| {
        let send =
            move |block| [Action::Send { sub, content, block: Some(block), bytes: None }, Action::Settle];
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
        let played = play(Model::new(device), &actions, &mut Met::default());
        assert!(played.is_ok(), "{actions:?}: {played:?}");
    }
}
