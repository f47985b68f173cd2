//! Cuts the power, checks the state of the device, and counts.

use std::collections::BTreeMap;
use std::fmt;
use std::panic::{catch_unwind, AssertUnwindSafe};
use std::str::FromStr;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::Mutex;

use super::device::{Bug, Device, Outcome};
use super::point::{self, At};
use super::scenario::{Allowed, Scenario, Tell, SCENARIOS};
use kit::model::{until_power_cut, Cut};
use kit::random::Random;

/// The number of violations that a report describes.
pub(super) const TOLD: usize = 10;
/// How many times a device is checked: bits between 0 and 1 read differently each time.
const LOOKS: usize = 4;

/// The way in which an operation is cut.
const KINDS: [(&str, Cut); 6] = [
    ("before", Cut::Before),
    ("after", Cut::After),
    ("torn", Cut::Torn(7)),
    ("torn-otherwise", Cut::Torn(8)),
    ("unstable", Cut::Unstable(10)),
    ("all-but-one-bit", Cut::Unstable(9)),
];

/// How much of a scenario is cut.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cuts {
    /// One operation in four, drawn by this seed, in every way; and every operation of the recovery,
    /// in one way that changes from operation to operation.
    Sample(u64),
    /// The same for every operation.
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
                Random(name ^ u64::from(operation)).chance(25)
            }
            Self::EveryOperation | Self::EveryWay => true,
        }
    }
}

/// A point of the proof: a scenario, a cut, and possibly another one in the recovery. Written as
/// `update:37:torn` or `update:37:torn:12:after`; operations are counted from the power-on.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Point {
    scenario: &'static str,
    first: At,
    second: Option<At>,
}

impl fmt::Display for Point {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        point::write(f, self.scenario, [Some(self.first), self.second], |kind| KINDS[kind].0)
    }
}

impl FromStr for Point {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let scenarios: Vec<_> = SCENARIOS.iter().map(|scenario| scenario.name).collect();
        let (scenario, first, second) = point::read(text.split(':'), &scenarios, &KINDS.map(|(way, _)| way))?;
        Ok(Self { scenario, first, second })
    }
}

/// The results of a scenario.
#[derive(Clone, Debug)]
pub struct Report<P = Point> {
    /// Flash operations of the scenario without a cut.
    pub operations: u64,
    /// Cuts, single and double.
    pub points: u64,
    /// The different states of the flash after these cuts. Level 1 does not count them.
    pub states: u64,
    /// How many times the host did everything again. Level 1 does so after each cut.
    pub recoveries: u64,
    /// The states of the device after the power returned, with their counts.
    pub outcomes: BTreeMap<String, u64>,
    /// For each way, a letter for each operation: what was found after a cut there. `B` bootloader,
    /// `O` old program, `N` new program, `!` a violation, `=` a flash that was looked at already, `.`
    /// not cut. Level 1 has none.
    pub map: BTreeMap<&'static str, Vec<u8>>,
    /// The number of points with a violation.
    pub violations: u64,
    /// The first of them: the point and the violation.
    pub told: Vec<(P, String)>,
}

// A derived implementation would require a default for points.
impl<P> Default for Report<P> {
    fn default() -> Self {
        Self {
            operations: 0,
            points: 0,
            states: 0,
            recoveries: 0,
            outcomes: BTreeMap::new(),
            map: BTreeMap::new(),
            violations: 0,
            told: Vec::new(),
        }
    }
}

impl Report {
    fn add(&mut self, other: Self) {
        self.points += other.points;
        for (outcome, count) in other.outcomes {
            *self.outcomes.entry(outcome).or_default() += count;
        }
        self.violations += other.violations;
        self.told.extend(other.told);
        self.told.truncate(TOLD);
    }

    fn count(&mut self, point: &Point, found: Result<Outcome, String>) -> bool {
        self.points += 1;
        match found {
            Ok(outcome) => {
                let outcome = match outcome {
                    Outcome::Bootloader => "bootloader",
                    Outcome::Runs(super::device::OLD) => "old program",
                    Outcome::Runs(_) => "new program",
                };
                *self.outcomes.entry(outcome.into()).or_default() += 1;
                true
            }
            Err(what) => {
                self.violations += 1;
                if self.told.len() < TOLD {
                    self.told.push((point.clone(), what));
                }
                false
            }
        }
    }
}

