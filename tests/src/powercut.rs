//! Proof by power cut of the built firmware on the emulated chip (`tests/attack` has that of the model).
//!
//! A power cut leaves nothing but the flash. So a scenario runs once, and the emulator keeps the
//! list of its flash operations: from it follows the flash after each cut. Cuts that leave the
//! same flash are one state. With each state the board is switched on and looked at, and with some
//! of them the host does everything again; this recovery has operations of its own, which are cut
//! in the same way.
//!
//! | module | what it does |
//! |---|---|
//! | [`story`] | what the host does, and what may be found |
//! | `look` | what a board does after the power returns |

use std::collections::hash_map::DefaultHasher;
use std::collections::HashSet;
use std::hash::{Hash, Hasher};
use std::panic::{catch_unwind, AssertUnwindSafe};
use std::sync::{Mutex, MutexGuard, PoisonError};

use attack::cuts::{name_of, At, Point, Report};
use emulator::machine::{Cells, Cut, Operation};

use crate::bench::Bench;
use crate::firmware;
use observe::{observe, switched_on};
use story::BOOT_MS;
use story::SCENARIOS;
pub use story::{scenarios, Observation, Outcome, Scenario, Story};

mod observe;
pub mod story;

/// The number of looks at a flash with bits between 0 and 1: they read differently each time.
const LOOKS: usize = 3;

/// The ways in which an operation is cut, in the order of their names.
const WAYS: [Cut; 5] =
    [Cut::Before, Cut::After, Cut::Torn { seed: 7 }, Cut::Torn { seed: 8 }, Cut::Unstable { seed: 9 }];

/// The operations that are taken: so many at the beginning and at the end, and one of how many
/// between.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Effort {
    /// How many at each end are cut, in every way, and one of how many between. The first and last
    /// ones concern the parameters.
    pub cut: (usize, usize),
    /// How many at each end are followed by a recovery, in one way, and one of how many between.
    pub recovered: (usize, usize),
    /// How many at each end of the recovery are cut, in one way, and one of how many between.
    pub cut_again: (usize, usize),
}

impl Effort {
    /// For every run of the tests.
    pub const SAMPLE: Self = Self { cut: (10, 128), recovered: (2, 1024), cut_again: (10, 1024) };
    /// A twentieth of all.
    pub const TWENTIETH: Self = Self { cut: (10, 20), recovered: (4, 256), cut_again: (10, 256) };
    /// Every operation.
    pub const FULL: Self = Self { cut: (10, 1), recovered: (10, 64), cut_again: (10, 64) };

    /// The same for a scenario in which a look takes ten times as long.
    fn slow(self) -> Self {
        let rarer = |(edge, one_in): (usize, usize)| (edge.div_ceil(3), one_in * 8);
        Self { cut: rarer(self.cut), recovered: rarer(self.recovered), cut_again: rarer(self.cut_again) }
    }

    fn takes((edge, one_in): (usize, usize), operation: usize, of: usize) -> bool {
        operation < edge || operation + edge >= of || operation.is_multiple_of(one_in)
    }
}

/// A run without a cut: its flash operations, or what went wrong.
fn record(story: &Story, bench: &mut Bench, cells: &Cells) -> Result<Vec<Operation>, String> {
    bench.power_off();
    bench.machine().set_flash_cells(cells);
    bench.machine().keep_flash_log();
    bench.power_on();
    bench.run_ms(BOOT_MS);
    let acted = (story.act)(bench);
    let operations = bench.machine().take_flash_log();
    bench.power_off();
    acted.map(|()| operations)
}

/// The flash after a cut, from the flash before and the operations up to this one.
fn behind(before: &Cells, operations: &[Operation], at: At) -> Option<Cells> {
    let chip = firmware::board().chip;
    let mut cells = before.clone();
    let (last, done) = operations.get(..=at.operation as usize)?.split_last()?;
    for operation in done {
        cells.apply(operation, chip, Cut::After);
    }
    cells.apply(last, chip, WAYS[at.way]);
    Some(cells)
}

fn hash(cells: &Cells) -> u64 {
    let mut hasher = DefaultHasher::new();
    cells.hash(&mut hasher);
    hasher.finish()
}

