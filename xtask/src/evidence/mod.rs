//! `cargo xtask evidence`: the page of what the jobs have measured, and the files in
//! `target/evidence` from which it is made; `docs/evidence` keeps the last results with the sources.
//!
//! Each file is one JSON object. It begins with `commit` (with `-dirty` behind it if the sources
//! were changed since), `toolchain` (the line of `rustc --version`) and `date` (UTC, ISO 8601);
//! the rest is the job's own. A job that has begun and not ended leaves `unfinished`. `reads` is how the
//! paths begin of the files that the result depends on: without it, all but texts and the tests of a
//! single crate.

mod page;

use std::fs;
use std::path::PathBuf;
use std::process::Command;
use std::time::{SystemTime, UNIX_EPOCH};

use crate::args::Args;
use crate::json::Value;
use crate::{process, toolchain, workspace, Outcome};

pub const HELP: &str = "\
usage: cargo xtask evidence [--keep]

Writes target/evidence/index.html: one page, without any other file, of what the last runs have
measured. It runs nothing itself: a part of which there is no result, or one of other sources, says so
and names the command.

  --keep   puts the results of target/evidence into docs/evidence, from where the page of another clone
           takes what it has not measured itself. A run that was broken off, or of sources that are no
           commit's, is not kept
";

/// The folder of the results that are kept with the sources.
const KEPT: &str = "docs/evidence/";
/// The tests of a crate alone, those that are no job of their own, what is built beside the workspace, and what
/// only reads results or built images.
const APART: [&str; 17] = [
    ".ci/",
    ".github/",
    "canopen/tests/",
    "coflash/tests/",
    "emulator/tests/",
    "fuzz/",
    "node/tests/",
    "python/",
    "seal/tests/",
    "shared-abi/tests/",
    "tests/python/",
    "tests/src/attacker/",
    "tests/tests/",
    "xtask/src/evidence/",
    "xtask/src/fuzz.rs",
    "xtask/src/mutants",
    "xtask/src/size.rs",
];
/// What emulated boards and nodes are made of, and the tests.
const DEVICES: &[&str] = &[
    "Cargo.",
    "app-template/",
    "boot-core/",
    "bootloader/",
    "bsp/",
    "canopen/src/",
    "coboot-app/",
    "coflash/src/",
    "emulator/",
    "linker/",
    "node/src/",
    "seal/src/",
    "shared-abi/src/",
    "tests/",
];
/// How the paths begin of what jobs depend on that read something else than most.
const READS: [(&str, &[&str]); 6] = [
    // They read the texts, too.
    ("tests", &[""]),
    (
        "size",
        &[
            "Cargo.",
            "boot-core/src/",
            "bootloader/",
            "bsp/",
            "canopen/src/",
            "linker/",
            "seal/src/",
            "shared-abi/src/",
            "xtask/src/build.rs",
            "xtask/src/pack.rs",
            "xtask/src/parts.rs",
            "xtask/src/size.rs",
            "xtask/src/zx0.rs",
        ],
    ),
    ("attacker", DEVICES),
    ("cpu", DEVICES),
    (
        "coverage",
        &[
            "Cargo.",
            "boot-core/",
            "canopen/",
            "coboot-app/",
            "coflash/src/",
            "seal/",
            "shared-abi/",
            "tests/",
        ],
    ),
    (
        "fuzz",
        &[
            "boot-core/src/",
            "boot-core/tests/model/",
            "canopen/src/",
            "canopen/tests/",
            "coflash/src/",
            "fuzz/",
            "seal/src/",
            "shared-abi/src/",
        ],
    ),
];
/// The inputs that the fuzzer has found.
const SEEDS: &str = "fuzz/seeds/";

