//! Proof by power cut: a device, what a host does to it, and what it does after a cut. The power is
//! cut in each flash operation of both, in every way.

use std::collections::{BTreeMap, VecDeque};
use std::fmt;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Mutex, PoisonError};

use canopen::NodeId;
use kit::bench::{CLEAR, CLR_SIGNATURE, SET_SIGNATURE};
use kit::model::{caught, Cut, ModelFlash};
use kit::random::Random;
use kit::rig::{
    fill_journal, sealed as with_keys, Setup, BOARD_NODE, ESACADEMY_2, LIFT_2, RENEWALS, STANDARD_2,
};
use seal::access::right;
use shared_abi::geometry::Region;

use crate::device::{Action, Device, Holder, Observation, Program, Stored, Trouble};
use crate::files::{file, Content, Extent, Flaw, Part, Sent, NEW, NEWEST};
use crate::mistakes::Mistake;
use crate::model::Model;
use crate::rules::{broken, History};
use crate::script::{renewal, whole};

/// The number of violations that a report describes.
const TOLD: usize = 10;
/// How many times a device starts and is looked at: bits between 0 and 1 read differently each
/// time.
const LOOKS: usize = 4;

/// The ways in which an operation is cut.
const WAYS: [(&str, Cut); 6] = [
    ("before", Cut::Before),
    ("after", Cut::After),
    ("torn", Cut::Torn(7)),
    ("torn-otherwise", Cut::Torn(8)),
    ("unstable", Cut::Unstable(10)),
    ("all-but-one-bit", Cut::Unstable(9)),
];

// --- points

/// One cut: the number of the flash operation, and the way, by its place in the list.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct At {
    pub operation: u32,
    pub way: usize,
}

/// A cut in a scenario, and possibly another one in the recovery; `board:` before it for the real
/// firmware. Written as `update:37:torn` or `board:update:37:torn:12:after`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Point {
    pub is_board: bool,
    pub scenario: &'static str,
    pub first: At,
    pub second: Option<At>,
}

/// The name of a way.
#[must_use]
pub fn name_of(way: usize) -> &'static str {
    WAYS[way].0
}

impl fmt::Display for Point {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}{}", if self.is_board { "board:" } else { "" }, self.scenario)?;
        let mut cuts = [Some(self.first), self.second].into_iter().flatten();
        cuts.try_for_each(|at| write!(f, ":{}:{}", at.operation, name_of(at.way)))
    }
}

impl Point {
    /// Reads a point; `boards`: the scenarios of the real firmware, which has the first five ways.
    ///
    /// # Errors
    /// What is wrong, and what there is.
    pub fn parse(text: &str, boards: &[&'static str]) -> Result<Self, String> {
        let of_board = text.strip_prefix("board:");
        let models: Vec<_> = SCENARIOS.iter().map(|scenario| scenario.name).collect();
        let (names, ways) = if of_board.is_some() { (boards, &WAYS[..5]) } else { (&models[..], &WAYS[..]) };
        let mut words = of_board.unwrap_or(text).split(':');
        let name = words.next().unwrap_or_default();
        let unknown = || format!("{name:?} is no scenario; there are {}.", names.join(", "));
        let scenario = names.iter().find(|known| **known == name).ok_or_else(unknown)?;
        let mut at = || -> Result<Option<At>, String> {
            let Some(operation) = words.next() else { return Ok(None) };
            let operation =
                operation.parse().map_err(|_| format!("{operation:?} is no number of an operation."))?;
            let way = words.next().unwrap_or_default();
            let known: Vec<_> = ways.iter().map(|(name, _)| *name).collect();
            let unknown = || format!("{way:?} is no way to cut; there are {}.", known.join(", "));
            Ok(Some(At { operation, way: known.iter().position(|name| *name == way).ok_or_else(unknown)? }))
        };
        let first = at()?.ok_or("a point names an operation: update:37:torn.")?;
        let second = at()?;
        match words.next() {
            None => Ok(Self { is_board: of_board.is_some(), scenario, first, second }),
            Some(more) => Err(format!("{more:?}: a point has two cuts at most.")),
        }
    }
}

/// The results of a scenario.
#[derive(Clone, Debug, Default)]
pub struct Report {
    /// Flash operations of the scenario without a cut.
    pub operations: u64,
    /// Cuts, single and double.
    pub points: u64,
    /// The different states of the flash after these cuts. The model does not count them.
    pub states: u64,
    /// How many times the host did everything again. On the model it does so after each cut.
    pub recoveries: u64,
    /// What was found after the power returned, with the counts.
    pub outcomes: BTreeMap<&'static str, u64>,
    /// For each way, a letter for each operation: what was found after a cut there. `B` bootloader,
    /// `O` old program, `N` new program, `!` a violation, `=` a flash that was looked at already,
    /// `.` not cut. The model has none.
    pub map: BTreeMap<&'static str, Vec<u8>>,
    /// The number of points with a violation.
    pub violations: u64,
    /// The first of them: the point and the violation.
    pub reported: Vec<(Point, String)>,
}

impl Report {
    /// Counts what was found at a point.
    pub fn note(&mut self, point: Point, found: Result<&'static str, String>) {
        match found {
            Ok(outcome) => *self.outcomes.entry(outcome).or_default() += 1,
            Err(what) => {
                self.violations += 1;
                if self.reported.len() < TOLD {
                    self.reported.push((point, what));
                }
            }
        }
    }

