//! `cargo xtask mutants`: would the tests notice a mistake?

mod reasons;

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsStr;
use std::fmt::Write;
use std::fs;
use std::path::Path;
use std::process::Command;

use crate::args::Args;
use crate::json::{quoted, Value};
use crate::setup::{self, Part, Setup};
use crate::{coverage, evidence, process, workspace, Outcome};

pub const HELP: &str = "\
usage: cargo xtask mutants [--package NAME] [--file GLOB] [--shard K/N] [--yes]

Changes the code of the crates that the device is made of, in one place at a time, as cargo-mutants
does, and runs the tests of that crate: each change must make one fail. Prints what no test noticed,
and counts; they go to target/evidence/mutants.json. It fails if a group of files has too few of its
changes noticed, once all crates are measured, or if a change stays unnoticed that
xtask/src/mutants/reasons.rs does not name.

  --package NAME  this crate alone: coboot-abi, coboot-canopen, coboot-core, coboot-app or coboot-seal;
                  what was measured of the others is kept, if nothing of theirs has changed since
  --file GLOB     the changes in these files alone, as '**/store/*.rs'; nothing is recorded
  --shard K/N     every N-th change, beginning with the K-th from 0: a sample; nothing is recorded
  --yes           install Debian's packages without asking

All changes of a package stand in one build, and a variable turns one on (mutants/); what cannot stand
there, and what no test has noticed and has no reason, is then built one by one. cargo-mutants is installed into
target/tools where it is missing, Debian's packages for the tests with signatures by apt-get.
";

/// The version to install if there is none.
const VERSION: &str = "27.1.0";

/// The changes of a package that are tried with the same tests.
struct Run {
    package: &'static str,
    /// The files that this run does not change, as globs.
    but: &'static [&'static str],
    /// A run with other features, behind one without: changes the files that begin with these, and
    /// what the run before has not noticed, because it may not have been built there.
    only: &'static [&'static str],
    features: &'static str,
    /// The tests are those of the objects and of sealed images alone.
    with_sealed_tests: bool,
}

impl Run {
    const fn of(package: &'static str) -> Self {
        Self { package, but: &[], only: &[], features: "", with_sealed_tests: false }
    }
}

/// The tests of sealed images, as arguments; each of them behind `before`.
fn sealed_tests(before: &str) -> Vec<String> {
    let tests = ["objects"].iter().chain(&coverage::SEALED_TESTS);
    tests.map(|test| format!("{before}--test={test}")).collect()
}

/// The crates with the tests of sealed images.
const SEALED_PACKAGES: &str = "--test-package=coboot-core,coboot-tests";

/// What the changes and the tests of a package are made of, as the beginnings of paths; of another crate
/// without its tests.
const READS: [(&str, &[&str]); 5] = [
    ("coboot-abi", &["shared-abi/"]),
    ("coboot-canopen", &["canopen/"]),
    (
        "coboot-core",
        // The tests with sealed images stand beside the emulated tests, whose crate needs host tool,
        // emulator and node. What else that crate holds, as the attacker, ends no result.
        &[
            "boot-core/",
            "tests/Cargo.toml",
            "tests/src/ihex.rs",
            "tests/src/lib.rs",
            "tests/src/powercut",
            "tests/src/sealed",
            "tests/tests/sealed_",
            "shared-abi/src/",
            "canopen/src/",
            "seal/src/",
            "coboot-app/src/",
            "coflash/src/",
            "emulator/src/",
            "node/src/",
        ],
    ),
    ("coboot-app", &["coboot-app/", "shared-abi/src/", "canopen/src/"]),
    ("coboot-seal", &["seal/"]),
];
/// What all of them are made of and measured with. The reasons are none of it: they are looked up anew.
const READ_BY_ALL: [&str; 4] = ["Cargo.toml", "Cargo.lock", "mutants/", "xtask/src/mutants.rs"];

