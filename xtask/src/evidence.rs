//! `cargo xtask evidence`: one page of what the jobs have measured of one commit.
//!
//! A job writes `target/evidence/NAME.json`; a job that runs in parts, `NAME-PART.json`. It is one
//! object with `commit`, `clean` (whether the sources were those of the commit), `toolchain` (the
//! line of `rustc --version`) and `date` (UTC, ISO 8601); the rest is the job's own. `failed` there
//! is a count that must be 0. A job that has begun and not ended leaves `unfinished`.

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::{json, Value};

use crate::args::Args;
use crate::{files, outcome::Outcome, process, toolchain, workspace};

pub const HELP: &str = "\
usage: cargo xtask evidence [--release]

Writes target/evidence/evidence.md: one page of what the jobs have measured of the commit that is
checked out. It runs nothing itself. A part of which there is no result of this commit says so and
names the command; results of other commits and of changed sources do not count.

  --release   writes docs/evidence.md, too: the figures of a release, with date and commit
";

/// The parts of the page: the name of the record, its member that is the result in one number, the job that makes the
/// record, and what it shows.
const PARTS: [[&str; 4]; 12] = [
    ["tests", "passed", "test", "All host crates, and the built firmware in the emulator."],
    ["powercut", "states", "powercut --full", "After a cut the device answers or runs a whole program."],
    ["attacker", "frames", "attack", "A seeded attacker and a legal master on one bus."],
    ["silicon", "chips", "attack --silicon 2000", "The main scenarios on chips that seeds draw."],
    ["fuzz", "inputs", "fuzz", "Random inputs for what meets the bus or a file."],
    ["cpu", "words", "opinion", "The same programs on QEMU's Cortex-M4 and on the emulator."],
    ["coverage", "percent", "coverage", "Lines of the device's crates that tests reach."],
    ["mutants", "tried", "mutants", "Changes of the code that the tests must notice."],
    ["bench", "percent", "bench --json", "A download, in percent of what wire and flash allow."],
    ["reproduce", "compared", "reproduce", "Two clones in two folders give the same firmware."],
    ["sbom", "bills", "sbom", "The crates in bootloader and host tool, as CycloneDX."],
    ["size", "bootloaders", "size", "The bootloader's flash on each board, against its budget."],
];

/// What no run here can show.
const NOT_VERIFIED: &str = "Nothing here ran on silicon. The emulated chip follows the reference manual, and the \
    emulator's authors read it: an error of theirs would be in both. Transceivers, termination, clock tolerance, \
    brown-out levels, the wear of the flash and the erase times of a real device are not verified. `cargo xtask hil` \
    runs the same tests on a board.";

pub fn run(mut args: Args) -> Outcome {
    let is_release = args.flag("--release");
    args.none_left()?;
    let (commit, clean) = sources();
    let mut records = Vec::new();
    files::make(&folder())?;
    for file in files::within(&folder())?.iter().filter(|file| files::is(file, "json")) {
        let record = process::json(&files::text(file)?).unwrap_or(Value::Null);
        records.push((file.file_stem().unwrap_or_default().to_string_lossy().into_owned(), record));
    }
    let results = results(&commit, &records);
    if !clean {
        println!("The sources have changed since commit {commit}; the page is about that commit.");
    }
    for ([name, ..], (verdict, _)) in PARTS.iter().zip(&results) {
        println!("  {name:<9} {verdict}");
    }
    let page = page(&commit, &results);
    if is_release {
        write(&workspace::root().join("docs/evidence.md"), &page)?;
    }
    write(&folder().join("evidence.md"), &page)
}

fn write(file: &Path, text: &str) -> Outcome {
    files::write(file, text)?;
    eprintln!("{} is written.", workspace::shown(file));
    Ok(())
}

fn folder() -> PathBuf {
    workspace::target_dir().join("evidence")
}

/// Records the facts of a job, a JSON object.
pub fn record(name: &str, facts: Value) -> Outcome {
    let Value::Object(mut facts) = facts else { return Err("what is recorded is no JSON object.".into()) };
    let (commit, clean) = sources();
    let date = process::output(Command::new("date").args(["-u", "+%Y-%m-%dT%H:%M:%SZ"]))?;
    facts.insert("commit".into(), commit.into());
    facts.insert("clean".into(), clean.into());
    facts.insert("toolchain".into(), toolchain::line().into());
    facts.insert("date".into(), date.trim().into());
    write(&folder().join(name).with_extension("json"), &format!("{:#}\n", Value::Object(facts)))
}

/// Records that this job has begun: if it breaks off, the page says so.
pub fn begin(name: &str) -> Outcome {
    record(name, json!({"unfinished": true}))
}

/// Runs a program that writes its facts to a file; returns them, and how it ended: a program that
/// fails has found something.
pub fn facts_of(name: &str, run: impl FnOnce(&Path) -> Outcome) -> Outcome<(Value, Outcome)> {
    let file = folder().join(name).with_extension("facts");
    let _ = fs::remove_file(&file);
    let ended = run(&file);
    Ok((process::json(&files::text(&file)?)?, ended))
}

/// The same for a job that is one program: its facts are the record.
pub fn of_program(name: &str, run: impl FnOnce(&Path) -> Outcome) -> Outcome {
    begin(name)?;
    let (facts, ended) = facts_of(name, run)?;
    record(name, facts)?;
    ended
}

/// The commit that is checked out, `unknown` outside a clone; and whether nothing was changed since.
fn sources() -> (String, bool) {
    match process::git(&["rev-parse", "HEAD"]) {
        Ok(commit) => {
            let is_clean = process::git(&["status", "--porcelain"]).is_ok_and(|list| list.is_empty());
            (commit.trim().to_owned(), is_clean)
        }
        Err(_) => ("unknown".to_owned(), false),
    }
}

