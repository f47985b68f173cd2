//! `cargo xtask test`: runs every test, with one summary at the end.

use std::collections::{BTreeMap, VecDeque};
use std::ffi::{OsStr, OsString};
use std::fs;
use std::io::{BufRead, BufReader, IsTerminal, Write};
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use shared_abi::layout::{stm32f407g_disc1_can2, Layout, BOARDS};

use crate::args::Args;
use crate::json::quoted;
use crate::setup::{self, Part, Setup};
use crate::{build, evidence, examples, process, workspace, Outcome};

pub const HELP: &str = "\
usage: cargo xtask test [--board BOARD] [--yes] [ARGS]

Sets the machine up, builds the firmware and runs the tests of all host crates, among them those that
run the firmware in the emulator and those that use a third-party CANopen client; then those that a
chip can make fail, with the firmware of a board of every other chip.

  --board BOARD   only the tests that run firmware, all of them, with that of this board
  --yes           installs what is missing with sudo
  ARGS            go to cargo test: `cargo xtask test -p coboot-canopen sdo`, `cargo xtask test -- --nocapture`

The tests find what was built by these variables: COBOOT_BOARD, COBOOT_FIRMWARE_DIR (bootloader.elf,
app-v1.elf, app-v2.elf, app-c.elf), COBOOT_COFLASH (the command line of the host tool), COBOOT_NODE (the node
without hardware) and COBOOT_PYTHON (an interpreter with tests/python/requirements.txt installed).
";

pub fn run(mut args: Args) -> Outcome {
    let chosen_board = args.has("--board");
    let board = workspace::board(&mut args)?;
    let setup = Setup::from(&mut args);
    setup.prepare(&[
        Part::Firmware,
        Part::C,
        Part::Examples,
        Part::Emulator,
        Part::Python,
        Part::Gdb,
        Part::Browser,
    ])?;
    let chosen = args.rest();
    // A run without arguments runs the tests of a chip for the other chips, too.
    let others: Vec<&Layout> = BOARDS
        .iter()
        .copied()
        .filter(|other| !chosen_board && chosen.is_empty() && other.chip.chip != board.chip.chip)
        .collect();
    // The boards with room for two programs are for the tests of two programs.
    let two = BOARDS.iter().copied().filter(|other| other.programs.len() > 1 && other.board != board.board);
    let whole = [board].into_iter().chain(two).map(|board| (board, &[][..]));
    let others_too = others.iter().map(|other| (*other, &CHIP_IMAGES[..]));
    let images = || {
        build::boards(&whole.chain(others_too).collect::<Vec<_>>())?;
        // A board with CAN2.
        build::images(&stm32f407g_disc1_can2::LAYOUT, &build::MAIN)?;
        examples::all()
    };
    let programs = || {
        let packages = ["--package", "coflash", "--package", "coboot-node"];
        process::run(process::cargo("build").current_dir(workspace::root()).args(packages))
    };
    let built = |name: &str| {
        let path = workspace::target_dir().join("debug").join(name);
        path.with_extension(std::env::consts::EXE_EXTENSION).into_os_string()
    };

    let is_whole = !chosen_board && chosen.is_empty();
    if is_whole {
        evidence::begin("tests")?;
    }
    let started = Instant::now();
    let python = setup::python().into_os_string();
    let new_suite = || Suite {
        summary: Summary::default(),
        coflash: built("coflash"),
        node: built("coboot-node"),
        python: python.clone(),
    };
    let mut suite;
    if is_whole {
        suite = side_by_side(board, &others, images, new_suite)?;
    } else {
        images()?;
        programs()?;
        suite = new_suite();
        let own = if chosen_board { build::tests_args(board) } else { Vec::new() };
        suite.run(board, Some(board), &[own, chosen].concat())?;
    }
    let summary = suite.summary;

    if is_whole {
        evidence::record("tests", &summary.as_json(started.elapsed().as_secs()))?;
    }
    println!();
    for name in &summary.names_of_failed {
        println!("FAILED: {name}");
    }
    let total = summary.total();
    println!("{} test programs in {} s", total.programs, started.elapsed().as_secs());
    println!("{}", summary.line());
    match total.failed {
        0 if total.programs == 0 => Err("no test ran.".into()),
        0 => Ok(()),
        1 => Err("1 test failed; its output stands above.".into()),
        failed => Err(format!("{failed} tests failed; their output stands above.")),
    }
}