    fn add(&mut self, other: Self) {
        self.points += other.points;
        for (outcome, count) in other.outcomes {
            *self.outcomes.entry(outcome).or_default() += count;
        }
        self.violations += other.violations;
        self.reported.extend(other.reported);
        self.reported.truncate(TOLD);
    }
}

// --- scenarios

/// The program before an update.
pub const OLD: Content = Content::Program(1, Extent::Bytes(0xD8));
/// The same with labels, which a lift wants.
const OLD_LABELLED: Content = Content::Program(1, Extent::Bytes(0x208));
const NEW_LABELLED: Content = Content::Program(1, Extent::Bytes(0x210));
const OLD_2: Content = Content::Program(2, Extent::Bytes(0xD8));
const NEW_2: Content = Content::Program(2, Extent::Bytes(0xE0));

/// What is there in the end: program 1 and program 2, released; whether program 1 starts by itself;
/// and the node-IDs that may be stored.
#[derive(Clone, Copy)]
struct End(Option<Content>, Option<Content>, bool, &'static [u8]);

type Actions = fn(&'static Setup) -> Vec<Action>;

/// A device before, what the host does, and what it does after a cut.
#[derive(Clone, Copy)]
pub struct Scenario {
    pub name: &'static str,
    pub about: &'static str,
    pub setup: &'static Setup,
    /// So many values more are in its journal.
    stores: u32,
    before: Actions,
    act: Actions,
    /// What a device must refuse after a cut, whatever it has.
    refused: Actions,
    /// `None`: the same once more.
    recover: Option<Actions>,
    /// The recovery is cut at one of so many operations.
    one_in: u32,
    end: End,
}

impl Scenario {
    const fn named(self, name: &'static str, about: &'static str) -> Self {
        Self { name, about, ..self }
    }

    /// The same on another device, with so many values more in its journal.
    #[must_use]
    pub const fn on(self, setup: &'static Setup, stores: u32) -> Self {
        Self { setup, stores, ..self }
    }

    /// Whether the journal changes to its other region in it.
    #[must_use]
    pub fn changes_over(&self) -> bool {
        let proof = Proof { scenario: self, mistake: None };
        let journal = self.setup.layout.parameters;
        let Ok(start) = proof.start() else { return false };
        let played = proof.play(&start.flash, &start.history, &(self.act)(self.setup));
        played.is_ok_and(|(_, trace)| trace.touched.iter().any(|at| journal.contains(at)))
    }
}

/// A command with all its work.
fn command(sub: u8, value: u8) -> [Action; 2] {
    [Action::Command { sub, value }, Action::Settle]
}

/// Password or CLEAR, and this content in one transfer.
fn at_once(setup: &'static Setup, sub: u8, content: Content, part: Part) -> Vec<Action> {
    let begin = match setup.password(sub) {
        Some(_) => Action::Password { sub, is_right: true },
        None => Action::Command { sub, value: CLEAR },
    };
    vec![begin, Action::Settle, Action::send(sub, content, part), Action::Settle]
}

/// The same in blocks, and released.
fn install(setup: &'static Setup, sub: u8, content: Content) -> Vec<Action> {
    [whole(setup, sub, content), command(sub, SET_SIGNATURE).to_vec()].concat()
}

/// With one block of it damaged.
fn flawed(setup: &'static Setup, block: usize, flaw: Flaw) -> Vec<Action> {
    let mut actions = whole(setup, 1, NEW);
    for action in &mut actions {
        if let Action::Send { sent, .. } = action {
            if sent.part == Part::Block(block) {
                sent.flaw = flaw;
            }
        }
    }
    actions
}

/// The blocks of the new program without CLEAR.
fn without_clear(setup: &'static Setup) -> Vec<Action> {
    install(setup, 1, NEW)
        .into_iter()
        .filter(|action| !matches!(action, Action::Command { value: CLEAR, .. }))
        .collect()
}

/// The beginning of a program, some steps of work, and then the client is gone.
fn broken_off(sub: u8, content: Content, steps: u32) -> [Action; 3] {
    let sent = Sent { content, part: Part::Whole, flaw: Flaw::None };
    let begin = Action::Send { sub, sent, is_announced: true, bytes: Some(140) };
    [begin, Action::Run(steps), Action::Cancel]
}

/// The passwords of two programs, one in the middle of the work on the other one.
fn password_during(_: &'static Setup) -> Vec<Action> {
    let unlock = |sub| [Action::Password { sub, is_right: true }];
    let (first, second) = (broken_off(1, NEW_LABELLED, 30), broken_off(2, NEW_2, 60));
    [&unlock(1)[..], &first, &unlock(2), &second, &[Action::Settle]].concat()
}

/// Both programs, in one transfer each.
fn both(setup: &'static Setup, contents: [Content; 2]) -> Vec<Action> {
    let of = |(sub, content)| at_once(setup, sub, content, Part::Whole);
    (1..).zip(contents).flat_map(of).collect()
}

/// A sealed program of this row of [`RELEASES`].
const fn release(row: u8) -> Option<Content> {
    Some(Content::Release(1, row))
}

fn sealed(setup: &'static Setup, row: u8) -> Vec<Action> {
    at_once(setup, 1, Content::Release(1, row), Part::Whole)
}

/// The same, and it has proved itself.
fn proved(setup: &'static Setup, row: u8) -> Vec<Action> {
    [sealed(setup, row), vec![Action::Return(1), Action::Settle]].concat()
}

fn erase_sealed(_: &'static Setup) -> Vec<Action> {
    [&[Action::Right(Holder::Root, right::ERASE)][..], &command(1, CLEAR), &command(1, CLEAR)].concat()
}

/// What a tool does until a new bootloader is installed.
fn renew(setup: &'static Setup) -> Vec<Action> {
    let sub = setup.profile.extras.bootloader.expect("it can be renewed");
    [Action::Settle, Action::Password { sub, is_right: true }, Action::Renew(NEWEST)].repeat(8)
}

const UPDATE: Scenario = Scenario {
    name: "update",
    about: "another program in the place of one that runs",
    setup: &STANDARD_2,
    stores: 0,
    before: |setup| install(setup, 1, OLD),
    act: |setup| install(setup, 1, NEW),
    refused: |_| vec![],
    recover: None,
    one_in: 1,
    end: End(Some(NEW), None, true, &[]),
};

const DURING: Scenario = Scenario {
    setup: &ESACADEMY_2,
    before: |setup| both(setup, [OLD_LABELLED, OLD_2]),
    act: password_during,
    recover: Some(|setup| both(setup, [NEW_LABELLED, NEW_2])),
    one_in: 8,
    end: End(Some(NEW_LABELLED), Some(NEW_2), true, &[]),
    ..UPDATE.named(
        "password-during",
        "ESAcademy's passwords of two programs, one in the middle of work on the other one",
    )
};

const SEALED: Scenario = Scenario {
    setup: &with_keys::STANDARD_1,
    before: |setup| sealed(setup, 2),
    act: |setup| sealed(setup, 5),
    one_in: 200,
    end: End(release(5), None, true, &[]),
    ..UPDATE.named("sealed", "a sealed program with a higher security counter")
};

const CONFIRMED: Scenario = Scenario {
    setup: &with_keys::CONFIRMED_1,
    before: |setup| proved(setup, 2),
    refused: |setup| sealed(setup, 1),
    ..SEALED
};

/// All of them.
pub static SCENARIOS: &[Scenario] = &[
    Scenario { before: |_| vec![], ..UPDATE.named("first-install", "a program into an empty device") },
    UPDATE,
    Scenario {
        act: |setup| at_once(setup, 1, NEW, Part::Whole),
        ..UPDATE.named("raw", "another program as a raw image, which is valid without a signature command")
    },
    Scenario {
        act: |setup| at_once(setup, 1, NEW, Part::Hex),
        ..UPDATE.named("hex", "another program as Intel HEX")
    },
    Scenario {
        act: |setup| {
            let last = file(setup, NEW).blocks.len() - 1;
            let wrong = [flawed(setup, last, Flaw::Sum), command(1, SET_SIGNATURE).to_vec()];
            [wrong.concat(), install(setup, 1, NEW)].concat()
        },
        recover: Some(|setup| install(setup, 1, NEW)),
        ..UPDATE.named("wrong-crc", "an update whose last block tells another CRC, then the right one")
    },
    Scenario {
        act: |setup| flawed(setup, 0, Flaw::Product),
        recover: Some(|setup| install(setup, 1, NEW)),
        ..UPDATE.named("wrong-product", "an update for another product, which costs nothing")
    },
    Scenario {
        act: |_| [command(1, CLEAR), command(1, CLEAR)].concat(),
        end: End(None, None, false, &[]),
        ..UPDATE.named("erase", "a program taken away by two CLEARs")
    },
    Scenario {
        act: |setup| {
            let erase = [command(1, CLEAR), command(1, CLEAR)].concat();
            [erase, vec![Action::ResetNode], without_clear(setup)].concat()
        },
        ..UPDATE.named(
            "erase-and-install",
            "a program taken away by two CLEARs, and after a reset another one without CLEAR, which looks \
             whether the flash is blank",
        )
    },
    Scenario {
        before: |setup| whole(setup, 1, OLD),
        act: |_| command(1, SET_SIGNATURE).to_vec(),
        end: End(Some(OLD), None, true, &[]),
        ..UPDATE.named("sign", "a signature set")
    },
    Scenario {
        act: |_| command(1, CLR_SIGNATURE).to_vec(),
        end: End(Some(OLD), None, false, &[]),
        ..UPDATE.named("unsign", "a signature taken away")
    },
    Scenario {
        act: |_| vec![Action::Store(9), Action::Settle],
        end: End(Some(OLD), None, true, &[9]),
        ..UPDATE.named("lss-store", "node-ID and bit rate stored by layer setting services")
    },
    Scenario {
        act: |_| (1..=50).flat_map(|id| [Action::Store(id), Action::Settle]).collect(),
        recover: Some(|_| vec![Action::Store(100), Action::Settle]),
        end: End(Some(OLD), None, true, &[50, 100]),
        ..UPDATE
            .named("compaction", "so many stores of node-ID and bit rate that the journal changes over twice")
    },
    Scenario {
        act: |_| vec![Action::Crash, Action::Crash, Action::ResetNode],
        recover: Some(|_| vec![Action::Crash, Action::ResetNode]),
        end: End(Some(OLD), None, true, &[]),
        ..UPDATE.named("crash-count", "crashes are counted, and a reset clears the count")
    },
    Scenario {
        setup: &LIFT_2,
        before: |setup| both(setup, [OLD_LABELLED, OLD_2]),
        act: |setup| at_once(setup, 2, NEW_2, Part::Whole),
        end: End(Some(OLD_LABELLED), Some(NEW_2), true, &[]),
        ..UPDATE.named("parameter-set", "another set of parameters in the place of one, in a lift")
    },
    Scenario {
        before: |setup| [install(setup, 1, OLD), install(setup, 2, OLD_2)].concat(),
        act: |setup| install(setup, 2, NEW_2),
        end: End(Some(OLD), Some(NEW_2), true, &[]),
        ..UPDATE.named("second-program", "program 2 updated while program 1 stays what it is")
    },
    Scenario {
        before: |setup| [install(setup, 1, OLD), install(setup, 2, OLD_2)].concat(),
        end: End(Some(NEW), Some(OLD_2), true, &[]),
        ..UPDATE.named("beside-the-second", "program 1 updated while program 2 stays what it is")
    },
    Scenario {
        setup: &LIFT_2,
        ..DURING.named(
            "lift-password-during",
            "a lift's password in the middle of work, and then the set of parameters broken off",
        )
    },
    DURING,
    Scenario {
        setup: &RENEWALS[0],
        act: renew,
        one_in: 1000,
        end: End(Some(OLD), None, true, &[]),
        ..UPDATE.named("renewal", "the bootloader is renewed; a program is there before and afterwards")
    },
    SEALED,
    Scenario {
        act: |setup| sealed(setup, 4),
        end: End(release(4), None, true, &[]),
        ..SEALED.named("compressed", "the same, encrypted and compressed")
    },
    Scenario { before: |_| vec![], ..SEALED.named("sealed-first", "a sealed program into an empty device") },
    Scenario {
        before: |setup| sealed(setup, 5),
        ..SEALED.named("sealed-again", "the same sealed program once more")
    },
    CONFIRMED.named("proved", "a sealed program that has proved itself, and another one that has not yet"),
    Scenario {
        act: erase_sealed,
        end: End(None, None, false, &[]),
        ..CONFIRMED.named(
            "proved-erase",
            "a sealed program that has proved itself, taken away by the holder of a root",
        )
    },
    Scenario {
        act: |setup| proved(setup, 5),
        ..CONFIRMED.named("proved-again", "the same, and the other one proves itself, too")
    },
];

// --- the proof

/// How much of a scenario is cut.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cuts {
    /// Some operations, drawn by this seed, in every way; and some of the recovery, in one way that
    /// changes from operation to operation.
    Sample(u64),
    /// Every operation, and every one of the recovery.
    EveryOperation,
    /// Every operation of both in every way.
    EveryWay,
}

impl Cuts {
    fn has(self, scenario: &Scenario, operation: u32) -> bool {
        match self {
            Self::Sample(seed) => {
                // Another sample for each scenario.
                let name = scenario.name.bytes().fold(seed, |name, letter| name << 5 ^ u64::from(letter));
                // A signature takes its time.
                let percent = if scenario.setup.takes_sealed { 8 } else { 25 };
                Random(name ^ u64::from(operation)).chance(percent)
            }
            Self::EveryOperation | Self::EveryWay => true,
        }
    }
}

/// An action without a cut.
struct Step {
    action: Action,
    before: History,
}

/// Actions without a cut.
struct Trace {
    steps: Vec<Step>,
    operations: u32,
    /// The actions that were refused.
    refused: Vec<String>,
    /// What was written and erased.
    touched: Vec<Region>,
    /// The state at the end.
    history: History,
}

/// A device without power, and its history.
#[derive(Clone)]
struct State {
    flash: ModelFlash,
    history: History,
    outcome: &'static str,
}

/// A scenario, and a mistake in the bootloader of its device.
#[derive(Clone, Copy)]
struct Proof<'s> {
    scenario: &'s Scenario,
    mistake: Option<Mistake>,
}

impl Proof<'_> {
    fn model(&self, flash: &ModelFlash) -> Model {
        let setup = self.scenario.setup;
        let is_large = setup.takes_sealed || setup.profile.extras.bootloader.is_some();
        Model::on(setup, if is_large { 2048 } else { 256 }, flash.clone(), self.mistake)
    }

