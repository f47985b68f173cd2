//! Level 2: the built firmware on the emulated chip, updated by `coflash`, with the power cut at
//! flash operations.
//!
//! A point starts with a copy of the flash of a board that runs version 1, so points are
//! independent and run in parallel. The emulator's own loader gives the expected final contents of
//! the flash from the ELF files.

use std::fmt;
use std::panic::{catch_unwind, AssertUnwindSafe};
use std::str::FromStr;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::Mutex;

use canopen::{Address, BitRate};
use coflash::file::block_file::BlockFile;
use coflash::update::{flash, FlashOptions};
use emulator::machine::{Cut, FlashCut, Machine, Options, ResetCause, Stop};

use super::points::{Report, TOLD};
use crate::bench::{Bench, NODE, RESCUE_WINDOW_MS};
use crate::firmware;

const VERSION: Address = Address::new(0x100A, 0);
/// The highest bit rate. It is stored in the device and differs from the default, so a device that
/// answers has kept its parameters.
const RATE: BitRate = BitRate::K1000;
const BIT_RATE: u32 = 1_000_000;
/// A board with a program, confirmed or not, runs it within this time, in ms.
const BOOT_MS: u64 = RESCUE_WINDOW_MS + 250;
/// The prefix of the name of a point.
pub const NAME: &str = "board";
/// The first and last operations of an update, which concern the parameters: a sample includes all
/// of them.
const EDGE: u64 = 10;

/// The way in which an operation is cut.
const KINDS: [(&str, Cut); 4] = [
    ("before", Cut::Before),
    ("after", Cut::After),
    ("torn", Cut::Torn { seed: 7 }),
    ("torn-otherwise", Cut::Torn { seed: 8 }),
];

/// A cut: the flash operation, counted from 0, and the way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct At {
    operation: u64,
    kind: usize,
}

impl At {
    fn flash_cut(self) -> FlashCut {
        FlashCut { operation: self.operation, when: KINDS[self.kind].1 }
    }
}

/// A cut in the update, and possibly another one in the recovery. Written as `board:37:torn` or
/// `board:37:torn:12:after`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Point {
    first: At,
    second: Option<At>,
}

impl fmt::Display for Point {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(NAME)?;
        for at in [Some(self.first), self.second].into_iter().flatten() {
            write!(f, ":{}:{}", at.operation, KINDS[at.kind].0)?;
        }
        Ok(())
    }
}

impl FromStr for Point {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let words: Vec<&str> = text.split(':').collect();
        let at = |operation: &str, kind: &str| -> Result<At, String> {
            let operation =
                operation.parse().map_err(|_| format!("{operation:?} is no number of an operation."))?;
            let kind = KINDS.iter().position(|(name, _)| *name == kind).ok_or_else(|| {
                let names: Vec<_> = KINDS.iter().map(|(name, _)| *name).collect();
                format!("{kind:?} is no way to cut; there are {}.", names.join(", "))
            })?;
            Ok(At { operation, kind })
        };
        match words[..] {
            [NAME, operation, kind] => Ok(Self { first: at(operation, kind)?, second: None }),
            [NAME, operation, kind, later, its_kind] => {
                Ok(Self { first: at(operation, kind)?, second: Some(at(later, its_kind)?) })
            }
            _ => Err(format!("{text:?} is no point: {NAME}:37:torn, or {NAME}:37:torn:12:after.")),
        }
    }
}

/// The set of points to run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Effort {
    /// The first and last operations, and about this many in between, each in one way; some with a
    /// cut in the recovery.
    Sample(u64),
    /// Each operation in every way, and a cut in each recovery.
    Full,
}

/// The program that answers after the power returns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Outcome {
    Bootloader,
    Old,
    New,
}

impl Outcome {
    const fn name(self) -> &'static str {
        match self {
            Self::Bootloader => "bootloader",
            Self::Old => "old program",
            Self::New => "new program",
        }
    }
}

/// The common data of all points.
pub struct Story {
    /// The flash of a board that runs version 1.
    start: Vec<u8>,
    /// The program's flash with version 1 in it, and with version 2.
    programs: [Vec<u8>; 2],
    update: BlockFile,
    operations: u64,
}

/// A part of the procedure that ends with the cut, or without one.
struct Run {
    cut: bool,
    operations: u64,
    outcome: Result<(), String>,
}