/// Builds the images, and runs all tests as soon as what they need is built, two test programs side
/// by side: the link of an image uses one core, and many tests have one thread, or wait for a clock.
fn side_by_side(
    board: &Layout,
    others: &[&Layout],
    images: impl FnOnce() -> Outcome + Send,
    new_suite: impl Fn() -> Suite,
) -> Outcome<Suite> {
    // The crate of the emulated tests has sealed images, without which a bootloader has more:
    // together, all would be tested with them.
    let others_than = |package: &&str| ["--exclude".to_owned(), (*package).to_owned()];
    let without = NOT_ON_HOST.iter().chain(&["coboot-tests", TOOLS]).flat_map(others_than);
    let hosts: Vec<String> = ["--workspace".to_owned()].into_iter().chain(without).collect();
    let queue = Mutex::new(with_images(board)?);
    let next = || queue.lock().unwrap_or_else(PoisonError::into_inner).pop_front();
    let all = |mut suite: Suite| {
        while let Some((place, arguments)) = next() {
            suite.run(board, place, &arguments)?;
        }
        Outcome::Ok(suite)
    };
    let broken_off = |_| "a part of the tests broke off.".to_owned();
    let (mut suite, beside) = (new_suite(), new_suite());
    std::thread::scope(|scope| {
        let images = scope.spawn(images);
        // With the tests of a package, cargo builds its programs: host tool and node, too.
        let build = [&["--no-run".to_owned(), "--quiet".to_owned()], &hosts[..]].concat();
        process::run(process::cargo("test").current_dir(workspace::root()).args(build))?;
        let hosts = scope.spawn(|| suite.run(board, None, &hosts).map(|()| suite));
        images.join().map_err(broken_off)??;
        let beside = scope.spawn(|| all(beside));
        let mut suite = all(hosts.join().map_err(broken_off)??)?;
        suite.summary.add(beside.join().map_err(broken_off)??.summary);
        // The tests of another chip are the same programs, compiled for another board.
        for other in others {
            let tests = CHIP_TESTS.iter().map(|test| format!("--test={test}"));
            let arguments: Vec<String> = build::tests_args(other).into_iter().chain(tests).collect();
            suite.run(other, Some(other), &arguments)?;
        }
        Ok(suite)
    })
}

/// The runs of tests that need the images of a board, with the place that they count for: those that
/// take minutes one by one.
fn with_images(board: &Layout) -> Outcome<VecDeque<(Option<&Layout>, Vec<String>)>> {
    let mut names = Vec::new();
    for folder in ["tests/tests", "core/boot-core/tests", "core/canopen/tests"] {
        let unreadable = |error: std::io::Error| format!("{folder} cannot be read: {error}.");
        for entry in fs::read_dir(workspace::root().join(folder)).map_err(unreadable)? {
            let path = entry.map_err(unreadable)?.path();
            let is_program = path.extension() == Some("rs".as_ref());
            let name =
                path.file_stem().and_then(OsStr::to_str).filter(|name| is_program && !SLOW.contains(name));
            names.extend(name.map(|name| format!("--test={name}")));
        }
    }
    names.sort();
    names.dedup();
    let sealed = ["--package=coboot-core", "--package=coboot-canopen"].map(str::to_owned);
    let board_too =
        |tests: &[String]| (Some(board), [&build::tests_args(board)[..], &sealed, tests].concat());
    let rest = ["--lib".to_owned()].into_iter().chain(names).collect::<Vec<_>>();
    let slow = SLOW.iter().map(|name| board_too(&[format!("--test={name}")]));
    let tools = (None, vec![format!("--package={TOOLS}")]);
    Ok([board_too(&rest), tools].into_iter().chain(slow).collect())
}

