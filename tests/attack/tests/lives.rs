//! The random lives of devices that are renewed, of each product:
//!
//! ```sh
//! COBOOT_ATTACKS=2000 cargo test -p coboot-attack    # seeds for each product
//! COBOOT_ATTACK_SEED=4711 cargo test -p coboot-attack    # one, with its actions
//! ```

use attack::device::Action;
use attack::files::{file, Content, Extent};
use attack::model::Model;
use attack::play::{attack, play, Failure, Met};
use attack::script;
use kit::rig::{Setup, RENEWALS};

/// A device with this name.
fn setup(name: &str) -> &'static Setup {
    RENEWALS.iter().find(|setup| setup.name == name).expect("there is one")
}

const fn command(sub: u8, value: u8) -> Action {
    Action::Command { sub, value }
}

const fn block(sub: u8, content: Content, block: usize) -> Action {
    Action::Send { sub, content, block: Some(block), bytes: None }
}

/// Blocks, each with all its work.
fn blocks(sub: u8, content: Content, blocks: std::ops::Range<usize>) -> Vec<Action> {
    blocks.flat_map(|number| [block(sub, content, number), Action::Settle]).collect()
}

/// A download of the program, which began before the installation failed, goes on after it: on a device that takes a
/// download without CLEAR.
#[test]
fn a_session_that_outlives_a_failed_installation_does_not_take_staging() {
    let program = Content::Program { number: 1, extent: Extent::Untold };
    let unlock = Action::Password { sub: 3 };
    let begin = [unlock, Action::Renew(Content::Image(1)), Action::Renew(Content::Image(1)), unlock];
    let device = setup("LIFT_1");
    let all = file(device, program).blocks.len();
    for after in 1..40 {
        let mut actions = begin.to_vec();
        actions.extend(blocks(1, program, 0..2));
        actions.extend([command(3, 0x83), Action::Dip(after), Action::Settle, Action::Supply]);
        actions.extend(blocks(1, program, 0..all));
        let played = play(Model::new(device), &actions, &mut Met::default());
        assert!(played.is_ok(), "{after}: {played:?}");
    }
}

/// A program takes staging while a download of a bootloader is open, which then goes on.
#[test]
fn a_session_that_outlives_the_installation_of_a_program_does_not_destroy_it() {
    let program = Content::Program { number: 1, extent: Extent::Untold };
    let image = Content::Image(1);
    let device = setup("LIFT_1");
    let all = file(device, program).blocks.len();
    let mut actions = vec![Action::Password { sub: 3 }];
    actions.extend(blocks(3, image, 0..2));
    actions.extend(blocks(1, program, 0..all));
    actions.extend(blocks(3, image, 0..3));
    let played = play(Model::new(device), &actions, &mut Met::default());
    assert!(played.is_ok(), "{played:?}");
}

fn environment(name: &str) -> Option<u64> {
    std::env::var(name).ok().map(|value| value.parse().unwrap_or_else(|_| panic!("{name} is no number")))
}

/// The seeds of each product.
const ATTACKS: u64 = 100;

#[test]
fn no_action_takes_the_bootloader_or_a_program() {
    let one = environment("COBOOT_ATTACK_SEED");
    let seeds = match one {
        Some(seed) => seed..seed + 1,
        None => 0..environment("COBOOT_ATTACKS").unwrap_or(ATTACKS),
    };
    let mut met = Met::default();
    let mut failures: Vec<(&str, Box<Failure>)> = Vec::new();
    for setup in &RENEWALS {
        let before = met.starts;
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
        println!("{}: {} attacks, {} lives", setup.name, seeds.end - seeds.start, met.starts - before);
    }
    let told: Vec<_> = failures.iter().map(|(setup, failure)| format!("{setup}, {failure}")).collect();
    assert!(told.is_empty(), "{} rules:\n{}", told.len(), told.join("\n"));
    // Each state of the record, and each place that an image can come from, was met.
    for wanted in [(0, 0), (1, 0), (1, 1), (2, 2), (3, 0), (3, 3)] {
        assert!(one.is_some() || met.states.contains(&wanted), "{wanted:?} was not met: {:?}", met.states);
    }
}