    /// The device before.
    fn start(&self) -> Result<State, String> {
        let Scenario { setup, stores, before, .. } = *self.scenario;
        let mut flash = Model::new(setup, 0, 0).flash();
        let history = History::new(setup, self.model(&flash).observe());
        let before = [before(setup), vec![Action::Settle, Action::PowerOff]].concat();
        let (model, trace) = self.play(&flash, &history, &before)?;
        flash = model.flash();
        fill_journal(&mut flash, setup.layout, stores);
        flash.power_on();
        Ok(State { flash, history: trace.history, outcome: "" })
    }

    /// Actions without a cut.
    fn play(
        &self,
        flash: &ModelFlash,
        history: &History,
        actions: &[Action],
    ) -> Result<(Model, Trace), String> {
        let mut model = self.model(flash);
        let mut history = history.clone();
        history.seen.starts = 0;
        let mut trace = Trace { steps: vec![], operations: 0, refused: vec![], touched: vec![], history };
        let mut rest: VecDeque<Action> = actions.iter().copied().collect();
        while let Some(action) = rest.pop_front() {
            let history = &mut trace.history;
            if let Action::Renew(image) = action {
                let next = renewal(&history.seen, self.scenario.setup, image);
                next.into_iter().rev().for_each(|action| rest.push_front(action));
                continue;
            }
            trace.steps.push(Step { action, before: history.clone() });
            let (answer, seen) = carried_out(|| (model.act(&action), model.observe()))?;
            if let Err(abort) = answer {
                trace.refused.push(format!("{action:?}: {abort}"));
            }
            history.note(&action, answer);
            kept(history, &seen)?;
            trace.touched.extend(&seen.touched);
            history.update(seen);
        }
        trace.operations = model.operations();
        Ok((model, trace))
    }

