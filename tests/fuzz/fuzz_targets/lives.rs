//! The bytes are the actions of an attack (`tests/attack`) on a device of any profile, with and without keys: blocks,
//! whole programs, sealed images, damaged and hostile ones and any bytes, in pieces of any length, with or without
//! work of the flash in between; commands, passwords, reads, resets, power cuts and faults of the flash.
//!
//! Must hold: each rule of `tests/attack` after each action; and afterwards each program can be installed (tried
//! after each eighth input, because it takes longer than most of them).
#![cfg_attr(fuzzing, no_main)]

use attack::files::forget;
use attack::model::Model;
use attack::play::{act, play, Met};
use attack::script;
use coboot_fuzz::is_eighth;
use kit::rig::{sealed, Setup, AT_ONCE_2, ESACADEMY_2, LIFT_2, PAULUS_1, RENEWALS, STANDARD_1, STANDARD_2};

static SETUPS: [&Setup; 12] = [
    &STANDARD_1,
    &STANDARD_2,
    &ESACADEMY_2,
    &LIFT_2,
    &PAULUS_1,
    &AT_ONCE_2,
    &sealed::STANDARD_1,
    &sealed::CONFIRMED_2,
    &sealed::ESACADEMY_2,
    &sealed::LIFT_2,
    &RENEWALS[1],
    &RENEWALS[6],
];

coboot_fuzz::target!(|bytes: &[u8]| {
    let [which, rest @ ..] = bytes else { return };
    let setup = SETUPS[usize::from(*which) % SETUPS.len()];
    let new = || Model::new(setup, if setup.takes_sealed { 2048 } else { 256 }, 0);
    forget();
    let actions = script::of_bytes(setup, rest);
    let mut met = Met::default();
    let played = if is_eighth(bytes) {
        play(new(), &actions, &mut met)
    } else {
        act(new(), &actions, &mut met).map(drop)
    };
    if let Err((n, broken)) = played {
        panic!("{}, action {n} of {actions:#?}: {broken:?}", setup.name);
    }
});
