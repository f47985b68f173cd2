//! All changes that cargo-mutants would make to a crate, in one build.
//!
//! cargo-mutants builds a crate again for each change, which takes hours. This program asks it for
//! the list, and writes every change into one copy of the sources, as a branch that a number in the
//! environment turns on. The tests are built once, and run once for each number.
//!
//! What cannot be a branch (a constant, the field of a struct) is left to cargo-mutants, and so is
//! the last word about a change that no test has noticed: `cargo xtask mutants` calls both.
//!
//! | module | what it does |
//! |---|---|
//! | [`list`] | what cargo-mutants would change |
//! | [`rewrite`] | the sources with a branch for each change |
//! | [`compile`] | builds the tests, and takes out what does not compile |
//! | [`run`] | runs the tests for each change |

#![forbid(unsafe_code)]

mod compile;
mod list;
mod rewrite;
mod run;

use std::fs;
use std::path::PathBuf;

use anyhow::{Context, Result};
use clap::Parser;

/// Runs the tests of a crate for each change that cargo-mutants would make to it.
#[derive(Parser)]
struct Arguments {
    /// The folder for the results and the copy of the sources.
    #[arg(long)]
    out: PathBuf,
    /// The package to change.
    #[arg(long)]
    package: String,
    /// Features to build with.
    #[arg(long, default_value = "")]
    features: String,
    /// The packages with the tests, separated by commas, if it is not the changed one alone.
    #[arg(long)]
    test_package: Option<String>,
    /// An argument for `cargo-mutants --list` that selects changes; may be repeated.
    #[arg(long = "select", allow_hyphen_values = true)]
    selection: Vec<String>,
    /// Arguments for `cargo test`.
    #[arg(last = true)]
    cargo: Vec<String>,
}

fn main() -> Result<()> {
    let arguments = Arguments::parse();
    let changes = list::changes(&arguments.package, &arguments.selection)?;
    println!("{}: {} changes", arguments.package, changes.len());
    let copy = arguments.out.join("sources");
    list::copy_sources(&copy)?;
    let tests = compile::Tests {
        package: &arguments.package,
        features: &arguments.features,
        packages: arguments.test_package.as_deref(),
        arguments: &arguments.cargo,
        target: arguments.out.join("target"),
    };
    let built = compile::build(&tests, &copy, &changes)?;
    let ends = run::all(&built.programs, &built.active, &arguments.out)?;
    let mut lists = [
        ("caught", String::new()),
        ("missed", String::new()),
        ("unviable", String::new()),
        ("alone", String::new()),
    ];
    for (number, change) in changes.iter().enumerate() {
        let end = match ends.get(&number) {
            Some(true) => 0,
            Some(false) => 1,
            None if built.unviable.contains(&number) => 2,
            None => 3,
        };
        lists[end].1 += &format!("{}\n", change.name);
    }
    for (name, lines) in lists {
        println!("  {name:<9} {:>5}", lines.lines().count());
        let file = arguments.out.join(name).with_extension("txt");
        fs::write(&file, lines).with_context(|| file.display().to_string())?;
    }
    Ok(())
}