/// Whether the result of a package may be another after a change of this file.
fn is_read(package: &str, file: &str) -> bool {
    let own = READS.iter().filter(|(name, _)| *name == package).flat_map(|(_, folders)| *folders);
    own.chain(&READ_BY_ALL).any(|begin| file.starts_with(begin))
}

/// Code in place of sealed images and of resume, in which there is nothing to do.
const ABSENT: &str = "boot-core/src/*/absent.rs";

/// The crates without an operating system below them.
const RUNS: &[Run] = &[
    Run::of("coboot-abi"),
    Run::of("coboot-canopen"),
    Run {
        but: &["boot-core/src/unseal/*.rs", "boot-core/src/intake/sealed.rs", ABSENT],
        ..Run::of("coboot-core")
    },
    // Its tests need images with signatures, which the crate of the emulated tests makes.
    Run {
        but: &[ABSENT],
        only: &["boot-core/src/unseal/", "boot-core/src/intake/sealed.rs"],
        features: "coboot-core/sealed",
        with_sealed_tests: true,
        ..Run::of("coboot-core")
    },
    Run::of("coboot-app"),
    Run::of("coboot-seal"),
];

/// Where a mistake costs a device: what decides, what is stored, and what checks a signature.
const STRICT: [&str; 6] = [
    "boot-core/src/store/",
    "boot-core/src/decision.rs",
    "boot-core/src/programmer/",
    "boot-core/src/control/",
    "shared-abi/src/callgate.rs",
    "seal/src/",
];
/// The least share of the changes that the tests notice there, and elsewhere, in percent.
const LIMITS: [(&str, f64); 2] = [("strict", 95.0), ("other", 90.0)];

/// The group of a file: an index into [`LIMITS`].
fn group(file: &str) -> usize {
    usize::from(!STRICT.iter().any(|part| file.starts_with(part)))
}

/// What became of a change, with the file in which cargo-mutants lists it.
const ENDS: [(&str, &str); 4] = [
    ("caught", "caught.txt"),
    ("missed", "missed.txt"),
    // A test that never ends notices the change, too.
    ("timeout", "timeout.txt"),
    ("unviable", "unviable.txt"),
];

/// The counts of one file.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
struct Row {
    package: String,
    /// The commit of the run.
    commit: String,
    caught: u32,
    unviable: u32,
    /// The changes that no test has noticed.
    unnoticed: Vec<String>,
}

impl Row {
    /// How many are unnoticed and have a reason, and how many have none.
    fn named_and_missed(&self, file: &str) -> (u32, u32) {
        let named = self.unnoticed.iter().filter(|change| reason(file, change).is_some()).count();
        (named as u32, (self.unnoticed.len() - named) as u32)
    }

    fn viable(&self) -> u32 {
        self.caught + self.unnoticed.len() as u32
    }
}

type Rows = BTreeMap<String, Row>;