pub fn run(mut args: Args) -> Outcome {
    let keep_all = args.flag("--keep");
    args.none_left()?;
    if keep_all {
        for name in page::names() {
            match keep(name) {
                Ok(()) => println!("  {name:<10} kept"),
                Err(why) => println!("  {name:<10} not kept: {why}"),
            }
        }
    }
    let file = workspace::target_dir().join("evidence").join("index.html");
    let unwritable = |error| format!("{} cannot be written: {error}.", workspace::shown(&file));
    fs::create_dir_all(file.parent().unwrap_or(&file)).map_err(unwritable)?;
    fs::write(&file, page::page(&commit(), recorded, holds)).map_err(unwritable)?;
    println!("The page is {}.", workspace::shown(&file));
    Ok(())
}

/// Writes `target/evidence/NAME.json` and returns its path. `facts` is a JSON object as text.
///
/// # Errors
/// When `facts` is no object or has one of the three members above, or when the file cannot be
/// written.
pub fn record(name: &str, facts: &str) -> Outcome<PathBuf> {
    let seconds = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs();
    let reads = READS.iter().find(|(job, _)| *job == name).map(|(_, reads)| *reads);
    let text = with_origin(facts, &commit(), &toolchain::line(), &date(seconds), reads.unwrap_or(&[]))?;
    let file = path(name);
    let unwritable = |error| format!("{} cannot be written: {error}.", workspace::shown(&file));
    fs::create_dir_all(file.parent().unwrap_or(&file)).map_err(unwritable)?;
    // A reader never sees half a file.
    let draft = file.with_extension("draft");
    fs::write(&draft, text).map_err(unwritable)?;
    fs::rename(&draft, &file).map_err(unwritable)?;
    Ok(file)
}

/// Notes that this job has begun: if it breaks off, the page says so.
///
/// # Errors
/// When the file cannot be written.
pub fn begin(name: &str) -> Outcome {
    record(name, "{\"unfinished\": true}").map(drop)
}

/// A file that another program writes its facts to, for [`record`]; it is not there yet.
pub fn file_for(name: &str) -> PathBuf {
    let file = path(name).with_extension("facts");
    let _ = fs::remove_file(&file);
    file
}

/// What was recorded last under this name, in this folder or else with the sources.
pub fn recorded(name: &str) -> Option<Value> {
    [path(name), kept(name)].iter().find_map(|file| Value::parse(&fs::read_to_string(file).ok()?).ok())
}

/// Puts the result of this name to those that are kept with the sources.
///
/// # Errors
/// When there is none, when it is that of a run that was broken off or of changed sources, or when it
/// cannot be written.
pub fn keep(name: &str) -> Outcome {
    let text = fs::read_to_string(path(name)).map_err(|_| "there is no result.")?;
    if !is_whole(&Value::parse(&text)?) {
        return Err("the run was broken off, or its sources were no commit's.".into());
    }
    let file = kept(name);
    let unwritable = |error| format!("{} cannot be written: {error}.", workspace::shown(&file));
    fs::create_dir_all(file.parent().unwrap_or(&file)).map_err(unwritable)?;
    fs::write(&file, text).map_err(unwritable)
}

/// Whether a record is the result of a commit.
fn is_whole(record: &Value) -> bool {
    *record.get("unfinished") != Value::Bool(true) && record.get("commit").text().is_some_and(is_commit)
}

fn kept(name: &str) -> PathBuf {
    workspace::root().join(KEPT).join(name).with_extension("json")
}

fn path(name: &str) -> PathBuf {
    workspace::target_dir().join("evidence").join(name).with_extension("json")
}

/// The facts with where they come from in front of them.
fn with_origin(facts: &str, commit: &str, toolchain: &str, date: &str, reads: &[&str]) -> Outcome<String> {
    let Value::Object(members) = Value::parse(facts)? else {
        return Err("what is recorded is no JSON object.".into());
    };
    let own = [("commit", commit), ("toolchain", toolchain), ("date", date)];
    if let Some((name, _)) = own.iter().find(|(name, _)| members.contains_key(*name)) {
        return Err(format!("what is recorded has a \"{name}\" of its own."));
    }
    let mut own =
        own.map(|(name, value)| format!("\"{name}\": \"{}\"", value.replace(['"', '\\'], "'"))).to_vec();
    if !reads.is_empty() {
        let reads: Vec<String> = reads.iter().map(|begin| format!("\"{begin}\"")).collect();
        own.push(format!("\"reads\": [{}]", reads.join(", ")));
    }
    let inner = facts.trim().trim_start_matches('{').trim_start();
    let comma = if members.is_empty() { "" } else { ",\n" };
    Ok(format!("{{{}{comma}{inner}\n", own.join(",\n")))
}

