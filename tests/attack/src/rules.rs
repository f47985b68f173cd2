//! The rules that a device keeps.

use kit::rig::Setup;
use shared_abi::renewal::{Origin, State};

use crate::device::{Action, Answer, Seen, Stored};
use crate::files::{self, Content};
use crate::script::CLEAR;

/// What was before an action.
pub struct History {
    /// The device then.
    pub seen: Seen,
    /// The programs, number 1 first: whether this one may be lost since CLEAR or data were accepted.
    may_go: Vec<bool>,
    /// The image in staging has decayed since it was stored.
    rotten: bool,
}

impl History {
    pub(crate) fn new(seen: Seen) -> Self {
        let may_go = vec![false; seen.programs.len()];
        Self { seen, may_go, rotten: false }
    }

    /// Takes note of what an answer permits. In a sealed device genuine data alone end a program.
    pub(crate) fn permit(&mut self, setup: &Setup, action: &Action, answer: Answer) {
        self.rotten |= matches!(action, Action::Rot(..));
        let ends = match *action {
            Action::Command { sub, value: CLEAR } if !setup.takes_sealed => Some(sub),
            Action::Password { sub } if !setup.takes_sealed && setup.password_clears() => Some(sub),
            Action::Send { sub, content, block, .. } => {
                let fits = matches!(content, Content::Program { number, .. } if number == sub);
                let has_data = fits && block != Some(0) || setup.is_data(sub);
                // Of a whole program in one transfer the first part may have been accepted.
                let is_whole = block.is_none() || setup.takes_sealed;
                let may_go = if is_whole { fits } else { has_data && answer == Answer::Acknowledged };
                return self.may_go_if(sub, may_go || is_whole && setup.is_data(sub));
            }
            _ => None,
        };
        self.may_go_if(ends.unwrap_or(0), answer == Answer::Acknowledged);
    }

    fn may_go_if(&mut self, program: u8, is_so: bool) {
        if let Some(may_go) = self.may_go.get_mut(usize::from(program).wrapping_sub(1)) {
            *may_go |= is_so;
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
    /// The rule, as the end of "it is true that".
    pub name: &'static str,
    /// Checks it.
    pub check: fn(before: &History, now: &Seen) -> Result<(), String>,
}

/// All rules.
pub const RULES: &[Rule] = &[
    Rule { name: "a bootloader can be loaded after each reset", check: loads },
    Rule { name: "the installation alone removes a confirmed record", check: keeps_confirmed },
    Rule { name: "data are not changed while a record for them is valid", check: records_are_true },
    Rule { name: "a program is lost by CLEAR or by accepted data alone", check: keeps_programs },
];

fn loads(_: &History, now: &Seen) -> Result<(), String> {
    match now.loads {
        Some(crc) if files::may_run(crc) => Ok(()),
        _ => Err(format!("{now:?}")),
    }
}

fn keeps_confirmed(before: &History, now: &Seen) -> Result<(), String> {
    let was = &before.seen;
    let Some(record) = was.record.filter(|record| record.state == State::Confirmed) else { return Ok(()) };
    // The resident part has loaded home all the same: the record is void.
    let is_void = was.origin == Origin::Home;
    let is_installed = now
        .record
        .is_some_and(|now| (now.state, now.crc) == (State::Installed, record.crc) && now.home == now.crc);
    if now.record == Some(record) || is_installed && now.home == Some(record.crc) || is_void {
        return Ok(());
    }
    if was.is_certain && now.is_certain {
        return Err(format!("{:?}, and now {now:?}", was.record));
    }
    Ok(())
}

fn records_are_true(before: &History, now: &Seen) -> Result<(), String> {
    let is_true = now.record.is_none() || now.is_staged || before.rotten;
    if now.is_certain && (!is_true || now.programs.contains(&Stored::Damaged)) {
        return Err(format!("{now:?}"));
    }
    Ok(())
}

fn keeps_programs(before: &History, now: &Seen) -> Result<(), String> {
    let was = &before.seen;
    if !(was.is_certain && now.is_certain) {
        return Ok(());
    }
    for (place, (was, now)) in was.programs.iter().zip(&now.programs).enumerate() {
        if matches!(was, Stored::Good(_)) && now != was && !before.may_go[place] {
            return Err(format!("program {} was {was:X?}, and is {now:X?}", place + 1));
        }
    }
    Ok(())
}
