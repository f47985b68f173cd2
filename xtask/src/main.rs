//! The jobs of the repository: `cargo xtask` lists them.
//!
//! There is one file for each job. This crate depends on the standard library, on `shared-abi` and on a
//! few small crates, so that it compiles in seconds on a machine with only a Rust toolchain.
//! Jobs that need more call [`setup`] first.
#![forbid(unsafe_code)]

use std::process::ExitCode;
use std::sync::atomic::Ordering;

mod args;
mod arrows;
mod attack;
mod bench;
mod book;
mod build;
mod check;
mod chips;
mod coverage;
mod demo;
mod deny;
mod diagrams;
#[cfg(test)]
mod docs;
mod eds;
mod elf;
mod emulate;
mod evidence;
mod examples;
mod files;
#[cfg(test)]
mod fleet;
mod fuzz;
mod hil;
mod layout;
mod links;
mod lint;
mod modules;
mod mutants;
mod new_board;
mod opinion;
mod ordered;
mod outcome;
mod package;
mod pairs;
#[cfg(test)]
mod paths;
mod portable;
mod powercut;
mod process;
mod product;
mod ram_image;
mod reproduce;
mod rooms;
mod sbom;
mod setup;
mod size;
mod test;
mod toolchain;
mod words;
mod workspace;

use args::Args;
use outcome::Outcome;

/// One job.
struct Job {
    /// The word after `cargo xtask`.
    name: &'static str,
    /// One line for the list.
    about: &'static str,
    /// The text of `cargo xtask NAME --help`.
    help: &'static str,
    /// Runs the job.
    run: fn(Args) -> Outcome,
}

/// A job for each line: its name, its module, and one line for the list.
macro_rules! jobs {
    ($($name:literal $module:ident $about:literal)+) => {
        &[$(Job { name: $name, about: $about, help: $module::HELP, run: $module::run }),+]
    };
}

/// The last line of each help.
const YES: &str = "With --yes a job installs what is missing with sudo.\n";

/// How many of the jobs are those that a newcomer needs.
const FIRST: usize = 8;

/// The jobs: first those that a newcomer needs.
const JOBS: &[Job] = jobs! {
    "demo" demo "the main job: flash, start, call back and flash again on an emulated board"
    "check" check "before each commit: formatting, clippy, arrows, unit tests; two minutes"
    "test" test "the tests of the product, with one summary at the end; --all for all"
    "build" build "the firmware of a board: bootloader and both versions of the application"
    "emulate" emulate "an emulated board for other programs to talk to"
    "layout" layout "the memory map of a board, or its linker fragment"
    "new-board" new_board "the three files of a port, with steps to go through"
    "docs" book "the pages as a site, its links checked"

    "hil" hil "what only a real board can show, through a debug probe and its bus"
    "chips" chips "a board for every chip, built and updated in the emulator"
    "examples" examples "the programs in examples/, each built by its own tools"
    "diagrams" diagrams "the graphs of the documents, from text"
    "eds" eds "the EDS files of bootloader and application"
    "fuzz" fuzz "the fuzz targets, each for a while (nightly toolchain)"
    "deny" deny "licences and origins of the crates of others"
    "bench" bench "how fast a program gets into the device, beside the limits of wire and flash"
    "powercut" powercut "cut the power at every flash operation, and look what is there"
    "reproduce" reproduce "two clones in two folders give the same firmware"
    "coverage" coverage "which lines of the device's crates the tests reach"
    "mutants" mutants "changes of the code that a test must notice"
    "evidence" evidence "one page of what the jobs have measured of this commit"
    "attack" attack "the standing attacker of the bus, for millions of frames"
    "opinion" opinion "the emulated CPU against QEMU's, word for word"
    "size" size "the bootloader's flash against its budget"
    "pairs" pairs "bootloaders with every pair of a product's choices: they build and fit"
    "arrows" arrows "who depends on whom, against the rules of the house"
    "lint" lint "formatting, clippy and documentation, warnings denied"
    "sbom" sbom "the software bills of materials of bootloader and host tool"
    "package" package "what is handed out: archives, packages, wheel, sums; installed and run by --check"
    "portable" portable "the host tools' code compiles for Windows and macOS"
    "setup" setup "what the other jobs need on this machine, installed where missing"
};

fn main() -> ExitCode {
    // The programs that a job has started get the signal from the terminal, too. What they print of it comes
    // before the last line.
    let interrupted = ctrlc::set_handler(|| {
        process::IS_ENDING.store(true, Ordering::Relaxed);
        std::thread::sleep(std::time::Duration::from_millis(300));
        eprintln!("\nxtask: interrupted. What is built so far is kept; the same command goes on from there.");
        std::process::exit(130);
    });
    if let Err(problem) = interrupted {
        eprintln!("xtask: Ctrl-C ends this without a word: {problem}.");
    }
    let mut words = std::env::args().skip(1);
    let outcome = match words.next().as_deref() {
        None => {
            print!("{}\n{} more: cargo xtask --all\n", overview(&JOBS[..FIRST]), JOBS.len() - FIRST);
            Ok(())
        }
        Some("--all" | "help" | "--help" | "-h") => {
            print!("{}", overview(JOBS));
            Ok(())
        }
        Some(name) => match JOBS.iter().find(|job| job.name == name) {
            None => Err(format!("there is no job \"{name}\".\n\n{}", overview(JOBS))),
            Some(job) => {
                let mut args = Args::new(words);
                if args.flag("--yes") {
                    setup::may_use_sudo();
                }
                if args.flag(["-h", "--help"]) {
                    print!("{}\n{YES}", job.help);
                    Ok(())
                } else {
                    (job.run)(args)
                }
            }
        },
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(problem) => {
            eprintln!("\nxtask: {problem}");
            ExitCode::FAILURE
        }
    }
}

fn overview(jobs: &[Job]) -> String {
    let jobs: String = jobs.iter().map(|job| format!("  {:<9} {}\n", job.name, job.about)).collect();
    format!("usage: cargo xtask JOB [OPTIONS]    (cargo xtask JOB --help says more)\n\n{jobs}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_job_has_a_help_text_that_starts_with_its_usage() {
        for job in JOBS {
            assert!(job.help.starts_with(&format!("usage: cargo xtask {}", job.name)), "{}", job.name);
            assert!(job.help.ends_with('\n'), "{}", job.name);
            assert!(overview(JOBS).contains(job.about));
        }
    }

    /// The standard output is the job's: what it prints may be JSON for a program (`cargo xtask
    /// bench --json`). What every job does on its way, such as building, goes to the standard error.
    #[test]
    fn only_a_job_itself_prints_on_the_standard_output() {
        for name in
            "args build elf evidence files outcome process product ram_image setup toolchain workspace"
                .split(' ')
        {
            let text = files::ours(format!("xtask/src/{name}.rs")).unwrap();
            let (before, job) = text.split_once("\npub fn run(").unwrap_or((&text, ""));
            let (_, after) = job.split_once("\n}\n").unwrap_or_default();
            for line in before.lines().chain(after.lines()) {
                let prints = ["print!(", "println!("].iter().any(|word| line.trim_start().starts_with(word));
                assert!(!prints, "{name}: {line}");
            }
        }
    }

    #[test]
    fn a_newcomer_sees_eight_jobs() {
        let first: Vec<_> = JOBS[..FIRST].iter().map(|job| job.name).collect();
        assert_eq!(first, ["demo", "check", "test", "build", "emulate", "layout", "new-board", "docs"]);
    }
}
