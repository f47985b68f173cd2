//! The rules that a device keeps.

use kit::bench::CLEAR;
use kit::rig::Setup;
use shared_abi::renewal::{Origin, State};

use crate::device::{Action, Seen, Stored};
use crate::files::{may_run, Content};

/// What was before an action.
pub struct History {
    setup: &'static Setup,
    /// The device then.
    pub seen: Seen,
    /// The programs, number 1 first: whether this one may be lost since CLEAR or data were accepted.
    may_go: Vec<bool>,
    /// The image in staging has decayed since it was stored.
    rotten: bool,
}

impl History {
    pub(crate) fn new(setup: &'static Setup, seen: Seen) -> Self {
        Self { setup, may_go: vec![false; seen.programs.len()], seen, rotten: false }
    }

    /// Takes note of what an action permits that the device has acknowledged, or not.
    pub(crate) fn permit(&mut self, action: &Action, is_acknowledged: bool) {
        let setup = self.setup;
        self.rotten |= matches!(action, Action::Rot(..));
        let (sub, may_go) = match *action {
            // In a sealed device genuine data alone end a program.
            Action::Command { sub, value: CLEAR } => (sub, is_acknowledged && !setup.takes_sealed),
            Action::Password { sub } => {
                (sub, is_acknowledged && !setup.takes_sealed && setup.password_clears())
            }
            Action::Send { sub, content, block, .. } => {
                let fits = matches!(content, Content::Program(number, _) if number == sub);
                // Of a stream the first part may have been accepted.
                let is_stream = block.is_none() || setup.takes_sealed;
                let has_data = block != Some(0) || setup.is_data(sub);
                (sub, (fits || setup.is_data(sub)) && (is_stream || has_data && is_acknowledged))
            }
            _ => return,
        };
        if let Some(program) = self.may_go.get_mut(usize::from(sub).wrapping_sub(1)) {
            *program |= may_go;
        }
    }

    pub(crate) fn update(&mut self, seen: Seen) {
        self.rotten &= seen.record.is_some();
        for ((may_go, now), before) in self.may_go.iter_mut().zip(&seen.programs).zip(&self.seen.programs) {
            // What was accepted belongs to a session; and a new program begins without.
            let is_over = seen.starts != self.seen.starts || now != before;
            *may_go &= !(is_over && matches!(now, Stored::Good(_)));
        }
        self.seen = seen;
    }
}

/// What is true after each action.
pub struct Rule {
    pub name: &'static str,
    pub is_kept: fn(before: &History, now: &Seen) -> bool,
}

pub const RULES: &[Rule] = &[
    Rule { name: "a bootloader can be loaded after each reset", is_kept: loads },
    Rule { name: "the installation alone removes a confirmed record", is_kept: keeps_confirmed },
    Rule { name: "data are not changed while a record for them is valid", is_kept: records_are_true },
    Rule { name: "a program is lost by CLEAR or by accepted data alone", is_kept: keeps_programs },
];

fn loads(before: &History, now: &Seen) -> bool {
    now.loads.is_some_and(|crc| may_run(before.setup, crc))
}

fn keeps_confirmed(before: &History, now: &Seen) -> bool {
    let was = &before.seen;
    let Some(record) = was.record.filter(|record| record.state == State::Confirmed) else { return true };
    // The resident part has loaded home all the same: the record is void.
    let is_void = was.origin == Origin::Home;
    let is_installed = now.state() == State::Installed && now.home == Some(record.crc);
    let is_certain = was.is_certain && now.is_certain;
    now.record == Some(record) || is_installed || is_void || !is_certain
}

fn records_are_true(before: &History, now: &Seen) -> bool {
    let is_true = now.record.is_none() || now.is_staged || before.rotten;
    !now.is_certain || is_true && !now.programs.contains(&Stored::Damaged)
}

fn keeps_programs(before: &History, now: &Seen) -> bool {
    let was = &before.seen;
    let mut programs = was.programs.iter().zip(&now.programs).zip(&before.may_go);
    let is_certain = was.is_certain && now.is_certain;
    !is_certain
        || programs.all(|((was, now), may_go)| *may_go || now == was || !matches!(was, Stored::Good(_)))
}