pub fn run(mut args: Args) -> Outcome {
    let (package, file, shard) = (args.value("--package")?, args.value("--file")?, args.value("--shard")?);
    let setup = Setup::from(&mut args);
    args.none_left()?;
    let is_chosen = |run: &&Run| package.as_deref().is_none_or(|name| name == run.package);
    let runs: Vec<&Run> = RUNS.iter().filter(is_chosen).collect();
    if let (Some(name), []) = (&package, &runs[..]) {
        let mut known: Vec<&str> = RUNS.iter().map(|run| run.package).collect();
        known.dedup();
        return Err(format!("there is no crate \"{name}\"; there is: {}.", known.join(", ")));
    }
    if runs.iter().any(|run| run.with_sealed_tests) {
        // The crate with those tests builds the emulator, too.
        setup.prepare(&[Part::Emulator])?;
    }
    let path = setup::tool("cargo-mutants", VERSION)?;
    let is_sample = file.is_some() || shard.is_some();
    let mut rows = match package {
        Some(package) => {
            let holds = |of: &str, commit: &str| evidence::is_unchanged(commit, |file| is_read(of, file));
            kept(evidence::recorded("mutants").as_ref(), holds, &package)
        }
        None => Rows::new(),
    };
    if !is_sample {
        evidence::record("mutants", &as_json(&rows, true))?;
    }
    let out = |number: usize| {
        let name = format!("{}-{number}", runs[number].package);
        workspace::target_dir().join("mutants").join(name)
    };
    // What one run notices is noticed. First all runs in one build each, which are quick: only what
    // none of them has noticed is built one by one.
    let (mut ends, mut tried) = (Ends::new(), Vec::new());
    for (number, run) in runs.iter().enumerate() {
        let again: Vec<String> = match run.only {
            [] => Vec::new(),
            only => {
                let files = only.iter().map(|file| format!("^{}", exactly(file)));
                files.chain(unnoticed(&ends, run).iter().map(|line| whole(line))).collect()
            }
        };
        let mut selection: Vec<String> = run.but.iter().map(|glob| format!("--exclude={glob}")).collect();
        selection.extend(file.iter().map(|glob| format!("--file={glob}")));
        selection.extend(shard.iter().map(|part| format!("--shard={part}")));
        selection.extend(again.into_iter().map(|name| format!("--re={name}")));
        let found = in_one_build(run, &selection, &path, &out(number))?;
        tried.push(found.keys().cloned().collect::<BTreeSet<String>>());
        merge(&mut ends, run, found);
    }
    for (number, run) in runs.iter().enumerate() {
        let left = to_build(&ends, run, &tried[number]);
        if !left.is_empty() {
            println!("{}: {} changes are built one by one", run.package, left.len());
            merge(&mut ends, run, one_by_one(run, &left, &path, &out(number))?);
        }
    }
    let commit = evidence::commit();
    let mut unnamed = Vec::new();
    for ((package, line), end) in ends {
        let Some((file, change)) = parts(&line) else { continue };
        let row = rows.entry(file.clone()).or_default();
        package.clone_into(&mut row.package);
        commit.clone_into(&mut row.commit);
        match end {
            "unviable" => row.unviable += 1,
            // What cargo-mutants gives no result for was not noticed either.
            "missed" | "alone" => {
                row.unnoticed.push(change.to_owned());
                if reason(&file, change).is_none() {
                    unnamed.push(line);
                }
            }
            _ => row.caught += 1,
        }
    }
    if !unnamed.is_empty() {
        println!("\nNo test noticed, and no reason is given for:\n{}\n", unnamed.join("\n"));
    }
    // A group has files of several crates: the limit is for all of them.
    let is_complete = READS.iter().all(|(name, _)| rows.values().any(|row| row.package == *name));
    let mut low = Vec::new();
    for (group_index, (name, limit)) in LIMITS.iter().enumerate() {
        let (caught, viable) = sums(&rows, group_index);
        let of_all = if is_complete { "" } else { " of all crates together, and some are not measured" };
        println!(
            "{name}: {caught} of {viable} noticed, {:.1} %; at least {limit} %{of_all}",
            share(caught, viable)
        );
        if is_complete && share(caught, viable) < *limit {
            low.push(*name);
        }
    }
    if is_sample {
        return Ok(());
    }
    evidence::record("mutants", &as_json(&rows, false))?;
    match (&low[..], unnamed.len()) {
        ([], 0) => Ok(()),
        ([], count) => Err(format!("no test noticed {count} changes that have no reason; they stand above.")),
        (low, _) => Err(format!("too few changes were noticed in: {}.", low.join(", "))),
    }
}

/// What became of the changes of a run, by the line that names one.
type Found = BTreeMap<String, &'static str>;