    /// The actions with a cut, and the device after it.
    fn cut(&self, flash: &ModelFlash, steps: &[Step], at: At) -> Result<State, String> {
        let mut model = self.model(flash);
        let _ = model.act(&Action::Flash(at.operation, Trouble::Cut(WAYS[at.way].1)));
        for Step { action, before } in steps {
            let answer = carried_out(|| model.act(action))?;
            if model.is_cut() {
                let mut history = before.clone();
                history.note(action, answer);
                return self.observe(model, history);
            }
        }
        Err("there is no such operation".into())
    }

    /// What is found after a cut, several times. With the first cut nothing is excused by bits
    /// between 0 and 1.
    fn observe(&self, mut model: Model, mut history: History) -> Result<State, String> {
        let mut seen = carried_out(|| model.observe())?;
        for observe in 0..LOOKS {
            if observe > 0 {
                seen = carried_out(|| {
                    let _ = model.act(&Action::PowerOff);
                    model.observe()
                })?;
            }
            let is_certain = seen.is_certain;
            seen.is_certain = history.seen.is_certain;
            kept(&history, &seen)?;
            seen.is_certain = is_certain;
        }
        let outcome = self.outcome(&history.seen, &seen);
        history.update(seen);
        Ok(State { flash: model.flash(), history, outcome })
    }