/// The package with the jobs, whose tests flash the images.
const TOOLS: &str = "xtask";
/// The test programs that take a minute and more.
const SLOW: [&str; 6] = ["porting", "powercut_board", "python_package", "powercut", "examples", "clients"];
/// The packages that are built for a chip, or by another tool.
const NOT_ON_HOST: [&str; 6] =
    ["bsp", "bootloader", "app-template", "app-template-v2", "test-app", "coflash-python"];

/// The test programs that run for a board of each chip: they show the mistakes that a port can have.
/// Dialects, logs and the rest are the same on all of them; at night all tests run for each chip.
const CHIP_TESTS: [&str; 7] = ["main_job", "device", "watchdog", "boot_time", "abi", "handover", "conform"];
/// The images that they need.
const CHIP_IMAGES: [&str; 4] = ["bootloader", "bootloader-paulus", "app-v1", "app-v2"];

/// The test programs that work with a program of others, unmodified; and which.
const FOREIGN: [(&str, &str); 12] = [
    ("c_application", "clang"),
    ("clients", "python-canopen, canopen-asyncio"),
    ("eds", "dcfchk, and python-canopen as a reader"),
    ("examples", "cmake, arm-none-eabi-gcc"),
    ("gdb_door", "gdb"),
    ("image", "zx0decompress"),
    ("peers", "python-canopen as a master of three devices"),
    ("python_package", "maturin, pytest, python-can"),
    ("sealed_client", "python-canopen"),
    ("ui", "Chromium"),
    ("virtual_can", "python-can, python-canopen"),
    ("zencan", "zencan-client"),
];
/// The test program of `coflash conform`.
const CONFORM: &str = "conform";

/// The results of the run so far, and the needs of the tests.
struct Suite {
    summary: Summary,
    coflash: OsString,
    node: OsString,
    python: OsString,
}

impl Suite {
    /// Runs `cargo test` with these arguments and the images of a board. The results count for
    /// `place`; `None` for tests without a board.
    fn run(&mut self, board: &Layout, place: Option<&Layout>, arguments: &[String]) -> Outcome {
        self.summary.place = place.map(|place| place.board.to_owned());
        let images = workspace::firmware_dir(board);
        let environment: [(&str, &OsStr); 5] = [
            ("COBOOT_BOARD", board.board.as_ref()),
            ("COBOOT_FIRMWARE_DIR", images.as_ref()),
            ("COBOOT_COFLASH", &self.coflash),
            ("COBOOT_NODE", &self.node),
            ("COBOOT_PYTHON", &self.python),
        ];
        self.summary.run(arguments, environment)
    }
}

/// The counts of test programs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Counts {
    programs: u32,
    passed: u32,
    failed: u32,
    skipped: u32,
}

impl Counts {
    fn add(&mut self, other: Self) {
        self.programs += other.programs;
        self.passed += other.passed;
        self.failed += other.failed;
        self.skipped += other.skipped;
    }

    fn as_json(self, named: &[(&str, &str)]) -> String {
        let named: String =
            named.iter().map(|(name, text)| format!("\"{name}\": {}, ", quoted(text))).collect();
        let Self { programs, passed, failed, skipped } = self;
        format!("{{{named}\"programs\": {programs}, \"passed\": {passed}, \"failed\": {failed}, \"skipped\": {skipped}}}")
    }
}

/// What a test program is.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Level {
    /// The tests within the sources of a crate.
    Unit,
    /// The tests of a crate from outside.
    Crate,
    /// The examples in the documentation.
    Documentation,
    /// The built firmware of this board, and the crates with sealed images.
    Board(String),
}