/// The result of a part in words, in bold if it is not good; and its records of this commit.
type Known<'a> = (String, Vec<&'a Value>);

/// What the records say of a commit, for each of [`PARTS`].
fn results<'a>(commit: &str, records: &'a [(String, Value)]) -> Vec<Known<'a>> {
    let known = |[part, counted, ..]: &[&str; 4]| {
        let is_of_part =
            |name: &str| name.strip_prefix(part).is_some_and(|rest| rest.is_empty() || rest.starts_with('-'));
        let all: Vec<_> = records.iter().filter(|(name, _)| is_of_part(name)).collect();
        let is_ours = |record: &&Value| record["commit"] == *commit && record["clean"] == true;
        let ours: Vec<_> = all.iter().map(|(_, record)| record).filter(is_ours).collect();
        (judge(counted, &ours, all.len() > ours.len()), ours)
    };
    PARTS.iter().map(known).collect()
}

fn judge(counted: &str, ours: &[&Value], has_others: bool) -> String {
    if ours.is_empty() {
        let others = if has_others { "; there are results of other sources" } else { "" };
        return format!("not run on this commit{others}");
    }
    if ours.iter().any(|record| record["unfinished"] == true) {
        return "**a run was broken off**".into();
    }
    let numbers =
        |name: &str| -> Vec<f64> { ours.iter().filter_map(|record| record[name].as_f64()).collect() };
    let (counts, failed) = (numbers(counted), numbers("failed").iter().sum::<f64>());
    if counts.len() < ours.len() {
        return "**a run has counted nothing**".into();
    }
    // Counts are summed over the parts of a run; of percents the least counts.
    let count = match counted {
        "percent" => counts.into_iter().fold(100.0, f64::min),
        _ => counts.iter().sum(),
    };
    let verdict = format!("{count} {counted}, {failed} failed");
    if failed > 0.0 {
        format!("**{verdict}**")
    } else {
        verdict
    }
}

fn page(commit: &str, results: &[Known]) -> String {
    let mut page =
        format!("# Evidence\n\nCommit `{commit}`. Every number comes from a run of its sources.\n\n");
    page += "| what | result | date | command |\n|---|---|---|---|\n";
    for ([name, _, job, _], (verdict, records)) in PARTS.iter().zip(results) {
        let dates = records.iter().filter_map(|record| record["date"].as_str()?.get(..10));
        let date = dates.max().unwrap_or("–");
        let _ = writeln!(page, "| {name} | {verdict} | {date} | `cargo xtask {job}` |");
    }
    let _ = writeln!(page, "\n{NOT_VERIFIED}");
    for ([name, .., about], (_, records)) in PARTS.iter().zip(results) {
        let _ = writeln!(page, "\n## {name}\n\n{about}");
        for record in records {
            let _ = writeln!(page, "\n```json\n{record:#}\n```");
        }
    }
    page
}

#[cfg(test)]
mod tests {
    use super::*;

    const COMMIT: &str = "0123abcd";

    fn of_commit(mut record: Value) -> Value {
        record["commit"] = json!(COMMIT);
        record["clean"] = json!(true);
        record
    }

    fn verdict(part: &str, records: &[(&str, Value)]) -> String {
        let records: Vec<_> =
            records.iter().map(|(name, record)| ((*name).to_owned(), record.clone())).collect();
        let at = PARTS.iter().position(|[name, ..]| *name == part).unwrap();
        results(COMMIT, &records).swap_remove(at).0
    }

    #[test]
    fn only_a_good_result_of_these_sources_is_good() {
        let others = "not run on this commit; there are results of other sources";
        for (record, expected) in [
            (json!(null), others),
            (of_commit(json!({"unfinished": true})), "**a run was broken off**"),
            (of_commit(json!({"passed": 3, "failed": 0})), "3 passed, 0 failed"),
            (of_commit(json!({"passed": 3, "failed": 1})), "**3 passed, 1 failed**"),
            (of_commit(json!({"failed": 0})), "**a run has counted nothing**"),
            (json!({"passed": 3, "failed": 0, "commit": "4567", "clean": true}), others),
            (json!({"passed": 3, "failed": 0, "commit": COMMIT, "clean": false}), others),
            (json!({"passed": 3, "failed": 0, "commit": COMMIT}), others),
            (json!({"passed": 3, "failed": 0}), others),
        ] {
            assert_eq!(verdict("tests", &[("tests", record.clone())]), expected, "{record}");
        }
        assert_eq!(verdict("tests", &[]), "not run on this commit");
    }

    #[test]
    fn the_parts_of_a_run_are_summed_and_one_that_failed_fails_all() {
        let of = |failed: u32| {
            let one = of_commit(json!({"tried": 700, "failed": 0}));
            let other = of_commit(json!({"tried": 800, "failed": failed}));
            verdict("mutants", &[("mutants-0-2", one), ("mutants-1-2", other)])
        };
        assert_eq!((of(0).as_str(), of(2).as_str()), ("1500 tried, 0 failed", "**1500 tried, 2 failed**"));
    }

    #[test]
    fn the_page_has_each_part_with_its_records() {
        let records = [("tests".to_owned(), of_commit(json!({"jobs": [{"a": 5}], "passed": "<b>"})))];
        let page = page(COMMIT, &results(COMMIT, &records));
        for [name, .., about] in PARTS {
            assert!(page.contains(&format!("| {name} |")) && page.contains(about), "{name}");
        }
        assert!(page.contains("| tests | **a run has counted nothing** |"), "{page}");
        assert!(page.contains("      \"a\": 5\n"), "{page}");
    }
}
