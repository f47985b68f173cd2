//! The jobs of the repository: `cargo xtask` lists them.
//!
//! There is one file for each job. This crate depends only on the standard library, on `shared-abi`
//! and on two small crates, so that it compiles in seconds on a machine with only a Rust toolchain.
//! Jobs that need more call [`setup`] first.
#![forbid(unsafe_code)]

use std::process::ExitCode;

mod args;
mod arrows;
mod attack;
mod bench;
mod book;
mod build;
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
mod fleet;
mod fuzz;
mod header;
mod hil;
mod json;
mod layout;
mod links;
mod lint;
mod modules;
mod mutants;
mod new_board;
mod opinion;
mod pack;
mod package;
#[cfg(test)]
mod pages;
mod pairs;
mod parts;
mod portable;
mod powercut;
mod process;
mod product;
mod record;
mod reproduce;
mod rooms;
mod sbom;
mod setup;
mod size;
mod test;
mod timing;
mod toolchain;
mod workspace;
mod zx0;

use args::Args;

/// The result of a job: nothing, or a message with the error and its remedy.
type Outcome<T = ()> = Result<T, String>;

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

/// The jobs, in the order in which a newcomer needs them.
const JOBS: &[Job] = &[
    Job {
        name: "demo",
        about: "the main job: flash, start, call back and flash again on an emulated board",
        help: demo::HELP,
        run: demo::run,
    },
    Job { name: "test", about: "every test, with one summary at the end", help: test::HELP, run: test::run },
    Job {
        name: "build",
        about: "the firmware of a board: bootloader and both versions of the application",
        help: build::HELP,
        run: build::run,
    },
    Job {
        name: "emulate",
        about: "an emulated board for other programs to talk to",
        help: emulate::HELP,
        run: emulate::run,
    },
    Job {
        name: "hil",
        about: "the main job and the update suite on a real board, through a debug probe",
        help: hil::HELP,
        run: hil::run,
    },
    Job {
        name: "layout",
        about: "the memory map of a board, or its linker fragment",
        help: layout::HELP,
        run: layout::run,
    },
    Job {
        name: "new-board",
        about: "the three files of a port, with steps to go through",
        help: new_board::HELP,
        run: new_board::run,
    },
    Job {
        name: "chips",
        about: "a board for every chip, built and updated in the emulator",
        help: chips::HELP,
        run: chips::run,
    },
    Job {
        name: "header",
        about: "the C header of the ABI between bootloader and application",
        help: header::HELP,
        run: header::run,
    },
    Job {
        name: "examples",
        about: "the programs in examples/, each built by its own tools",
        help: examples::HELP,
        run: examples::run,
    },
    Job {
        name: "diagrams",
        about: "the pictures of the documents, from text",
        help: diagrams::HELP,
        run: diagrams::run,
    },
    Job {
        name: "record",
        about: "the picture of the two windows, out of what the programs print",
        help: record::HELP,
        run: record::run,
    },
    Job { name: "docs", about: "the pages as a site, its links checked", help: book::HELP, run: book::run },
    Job { name: "eds", about: "the EDS files of bootloader and application", help: eds::HELP, run: eds::run },
    Job {
        name: "fuzz",
        about: "the fuzz targets, each for a while (nightly toolchain)",
        help: fuzz::HELP,
        run: fuzz::run,
    },
    Job {
        name: "deny",
        about: "licences and origins of the crates of others",
        help: deny::HELP,
        run: deny::run,
    },
    Job {
        name: "bench",
        about: "how fast a program gets into the device, beside the limits of wire and flash",
        help: bench::HELP,
        run: bench::run,
    },
    Job {
        name: "powercut",
        about: "cut the power at every flash operation, and look what is there",
        help: powercut::HELP,
        run: powercut::run,
    },
    Job {
        name: "reproduce",
        about: "two clones in two folders give the same firmware",
        help: reproduce::HELP,
        run: reproduce::run,
    },
    Job {
        name: "coverage",
        about: "which lines of the device's crates the tests reach",
        help: coverage::HELP,
        run: coverage::run,
    },
    Job {
        name: "mutants",
        about: "changes of the code that a test must notice",
        help: mutants::HELP,
        run: mutants::run,
    },
    Job {
        name: "evidence",
        about: "one page of what the last runs have measured",
        help: evidence::HELP,
        run: evidence::run,
    },
    Job {
        name: "attack",
        about: "the standing attacker of the bus, for millions of frames",
        help: attack::HELP,
        run: attack::run,
    },
    Job {
        name: "opinion",
        about: "the emulated CPU against QEMU's, word for word",
        help: opinion::HELP,
        run: opinion::run,
    },
    Job {
        name: "size",
        about: "the bootloader's flash against its budget",
        help: size::HELP,
        run: size::run,
    },
    Job {
        name: "pairs",
        about: "bootloaders with every pair of a product's choices: they build and fit",
        help: pairs::HELP,
        run: pairs::run,
    },
    Job {
        name: "arrows",
        about: "who depends on whom, against the rules of the house",
        help: arrows::HELP,
        run: arrows::run,
    },
    Job {
        name: "lint",
        about: "formatting, clippy and documentation, warnings denied",
        help: lint::HELP,
        run: lint::run,
    },
    Job {
        name: "sbom",
        about: "the software bills of materials of bootloader and host tool",
        help: sbom::HELP,
        run: sbom::run,
    },
    Job {
        name: "package",
        about: "what is handed out: archives, packages, wheel, sums; installed and run by --check",
        help: package::HELP,
        run: package::run,
    },
    Job {
        name: "portable",
        about: "the host tools' code compiles for Windows and macOS",
        help: portable::HELP,
        run: portable::run,
    },
    Job {
        name: "setup",
        about: "what the other jobs need on this machine, installed where missing",
        help: setup::HELP,
        run: setup::run,
    },
];

fn main() -> ExitCode {
    let mut words = std::env::args().skip(1);
    let outcome = match words.next().as_deref() {
        None | Some("help" | "--help" | "-h") => {
            print!("{}", overview());
            Ok(())
        }
        Some(name) => match JOBS.iter().find(|job| job.name == name) {
            None => Err(format!("there is no job \"{name}\".\n\n{}", overview())),
            Some(job) => {
                let args = Args::new(words);
                if args.asks_for_help() {
                    print!("{}", job.help);
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

fn overview() -> String {
    let mut text =
        String::from("usage: cargo xtask JOB [OPTIONS]    (cargo xtask JOB --help tells more)\n\n");
    for job in JOBS {
        text += &format!("  {:<9} {}\n", job.name, job.about);
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_job_has_a_help_text_that_starts_with_its_usage() {
        for job in JOBS {
            assert!(job.help.starts_with(&format!("usage: cargo xtask {}", job.name)), "{}", job.name);
            assert!(job.help.ends_with('\n'), "{}", job.name);
            assert!(overview().contains(job.about));
        }
    }
}