/// The totals of many test programs.
#[derive(Debug, Default, PartialEq, Eq)]
struct Summary {
    /// The board whose firmware the tests run; `None` for those without one.
    place: Option<String>,
    /// What the test program is that runs now, and its name.
    program: Option<(Level, String)>,
    /// By test program.
    counts: BTreeMap<(Level, String), Counts>,
    /// What did not get as far as a count.
    broken: u32,
    names_of_failed: Vec<String>,
}

impl Summary {
    /// Runs `cargo test` with these arguments, and takes what it prints.
    fn run(&mut self, arguments: &[String], environment: [(&str, &OsStr); 5]) -> Outcome {
        let unreadable = |error: std::io::Error| format!("the output of the tests cannot be read: {error}.");
        // cargo names the test program on one stream, and that reports on the other: in one pipe
        // they stay in order.
        let (printed, writer) = std::io::pipe().map_err(unreadable)?;
        let mut cargo = process::cargo("test");
        cargo
            .args(std::io::stderr().is_terminal().then_some("--color=always"))
            .arg("--no-fail-fast")
            .args(arguments)
            .current_dir(workspace::root())
            .envs(environment)
            .stdout(writer.try_clone().map_err(unreadable)?)
            .stderr(writer);
        let mut tests = cargo.spawn().map_err(|error| process::not_started(&cargo, &error))?;
        // The pipe ends with the last program that can write into it.
        drop(cargo);
        let failed = self.total().failed;
        let mut printed = BufReader::new(printed);
        let mut line = Vec::new();
        // Several runs print side by side.
        let place = format!("[{}] ", self.place.as_deref().unwrap_or("host"));
        // The output is read as bytes: a test may print invalid UTF-8.
        while printed.read_until(b'\n', &mut line).is_ok_and(|len| len > 0) {
            let mut out = std::io::stdout().lock();
            let _ = out.write_all(place.as_bytes()).and_then(|()| out.write_all(&line));
            let _ = out.flush();
            self.take(&String::from_utf8_lossy(&line));
            line.clear();
        }
        let status = tests.wait().map_err(unreadable)?;
        if !status.success() && self.total().failed == failed {
            // It counts as a failure, so that the last line is never better than the run.
            self.broken += 1;
            self.names_of_failed
                .push("something that did not build, or a test program that broke off".into());
        }
        Ok(())
    }

    /// Takes one line of what cargo and the test programs print.
    fn take(&mut self, line: &str) {
        let line = without_colours(line);
        let line = line.trim_end();
        if let Some((_, counts)) = line.strip_prefix("test result: ").and_then(|line| line.split_once(". ")) {
            let count = |what: &str| -> u32 {
                let field = counts.split("; ").find_map(|field| field.strip_suffix(what));
                field.and_then(|number| number.trim().parse().ok()).unwrap_or(0)
            };
            let counts = Counts {
                programs: 1,
                passed: count(" passed"),
                failed: count(" failed"),
                skipped: count(" ignored"),
            };
            let program = self.program.clone().unwrap_or((Level::Crate, String::new()));
            self.counts.entry(program).or_default().add(counts);
        } else if let Some(name) =
            line.strip_prefix("test ").and_then(|line| line.strip_suffix(" ... FAILED"))
        {
            self.names_of_failed.push(name.to_owned());
        } else if let Some((level, name)) = started(line) {
            self.program = Some((self.place.clone().map_or(level, Level::Board), name));
        }
    }

    fn sum(&self, of: impl Fn(&Level, &str) -> bool) -> Counts {
        let mut sum = Counts::default();
        let chosen = self.counts.iter().filter(|((level, name), _)| of(level, name));
        chosen.for_each(|(_, counts)| sum.add(*counts));
        sum
    }

    /// Adds the results of tests that ran beside these.
    fn add(&mut self, other: Self) {
        for (program, counts) in other.counts {
            self.counts.entry(program).or_default().add(counts);
        }
        self.broken += other.broken;
        self.names_of_failed.extend(other.names_of_failed);
    }