impl Story {
    /// Installs version 1 like a host, and counts the operations of an update to version 2.
    ///
    /// # Errors
    /// If this fails without a cut.
    pub fn new() -> Result<Self, String> {
        let mut bench = Bench::new();
        let board = bench.boards()[0];
        bench.commission(board, NODE, RATE);
        bench.set_host_bit_rate(BIT_RATE);
        bench.power_on();
        bench.run_ms(BOOT_MS);
        write(&mut bench, &firmware::blocks(firmware::APP_V1))?;
        bench.power_off();
        let mut story = Self {
            start: bench.machine().flash().to_vec(),
            programs: [program_of(firmware::APP_V1)?, program_of(firmware::APP_V2)?],
            update: firmware::blocks(firmware::APP_V2),
            operations: 0,
        };
        let mut bench = board_with(&story.start)?;
        let run = story.power_on_and_update(&mut bench, None);
        run.outcome?;
        story.operations = run.operations;
        match story.inspect(&mut bench)? {
            Outcome::New => Ok(story),
            other => Err(format!("without a cut: {}", other.name())),
        }
    }

    /// The power returns, and the host updates. The cut is counted from the power-on.
    fn power_on_and_update(&self, bench: &mut Bench, cut: Option<At>) -> Run {
        bench.events();
        bench.machine().cut_power_at(cut.map(At::flash_cut));
        let before = operations_of(bench);
        bench.power_on();
        bench.run_ms(BOOT_MS);
        let outcome = write(bench, &self.update);
        let operations = operations_of(bench) - before;
        let cut = bench.events().iter().any(|(_, stop)| *stop == Stop::PowerCut);
        bench.power_off();
        Run { cut, operations, outcome }
    }

    /// The state of the device after power-on.
    fn inspect(&self, bench: &mut Bench) -> Result<Outcome, String> {
        // A request in progress at the cut would keep the device in a rescue window: it is consumed
        // now, and the power is cut again.
        bench.power_on();
        bench.run_ms(50);
        bench.power_off();
        bench.run_ms(10);
        bench.events();
        let from = bench.time();
        bench.power_on();
        bench.run_ms(BOOT_MS);
        // A program that was never confirmed starts after a reset, at the end of the rescue window.
        let resets = bench.events();
        if !matches!(resets[..], [] | [(_, Stop::Reset(ResetCause::Software))]) {
            return Err(format!("it starts with {resets:?}"));
        }
        let boot_up = (0x700 + u32::from(NODE), vec![0]);
        if !bench.frames_since(from).into_iter().any(|(_, id, data)| (id, data) == boot_up) {
            return Err(format!("no boot-up within {BOOT_MS} ms"));
        }
        let told = bench.session().device_type().map_err(|error| format!("no answer: {error}"))?;
        let outcome = match told {
            None => return Err("it does not tell what it is".into()),
            Some(kind) if kind.is_bootloader() => Outcome::Bootloader,
            Some(_) => {
                let version = bench.session().read_text(VERSION).map_err(|error| error.to_string())?;
                let (outcome, whole) = match version.as_str() {
                    "1.0.0" => (Outcome::Old, &self.programs[0]),
                    "2.0.0" => (Outcome::New, &self.programs[1]),
                    _ => return Err(format!("it runs version {version:?}")),
                };
                if !starts_with(program_flash(bench.machine()), whole) {
                    return Err(format!("version {version} runs, and is not whole"));
                }
                outcome
            }
        };
        let events = bench.events();
        if !events.is_empty() {
            return Err(format!("{} answers after {events:?}", outcome.name()));
        }
        let reports = bench.machine().reports();
        if !reports.is_empty() {
            return Err(format!("the firmware touched what the emulator does not model: {reports:?}"));
        }
        Ok(outcome)
    }

    /// Runs a point, checks the device after each cut and at the end, and returns its state after
    /// each cut.
    fn at(&self, point: Point) -> Result<Vec<Outcome>, String> {
        let mut bench = board_with(&self.start)?;
        let mut last = Outcome::Old;
        let mut all = Vec::new();
        for at in [Some(point.first), point.second].into_iter().flatten() {
            let run = self.power_on_and_update(&mut bench, Some(at));
            if !run.cut {
                // A recovery may be shorter than the update: then it must have been successful.
                run.outcome.map_err(|error| format!("no cut at {}, and yet: {error}", at.operation))?;
            }
            let found = self.inspect(&mut bench)?;
            let untouched = at.operation == 0 && at.kind == 0;
            if untouched && found != last {
                return Err(format!("nothing was changed, and {} became {}", last.name(), found.name()));
            }
            if found == Outcome::Old && last != Outcome::Old {
                return Err("the old program is back".into());
            }
            if !run.cut && found != Outcome::New {
                return Err(format!("no cut, and yet {}", found.name()));
            }
            last = found;
            all.push(found);
            bench.power_off();
        }
        let run = self.power_on_and_update(&mut bench, None);
        run.outcome.map_err(|error| format!("the update does not complete: {error}"))?;
        match self.inspect(&mut bench)? {
            Outcome::New => Ok(all),
            other => Err(format!("after the recovery: {}", other.name())),
        }
    }

