//! `cargo xtask evidence`: one page of what the jobs have measured of one commit.
//!
//! A job writes `target/evidence/NAME.json`; a job that runs in parts, `NAME-PART.json`. It is one
//! object with `commit`, `clean` (whether the sources were those of the commit), `toolchain` (the
//! line of `rustc --version`) and `date` (UTC, ISO 8601); the rest is the job's own. `failed` there
//! is a count that must be 0. A job that has begun and not ended leaves `unfinished`.

use std::fmt::Write;
use std::fs;
use std::path::PathBuf;
use std::process::Command;

use serde_json::{json, Map, Value};

use crate::args::Args;
use crate::{process, toolchain, workspace, Outcome};

pub const HELP: &str = "\
usage: cargo xtask evidence [--release]

Writes target/evidence/index.html: one page, without any other file, of what the jobs have measured of
the commit that is checked out. It runs nothing itself. A part of which there is no result of this
commit says so and names the command; results of other commits and of changed sources do not count.

  --release   writes docs/evidence.md, too: the figures, with date and commit
";

/// A part of the page.
struct Part {
    /// The name of the record.
    name: &'static str,
    /// The member of the record that is its result in one number.
    counts: &'static str,
    /// The command that makes the record.
    command: &'static str,
    title: &'static str,
    /// What it shows.
    about: &'static str,
}

/// The parts of the page, one a line.
const PARTS: &str = "\
tests | passed | cargo xtask test | Tests | All host crates, and the built firmware in the emulator.
powercut | states | cargo xtask powercut --full | Power cuts | The power fails in a flash operation; then the device \
    answers or runs a whole program. Level 1: boot-core on a model of the flash; level 2: the built firmware, at every \
    state of its flash.
attacker | frames | cargo xtask attack | Hostile bus | A seeded attacker and a legal master on one bus.
fuzz | inputs | cargo xtask fuzz | Fuzzing | Random inputs for each parser and state machine that meets the bus or a file.
cpu | words | cargo xtask opinion --json | Second opinion | The same programs on QEMU's Cortex-M4 and on the emulator.
coverage | percent | cargo xtask coverage | Coverage | Lines of the crates without an operating system that tests reach.
mutants | tried | cargo xtask mutants | Mutants | Changes of the code that the tests must notice.
bench | percent | cargo xtask bench --json | Speed | A download, in percent of what wire and flash allow.
reproduce | compared | cargo xtask reproduce | Reproducible builds | Two clones in two folders give the same firmware.
sbom | bills | cargo xtask sbom | Bills of materials | The crates in bootloader and host tool, as CycloneDX.
size | bootloaders | cargo xtask size | Size | The bootloader's flash on each board, against its budget, and by part.
";

fn parts() -> impl Iterator<Item = Part> {
    PARTS.lines().filter_map(|line| {
        let fields: Vec<_> = line.split(" | ").collect();
        let [name, counts, command, title, about] = fields[..] else { return None };
        Some(Part { name, counts, command, title, about })
    })
}

/// What no run here can show.
const NOT_VERIFIED: &str = "Nothing here ran on silicon. The emulated chip follows the reference manual, and the \
    emulator's authors read it: an error of theirs would be in both. Transceivers, termination, clock tolerance, \
    brown-out levels, the wear of the flash and the erase times of a real device are not verified. `cargo xtask hil` \
    runs the same tests on a board.";

pub fn run(mut args: Args) -> Outcome {
    let release = args.flag("--release");
    args.none_left()?;
    let (commit, clean) = sources();
    let mut records = Vec::new();
    for entry in fs::read_dir(folder()).into_iter().flatten().flatten().map(|entry| entry.path()) {
        if entry.extension().is_some_and(|extension| extension == "json") {
            let text = fs::read_to_string(&entry).unwrap_or_default();
            let record = serde_json::from_str(&text).unwrap_or(Value::Null);
            records.push((entry.file_stem().unwrap_or_default().to_string_lossy().into_owned(), record));
        }
    }
    records.sort_by(|one, other| one.0.cmp(&other.0));
    let results = results(&commit, &records);
    if !clean {
        println!("The sources have changed since commit {commit}; the page is about that commit.");
    }
    for (part, result) in &results {
        println!("  {:<9} {}", part.name, result.verdict);
    }
    write(&folder().join("index.html"), &page(&commit, &results))?;
    if release {
        write(&workspace::root().join("docs/evidence.md"), &text(&commit, &results))?;
    }
    Ok(())
}

fn write(file: &PathBuf, text: &str) -> Outcome {
    let unwritable = |error| format!("{} cannot be written: {error}.", workspace::shown(file));
    fs::create_dir_all(file.parent().unwrap_or(file)).map_err(unwritable)?;
    // A reader never sees half a file.
    let draft = file.with_extension("draft");
    fs::write(&draft, text).and_then(|()| fs::rename(&draft, file)).map_err(unwritable)?;
    println!("{} is written.", workspace::shown(file));
    Ok(())
}

