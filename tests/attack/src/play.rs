//! Carries out the actions of a seed, and shortens those that break a rule.

use std::collections::BTreeSet;
use std::fmt;

use canopen::AbortCode;
use shared_abi::renewal::Origin;

use crate::cuts::carried_out;
use crate::device::{Action, Device, Program, Stored, Trouble};
use crate::files::{file, Content, Extent, Part, NEWEST};
use crate::rules::{broken, History};
use crate::script;

/// A broken rule, and what was found.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Broken(pub &'static str, pub String);

impl fmt::Display for Broken {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "not true that {}: {}", self.0, self.1)
    }
}

/// What attacks have met: the states of a renewal with the origin of the bootloader, the lives of
/// the device, and the programs that were installed.
#[derive(Default)]
pub struct Met {
    pub programs: u64,
    /// The actions that were refused.
    pub refused: u64,
    pub states: BTreeSet<(u8, u8)>,
    pub lives: u64,
}

/// An attack on a device.
pub struct Attack<'a, D> {
    device: D,
    history: History,
    met: &'a mut Met,
}

impl<D: Device> Attack<'_, D> {
    /// The device after it.
    pub fn device(&self) -> &D {
        &self.device
    }

    /// Carries out an action, and checks all rules; the device's answer.
    fn act(&mut self, action: &Action) -> Result<Result<(), AbortCode>, Broken> {
        if let Action::Renew(image) = action {
            let actions = script::renewal(&self.history.seen, self.device.setup(), *image);
            return self.act_all(&actions).map(Ok);
        }
        let (answer, seen) = carried_out(|| (self.device.act(action), self.device.observe()))
            .map_err(|text| Broken("nothing panics, and all work ends", text))?;
        self.met.refused += u64::from(answer.is_err());
        self.history.note(action, answer);
        if let Some(rule) = broken(&self.history, &seen) {
            return Err(Broken(rule.name, format!("before: {:X?}\n  now: {seen:X?}", self.history.seen)));
        }
        let programs = self.history.seen.programs.iter().zip(&seen.programs);
        let is_new = |(was, now): &(&Program, &Program)| was.stored != now.stored && now.record.is_some();
        self.met.programs += programs.filter(is_new).count() as u64;
        self.met.lives += u64::from(seen.starts - self.history.seen.starts);
        self.met.states.insert((seen.state() as u8, seen.origin as u8));
        self.history.update(seen);
        Ok(answer)
    }

    fn act_all(&mut self, actions: &[Action]) -> Result<(), Broken> {
        actions.iter().try_for_each(|action| self.act(action).map(drop))
    }

    /// Whatever was done: a tool that knows what it wants gets the newest image installed, and any program.
    fn repair(&mut self) -> Result<(), Broken> {
        let setup = self.device.setup();
        self.act_all(&[Action::Flash(0, Trouble::None), Action::Cancel])?;
        if self.history.is_spoilt {
            return Ok(());
        }
        if let Some(sub) = setup.profile.extras.bootloader {
            self.act_all(&script::make_room(setup))?;
            for _ in 0..8 {
                let unlock = Action::Password { sub, is_right: true };
                self.act_all(&[Action::Settle, unlock, Action::Renew(NEWEST)])?;
            }
            let seen = &self.history.seen;
            if seen.home != Some(file(setup, NEWEST).crc) || seen.origin != Origin::Home {
                let rule = "a tool gets a new bootloader installed afterwards";
                return Err(Broken(rule, format!("{seen:X?}")));
            }
        }
        for sub in 1..=setup.programs() {
            // Data have one form.
            let forms = [Part::Whole, Part::Hex, Part::Block(0)];
            for part in forms.into_iter().take(if setup.is_data(sub) { 1 } else { 3 }) {
                self.install(sub, part)?;
            }
        }
        Ok(())
    }

    /// A host without knowledge of the history installs a program in this form, and starts it.
    fn install(&mut self, sub: u8, part: Part) -> Result<(), Broken> {
        let setup = self.device.setup();
        let content = Content::Program(sub, Extent::Small);
        let broken = |what: String| Broken("each program can be installed and started afterwards", what);
        // A sealed device refuses a second CLEAR, and knows of the first one until a reset.
        let first = if setup.takes_sealed { Action::PowerOff } else { Action::Settle };
        // A host with wrong passwords must wait.
        self.act_all(&[first, Action::Settle, Action::Wait(60_000)])?;
        for action in script::installation(setup, sub, part) {
            let answer = self.act(&action)?;
            self.act_all(&[Action::Settle])?;
            let program = self.history.seen.program(sub).expect("there is one");
            if answer.is_err() || program.status != 0 {
                return Err(broken(format!("{action:?}: {answer:?}, {program:X?}")));
            }
        }
        let program = self.history.seen.program(sub).expect("there is one");
        let is_whole = program.stored == Stored::Good(file(setup, content).crc) && program.state == 0;
        let is_released = setup.is_data(sub) || program.record.is_some_and(|record| record.signed);
        if is_whole && is_released {
            Ok(())
        } else {
            Err(broken(format!("{program:X?}")))
        }
    }
}

/// Carries out actions on a new device, and installs the newest bootloader and each program at the end.
///
/// # Errors
/// The number of the action that broke a rule, or of all if the tool failed at the end; with the rule.
pub fn play<D: Device>(device: D, actions: &[Action], met: &mut Met) -> Result<(), (usize, Broken)> {
    let mut attack = act(device, actions, met)?;
    attack.repair().map_err(|broken| (actions.len(), broken))
}

/// Carries out actions on a new device.
///
/// # Errors
/// The number of the action that broke a rule, with the rule.
pub fn act<'m, D: Device>(
    mut device: D,
    actions: &[Action],
    met: &'m mut Met,
) -> Result<Attack<'m, D>, (usize, Broken)> {
    let history = History::new(device.setup(), device.observe());
    let mut attack = Attack { device, history, met };
    for (n, action) in actions.iter().enumerate() {
        attack.act_all(&[*action]).map_err(|broken| (n, broken))?;
    }
    Ok(attack)
}

/// An attack that has broken a rule, with the actions that are needed for it.
pub struct Failure {
    seed: u64,
    actions: Vec<Action>,
    pub broken: Broken,
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "seed {}: {}\n  the actions, shortened:", self.seed, self.broken)?;
        self.actions.iter().enumerate().try_for_each(|(n, action)| writeln!(f, "  {n:>3} {action:?}"))
    }
}

/// The attack of a seed on a new device.
///
/// # Errors
/// The rule that it has broken.
pub fn attack<D: Device>(new: impl Fn() -> D, seed: u64, met: &mut Met) -> Result<(), Box<Failure>> {
    let mut actions = script::of(new().setup(), seed);
    let Err((n, mut broken)) = play(new(), &actions, met) else { return Ok(()) };
    actions.truncate(n + 1);
    let mut size = actions.len().next_power_of_two();
    while size > 0 {
        let mut from = 0;
        while from < actions.len() {
            let mut fewer = actions.clone();
            fewer.drain(from..(from + size).min(actions.len()));
            match play(new(), &fewer, &mut Met::default()) {
                Err((n, found)) if found.0 == broken.0 => {
                    fewer.truncate(n + 1);
                    (actions, broken) = (fewer, found);
                }
                _ => from += size,
            }
        }
        size /= 2;
    }
    Err(Box::new(Failure { seed, actions, broken }))
}