    fn total(&self) -> Counts {
        let sum = self.sum(|_, _| true);
        Counts { failed: sum.failed + self.broken, ..sum }
    }

    /// The last line of a run; `.ci/run` repeats it.
    fn line(&self) -> String {
        let Counts { passed, failed, skipped, .. } = self.total();
        let mut line = format!("{passed} passed, {failed} failed");
        if skipped > 0 {
            line += &format!(", {skipped} skipped");
        }
        line
    }

    /// The record of a whole run.
    fn as_json(&self, seconds: u64) -> String {
        let mut levels: Vec<&Level> = self.counts.keys().map(|(level, _)| level).collect();
        levels.dedup();
        let of_levels = levels.iter().map(|level| {
            let name = match level {
                Level::Unit => "within a crate",
                Level::Crate => "a crate from outside",
                Level::Documentation => "documentation",
                Level::Board(board) => &format!("firmware of {board}"),
            };
            self.sum(|of, _| of == *level).as_json(&[("level", name)])
        });
        let foreign = FOREIGN.iter().filter_map(|(name, others)| {
            let counts = self.sum(|level, of| matches!(level, Level::Board(_)) && of == *name);
            (counts.programs > 0).then(|| counts.as_json(&[("tests", *name), ("with", *others)]))
        });
        let conform = levels.iter().filter_map(|level| match level {
            Level::Board(board) => {
                let counts = self.sum(|of, name| of == *level && name == CONFORM);
                (counts.programs > 0).then(|| counts.as_json(&[("board", board)]))
            }
            _ => None,
        });
        let list = |items: &mut dyn Iterator<Item = String>| items.collect::<Vec<_>>().join(",\n");
        let Counts { programs, passed, failed, skipped } = self.total();
        format!(
            "{{\"passed\": {passed}, \"failed\": {failed}, \"skipped\": {skipped}, \"programs\": {programs}, \
             \"seconds\": {seconds},\n\"levels\": [{}],\n\"foreign\": [{}],\n\"conformance\": [{}]}}",
            list(&mut of_levels.into_iter()),
            list(&mut foreign.into_iter()),
            list(&mut conform.into_iter())
        )
    }
}

/// The test program that cargo starts: `Running tests/clients.rs (target/debug/deps/clients-…)`,
/// `Running unittests src/lib.rs (…)`, `Doc-tests canopen`.
fn started(line: &str) -> Option<(Level, String)> {
    let line = line.trim_start();
    if let Some(name) = line.strip_prefix("Doc-tests ") {
        return Some((Level::Documentation, name.to_owned()));
    }
    let (source, _) = line.strip_prefix("Running ")?.split_once(" (")?;
    if let Some(source) = source.strip_prefix("unittests ") {
        return Some((Level::Unit, source.to_owned()));
    }
    let file = source.replace('\\', "/");
    let name = file.rsplit('/').next()?.strip_suffix(".rs")?;
    Some((Level::Crate, if name == "main" { file.clone() } else { name.to_owned() }))
}

