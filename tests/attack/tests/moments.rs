//! What comes at any moment of the work on something else: the rules judge it.

use attack::device::Action;
use attack::files::{Content, Extent, Flaw, Part, Sent};
use attack::model::Model;
use attack::play::{act, Met};
use kit::bench::{CLEAR, CLR_SIGNATURE, SET_SIGNATURE, START};
use kit::rig::{Setup, AT_ONCE_2, ESACADEMY_2, LIFT_2, STANDARD_1, STANDARD_2};

/// The moments, in steps of the device's work. A sector is erased and some words are programmed in
/// 100.
const MOMENTS: u32 = 400;
/// CiA 302-3: a reset, which starts a program after a stream.
const RESET: u8 = 2;

fn unlock(setup: &'static Setup, sub: u8) -> Action {
    match setup.password(sub) {
        Some(_) => Action::Password { sub, is_right: true },
        None => Action::Command { sub, value: CLEAR },
    }
}

fn program(sub: u8, size: usize) -> Content {
    Content::Program(sub, Extent::Bytes(size))
}

/// All of a program in one transfer, without its work.
fn stream(setup: &'static Setup, sub: u8, part: Part) -> [Action; 3] {
    [unlock(setup, sub), Action::Settle, Action::send(sub, program(sub, 900), part)]
}

/// The beginning of a transfer.
fn begin(sub: u8, part: Part, bytes: usize) -> Action {
    let sent = Sent { content: program(sub, 700), part, flaw: Flaw::None };
    Action::Send { sub, sent, is_announced: bytes.is_multiple_of(2), bytes: Some(bytes) }
}

/// Both programs.
fn both(setup: &'static Setup) -> Vec<Action> {
    let of = |sub| [&stream(setup, sub, Part::Whole)[..], &[Action::Settle]].concat();
    [of(1), of(2), vec![Action::PowerOff]].concat()
}

type At = fn(&'static Setup, u32) -> Vec<Action>;

/// A device with these programs, and what comes in this moment.
fn play(setup: &'static Setup, before: &[Action], at: At) -> Vec<(u32, Met)> {
    let mut met = Met::default();
    let prepared = act(Model::new(setup, 1024, 0), before, &mut met).expect("it is prepared");
    let flash = prepared.device().flash();
    let one = |moment| {
        let (actions, mut met) = (at(setup, moment), Met::default());
        let device = Model::on(setup, 1024, flash.clone(), None);
        if let Err((n, broken)) = act(device, &actions, &mut met) {
            panic!("{}, moment {moment}, action {n} of {actions:?}: {broken:?}", setup.name);
        }
        (moment, met)
    };
    (0..MOMENTS).map(one).collect()
}

/// A download to program 1 is aborted, the password or CLEAR arrives at any moment of the remaining
/// work, and a download to program 2 is aborted, too.
#[test]
fn a_record_never_outlives_its_program_whenever_the_password_or_clear_comes() {
    for setup in [&LIFT_2, &ESACADEMY_2, &STANDARD_2, &AT_ONCE_2] {
        play(setup, &both(setup), |setup, moment| {
            let first = [unlock(setup, 1), begin(1, Part::Whole, 650), Action::Run(moment), Action::Cancel];
            let second = [unlock(setup, 2), begin(2, Part::Whole, 650), Action::Run(100), Action::Cancel];
            [&first[..], &second, &[Action::Settle, Action::PowerOff]].concat()
        });
    }
}

/// A stream to one program is complete, and one to the other program is being finished: START and
/// the reset for the first one start it, or are refused. The same while a signature of the other
/// one is being stored.
#[test]
fn what_is_started_is_the_program_that_was_named() {
    let setup = &STANDARD_2;
    let started = |before: &[Action], at: At| {
        for (moment, met) in play(setup, before, at) {
            assert!(met.refused > 0 || met.lives > 0, "{moment}: it was taken, and nothing starts");
        }
    };
    macro_rules! rows {
        ($($first:literal $command:ident $part:ident),*) => {
            // In one life: a reset would forget the first stream.
            $(started(&[], |setup, moment| {
                let (first, other) =
                    (stream(setup, $first, Part::$part), stream(setup, 3 - $first, Part::$part));
                let command = Action::Command { sub: $first, value: $command };
                let named = [Action::Run(moment), command, Action::Settle];
                [&first[..], &[Action::Settle], &other, &named].concat()
            });)*
        };
    }
    rows!(1 START Whole, 2 START Whole, 1 RESET Hex, 2 RESET Hex, 1 START Hex, 2 RESET Whole);
    let during: [At; 2] =
        [|_, moment| during(SET_SIGNATURE, moment), |_, moment| during(CLR_SIGNATURE, moment)];
    during.into_iter().for_each(|at| started(&both(setup), at));
}

fn during(signature: u8, moment: u32) -> Vec<Action> {
    let start = Action::Command { sub: 1, value: START };
    vec![Action::Command { sub: 2, value: signature }, Action::Run(moment), start, Action::Settle]
}

/// A set of parameters is data: no command starts it, at any moment after its download.
#[test]
fn data_are_never_started() {
    let at: [At; 2] =
        [|setup, moment| command(setup, moment, START), |setup, moment| command(setup, moment, RESET)];
    for (_, met) in at.into_iter().flat_map(|at| play(&LIFT_2, &[], at)) {
        assert_eq!(met.lives, 0);
    }
    fn command(setup: &'static Setup, moment: u32, value: u8) -> Vec<Action> {
        let command = Action::Command { sub: 2, value };
        [&stream(setup, 2, Part::Whole)[..], &[Action::Run(moment), command, Action::Settle]].concat()
    }
}

/// Layer setting services do not check whether a download is running, and neither does a second SDO
/// server: the values that they store must not replace the record that must be removed first.
#[test]
fn a_record_never_outlives_its_program_whatever_is_stored_during_a_download() {
    let setup = &STANDARD_1;
    let before = [&stream(setup, 1, Part::Whole)[..], &[Action::Settle]].concat();
    play(setup, &before, |setup, moment| {
        let between = [
            Action::Store(9),
            Action::Command { sub: 1, value: SET_SIGNATURE },
            Action::Command { sub: 1, value: CLR_SIGNATURE },
        ][moment as usize % 3];
        let part = [Part::Block(0), Part::Whole, Part::Hex][moment as usize / 3 % 3];
        let begin = begin(1, part, 7 * (moment as usize / 9));
        let steps = [Action::Run(2)].repeat(100);
        [&[unlock(setup, 1), begin, between, Action::GoOn(None)][..], &steps].concat()
    });
}