    fn points(&self, effort: Effort) -> Vec<Point> {
        let all = || {
            (0..self.operations)
                .flat_map(|operation| (0..KINDS.len()).map(move |kind| At { operation, kind }))
        };
        // The second cut moves through the recovery, which is about as long as the update.
        let twice = |first: At| Point {
            first,
            second: Some(At {
                operation: first.operation * 1_103 % self.operations,
                kind: (first.kind + first.operation as usize) % KINDS.len(),
            }),
        };
        match effort {
            Effort::Full => all().map(twice).collect(),
            Effort::Sample(count) => {
                let last = self.operations - 1;
                let step = (self.operations / count.max(1)).max(1);
                let near = |operation: u64| {
                    operation < EDGE || operation + EDGE > last || operation.is_multiple_of(step)
                };
                let turn = |operation: u64| (operation + operation / step) as usize % KINDS.len();
                all()
                    .filter(|at| {
                        [0, last].contains(&at.operation)
                            || near(at.operation) && at.kind == turn(at.operation)
                    })
                    .enumerate()
                    .map(|(i, first)| if i % 3 == 2 { twice(first) } else { Point { first, second: None } })
                    .collect()
            }
        }
    }

    /// Runs points on all cores.
    #[must_use]
    pub fn run(&self, effort: Effort) -> Report<Point> {
        let points = self.points(effort);
        let next = AtomicUsize::new(0);
        let total = Mutex::new(Report { operations: self.operations, ..Report::default() });
        let threads = std::thread::available_parallelism().map_or(1, usize::from);
        std::thread::scope(|scope| {
            for _ in 0..threads {
                scope.spawn(|| {
                    while let Some(&point) = points.get(next.fetch_add(1, Ordering::Relaxed)) {
                        let found = catch_unwind(AssertUnwindSafe(|| self.at(point)))
                            .unwrap_or_else(|_| Err("a panic".into()));
                        let mut total = total.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
                        total.points += 1;
                        match found {
                            Ok(found) => {
                                for outcome in found {
                                    *total.outcomes.entry(outcome.name().into()).or_default() += 1;
                                }
                            }
                            Err(what) => {
                                total.violations += 1;
                                if total.told.len() < TOLD {
                                    total.told.push((point, what));
                                }
                            }
                        }
                    }
                });
            }
        });
        total.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner)
    }

    /// One point as text.
    #[must_use]
    pub fn reproduce(&self, point: Point) -> String {
        match self.at(point) {
            Ok(found) => {
                let found: Vec<_> = found.into_iter().map(Outcome::name).collect();
                let (operations, found) = (self.operations, found.join(", then "));
                format!("{point}, of {operations} operations: {found}; the update then completes.\n")
            }
            Err(what) => format!("{point}: VIOLATION: {what}\n"),
        }
    }
}

fn write(bench: &mut Bench, file: &BlockFile) -> Result<(), String> {
    match flash(&mut bench.session(), file, &FlashOptions::default().trial_run(false), &mut |_| {}) {
        Ok(_) => Ok(()),
        Err(error) => Err(error.to_string()),
    }
}

/// A board with this flash, still without power.
fn board_with(flash: &[u8]) -> Result<Bench, String> {
    let mut bench = Bench::new();
    bench.set_host_bit_rate(BIT_RATE);
    let base = firmware::board().chip.flash.base;
    bench.machine().load_bin(base, flash).map_err(|error| error.to_string())?;
    Ok(bench)
}

fn operations_of(bench: &mut Bench) -> u64 {
    let counters = bench.machine().counters();
    counters.sectors_erased + counters.units_programmed
}

fn program_flash(machine: &Machine) -> &[u8] {
    let board = firmware::board();
    &machine.flash()[(board.programs[0].base - board.chip.flash.base) as usize..]
}

/// The first bytes of the program's flash with this image, from the emulator's own ELF loader.
fn program_of(image: &str) -> Result<Vec<u8>, String> {
    let chip = firmware::board().chip;
    let mut machine = Machine::new(chip, Options::default()).map_err(|error| error.to_string())?;
    machine.load(&firmware::elf(image)).map_err(|error| error.to_string())?;
    let bytes = program_flash(&machine);
    let used = bytes.iter().rposition(|byte| *byte != 0xFF).map_or(0, |last| last + 1);
    Ok(bytes[..used].to_vec())
}

fn starts_with(flash: &[u8], program: &[u8]) -> bool {
    flash.get(..program.len()) == Some(program)
}