    fn outcome(&self, before: &Observation, seen: &Observation) -> &'static str {
        let End(new, ..) = self.scenario.end;
        let (was, program) = (&before.programs[0], &seen.programs[0]);
        let of = |content| file(self.scenario.setup, content).crc;
        match (seen.starting, new) {
            (Some((1, _)), Some(new)) if program.stored == Stored::Good(of(new)) => "new program",
            _ if program.counter > was.counter => "counter before its program",
            (Some(_), _) => "old program",
            (None, _) => "bootloader",
        }
    }

    /// What the host does after a cut.
    fn recover(&self, from: &State) -> Result<Trace, String> {
        let Scenario { setup, refused, act, recover, .. } = *self.scenario;
        self.play(&from.flash, &from.history, &refused(setup))?;
        let (_, trace) = self.play(&from.flash, &from.history, &recover.unwrap_or(act)(setup))?;
        match self.ends(&trace.history.seen) {
            true => Ok(trace),
            false => {
                let refused = trace.refused.first().map_or("", String::as_str);
                let programs = &trace.history.seen.programs;
                Err(format!("the recovery does not complete: {refused} {programs:X?}"))
            }
        }
    }

    fn ends(&self, seen: &Observation) -> bool {
        let Scenario { setup, end: End(first, second, starts, nodes), .. } = *self.scenario;
        let counts_late = setup.config.download.seal.counter_with_confirmation;
        let is = |(program, content): (&Program, Option<Content>)| match content {
            None => program.record.is_none(),
            Some(content) => {
                let counter = if setup.takes_sealed { content.counter() } else { 0 };
                program.stored == Stored::Good(file(setup, content).crc)
                    && program.status == 0
                    && if counts_late { program.counter <= counter } else { program.counter == counter }
            }
        };
        let is_node = |id: Option<NodeId>| {
            if nodes.is_empty() {
                id == BOARD_NODE.id
            } else {
                id.is_some_and(|id| nodes.contains(&id.get()))
            }
        };
        let renews = setup.profile.extras.bootloader.is_some();
        let is_signed = |program: &Program| program.record.is_none_or(|record| record.signed);
        seen.programs.iter().zip([first, second]).all(is)
            && seen.programs.iter().skip(1).all(is_signed)
            && seen.starting.map(|(number, _)| number) == starts.then_some(1)
            && is_node(seen.node.id)
            && (!renews || seen.home == Some(file(setup, NEWEST).crc))
    }

    /// All points whose first cut is at this operation.
    fn at_operation(&self, start: &State, steps: &[Step], operation: u32, cuts: Cuts) -> Report {
        let mut report = Report::default();
        if !cuts.has(self.scenario, operation) {
            return report;
        }
        for way in 0..WAYS.len() {
            let first = At { operation, way };
            let point = Point { is_board: false, scenario: self.scenario.name, first, second: None };
            report.points += 1;
            let found = self.cut(&start.flash, steps, first);
            let found = found.and_then(|state| self.recover(&state).map(|trace| (state, trace)));
            let (state, trace) = match found {
                Ok(found) => found,
                Err(what) => {
                    report.note(point, Err(what));
                    continue;
                }
            };
            report.note(point, Ok(state.outcome));
            let one_in = self.scenario.one_in * if matches!(cuts, Cuts::Sample(_)) { 8 } else { 1 };
            let first_of = 1 + (7 * operation + 13 * way as u32) % one_in;
            for operation in (first_of..=trace.operations).step_by(one_in as usize) {
                let turn = (first.operation + operation) as usize % WAYS.len();
                for way in (0..WAYS.len()).filter(|way| cuts == Cuts::EveryWay || *way == turn) {
                    let second = At { operation, way };
                    report.points += 1;
                    let found = self.cut(&state.flash, &trace.steps, second);
                    let found = found.and_then(|state| self.recover(&state).map(|_| state.outcome));
                    report.note(Point { second: Some(second), ..point }, found);
                }
            }
        }
        report
    }

    /// Cuts until there are so many violations.
    fn run(&self, cuts: Cuts, violations: u64) -> Result<Report, String> {
        let start = self.start()?;
        let act = [(self.scenario.act)(self.scenario.setup), vec![Action::PowerOff]].concat();
        let (model, trace) = self.play(&start.flash, &start.history, &act)?;
        self.recover(&State { flash: model.flash(), history: trace.history.clone(), outcome: "" })?;
        let next = AtomicU32::new(1);
        let total = Mutex::new(Report { operations: trace.operations.into(), ..Report::default() });
        // A run that must stop early processes the operations in order, so that it always reports
        // the same first violation.
        let threads =
            if violations == 1 { 1 } else { std::thread::available_parallelism().map_or(1, usize::from) };
        std::thread::scope(|scope| {
            for _ in 0..threads {
                let start = start.clone();
                let (next, total, steps, operations) = (&next, &total, &trace.steps, trace.operations);
                scope.spawn(move || loop {
                    let operation = next.fetch_add(1, Ordering::Relaxed);
                    if operation > operations {
                        break;
                    }
                    let report = self.at_operation(&start, steps, operation, cuts);
                    let mut total = total.lock().unwrap_or_else(PoisonError::into_inner);
                    total.add(report);
                    if total.violations >= violations {
                        break;
                    }
                });
            }
        });
        Ok(total.into_inner().unwrap_or_else(PoisonError::into_inner))
    }
}