/// Puts a letter into the map of a report.
fn mark(report: &mut Report, at: At, letter: u8) {
    let operations = report.operations as usize;
    let row = report.map.entry(name_of(at.way)).or_insert_with(|| vec![b'.'; operations]);
    row[at.operation as usize] = letter;
}

/// The proof for one scenario.
struct Proof<'s> {
    name: &'static str,
    story: &'s Story,
    operations: &'s [Operation],
    effort: Effort,
    /// The states that were looked at, and the counts.
    total: Mutex<(HashSet<u64>, Report)>,
}

impl Proof<'_> {
    fn total(&self) -> MutexGuard<'_, (HashSet<u64>, Report)> {
        self.total.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The point of a first cut.
    fn point(&self, operation: usize, way: usize) -> Point {
        let first = At { operation: operation as u32, way };
        Point { is_board: true, scenario: self.name, first, second: None }
    }

    /// Whether nobody has looked at this state yet.
    fn is_new(&self, cells: &Cells) -> bool {
        let hash = hash(cells);
        let mut total = self.total();
        total.1.points += 1;
        let new = total.0.insert(hash);
        total.1.states += u64::from(new);
        new
    }

    /// Looks at a state, as often as it takes.
    fn inspect(&self, bench: &mut Bench, cells: &Cells) -> Result<Observation, String> {
        let looks = if cells.unstable.is_empty() { 1 } else { LOOKS };
        let mut seen = self.story.from;
        for _ in 0..looks {
            seen = switched_on(self.story, bench, cells)?;
            let Story { from, to, between, .. } = self.story;
            let outcomes = [&[from.outcome, to.outcome][..], between].concat();
            let known = [from, to].iter().any(|end| end.bootloader == seen.bootloader)
                && [from.node, to.node].contains(&seen.node);
            if !outcomes.contains(&seen.outcome) || !known {
                return Err(format!("{seen:?}, where {from:?}, {to:?} or {between:?} may be"));
            }
        }
        Ok(seen)
    }

    fn count(&self, point: Point, found: Result<Observation, String>) {
        let mut total = self.total();
        let report = &mut total.1;
        let letter = match &found {
            Ok(Observation { outcome: Outcome::Bootloader, .. }) => b'B',
            Ok(Observation { outcome: Outcome::Old, .. }) => b'O',
            Ok(Observation { outcome: Outcome::New, .. }) => b'N',
            Err(_) => b'!',
        };
        if point.second.is_none() || letter == b'!' {
            mark(report, point.first, letter);
        }
        report.note(point, found.map(|seen| seen.outcome.name()));
    }

    /// All points whose first cut is at this operation; `before` is the flash before it.
    fn at_operation(&self, bench: &mut Bench, number: usize, before: &Cells) {
        let chip = firmware::board().chip;
        let all = self.operations.len();
        let recovers = Effort::takes(self.effort.recovered, number, all);
        for (way, cut) in WAYS.iter().enumerate() {
            // The state before an operation is that after the one before.
            if *cut == Cut::Before && number > 0 {
                continue;
            }
            let mut cells = before.clone();
            cells.apply(&self.operations[number], chip, *cut);
            let point = self.point(number, way);
            if self.is_new(&cells) {
                let found = self.inspect(bench, &cells);
                self.count(point, found);
            } else {
                mark(&mut self.total().1, point.first, b'=');
            }
            if recovers && (way == 1 + number % (WAYS.len() - 1) || number + 1 == all) {
                self.recover(bench, point, &cells);
            }
        }
    }

    /// The host does everything again, and the power is cut in this, too.
    fn recover(&self, bench: &mut Bench, point: Point, cells: &Cells) {
        let recovery =
            record(self.story, bench, cells).and_then(|operations| match observe(self.story, bench)? {
                seen if seen == self.story.to => Ok(operations),
                seen => Err(format!("{seen:?}, where {:?} should be", self.story.to)),
            });
        self.total().1.recoveries += 1;
        let operations = match recovery {
            Ok(operations) => operations,
            Err(what) => return self.count(point, Err(format!("the recovery does not complete: {what}"))),
        };
        let chip = firmware::board().chip;
        let mut before = cells.clone();
        for (number, operation) in operations.iter().enumerate() {
            if Effort::takes(self.effort.cut_again, number, operations.len()) {
                let way = 1 + (point.first.operation as usize + number) % (WAYS.len() - 1);
                let mut cells = before.clone();
                cells.apply(operation, chip, WAYS[way]);
                if self.is_new(&cells) {
                    let point = Point { second: Some(At { operation: number as u32, way }), ..point };
                    let found = self.inspect(bench, &cells);
                    self.count(point, found);
                }
            }
            before.apply(operation, chip, Cut::After);
        }
    }
}

