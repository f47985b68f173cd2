//! `cargo xtask test`: runs every test, with one summary at the end.

use std::ffi::{OsStr, OsString};
use std::io::{BufRead, BufReader, Write};
use std::process::Stdio;
use std::time::Instant;

use shared_abi::layout::{stm32f407g_disc1_can2, Layout, BOARDS};

use crate::args::Args;
use crate::setup::{self, Part, Setup};
use crate::{build, evidence, examples, process, workspace, Outcome};

pub const HELP: &str = "\
usage: cargo xtask test [--board BOARD] [--yes] [ARGS]

Sets the machine up, builds the firmware and runs the tests of all host crates, among them those that
run the firmware in the emulator and those that use a third-party CANopen client; then the main ones
among those with the firmware of every other board.

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
    // A run without arguments runs the main tests for the other chips, too.
    let others: Vec<&Layout> = BOARDS
        .iter()
        .copied()
        .filter(|other| !chosen_board && chosen.is_empty() && other.chip.chip != board.chip.chip)
        .collect();
    // The boards with room for two programs are for the tests of two programs.
    let two = BOARDS.iter().copied().filter(|other| other.programs.len() > 1 && other.board != board.board);
    build::boards(&[board].into_iter().chain(two).chain(others.iter().copied()).collect::<Vec<_>>())?;
    // A board with CAN2.
    build::images(&stm32f407g_disc1_can2::LAYOUT, &build::MAIN)?;
    examples::all()?;
    let programs = ["--package", "coflash", "--package", "coboot-node"];
    process::run(process::cargo("build").current_dir(workspace::root()).args(programs))?;
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
    let mut suite =
        Suite { summary: Summary::default(), coflash: built("coflash"), node: built("coboot-node"), python };
    if chosen_board {
        suite.run(board, &[build::tests_args(board), chosen].concat())?;
    } else if !chosen.is_empty() {
        suite.run(board, &chosen)?;
    } else {
        // The crate of the emulated tests has sealed images, without which a bootloader has more:
        // together, all would be tested with them.
        let others_than = |package: &&str| ["--exclude".to_owned(), (*package).to_owned()];
        let hosts = NOT_ON_HOST.iter().chain(&["coboot-tests"]).flat_map(others_than);
        suite.run(board, &["--workspace".to_owned()].into_iter().chain(hosts).collect::<Vec<_>>())?;
        let sealed = ["--package=coboot-core", "--package=coboot-canopen"].map(str::to_owned);
        suite.run(board, &[build::tests_args(board), sealed.to_vec()].concat())?;
        for other in others {
            println!("\n-- {} --", other.board);
            let tests = MAIN_TESTS.iter().map(|test| format!("--test={test}"));
            suite.run(other, &build::tests_args(other).into_iter().chain(tests).collect::<Vec<_>>())?;
        }
    }
    let summary = suite.summary;

    if is_whole {
        let Summary { passed, failed, ignored, programs, .. } = &summary;
        let seconds = started.elapsed().as_secs();
        evidence::record(
            "tests",
            &format!("{{\"passed\": {passed}, \"failed\": {failed}, \"skipped\": {ignored}, \"programs\": {programs}, \"seconds\": {seconds}}}"),
        )?;
    }
    println!();
    for name in &summary.names_of_failed {
        println!("FAILED: {name}");
    }
    println!("{} test programs in {} s", summary.programs, started.elapsed().as_secs());
    println!("{}", summary.line());
    match summary.failed {
        0 if summary.programs == 0 => Err("no test ran.".into()),
        0 => Ok(()),
        1 => Err("1 test failed; its output stands above.".into()),
        failed => Err(format!("{failed} tests failed; their output stands above.")),
    }
}

/// The packages that are built for a chip, or by another tool.
const NOT_ON_HOST: [&str; 4] = ["bsp", "bootloader", "app-template", "coflash-python"];

/// The test programs that run for every board: they show the mistakes that a port can have.
const MAIN_TESTS: [&str; 12] = [
    "main_job",
    "device",
    "masters",
    "watchdog",
    "boot_time",
    "abi",
    "image",
    "c_application",
    "handover",
    "log",
    "virtual_can",
    "conform",
];

/// The results of the run so far, and the needs of the tests.
struct Suite {
    summary: Summary,
    coflash: OsString,
    node: OsString,
    python: OsString,
}

impl Suite {
    /// Runs `cargo test` with these arguments, and the images of a board.
    fn run(&mut self, board: &Layout, arguments: &[String]) -> Outcome {
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

/// The totals of many test programs.
#[derive(Debug, Default, PartialEq, Eq)]
struct Summary {
    passed: u32,
    failed: u32,
    ignored: u32,
    programs: u32,
    names_of_failed: Vec<String>,
}

impl Summary {
    /// Runs `cargo test` with these arguments, and takes what it prints.
    fn run(&mut self, arguments: &[String], environment: [(&str, &OsStr); 5]) -> Outcome {
        let mut cargo = process::cargo("test");
        cargo
            .arg("--no-fail-fast")
            .args(arguments)
            .current_dir(workspace::root())
            .envs(environment)
            .stdout(Stdio::piped());
        let mut tests = cargo.spawn().map_err(|error| process::not_started(&cargo, &error))?;
        let failed = self.failed;
        if let Some(printed) = tests.stdout.take() {
            let mut printed = BufReader::new(printed);
            let mut line = Vec::new();
            // The output is read as bytes: a test may print invalid UTF-8.
            while printed.read_until(b'\n', &mut line).is_ok_and(|len| len > 0) {
                let mut out = std::io::stdout().lock();
                let _ = out.write_all(&line).and_then(|()| out.flush());
                self.take(&String::from_utf8_lossy(&line));
                line.clear();
            }
        }
        let status = tests.wait().map_err(|error| process::not_started(&cargo, &error))?;
        if !status.success() && self.failed == failed {
            // It counts as a failure, so that the last line is never better than the run.
            self.failed += 1;
            self.names_of_failed
                .push("something that did not build, or a test program that broke off".into());
        }
        Ok(())
    }

    /// Takes one line of a test program's output.
    fn take(&mut self, line: &str) {
        let line = line.trim_end();
        if let Some((_, counts)) = line.strip_prefix("test result: ").and_then(|line| line.split_once(". ")) {
            let count = |what: &str| -> u32 {
                let field = counts.split("; ").find_map(|field| field.strip_suffix(what));
                field.and_then(|number| number.trim().parse().ok()).unwrap_or(0)
            };
            self.passed += count(" passed");
            self.failed += count(" failed");
            self.ignored += count(" ignored");
            self.programs += 1;
        } else if let Some(name) =
            line.strip_prefix("test ").and_then(|line| line.strip_suffix(" ... FAILED"))
        {
            self.names_of_failed.push(name.to_owned());
        }
    }

    /// The last line of a run; `.ci/run` repeats it.
    fn line(&self) -> String {
        let mut line = format!("{} passed, {} failed", self.passed, self.failed);
        if self.ignored > 0 {
            line += &format!(", {} skipped", self.ignored);
        }
        line
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
        assert_eq!(summary.programs, 2);
        assert_eq!(summary.names_of_failed, ["flash::cut"]);
        assert_eq!(Summary::default().line(), "0 passed, 0 failed");
    }
}