fn folder() -> PathBuf {
    workspace::target_dir().join("evidence")
}

/// Records the facts of a job, a JSON object.
pub fn record(name: &str, facts: Value) -> Outcome {
    let (commit, clean) = sources();
    let date = process::output(Command::new("date").args(["-u", "+%Y-%m-%dT%H:%M:%SZ"]))?;
    let origin =
        json!({"commit": commit, "clean": clean, "toolchain": toolchain::line(), "date": date.trim()});
    write(&folder().join(name).with_extension("json"), &format!("{:#}\n", with_origin(facts, origin)?))
}

/// Records facts that another program has written as text.
pub fn record_text(name: &str, facts: &str) -> Outcome {
    let facts =
        serde_json::from_str(facts).map_err(|error| format!("what is recorded is no JSON: {error}."))?;
    record(name, facts)
}

/// Records that this job has begun: if it breaks off, the page says so.
pub fn begin(name: &str) -> Outcome {
    record(name, json!({"unfinished": true}))
}

/// A file that another program writes its facts to, for [`record_text`]; it is not there yet.
pub fn file_for(name: &str) -> PathBuf {
    let file = folder().join(name).with_extension("facts");
    let _ = fs::remove_file(&file);
    file
}

fn with_origin(facts: Value, origin: Value) -> Outcome<Value> {
    let (Value::Object(mut facts), Value::Object(origin)) = (facts, origin) else {
        return Err("what is recorded is no JSON object.".into());
    };
    for (name, value) in origin {
        if facts.insert(name.clone(), value).is_some() {
            return Err(format!("what is recorded has a \"{name}\" of its own."));
        }
    }
    Ok(Value::Object(facts))
}

/// The commit that is checked out, `unknown` outside a clone; and whether nothing was changed since.
fn sources() -> (String, bool) {
    let git =
        |words: &[&str]| process::output(Command::new("git").current_dir(workspace::root()).args(words));
    match git(&["rev-parse", "HEAD"]) {
        Ok(commit) => {
            (commit.trim().to_owned(), git(&["status", "--porcelain"]).is_ok_and(|list| list.is_empty()))
        }
        Err(_) => ("unknown".to_owned(), false),
    }
}

/// What is known of a part.
struct Known<'a> {
    /// `good`, `bad` or `none`: no result of this commit.
    class: &'static str,
    verdict: String,
    /// The records of this commit.
    records: Vec<&'a Map<String, Value>>,
}

/// What the records say of a commit.
fn results<'a>(commit: &str, records: &'a [(String, Value)]) -> Vec<(Part, Known<'a>)> {
    let known = |part: &Part| {
        let is_of_part = |name: &str| {
            name.strip_prefix(part.name).is_some_and(|rest| rest.is_empty() || rest.starts_with('-'))
        };
        let (mut ours, mut others) = (Vec::new(), 0);
        for (_, record) in records.iter().filter(|(name, _)| is_of_part(name)) {
            match record.as_object() {
                Some(record)
                    if record.get("commit") == Some(&json!(commit))
                        && record.get("clean") == Some(&json!(true)) =>
                {
                    ours.push(record);
                }
                _ => others += 1,
            }
        }
        let (class, verdict) = judge(part, &ours, others);
        Known { class, verdict, records: ours }
    };
    parts().map(|part| (known(&part), part)).map(|(known, part)| (part, known)).collect()
}

fn judge(part: &Part, ours: &[&Map<String, Value>], others: usize) -> (&'static str, String) {
    if ours.is_empty() {
        let others = if others > 0 { "; there are results of other sources" } else { "" };
        return ("none", format!("not run on this commit: `{}`{others}", part.command));
    }
    if ours.iter().any(|record| record.contains_key("unfinished")) {
        return ("bad", "a run was broken off".into());
    }
    let numbers =
        |name: &str| -> Vec<f64> { ours.iter().filter_map(|record| record.get(name)?.as_f64()).collect() };
    let (counts, failed) = (numbers(part.counts), numbers("failed").iter().sum::<f64>());
    if counts.len() < ours.len() {
        return ("bad", "a run has counted nothing".into());
    }
    // Counts are summed over the parts of a run; of percents the least counts.
    let count = match part.counts {
        "percent" => counts.into_iter().fold(100.0, f64::min),
        _ => counts.iter().sum(),
    };
    let verdict = format!("{} {}, {failed} failed", shown(&json!(count)), part.counts);
    (if failed > 0.0 { "bad" } else { "good" }, verdict)
}