/// The same of all runs, by package and line.
type Ends = BTreeMap<(&'static str, String), &'static str>;

/// Adds what a run has found. What was not built in this run keeps the end that it had.
fn merge(ends: &mut Ends, run: &Run, found: Found) {
    for (line, end) in found {
        let before = ends.entry((run.package, line)).or_insert(end);
        if end != "unviable" || *before == "alone" {
            *before = end;
        }
    }
}

/// The changes of a run's package that no run before has noticed.
fn unnoticed(ends: &Ends, run: &Run) -> Vec<String> {
    let left = ends
        .iter()
        .filter(|((package, _), end)| *package == run.package && matches!(**end, "missed" | "alone"));
    left.map(|((_, line), _)| line.clone()).collect()
}

/// The changes of a run that are built one by one. With a reason it is known that no test notices it;
/// but a reason is for all changes of a file with the same words, and those that could not stand in the
/// one build have not been tried yet.
fn to_build(ends: &Ends, run: &Run, selected: &BTreeSet<String>) -> Vec<String> {
    let has_reason = |line: &str| parts(line).is_some_and(|(file, change)| reason(&file, change).is_some());
    let is_left = |((package, line), end): &(&(&str, String), &&str)| {
        *package == run.package
            && selected.contains(line)
            && (**end == "alone" || **end == "missed" && !has_reason(line))
    };
    ends.iter().filter(is_left).map(|((_, line), _)| line.clone()).collect()
}

/// Tries the changes that can stand side by side in one build (mutants/). Those that no test has
/// noticed may be noticed by an example in the documentation, which takes no part there.
fn in_one_build(run: &Run, selection: &[String], path: &OsStr, out: &Path) -> Outcome<Found> {
    let mut all = process::cargo("run");
    all.args(["--quiet", "--package", "coboot-mutants", "--", "--package", run.package, "--out"]).arg(out);
    all.env("PATH", path).current_dir(workspace::root());
    all.args(selection.iter().map(|part| format!("--select={part}")));
    if !run.features.is_empty() {
        all.args(["--features", run.features]);
    }
    if run.with_sealed_tests {
        all.args([SEALED_PACKAGES, "--"]).args(sealed_tests(""));
    }
    process::run(&mut all)?;
    let lists = ["caught", "missed", "unviable", "alone"].map(|end| (end, format!("{end}.txt")));
    Ok(found_in(out, &lists))
}

/// Tries these changes with cargo-mutants.
fn one_by_one(run: &Run, names: &[String], path: &OsStr, out: &Path) -> Outcome<Found> {
    let mut mutants = Command::new("cargo-mutants");
    mutants.env("PATH", path).current_dir(workspace::root());
    // One crate is built again for each change: what was built before counts, and nobody
    // debugs it.
    mutants.envs([("CARGO_INCREMENTAL", "1"), ("CARGO_PROFILE_DEV_DEBUG", "0")]);
    mutants.args(["mutants", "--package", run.package, "--output"]).arg(out);
    mutants.args(["--no-shuffle", "--colors", "never", "--jobs", "2"]);
    mutants.args(names.iter().flat_map(|name| ["--re".to_owned(), whole(name)]));
    if !run.features.is_empty() {
        mutants.args(["--features", run.features]);
    }
    if run.with_sealed_tests {
        // Without a change, cargo-mutants would look for these tests in the changed crate alone; they
        // have passed in the one build. The first build compiles the emulator, too.
        mutants.args(["--baseline=skip", "--timeout=300", "--build-timeout=1200"]);
        // For the build, too: the other tests need not be built.
        mutants.arg(SEALED_PACKAGES).args(sealed_tests("--cargo-arg="));
    } else {
        // The compiler computes the constants: a change can make it compute for ever.
        mutants.args(["--timeout-multiplier=3", "--build-timeout=180"]);
    }
    // It fails if a change was missed, or a build took too long, which are results.
    let status = mutants.status().map_err(|error| process::not_started(&mutants, &error))?;
    let known = [0, 2, 3];
    if !status.code().is_some_and(|code| known.contains(&code)) {
        return Err(format!("cargo-mutants failed ({status}); what it printed above says why."));
    }
    let mut found = found_in(&out.join("mutants.out"), &ENDS.map(|(end, list)| (end, list.to_owned())));
    // It also tries every removal of a field, whatever it is asked for: another run has noticed those.
    found.retain(|line, _| names.contains(line));
    Ok(found)
}

fn found_in(folder: &Path, lists: &[(&'static str, String)]) -> Found {
    let mut found = Found::new();
    for (end, list) in lists {
        let list = fs::read_to_string(folder.join(list)).unwrap_or_default();
        found.extend(list.lines().map(|line| (line.to_owned(), *end)));
    }
    found
}

/// The regular expression that matches this name and no other.
fn whole(name: &str) -> String {
    format!("^{}$", exactly(name))
}

/// A text as the regular expression that matches it.
fn exactly(text: &str) -> String {
    let is_meta = |letter: &char| r"\.+*?()|[]{}^$#&-~".contains(*letter);
    text.chars().flat_map(|letter| is_meta(&letter).then_some('\\').into_iter().chain([letter])).collect()
}

/// The file and the change of a line of a list: `boot-core/src/flash.rs:12:5: replace ...`.
fn parts(line: &str) -> Option<(String, &str)> {
    let (file, rest) = line.split_once(".rs:")?;
    let change = rest.splitn(3, ':').nth(2)?.trim();
    Some((format!("{}.rs", file.replace('\\', "/")), change))
}

/// Why no test can notice a change, or need not.
fn reason(file: &str, change: &str) -> Option<&'static str> {
    let is_it = |named: &&(&str, &str, &'static str)| named.0 == file && named.1 == change;
    reasons::REASONS.iter().find(is_it).map(|(_, _, why)| *why)
}

fn sums(rows: &Rows, of: usize) -> (u32, u32) {
    let chosen = rows.iter().filter(|(file, _)| group(file) == of).map(|(_, row)| row);
    chosen.fold((0, 0), |(caught, viable), row| (caught + row.caught, viable + row.viable()))
}

fn share(caught: u32, viable: u32) -> f64 {
    if viable == 0 {
        100.0
    } else {
        f64::from(caught) / f64::from(viable) * 100.0
    }
}

/// What was recorded of the other packages, as far as it holds for the sources as they are.
fn kept(record: Option<&Value>, holds: impl Fn(&str, &str) -> bool, package: &str) -> Rows {
    let count = |row: &Value, name| row.get(name).number().map(|count| count as u32);
    let row = |row: &Value| {
        let [package, commit] = ["package", "commit"].map(|name| row.get(name).text().map(str::to_owned));
        let [caught, unviable] = ["caught", "unviable"].map(|name| count(row, name));
        let unnoticed = row.get("unnoticed").items().iter();
        let unnoticed = unnoticed.filter_map(|row| row.get("change").text()).map(str::to_owned);
        let counts = Row {
            package: package?,
            commit: commit?,
            caught: caught?,
            unviable: unviable?,
            unnoticed: unnoticed.collect(),
        };
        Some((row.get("file").text()?.to_owned(), counts))
    };
    let rows = record.map_or(&[][..], |record| record.get("files").items()).iter().filter_map(row);
    rows.filter(|(_, row)| row.package != package && holds(&row.package, &row.commit)).collect()
}

fn as_json(rows: &Rows, is_unfinished: bool) -> String {
    let mut text = String::from("{");
    if is_unfinished {
        text += "\"unfinished\": true, ";
    }
    let groups = LIMITS.iter().enumerate().map(|(index, (name, limit))| {
        let (caught, viable) = sums(rows, index);
        let share = share(caught, viable);
        format!(
            "{{\"group\": {}, \"viable\": {viable}, \"caught\": {caught}, \"percent\": {share:.1}, \"least\": {limit}}}",
            quoted(name)
        )
    });
    let _ = write!(text, "\"groups\": [{}]", groups.collect::<Vec<_>>().join(", "));
    let left = READS.iter().filter(|(package, _)| !rows.values().any(|row| row.package == *package));
    let left = left.map(|(package, _)| quoted(package)).collect::<Vec<_>>().join(", ");
    let reads = READS.iter().flat_map(|(_, folders)| *folders).chain(&READ_BY_ALL);
    let reads = reads.map(|begin| quoted(begin)).collect::<Vec<_>>().join(", ");
    let _ = write!(text, ", \"left\": [{left}], \"reads\": [{reads}]");
    let files = rows.iter().map(|(file, row)| {
        let (named, missed) = row.named_and_missed(file);
        let unnoticed = row.unnoticed.iter().map(|change| {
            let why = reason(file, change).map_or("null".to_owned(), quoted);
            format!("{{\"change\": {}, \"why\": {why}}}", quoted(change))
        });
        let unnoticed = unnoticed.collect::<Vec<_>>();
        format!(
            "\n{{\"file\": {}, \"package\": {}, \"commit\": {}, \"caught\": {}, \"named\": {named}, \
             \"missed\": {missed}, \"unviable\": {}, \"unnoticed\": [{}]}}",
            quoted(file),
            quoted(&row.package),
            quoted(&row.commit),
            row.caught,
            row.unviable,
            unnoticed.join(", ")
        )
    });
    let _ = write!(text, ", \"files\": [{}]", files.collect::<Vec<_>>().join(","));
    let sum = |of: fn(&Row) -> u32| rows.values().map(of).sum::<u32>();
    let (named, missed) = rows
        .iter()
        .map(|(file, row)| row.named_and_missed(file))
        .fold((0, 0), |sums, of| (sums.0 + of.0, sums.1 + of.1));
    let _ = write!(
        text,
        ", \"viable\": {}, \"caught\": {}, \"named\": {named}, \"missed\": {missed}}}",
        sum(Row::viable),
        sum(|row| row.caught)
    );
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_names_its_file_and_its_change() {
        let line = "boot-core/src/store/mod.rs:12:5: replace Journal::open -> Self with Default::default()";
        let (file, change) = parts(line).unwrap();
        assert_eq!(file, "boot-core/src/store/mod.rs");
        assert_eq!(change, "replace Journal::open -> Self with Default::default()");
        assert_eq!(parts("nothing"), None);
        assert_eq!(exactly("a/b.rs:1: replace + with <T>"), r"a/b\.rs:1: replace \+ with <T>");
    }

    #[test]
    fn what_one_run_notices_is_noticed() {
        let [first, second] = [Run::of("coboot-core"), Run { only: &["a"], ..Run::of("coboot-core") }];
        let found = |lines: [(&str, &'static str); 5]| lines.map(|(line, end)| (line.to_owned(), end)).into();
        let mut ends = Ends::new();
        merge(
            &mut ends,
            &first,
            found([("a", "caught"), ("b", "missed"), ("c", "alone"), ("d", "alone"), ("e", "missed")]),
        );
        assert_eq!(unnoticed(&ends, &second), ["b", "c", "d", "e"]);
        assert!(unnoticed(&ends, &Run::of("coboot-app")).is_empty());
        merge(
            &mut ends,
            &second,
            found([("b", "caught"), ("c", "missed"), ("d", "unviable"), ("e", "unviable"), ("f", "timeout")]),
        );
        assert_eq!(unnoticed(&ends, &second), ["c", "e"], "what one run cannot build, another has missed");
    }

    #[test]
    fn a_change_that_was_not_tried_is_built_although_its_words_have_a_reason() {
        let (file, change, _) = reasons::REASONS[0];
        let line = |number: u32| format!("{file}:{number}:1: {change}");
        let other = format!("{file}:9:1: replace this with that");
        let run = Run::of("coboot-core");
        let ends: Ends =
            [(line(1), "alone"), (line(2), "missed"), (line(3), "caught"), (other.clone(), "missed")]
                .map(|(line, end)| ((run.package, line), end))
                .into();
        let selected = ends.keys().map(|(_, line)| line.clone()).collect();
        assert_eq!(to_build(&ends, &run, &selected), [line(1), other]);
        assert!(to_build(&ends, &run, &BTreeSet::new()).is_empty());
        assert!(to_build(&ends, &Run::of("coboot-app"), &selected).is_empty());
    }

    #[test]
    fn the_files_of_a_group_are_those_that_the_device_stands_on() {
        let groups = ["boot-core/src/store/node.rs", "boot-core/src/decision.rs", "boot-core/src/queue.rs"];
        assert_eq!(groups.map(group), [0, 0, 1]);
        for part in STRICT {
            assert!(workspace::root().join(part).exists(), "{part}");
        }
    }

    #[test]
    fn every_reason_is_of_a_file_that_is_there() {
        for (file, change, why) in reasons::REASONS {
            assert!(workspace::root().join(file).is_file(), "{file}");
            assert!(!change.is_empty() && why.ends_with('.'), "{file}: {change}");
        }
    }

    #[test]
    fn what_is_recorded_is_kept_of_another_package_while_it_holds() {
        let row = |package: &str, caught, unnoticed: &[&str]| Row {
            package: package.into(),
            commit: "12".into(),
            caught,
            unviable: 3,
            unnoticed: unnoticed.iter().map(|change| (*change).to_owned()).collect(),
        };
        let (file, change, _) =
            reasons::REASONS.iter().find(|(file, ..)| file.starts_with("canopen/")).unwrap();
        let rows = Rows::from([
            ("seal/src/lib.rs".to_owned(), row("coboot-seal", 17, &["a \"b\"", "c", "d"])),
            ((*file).to_owned(), row("coboot-canopen", 9, &[change])),
        ]);
        let record = Value::parse(&as_json(&rows, false)).unwrap();
        assert_eq!(record.get("viable").number(), Some(30.0));
        assert_eq!(record.get("groups").items()[0].get("percent").number(), Some(85.0));
        assert_eq!(record.get("groups").items()[1].get("percent").number(), Some(90.0));
        assert_eq!(["named", "missed"].map(|name| record.get(name).number()), [Some(1.0), Some(3.0)]);
        let left: Vec<_> = record.get("left").items().iter().filter_map(Value::text).collect();
        assert_eq!(left, ["coboot-abi", "coboot-core", "coboot-app"]);
        let files = |rows: Rows| rows.into_keys().collect::<Vec<_>>();
        let same = |_: &str, of: &str| of == "12";
        assert_eq!(kept(Some(&record), same, "coboot-app"), rows);
        assert_eq!(files(kept(Some(&record), same, "coboot-seal")), [*file]);
        let only_seal = |package: &str, _: &str| package == "coboot-seal";
        assert_eq!(files(kept(Some(&record), only_seal, "coboot-app")), ["seal/src/lib.rs"]);
        assert!(kept(None, same, "coboot-app").is_empty());
    }

    #[test]
    fn a_package_has_the_folders_of_what_it_is_made_of() {
        for run in RUNS {
            assert!(READS.iter().any(|(package, _)| *package == run.package), "{}", run.package);
        }
        for begin in READS.iter().flat_map(|(_, begins)| *begins) {
            let (folder, name) = begin.rsplit_once('/').unwrap();
            let mut files = fs::read_dir(workspace::root().join(folder)).unwrap();
            let begins = |file: &str| file.starts_with(name);
            assert!(files.any(|file| begins(&file.unwrap().file_name().to_string_lossy())), "{begin}");
        }
        assert!(
            is_read("coboot-canopen", "canopen/src/lib.rs")
                && !is_read("coboot-canopen", "boot-core/src/lib.rs")
        );
        assert!(
            is_read("coboot-core", "canopen/src/lib.rs")
                && is_read("coboot-core", "tests/tests/sealed_model.rs")
                && !is_read("coboot-core", "tests/src/attacker/board.rs")
                && !is_read("coboot-core", "canopen/tests/lss.rs")
                && !is_read("coboot-abi", "xtask/src/mutants/reasons.rs")
        );
        assert!(is_read("coboot-seal", "Cargo.lock") && !is_read("coboot-seal", "xtask/src/main.rs"));
    }
}