/// Cuts the power in a scenario.
///
/// # Errors
/// If the scenario fails without a cut.
pub fn run(scenario: &Scenario, effort: Effort) -> Result<Report, String> {
    let effort = if scenario.is_sealed { effort.slow() } else { effort };
    let story = scenario.story()?;
    Ok(prove(scenario.name, &story, &operations(&story)?, effort))
}

/// The flash operations of a story without a cut.
///
/// # Errors
/// If it fails.
pub fn operations(story: &Story) -> Result<Vec<Operation>, String> {
    let mut bench = story.bench();
    let operations = record(story, &mut bench, &story.start)?;
    match observe(story, &mut bench)? {
        seen if seen == story.to => Ok(operations),
        seen => Err(format!("without a cut: {seen:?}")),
    }
}

/// Cuts the power in these operations.
#[must_use]
pub fn prove(name: &'static str, story: &Story, operations: &[Operation], effort: Effort) -> Report {
    let report = Report { operations: operations.len() as u64, ..Report::default() };
    let total = Mutex::new((HashSet::new(), report));
    let proof = Proof { name, story, operations, effort, total };
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    std::thread::scope(|scope| {
        for thread in 0..threads {
            let proof = &proof;
            scope.spawn(move || {
                let chip = firmware::board().chip;
                let mut bench = story.bench();
                let mut before = story.start.clone();
                let mut turn = 0;
                for (number, operation) in operations.iter().enumerate() {
                    if Effort::takes(effort.cut, number, operations.len()) {
                        turn += 1;
                        if turn % threads == thread {
                            let run = AssertUnwindSafe(|| proof.at_operation(&mut bench, number, &before));
                            if catch_unwind(run).is_err() {
                                proof.count(proof.point(number, 0), Err("a panic".into()));
                                bench = story.bench();
                            }
                        }
                    }
                    before.apply(operation, chip, Cut::After);
                }
            });
        }
    });
    proof.total.into_inner().unwrap_or_else(PoisonError::into_inner).1
}

/// One point as text.
#[must_use]
pub fn reproduce(point: Point) -> String {
    tell(point).unwrap_or_else(|what| format!("{point}: VIOLATION: {what}\n"))
}

fn tell(point: Point) -> Result<String, String> {
    let scenario = SCENARIOS.iter().find(|scenario| scenario.name == point.scenario);
    let scenario = scenario.ok_or("there is no such scenario")?;
    let story = scenario.story()?;
    let mut bench = story.bench();
    let mut text = format!("{point}: {}\n", scenario.about);
    let mut cells = story.start.clone();
    for at in [Some(point.first), point.second].into_iter().flatten() {
        let operations = record(&story, &mut bench, &cells)?;
        let Some(behind) = behind(&cells, &operations, at) else {
            return Err(format!("there is no operation {}, {} are all", at.operation, operations.len()));
        };
        cells = behind;
        let seen = switched_on(&story, &mut bench, &cells)?;
        text += &format!(
            "cut at operation {} of {} ({}): {}, node {}\n",
            at.operation,
            operations.len(),
            name_of(at.way),
            seen.outcome.name(),
            seen.node
        );
    }
    let operations = record(&story, &mut bench, &cells)?;
    let seen = observe(&story, &mut bench)?;
    text +=
        &format!("recovery, {} operations: {}, node {}\n", operations.len(), seen.outcome.name(), seen.node);
    Ok(text)
}