/// Text as HTML.
fn html(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// A value without members as text; numbers with spaces between thousands.
fn shown(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        Value::Bool(is) => if *is { "yes" } else { "no" }.into(),
        Value::Number(number) if number.as_f64().is_some_and(|number| number.fract() == 0.0) => {
            let digits: Vec<char> =
                format!("{:.0}", number.as_f64().unwrap_or_default()).chars().rev().collect();
            let groups: Vec<String> = digits.chunks(3).map(|group| group.iter().collect()).collect();
            groups.join("\u{202f}").chars().rev().collect()
        }
        Value::Array(items) => items.iter().map(shown).collect::<Vec<_>>().join(", "),
        other => other.to_string(),
    }
}

/// Whether a value is shown in one cell.
fn is_plain(value: &Value) -> bool {
    !value.is_object() && rows_of(value).is_none()
}

/// The rows of a list of objects.
fn rows_of(value: &Value) -> Option<Vec<&Map<String, Value>>> {
    value.as_array()?.iter().map(Value::as_object).collect::<Option<Vec<_>>>().filter(|rows| !rows.is_empty())
}

/// The members of an object: first those of one cell, then a table for each list of objects.
fn details(object: &Map<String, Value>) -> String {
    let mut text = String::from("<div class=\"wide\"><table>\n");
    for (name, value) in object.iter().filter(|(_, value)| is_plain(value)) {
        let _ = writeln!(
            text,
            "<tr><th>{}</th><td>{}</td></tr>",
            html(&name.replace('_', " ")),
            html(&shown(value))
        );
    }
    text += "</table></div>\n";
    for (name, rows) in object.iter().filter_map(|(name, value)| Some((name, rows_of(value)?))) {
        // What a row is comes before its numbers.
        let mut names: Vec<&String> =
            rows[0].iter().filter(|(_, value)| is_plain(value)).map(|(name, _)| name).collect();
        names.sort_by_key(|name| (*name == "why", !rows[0][*name].is_string()));
        let _ = write!(text, "<h3>{}</h3>\n<div class=\"wide\"><table><tr>", html(&name.replace('_', " ")));
        text.extend(names.iter().map(|name| format!("<th>{}</th>", html(&name.replace('_', " ")))));
        for row in &rows {
            text += "</tr>\n<tr>";
            let cell = |name: &&String| row.get(*name).map_or_else(|| "–".to_owned(), shown);
            text.extend(names.iter().map(|name| format!("<td>{}</td>", html(&cell(name)))));
        }
        text += "</tr></table></div>\n";
        // Lists within the rows.
        for row in rows.iter().filter(|row| row.values().any(|value| rows_of(value).is_some())) {
            text += &details(row);
        }
    }
    text
}

fn page(commit: &str, results: &[(Part, Known)]) -> String {
    let (mut cards, mut sections) = (String::new(), String::new());
    for (Part { name, title, command, about, .. }, Known { class, verdict, records }) in results {
        let verdict = html(verdict);
        let _ = writeln!(cards, "<a class=\"{class}\" href=\"#{name}\"><b>{title}</b><br>{verdict}</a>");
        let _ = writeln!(
            sections,
            "<section id=\"{name}\"><h2>{title}</h2><p>{} <code>{command}</code></p>",
            html(about)
        );
        let _ = writeln!(sections, "<p class=\"{class}\">{verdict}</p>");
        sections.extend(records.iter().map(|record| details(record)));
        sections += "</section>\n";
    }
    format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <title>coboot: evidence</title>\n<style>{STYLE}</style></head><body>\n\
         <h1>coboot: evidence</h1>\n<p>Commit <code>{}</code>. Every number comes from a run of its sources.</p>\n\
         <nav>{cards}</nav>\n{sections}<h2>Not verified</h2><p>{}</p>\n</body></html>\n",
        html(commit),
        html(NOT_VERIFIED)
    )
}

/// The page of a release, in Markdown.
fn text(commit: &str, results: &[(Part, Known)]) -> String {
    let mut text = format!(
        "# Evidence\n\nWhat the jobs have measured of commit `{commit}`, written by `cargo xtask evidence --release`.\n\n\
         | what | result | date | command |\n|---|---|---|---|\n"
    );
    for (part, known) in results {
        let dates = known.records.iter().filter_map(|record| record.get("date")?.as_str()?.get(..10));
        let date = dates.max().unwrap_or("–");
        let result =
            if known.class == "bad" { format!("**{}**", known.verdict) } else { known.verdict.clone() };
        let _ = writeln!(text, "| {} | {result} | {date} | `{}` |", part.title, part.command);
    }
    text + "\n" + NOT_VERIFIED + "\n"
}