/// The commit of the sources; `unknown` outside a clone. What jobs have written does not change it.
pub fn commit() -> String {
    let git =
        |words: &[&str]| process::output(Command::new("git").current_dir(workspace::root()).args(words));
    let Ok(commit) = git(&["rev-parse", "HEAD"]) else { return "unknown".to_owned() };
    let changed = git(&["diff", "--name-only", "HEAD"]).is_ok_and(|files| !files.lines().all(is_result));
    format!("{}{}", commit.trim(), if changed { "-dirty" } else { "" })
}

fn is_commit(of: &str) -> bool {
    of.len() == 40 && of.bytes().all(|byte| byte.is_ascii_hexdigit())
}

/// Whether a result holds for the sources as they are, although it may be of another commit.
pub fn holds(record: &Value) -> bool {
    let commit = record.get("commit").text().unwrap_or_default();
    is_unchanged(commit, |file| matters(record.get("reads").items(), file))
}

/// Whether no file that matters has changed since a commit.
pub fn is_unchanged(since: &str, matters: impl Fn(&str) -> bool) -> bool {
    let mut git = Command::new("git");
    git.current_dir(workspace::root()).args(["diff", "--name-only", since, "--"]);
    is_commit(since) && process::output(&mut git).is_ok_and(|changed| !changed.lines().any(matters))
}

/// Whether a result that depends on these files may be another after a change of this one.
fn matters(reads: &[Value], file: &str) -> bool {
    let is_apart = file.ends_with(".md")
        || file.starts_with("docs/")
        || APART.iter().any(|folder| file.starts_with(folder));
    match reads {
        _ if is_result(file) => false,
        [] => !is_apart,
        reads => reads.iter().filter_map(Value::text).any(|begin| file.starts_with(begin)),
    }
}

/// Whether jobs have written this file: what they have measured, and inputs that they have found.
fn is_result(file: &str) -> bool {
    [KEPT, SEEDS].iter().any(|folder| file.starts_with(folder))
}