/// The first broken rule, if there is one.
fn kept(history: &History, seen: &Observation) -> Result<(), String> {
    broken(history, seen).map_or(Ok(()), |rule| Err(format!("not true that {}: {seen:X?}", rule.name)))
}

/// A panic of the bootloader is an error.
pub(crate) fn carried_out<T>(act: impl FnOnce() -> T) -> Result<T, String> {
    caught(act).map_err(|cause| {
        let text = cause.downcast_ref::<String>().map(String::as_str);
        text.or(cause.downcast_ref::<&str>().copied()).unwrap_or("a panic").to_owned()
    })
}

/// Cuts the power at operations of a scenario, and of the recovery.
///
/// # Errors
/// If the scenario fails without a cut.
pub fn run(scenario: &Scenario, cuts: Cuts) -> Result<Report, String> {
    Proof { scenario, mistake: None }.run(cuts, u64::MAX)
}

/// How a mistake shows in a scenario.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Shown {
    /// Not at all.
    No,
    /// The scenario fails without a power cut: no cut is needed to find this mistake.
    Uncut(String),
    /// At this point, which is the first.
    ByCut(Point, String),
}

/// How a mistake shows in this scenario. Stops at the first violation.
#[must_use]
pub fn shows(scenario: &Scenario, mistake: Mistake) -> Shown {
    match (Proof { scenario, mistake: Some(mistake) }).run(Cuts::EveryOperation, 1) {
        Err(what) => Shown::Uncut(what),
        Ok(report) => match report.reported.into_iter().next() {
            Some((point, what)) => Shown::ByCut(point, what),
            None => Shown::No,
        },
    }
}

/// One point as text.
#[must_use]
pub fn reproduce(point: &Point) -> String {
    let Some(scenario) = SCENARIOS.iter().find(|scenario| scenario.name == point.scenario) else {
        return format!("{point}: there is no such scenario.");
    };
    let mut text = format!("{point}: {}\n", scenario.about);
    if let Err(what) = tell(scenario, point, &mut text) {
        text += &format!("  VIOLATION: {what}\n");
    }
    text
}

fn tell(scenario: &Scenario, point: &Point, text: &mut String) -> Result<(), String> {
    let proof = Proof { scenario, mistake: None };
    let mut state = proof.start()?;
    let (_, mut trace) = proof.play(&state.flash, &state.history, &(scenario.act)(scenario.setup))?;
    for at in [Some(point.first), point.second].into_iter().flatten() {
        let (operation, way, all) = (at.operation, name_of(at.way), trace.operations);
        *text += &format!("cut at operation {operation} of {all} ({way})\n");
        state = proof.cut(&state.flash, &trace.steps, at)?;
        *text += &format!("  power on: {}, node {:?}\n", state.outcome, state.history.seen.node);
        trace = proof.recover(&state)?;
    }
    *text += &format!("recovery, {} operations\n", trace.operations);
    Ok(())
}