const STYLE: &str = "
:root{color-scheme:light dark;--good:#15803d;--bad:#b91c1c;--none:#6b7280}
body{font:16px/1.5 system-ui,sans-serif;max-width:72rem;margin:0 auto;padding:1rem}
nav{display:grid;grid-template-columns:repeat(auto-fill,minmax(13rem,1fr));gap:.75rem}
nav a{color:inherit;text-decoration:none}
.good,.bad,.none{border-left:.35rem solid var(--mark);padding-left:.6rem}
.good{--mark:var(--good)}.bad{--mark:var(--bad)}.none{--mark:var(--none)}
.wide{overflow-x:auto}
table{border-collapse:collapse;font-variant-numeric:tabular-nums}
th,td{border-bottom:1px solid #8884;padding:.2rem .6rem;text-align:left;vertical-align:top}
section{border-top:1px solid #8888;margin-top:1.5rem}
";

#[cfg(test)]
mod tests {
    use super::*;

    const COMMIT: &str = "0123abcd";

    fn of_tests(record: Value) -> (&'static str, String, String) {
        let records = [("tests".to_owned(), record)];
        let results = results(COMMIT, &records);
        (results[0].1.class, results[0].1.verdict.clone(), page(COMMIT, &results))
    }

    #[test]
    fn facts_get_their_origin_in_front_and_stay_what_they_are() {
        let record = with_origin(json!({"count": 3}), json!({"commit": "abc"})).unwrap();
        assert_eq!(record, json!({"commit": "abc", "count": 3}));
    }

    #[test]
    fn what_is_no_object_or_hides_the_origin_is_refused() {
        for facts in [json!([]), json!(3), json!({"commit": 1}), json!({"a": 1, "date": 2})] {
            assert!(with_origin(facts.clone(), json!({"commit": "", "date": ""})).is_err(), "{facts}");
        }
    }

    #[test]
    fn only_a_good_result_of_these_sources_is_green() {
        let clean = |mut record: Value| {
            record["commit"] = json!(COMMIT);
            record["clean"] = json!(true);
            record
        };
        for (record, expected) in [
            (json!(null), "none"),
            (clean(json!({"unfinished": true})), "bad"),
            (clean(json!({"passed": 3, "failed": 0})), "good"),
            (clean(json!({"passed": 3, "failed": 1})), "bad"),
            (clean(json!({"failed": 0})), "bad"),
            (json!({"passed": 3, "failed": 0, "commit": "4567", "clean": true}), "none"),
            (json!({"passed": 3, "failed": 0, "commit": COMMIT, "clean": false}), "none"),
            (json!({"passed": 3, "failed": 0, "commit": COMMIT}), "none"),
            (json!({"passed": 3, "failed": 0}), "none"),
        ] {
            let (class, verdict, page) = of_tests(record.clone());
            assert_eq!(class, expected, "{record}: {verdict}");
            assert_eq!(page.contains("class=\"good\""), expected == "good", "{record}");
        }
    }

    #[test]
    fn the_parts_of_a_run_are_summed_and_one_that_failed_fails_all() {
        let part = |name: &str, tried, failed| {
            (name.to_owned(), json!({"commit": COMMIT, "clean": true, "tried": tried, "failed": failed}))
        };
        let of = |records: &[(String, Value)]| {
            let results = results(COMMIT, records);
            let (_, known) = results.iter().find(|(part, _)| part.name == "mutants").unwrap();
            (known.class, known.verdict.clone())
        };
        let [one, other] = [part("mutants-0-2", 700, 0), part("mutants-1-2", 800, 0)];
        assert_eq!(of(&[one.clone(), other]), ("good", "1\u{202f}500 tried, 0 failed".to_owned()));
        assert_eq!(of(&[one, part("mutants-1-2", 800, 2)]).0, "bad");
    }

    #[test]
    fn records_of_any_contents_make_a_page() {
        for facts in [
            json!({}),
            json!({"boards": [{"scenarios": [{"scenario": "update", "map": {"after": ""}}]}]}),
            json!({"targets": {"a": 3}, "downloads": [{}], "images": [], "passed": "<b>"}),
        ] {
            let mut record = facts.clone();
            record["commit"] = json!(COMMIT);
            record["clean"] = json!(true);
            let (class, _, page) = of_tests(record);
            assert!(page.ends_with("</html>\n") && !page.contains("<b>\""), "{facts}");
            assert_ne!(class, "good", "{facts}");
        }
    }

    #[test]
    fn a_sentence_stands_behind_the_numbers_of_a_list() {
        let record = json!({"explained": [{"a": 5, "why": "so", "z": "what"}], "found": []});
        let details = details(record.as_object().unwrap());
        assert!(details.contains("<th>z</th><th>a</th><th>why</th>"), "{details}");
    }
}