/// A line without the terminal's colours (ECMA-48, SGR).
fn without_colours(line: &str) -> String {
    let mut parts = line.split("\u{1b}[");
    let mut plain = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        plain += part.split_once('m').map_or("", |(_, rest)| rest);
    }
    plain
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::json::Value;

    /// Lines in libtest's format.
    #[test]
    fn totals_are_summed_over_the_programs() {
        let mut summary = Summary::default();
        for line in [
            "running 3 tests",
            "test crc ... ok",
            "test flash::cut ... FAILED",
            "test slow ... ignored, takes an hour",
            "test result: FAILED. 1 passed; 1 failed; 1 ignored; 0 measured; 4 filtered out; finished in 0.01s",
            "the word passed in another line: 7 passed; 7 failed",
            "test result: ok. 20 passed; 0 failed; 0 ignored; 0 measured; 0 filtered out; finished in 2.00s\n",
        ] {
            summary.take(line);
        }
        assert_eq!(summary.line(), "21 passed, 1 failed, 1 skipped");
        assert_eq!(summary.total().programs, 2);
        assert_eq!(summary.names_of_failed, ["flash::cut"]);
        assert_eq!(Summary::default().line(), "0 passed, 0 failed");
        let mut more = Summary { broken: 1, ..Summary::default() };
        more.take("test result: ok. 4 passed; 0 failed; 0 ignored; 0 measured; 0 filtered out\n");
        summary.add(more);
        assert_eq!(summary.line(), "25 passed, 2 failed, 1 skipped");
    }

    /// Lines in cargo's format, with and without colours.
    #[test]
    fn each_program_counts_where_it_belongs() {
        let mut summary = Summary::default();
        let result = |passed, failed| {
            format!(
                "test result: ok. {passed} passed; {failed} failed; 0 ignored; 0 measured; 0 filtered out\n"
            )
        };
        let mut take = |place: Option<&str>, header: &str, passed, failed| {
            summary.place = place.map(str::to_owned);
            summary.take(header);
            summary.take(&result(passed, failed));
        };
        take(None, "     Running unittests src/lib.rs (target/debug/deps/canopen-01)\n", 5, 0);
        take(None, "     Running unittests src/lib.rs (target/debug/deps/seal-02)\n", 6, 0);
        take(
            None,
            "\u{1b}[1m\u{1b}[92m     Running\u{1b}[0m tests/conform.rs (target/debug/deps/conform-03)\n",
            7,
            0,
        );
        take(None, "   Doc-tests canopen\n", 8, 0);
        take(Some("a-board"), "     Running tests/clients.rs (target/debug/deps/clients-04)\n", 9, 1);
        take(Some("a-board"), "     Running tests/conform.rs (target/debug/deps/conform-05)\n", 10, 0);
        take(Some("b-board"), "     Running tests/conform.rs (target/debug/deps/conform-05)\n", 11, 2);
        summary.broken = 1;
        let record = Value::parse(&summary.as_json(60)).unwrap();
        let rows = |list: &str, name: &str, count: &str| -> Vec<(String, u32)> {
            let row = |row: &Value| {
                (row.get(name).text().unwrap().to_owned(), row.get(count).number().unwrap() as u32)
            };
            record.get(list).items().iter().map(row).collect()
        };
        let of = |rows: &[(&str, u32)]| {
            rows.iter().map(|(name, count)| ((*name).to_owned(), *count)).collect::<Vec<_>>()
        };
        let levels = [
            ("within a crate", 11),
            ("a crate from outside", 7),
            ("documentation", 8),
            ("firmware of a-board", 19),
            ("firmware of b-board", 11),
        ];
        assert_eq!(rows("levels", "level", "passed"), of(&levels));
        assert_eq!(rows("foreign", "tests", "failed"), of(&[("clients", 1)]));
        assert_eq!(rows("conformance", "board", "failed"), of(&[("a-board", 0), ("b-board", 2)]));
        assert_eq!(record.get("passed").number(), Some(56.0));
        assert_eq!(record.get("failed").number(), Some(4.0), "with what broke off");
    }

    #[test]
    fn each_test_program_runs_once_and_what_is_named_is_there() {
        let runs = with_images(&shared_abi::layout::stm32f407g_disc1::LAYOUT).unwrap();
        let of = |name: &str| {
            let argument = format!("--test={name}");
            runs.iter().flat_map(|(_, arguments)| arguments).filter(|other| **other == argument).count()
        };
        for name in FOREIGN.iter().map(|(name, _)| *name).chain([CONFORM]).chain(SLOW).chain(CHIP_TESTS) {
            assert_eq!(of(name), 1, "{name}");
        }
    }
}
