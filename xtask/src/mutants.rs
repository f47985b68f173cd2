//! `cargo xtask mutants`: would the tests notice a mistake?

use std::collections::BTreeMap;
use std::fmt::Write;
use std::fs;
use std::path::Path;
use std::process::Command;

use crate::args::Args;
use crate::{evidence, process, setup, workspace, Outcome};

pub const HELP: &str = "\
usage: cargo xtask mutants [--package NAME] [--file GLOB] [--shard K/N]

Changes the code of the crates that the device is made of, in one place at a time (cargo-mutants), and
runs the crate's own tests: each change must make one fail. Prints what no test noticed, and counts;
they go to target/evidence/mutants.json.

  --package NAME  this crate alone: coboot-abi, coboot-canopen, coboot-core, coboot-app or coboot-seal
  --file GLOB     the changes in these files alone, as '**/store/*.rs'
  --shard K/N     every N-th change, beginning with the K-th from 0: a sample

All of it takes many hours. cargo-mutants is installed into target/tools where it is missing.
";

/// The version to install if there is none.
const VERSION: &str = "27.1.0";
/// The crates without an operating system below them.
const PACKAGES: [&str; 5] = ["coboot-abi", "coboot-canopen", "coboot-core", "coboot-app", "coboot-seal"];

/// What became of a change, with the file in which cargo-mutants lists it.
const ENDS: [(&str, &str); 4] = [
    ("caught", "caught.txt"),
    ("missed", "missed.txt"),
    // A test that never ends notices the change, too.
    ("timeout", "timeout.txt"),
    ("unviable", "unviable.txt"),
];

pub fn run(mut args: Args) -> Outcome {
    let (package, file, shard) = (args.value("--package")?, args.value("--file")?, args.value("--shard")?);
    args.none_left()?;
    let packages: Vec<&str> = match &package {
        None => PACKAGES.to_vec(),
        Some(name) => match PACKAGES.iter().find(|known| *known == name) {
            Some(known) => vec![known],
            None => return Err(format!("there is no crate \"{name}\"; there is: {}.", PACKAGES.join(", "))),
        },
    };
    let path = setup::tool("cargo-mutants", VERSION)?;
    evidence::begin("mutants")?;
    let mut counts: BTreeMap<String, [u32; 4]> = BTreeMap::new();
    for package in packages {
        let out = workspace::target_dir().join("mutants").join(package);
        let _ = fs::remove_dir_all(&out);
        fs::create_dir_all(&out)
            .map_err(|error| format!("{} cannot be written: {error}.", workspace::shown(&out)))?;
        let mut mutants = Command::new("cargo-mutants");
        mutants.env("PATH", &path).current_dir(workspace::root());
        mutants.args(["mutants", "--package", package, "--output"]).arg(&out);
        mutants.args(["--no-shuffle", "--colors", "never", "--jobs", "2"]);
        mutants.args(file.iter().flat_map(|glob| ["--file", glob]));
        mutants.args(shard.iter().flat_map(|part| ["--shard", part]));
        // It fails if a change was missed, which is a result.
        let status = mutants.status().map_err(|error| process::not_started(&mutants, &error))?;
        let known = [0, 2, 3];
        if !status.code().is_some_and(|code| known.contains(&code)) {
            return Err(format!("cargo-mutants failed ({status}); what it printed above says why."));
        }
        for (end, (_, list)) in ENDS.iter().enumerate() {
            let list = fs::read_to_string(out.join("mutants.out").join(list)).unwrap_or_default();
            for file in list.lines().filter_map(file_of) {
                counts.entry(file).or_default()[end] += 1;
            }
        }
        print_missed(&out.join("mutants.out/missed.txt"));
    }
    evidence::record("mutants", &as_json(&counts)).map(drop)
}

/// The file of a line of a list: `boot-core/src/flash.rs:12:5: replace ...`.
fn file_of(line: &str) -> Option<String> {
    let (file, _) = line.split_once(".rs:")?;
    Some(format!("{}.rs", file.replace('\\', "/")))
}

fn print_missed(list: &Path) {
    let missed = fs::read_to_string(list).unwrap_or_default();
    if !missed.is_empty() {
        println!("\nNo test noticed:\n{missed}");
    }
}

fn as_json(counts: &BTreeMap<String, [u32; 4]>) -> String {
    let sum = |end: usize| counts.values().map(|ends| ends[end]).sum::<u32>();
    let (noticed, missed) = (sum(0) + sum(2), sum(1));
    let mut rows = String::new();
    for (n, (file, [caught, missed, timeout, unviable])) in counts.iter().enumerate() {
        let comma = if n == 0 { "" } else { "," };
        let _ = write!(
            rows,
            "{comma}\n{{\"file\": \"{file}\", \"caught\": {}, \"missed\": {missed}, \"unviable\": {unviable}}}",
            caught + timeout
        );
    }
    format!(
        "{{\"viable\": {}, \"caught\": {noticed}, \"missed\": {missed}, \"unviable\": {}, \"files\": [{rows}]}}",
        noticed + missed,
        sum(3)
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::json::Value;

    #[test]
    fn a_line_names_its_file() {
        let line = "boot-core/src/store/mod.rs:12:5: replace Journal::open -> Self with Default::default()";
        assert_eq!(file_of(line).as_deref(), Some("boot-core/src/store/mod.rs"));
        assert_eq!(file_of("nothing"), None);
    }

    #[test]
    fn what_never_ends_is_noticed() {
        let counts = BTreeMap::from([("a.rs".to_owned(), [5, 1, 2, 3]), ("b.rs".to_owned(), [1, 0, 0, 0])]);
        let value = Value::parse(&as_json(&counts)).unwrap();
        let number = |name| value.get(name).number();
        assert_eq!(["viable", "caught", "missed", "unviable"].map(number), [9.0, 8.0, 1.0, 3.0].map(Some));
        assert_eq!(value.get("files").items()[0].get("caught").number(), Some(7.0));
    }
}