/// A time in seconds since 1970, as `2026-01-31T12:00:00Z`.
fn date(seconds: u64) -> String {
    let (mut days, rest) = (seconds / 86400, seconds % 86400);
    let is_leap =
        |year: u64| year.is_multiple_of(4) && (!year.is_multiple_of(100) || year.is_multiple_of(400));
    let mut year = 1970;
    while days >= 365 + u64::from(is_leap(year)) {
        days -= 365 + u64::from(is_leap(year));
        year += 1;
    }
    let mut month = 1;
    for length in [31, 28 + u64::from(is_leap(year)), 31, 30, 31, 30, 31, 31, 30, 31, 30] {
        if days < length {
            break;
        }
        days -= length;
        month += 1;
    }
    let (hour, minute, second) = (rest / 3600, rest / 60 % 60, rest % 60);
    format!("{year}-{month:02}-{:02}T{hour:02}:{minute:02}:{second:02}Z", days + 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn facts_get_their_origin_in_front_and_stay_what_they_are() {
        for (facts, count) in [("{}", None), (" { \"count\": 3, \"more\": {} } ", Some("3"))] {
            let text = with_origin(facts, "abc", "rustc 1 \"x\"", "2026-01-31T12:00:00Z", &["a/"]).unwrap();
            let value = Value::parse(&text).unwrap();
            assert_eq!(value.get("commit").text(), Some("abc"));
            assert_eq!(value.get("toolchain").text(), Some("rustc 1 'x'"));
            assert_eq!(value.get("date").text(), Some("2026-01-31T12:00:00Z"));
            assert_eq!(value.get("reads").items()[0].text(), Some("a/"));
            assert_eq!(*value.get("count"), count.map_or(Value::Null, |count| Value::Number(count.into())));
        }
    }

    #[test]
    fn a_result_holds_until_a_file_changes_that_its_job_reads() {
        let reads = |record: &str| Value::parse(record).unwrap().get("reads").items().to_vec();
        let (all, some) = (reads(r#"{"reads": [""]}"#), reads(r#"{"reads": ["canopen/", "Cargo.lock"]}"#));
        for (file, is_in_all, is_in_some, is_code) in [
            ("README.md", true, false, false),
            ("docs/adr/0018-toolchain-of-a-release.md", true, false, false),
            ("docs/evidence/bench.json", false, false, false),
            ("fuzz/seeds/lss/1", false, false, false),
            ("canopen/src/lib.rs", true, true, true),
            ("Cargo.lock", true, true, true),
            ("xtask/src/main.rs", true, false, true),
            ("docsy/a.rs", true, false, true),
            ("canopen/tests/lss.rs", true, true, false),
            ("boot-core/tests/model/mod.rs", true, false, true),
            ("tests/tests/sealed_model.rs", true, false, false),
            ("tests/python/client.py", true, false, false),
            ("tests/src/attacker/mod.rs", true, false, false),
            ("xtask/src/mutants.rs", true, false, false),
            ("tests/src/powercut.rs", true, false, true),
        ] {
            assert_eq!(matters(&all, file), is_in_all, "{file}");
            assert_eq!(matters(&some, file), is_in_some, "{file}");
            assert_eq!(matters(&[], file), is_code, "{file}");
        }
        // No commits; among them an option for git.
        for of in ["unknown", "", "0123-dirty", "--output=x", &"0".repeat(40)] {
            assert!(!is_unchanged(of, |_| false), "{of}");
        }
    }

    #[test]
    fn the_folders_are_there() {
        let named = READS.iter().flat_map(|(_, reads)| *reads).chain(&APART);
        for folder in named.filter(|begin| begin.ends_with('/')) {
            assert!(workspace::root().join(folder).is_dir(), "{folder}");
        }
    }

    #[test]
    fn only_the_whole_result_of_a_commit_is_kept() {
        let commit = "0123456789abcdef0123456789abcdef01234567";
        for (record, expected) in [
            (format!(r#"{{"commit": "{commit}"}}"#), true),
            (format!(r#"{{"commit": "{commit}", "unfinished": true}}"#), false),
            (format!(r#"{{"commit": "{commit}-dirty"}}"#), false),
            (r#"{"commit": "unknown"}"#.to_owned(), false),
            ("{}".to_owned(), false),
        ] {
            assert_eq!(is_whole(&Value::parse(&record).unwrap()), expected, "{record}");
        }
    }

    #[test]
    fn what_is_no_object_or_hides_the_origin_is_refused() {
        for facts in ["", "[]", "{", "3", "{\"commit\": 1}", "{\"a\": 1, \"date\": 2}"] {
            assert!(with_origin(facts, "", "", "", &[]).is_err(), "{facts}");
        }
    }

    /// Second column: the output of GNU `date -u -d @… +%FT%TZ`.
    #[test]
    fn dates_are_those_of_the_calendar() {
        for (seconds, text) in [
            (0, "1970-01-01T00:00:00Z"),
            (951782400, "2000-02-29T00:00:00Z"),
            (951868799, "2000-02-29T23:59:59Z"),
            (1709251199, "2024-02-29T23:59:59Z"),
            (1798761599, "2026-12-31T23:59:59Z"),
            (1798761600, "2027-01-01T00:00:00Z"),
            (4107542400, "2100-03-01T00:00:00Z"),
            (4102444799, "2099-12-31T23:59:59Z"),
        ] {
            assert_eq!(date(seconds), text);
        }
    }
}