type Script = fn(&Scenario, &mut Device, &Allowed, Tell<'_>) -> Result<(), String>;

/// A script, cut or not.
struct Run {
    cut: bool,
    operations: u32,
    /// The place of the cut.
    struck: String,
    /// The permitted states now.
    allowed: Allowed,
    /// The device's refusals.
    outcome: Result<(), String>,
}

fn run_script(
    scenario: &Scenario,
    script: Script,
    device: &mut Device,
    from: Allowed,
    at: Option<At>,
) -> Run {
    let mut allowed = from.clone();
    let mut outcome = Ok(());
    device.flash.cut = at.map(|at| (at.operation, KINDS[at.kind].1));
    let cut = until_power_cut(|| outcome = script(scenario, device, &from, &mut |now| allowed = now));
    let operations = device.flash.operations;
    let struck = device.flash.touched.last().map_or_else(String::new, |region| match region.size {
        4 => format!("programming the word at {:08X}h", region.base),
        size => format!("erasing {size} bytes at {:08X}h", region.base),
    });
    device.power_on();
    Run { cut, operations, struck, allowed, outcome }
}

/// Checks several times that the present state of the device is permitted.
fn inspect(device: &Device, allowed: &Allowed) -> Result<Outcome, String> {
    let mut last = Outcome::Bootloader;
    for _ in 0..LOOKS {
        device.records_are_true()?;
        last = device.decision()?;
        if !allowed.outcomes.contains(&last) {
            return Err(format!("{last:?}, where {:?} may be", allowed.outcomes));
        }
        let node = device.node();
        if !allowed.nodes.contains(&node) {
            return Err(format!("{node:?}, where {:?} may be", allowed.nodes));
        }
        let second = device.installed(2);
        if !allowed.second.contains(&second) {
            return Err(format!("program 2 is {second:?}, where {:?} may be", allowed.second));
        }
    }
    Ok(last)
}

/// The exact state.
fn exactly(device: &Device) -> Result<Allowed, String> {
    Ok(Allowed {
        outcomes: vec![device.decision()?],
        nodes: vec![device.node()],
        second: vec![device.installed(2)],
    })
}

/// The recovery, until its end.
fn completes(scenario: &Scenario, device: &Device, from: &Allowed) -> Result<(Outcome, u32), String> {
    let mut device = device.clone();
    let run = run_script(scenario, Scenario::recover, &mut device, from.clone(), None);
    run.outcome.map_err(|error| format!("the recovery does not complete: {error}"))?;
    let outcome = inspect(&device, &scenario.end()).map_err(|what| format!("after the recovery: {what}"))?;
    Ok((outcome, run.operations))
}

/// All points whose first cut is at this operation.
fn at_operation(scenario: &Scenario, device: &Device, operation: u32, cuts: Cuts) -> Report {
    let mut report = Report::default();
    if !cuts.has(scenario, operation) {
        return report;
    }
    let Ok(start) = exactly(device) else { return report };
    for kind in 0..KINDS.len() {
        let first = At { operation, kind };
        let mut device = device.clone();
        let run = run_script(scenario, Scenario::act, &mut device, start.clone(), Some(first));
        let point = Point { scenario: scenario.name, first, second: None };
        let found = inspect(&device, &run.allowed);
        let recovery = completes(scenario, &device, &run.allowed);
        let sound = found.and_then(|found| recovery.clone().map(|_| found));
        if !report.count(&point, sound) {
            continue;
        }
        let Ok((_, operations)) = recovery else { continue };
        for operation in 1..=operations {
            let turn = (first.operation + operation) as usize % KINDS.len();
            for kind in (0..KINDS.len()).filter(|kind| cuts == Cuts::EveryWay || *kind == turn) {
                let second = At { operation, kind };
                let mut device = device.clone();
                let run =
                    run_script(scenario, Scenario::recover, &mut device, run.allowed.clone(), Some(second));
                let point = Point { second: Some(second), ..point.clone() };
                let found = inspect(&device, &run.allowed)
                    .and_then(|found| completes(scenario, &device, &run.allowed).map(|_| found));
                report.count(&point, found);
            }
        }
    }
    report
}

/// Cuts the power at operations of a scenario, and of the recovery.
///
/// # Errors
/// If the scenario fails without a cut.
pub fn run(scenario: &Scenario, cuts: Cuts) -> Result<Report, String> {
    run_until(scenario, None, cuts, u64::MAX)
}

/// How a bug shows in a scenario.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Shown {
    /// Not at all.
    No,
    /// The scenario fails without a power cut: no cut is needed to find this bug.
    Uncut(String),
    /// At this point, which is the first.
    ByCut(Point, String),
}

