//! `cargo xtask eds`: the EDS files, from the tables that the firmware serves.

use std::fs;

use crate::args::Args;
use crate::setup::{Part, Setup};
use crate::{process, workspace, Outcome};

pub const HELP: &str = "\
usage: cargo xtask eds [--out FOLDER] [--yes]

Writes the electronic data sheets of bootloader and application template (CiA 306-1), for
configuration tools and masters. They are made from the tables of the object dictionaries; run this
after a change there, a test compares.

  --out FOLDER    where to (default: docs/eds)
  --yes           installs what is missing with sudo
";

pub fn run(mut args: Args) -> Outcome {
    let out = args.value("--out")?;
    let setup = Setup::from(&mut args);
    args.none_left()?;
    // The crate that makes them is also that of the emulated tests.
    setup.prepare(&[Part::Emulator])?;
    let folder = out.map_or_else(|| workspace::root().join("docs/eds"), Into::into);
    fs::create_dir_all(&folder)
        .map_err(|error| format!("{} cannot be made: {error}.", workspace::shown(&folder)))?;
    let mut eds = process::cargo("run");
    eds.args(["--quiet", "--package", "coboot-tests", "--bin", "eds", "--"]).arg(&folder);
    process::run(&mut eds)
}