/// How a bug shows in this scenario. Stops at the first violation.
#[must_use]
pub fn shows(scenario: &Scenario, bug: Bug) -> Shown {
    match run_until(scenario, Some(bug), Cuts::EveryOperation, 1) {
        Err(what) => Shown::Uncut(what),
        Ok(report) => match report.told.into_iter().next() {
            Some((point, what)) => Shown::ByCut(point, what),
            None => Shown::No,
        },
    }
}

fn run_until(scenario: &Scenario, bug: Option<Bug>, cuts: Cuts, violations: u64) -> Result<Report, String> {
    let device = scenario.device(bug);
    let start = exactly(&device)?;
    let mut through = device.clone();
    let run = run_script(scenario, Scenario::act, &mut through, start, None);
    let operations = run.operations;
    run.outcome?;
    inspect(&through, &run.allowed)?;
    completes(scenario, &through, &run.allowed)?;

    let next = AtomicU32::new(1);
    let total = Mutex::new(Report { operations: operations.into(), ..Report::default() });
    // A run that must stop early processes the operations in order, so that it always reports the
    // same first violation.
    let threads =
        if violations == 1 { 1 } else { std::thread::available_parallelism().map_or(1, usize::from) };
    std::thread::scope(|scope| {
        for _ in 0..threads {
            let device = device.clone();
            let (next, total) = (&next, &total);
            scope.spawn(move || loop {
                let operation = next.fetch_add(1, Ordering::Relaxed);
                if operation > operations {
                    break;
                }
                let report =
                    catch_unwind(AssertUnwindSafe(|| at_operation(scenario, &device, operation, cuts)))
                        .unwrap_or_else(|_| {
                            let first = At { operation, kind: 0 };
                            let point = Point { scenario: scenario.name, first, second: None };
                            Report {
                                violations: 1,
                                told: vec![(point, "a panic".into())],
                                ..Report::default()
                            }
                        });
                let mut total = total.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
                total.add(report);
                if total.violations >= violations {
                    break;
                }
            });
        }
    });
    Ok(total.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner))
}

/// One point as text.
#[must_use]
pub fn reproduce(point: &Point) -> String {
    let Some(scenario) = SCENARIOS.iter().find(|scenario| scenario.name == point.scenario) else {
        return format!("{point}: there is no such scenario.");
    };
    let mut device = scenario.device(None);
    let mut text = format!("{point}: {}\n", scenario.about);
    let mut allowed = match exactly(&device) {
        Ok(start) => start,
        Err(what) => return text + &what,
    };
    let mut script: Script = Scenario::act;
    for at in [Some(point.first), point.second].into_iter().flatten() {
        let run = run_script(scenario, script, &mut device, allowed, Some(at));
        allowed = run.allowed;
        let (operation, kind) = (at.operation, KINDS[at.kind].0);
        text += &if run.cut {
            format!("cut at operation {operation} ({kind}), {}\n", run.struck)
        } else {
            format!("no cut: there is no operation {operation}, {} are all\n", run.operations)
        };
        text += &match inspect(&device, &allowed) {
            Ok(outcome) => format!("  power on: {outcome:?}, node {:?}\n", device.node()),
            Err(what) => format!("  VIOLATION: {what}\n"),
        };
        script = Scenario::recover;
    }
    text += &match completes(scenario, &device, &allowed) {
        Ok((outcome, operations)) => format!("recovery, {operations} operations: {outcome:?}\n"),
        Err(what) => format!("  VIOLATION: {what}\n"),
    };
    text
}
