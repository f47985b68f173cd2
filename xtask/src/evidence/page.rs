//! The page: what the jobs have recorded, with its origin, and what is missing.

use std::cmp::Ordering;
use std::fmt::Write;

use crate::json::Value;

/// A part of the page, from one record.
struct Part {
    /// The name of the record.
    name: &'static str,
    title: &'static str,
    /// The command that makes the record.
    command: &'static str,
    /// What it shows, in a sentence.
    about: &'static str,
    /// The verdict in a few words, `Err` if it is bad; then the details as HTML.
    show: fn(&Value) -> (Result<String, String>, String),
}

const PARTS: &[Part] = &[
    Part {
        name: "tests",
        title: "Tests",
        command: "cargo xtask test",
        about: "All host crates, and the built firmware in the emulator on a board of each chip.",
        show: tests,
    },
    Part {
        name: "powercut",
        title: "Power cuts",
        command: "cargo xtask powercut --full",
        about: "The power fails in a flash operation; then the device answers or runs a whole program. Level 1: \
                boot-core on a model of the flash, at every point; level 2: the built firmware in the emulator, at every \
                state of its flash.",
        show: powercut,
    },
    Part {
        name: "attacker",
        title: "Hostile bus",
        command: "cargo xtask attack",
        about: "A seeded attacker and a legal master on one bus; what nobody may change stays.",
        show: |record| plain(record, "frames"),
    },
    Part {
        name: "fuzz",
        title: "Fuzzing",
        command: "cargo xtask fuzz",
        about: "Random inputs for each parser and state machine that meets the bus or a foreign file.",
        show: fuzz,
    },
    Part {
        name: "cpu",
        title: "Second opinion on the CPU",
        command: "cargo xtask opinion --json",
        about: "The same programs on QEMU's Cortex-M4 and on the emulator, compared word for word.",
        show: |record| plain(record, "words"),
    },
    Part {
        name: "coverage",
        title: "Coverage",
        command: "cargo xtask coverage",
        about: "Lines of the crates without an operating system that tests on the host reach.",
        show: coverage,
    },
    Part {
        name: "mutants",
        title: "Mutants",
        command: "cargo xtask mutants",
        about: "Changes of the code that the tests must notice.",
        show: mutants,
    },
    Part {
        name: "bench",
        title: "Speed",
        command: "cargo xtask bench --json",
        about: "A download in virtual time, beside the limits of wire and flash.",
        show: bench,
    },
    Part {
        name: "reproduce",
        title: "Reproducible builds",
        command: "cargo xtask reproduce",
        about: "Two clones in two folders give the same firmware.",
        show: |record| plain(record, "compared"),
    },
    Part {
        name: "sbom",
        title: "Bills of materials",
        command: "cargo xtask sbom",
        about: "The crates in bootloader and host tool, as CycloneDX; the hash fits into a sealed image.",
        show: |record| plain(record, "bills"),
    },
    Part {
        name: "size",
        title: "Size",
        command: "cargo xtask size",
        about: "The bootloader's flash on each board, against its budget, and by part. What runs from RAM lies in flash \
                packed; the share of a part in the packed bytes is an estimate.",
        show: size,
    },
];

/// What no run here can show.
const NOT_VERIFIED: &str = "Nothing here ran on silicon. The emulated chip follows the reference manual, and \
    the emulator's authors read it: an error of theirs would be in both. Transceivers, termination, clock \
    tolerance, brown-out levels, the wear of the flash and the erase times of a real device are not verified. \
    <code>cargo xtask hil</code> runs the same tests on a board.";

/// The names of the records.
pub fn names() -> impl Iterator<Item = &'static str> {
    PARTS.iter().map(|part| part.name)
}

/// The page for sources of this commit, with the records that `read` finds. `holds` tells of one
/// that is of another commit whether it is the result of these sources, too.
pub fn page(commit: &str, read: impl Fn(&str) -> Option<Value>, holds: impl Fn(&Value) -> bool) -> String {
    let (mut cards, mut sections) = (String::new(), String::new());
    for part in PARTS {
        let record = read(part.name);
        let (class, verdict, details) = judge(part, commit, record.as_ref(), &holds);
        let _ = writeln!(
            cards,
            "<a class=\"card {class}\" href=\"#{}\"><b>{}</b><span>{verdict}</span></a>",
            part.name, part.title
        );
        let _ = write!(
            sections,
            "<section id=\"{}\"><h2>{}</h2><p>{} <code>{}</code></p>\n<p class=\"verdict {class}\">{verdict}</p>\n{}{details}</section>\n",
            part.name,
            part.title,
            part.about,
            part.command,
            record.as_ref().map_or(String::new(), origin),
        );
    }
    format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <title>coboot: evidence</title>\n<style>{STYLE}</style></head><body>\n\
         <h1>coboot: evidence</h1>\n<p>Sources: commit <code>{}</code>. Every number comes from a run.</p>\n\
         <nav>{cards}</nav>\n{sections}\
         <section id=\"not-verified\"><h2>Not verified</h2><p>{NOT_VERIFIED}</p></section>\n</body></html>\n",
        text(commit)
    )
}

/// The class, the verdict and the details of a part.
fn judge(
    part: &Part,
    commit: &str,
    record: Option<&Value>,
    holds: impl Fn(&Value) -> bool,
) -> (&'static str, String, String) {
    let Some(record) = record else {
        return ("none", format!("not run: <code>{}</code>", part.command), String::new());
    };
    if *record.get("unfinished") == Value::Bool(true) {
        return ("bad", "the last run was broken off".into(), String::new());
    }
    let (verdict, details) = (part.show)(record);
    let of = record.get("commit").text().unwrap_or("unknown");
    match verdict {
        Err(what) => ("bad", what, details),
        Ok(what) if of != commit && holds(record) => {
            ("good", format!("{what}; what it measures has not changed since"), details)
        }
        Ok(what) if of != commit => {
            let of = if of.ends_with("-dirty") { "of changed sources" } else { "of another commit" };
            ("old", format!("{what}; {of}"), details)
        }
        // Changed sources are not those of a commit.
        Ok(what) if commit.ends_with("-dirty") => {
            ("old", format!("{what}; the sources were changed"), details)
        }
        Ok(what) => ("good", what, details),
    }
}

fn origin(record: &Value) -> String {
    let of = |name| text(record.get(name).text().unwrap_or("unknown"));
    format!("<p class=\"origin\">{}, commit {}, {}</p>\n", of("date"), of("commit"), of("toolchain"))
}

/// Text as HTML.
fn text(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// A number with spaces between thousands, or text.
fn shown(value: &Value) -> String {
    match value {
        Value::Number(number) if number.bytes().all(|digit| digit.is_ascii_digit()) => {
            let digits: Vec<char> = number.chars().rev().collect();
            let groups: Vec<String> = digits.chunks(3).map(|group| group.iter().collect()).collect();
            groups.join("\u{202f}").chars().rev().collect()
        }
        Value::Number(number) => number.clone(),
        Value::String(string) => text(string),
        Value::Bool(true) => "yes".into(),
        Value::Bool(false) => "no".into(),
        Value::Null => "–".into(),
        Value::Array(items) if items.is_empty() => "none".into(),
        Value::Array(items) => items.iter().map(shown).collect::<Vec<_>>().join(", "),
        Value::Object(_) => value
            .members()
            .map(|(name, value)| format!("{}: {}", text(name), shown(value)))
            .collect::<Vec<_>>()
            .join(", "),
    }
}

fn number(value: &Value, name: &str) -> f64 {
    value.get(name).number().unwrap_or(f64::NAN)
}

/// The member of a record that holds a sentence.
const WHY: &str = "why";
/// The class of what scrolls on a narrow screen.
const WIDE: &str = "wide";
/// The class of a table with sentences: on a narrow screen, the cells of a row stand one below the other.
const LONG: &str = "wide long";

/// A table of these members of objects.
fn table(names: &[&str], rows: &[Value]) -> String {
    let class = if names.contains(&WHY) { LONG } else { WIDE };
    let mut table = format!("<div class=\"{class}\"><table><tr>");
    for name in names {
        let _ = write!(table, "<th>{}</th>", text(&name.replace('_', " ")));
    }
    for row in rows {
        table += "</tr>\n<tr>";
        for name in names {
            let title = text(&name.replace('_', " "));
            let _ = write!(table, "<td data-name=\"{title}\">{}</td>", shown(row.get(name)));
        }
    }
    table + "</tr></table></div>\n"
}

/// `Ok` if this member is 0.
fn none(record: &Value, name: &str, good: String) -> Result<String, String> {
    match record.get(name).number() {
        Some(0.0) => Ok(good),
        _ => Err(format!("{good}, {} {name}", shown(record.get(name)))),
    }
}

fn tests(record: &Value) -> (Result<String, String>, String) {
    let passed = format!("{} passed", shown(record.get("passed")));
    let mut details = String::new();
    for (title, list, names) in [
        ("By level", "levels", ["level", "programs", "passed", "failed", "skipped"]),
        ("With programs of others", "foreign", ["with", "tests", "passed", "failed", "skipped"]),
        ("Conformance, by board", "conformance", ["board", "programs", "passed", "failed", "skipped"]),
    ] {
        let _ = writeln!(details, "<h3>{title}</h3>");
        details += &table(&names, record.get(list).items());
    }
    (none(record, "failed", passed), details)
}

fn powercut(record: &Value) -> (Result<String, String>, String) {
    let boards = record.get("boards").items();
    let sum = |name| boards.iter().map(|board| number(board, name)).sum::<f64>();
    let (states, violations) = (sum("states"), sum("violations"));
    let shown_states = shown(&Value::Number(format!("{states}")));
    let boards_are = if boards.len() == 1 { "board" } else { "boards" };
    let verdict =
        format!("{shown_states} states of the real firmware's flash on {} {boards_are}", boards.len());
    let mut details = String::new();
    for board in boards {
        let _ = writeln!(details, "<h3>{}</h3>", shown(board.get("board")));
        let scenarios = board.get("scenarios").items();
        let names = [
            "level",
            "scenario",
            "violations",
            "operations",
            "points",
            "states",
            "recoveries",
            "bootloader",
            "old_program",
            "new_program",
        ];
        details += &table(&names, scenarios);
        for scenario in scenarios.iter().filter(|scenario| scenario.get("scenario").text() == Some("update"))
        {
            details += &map(scenario.get("map"));
        }
    }
    let verdict = if states > 0.0 && violations == 0.0 {
        Ok(verdict)
    } else {
        Err(format!("{verdict}, {violations} violations"))
    };
    (verdict, details)
}

/// What was found behind a cut, by operation and way. A column is as many operations as it takes;
/// it shows the worst of them.
fn map(map: &Value) -> String {
    const COLUMNS: usize = 720;
    const WORST: &[u8] = b".=NOB!";
    let rows: Vec<(&str, &str)> =
        map.members().filter_map(|(way, letters)| Some((way, letters.text()?))).collect();
    let Some(operations) = rows.iter().map(|(_, letters)| letters.len()).max().filter(|len| *len > 0) else {
        return String::new();
    };
    let mut svg = format!(
        "<div class=\"wide\"><svg class=\"map\" viewBox=\"0 0 {} {}\" role=\"img\" aria-label=\"what was found behind each cut\">",
        COLUMNS + 110,
        rows.len() * 22 + 20
    );
    let columns = operations.min(COLUMNS);
    let width = COLUMNS as f64 / columns as f64;
    for (y, (way, letters)) in rows.iter().enumerate() {
        let _ = write!(svg, "<text x=\"0\" y=\"{}\">{}</text>", y * 22 + 14, text(way));
        let worst = |column: usize| {
            let cells =
                &letters.as_bytes()[column * letters.len() / columns..(column + 1) * letters.len() / columns];
            cells.iter().max_by_key(|letter| WORST.iter().position(|known| known == *letter)).copied()
        };
        let mut column = 0;
        while column < columns {
            let letter = worst(column);
            let run = (column..columns).take_while(|next| worst(*next) == letter).count();
            let class = match letter {
                Some(b'N') => "new",
                Some(b'O') => "was",
                Some(b'B') => "boot",
                Some(b'=') => "same",
                Some(b'!') => "wrong",
                _ => "uncut",
            };
            let _ = write!(
                svg,
                "<rect class=\"{class}\" x=\"{:.1}\" y=\"{}\" width=\"{:.1}\" height=\"18\"/>",
                110.0 + column as f64 * width,
                y * 22,
                run as f64 * width
            );
            column += run;
        }
    }
    let _ = write!(
        svg,
        "<text x=\"110\" y=\"{}\">operation 0 to {}</text></svg></div>\n<p class=\"key\">",
        rows.len() * 22 + 14,
        operations - 1
    );
    for (class, words) in [
        ("was", "old program"),
        ("boot", "bootloader"),
        ("new", "new program"),
        ("same", "a flash that was looked at already"),
        ("wrong", "violation"),
        ("uncut", "not cut"),
    ] {
        let _ = write!(svg, "<span><i class=\"{class}\"></i> {words}</span> ");
    }
    svg + "</p>\n"
}

fn fuzz(record: &Value) -> (Result<String, String>, String) {
    let targets = record.get("targets");
    // A target without a count has tried nothing.
    let tried = || targets.members().map(|(_, target)| target.get("inputs").number().unwrap_or(0.0));
    let inputs: f64 = tried().sum();
    let fewest = tried().reduce(f64::min).unwrap_or(0.0);
    let of = |count: f64| shown(&Value::Number(format!("{count}")));
    let rows: Vec<Value> = targets
        .members()
        .map(|(name, target)| {
            let mut row: std::collections::BTreeMap<String, Value> =
                target.members().map(|(name, value)| (name.to_owned(), value.clone())).collect();
            row.insert("target".into(), Value::String(name.into()));
            Value::Object(row)
        })
        .collect();
    let head = ["target", "inputs", "seconds", "edges", "corpus", "since"];
    let verdict = format!("{} inputs without a fault, at least {} a target", of(inputs), of(fewest));
    // A target that never ran is no evidence, and one that hardly ran is not much.
    let verdict = if rows.len() as f64 != number(record, "of") {
        Err(format!("{verdict}; only {} of {} targets ran", rows.len(), shown(record.get("of"))))
    } else if fewest.partial_cmp(&number(record, "least")).is_none_or(Ordering::is_lt) {
        Err(format!("{verdict}, of {} that each should have", shown(record.get("least"))))
    } else {
        Ok(verdict)
    };
    (verdict, table(&head, &rows))
}

/// The time that wire or flash takes at least for a download, whichever is later; not a number if one
/// of them is missing.
fn limit_us(row: &Value) -> f64 {
    let (wire, flash) = (number(row, "wire_limit_us"), number(row, "flash_limit_us"));
    if wire.is_nan() || flash.is_nan() {
        f64::NAN
    } else {
        wire.max(flash)
    }
}

fn bench(record: &Value) -> (Result<String, String>, String) {
    let downloads = record.get("downloads").items();
    let longest = downloads.iter().map(|row| number(row, "measured_us")).fold(1.0, f64::max);
    let mut svg = format!(
        "<div class=\"wide\"><svg class=\"bars\" viewBox=\"0 0 760 {}\" role=\"img\" aria-label=\"duration and limits\">",
        downloads.len() * 20 + 4
    );
    for (n, row) in downloads.iter().enumerate() {
        let length = |us: f64| us / longest * 480.0;
        let (measured, y) = (length(number(row, "measured_us")), n * 20);
        let _ = write!(
            svg,
            "<text x=\"0\" y=\"{}\">{} kbit/s, {} KiB</text>\
             <rect class=\"took\" x=\"150\" y=\"{}\" width=\"{:.1}\" height=\"13\"/>\
             <rect class=\"limit\" x=\"{:.1}\" y=\"{}\" width=\"2\" height=\"19\"/>\
             <text x=\"{:.1}\" y=\"{}\">{:.2} s</text>",
            y + 13,
            number(row, "bit_rate") / 1000.0,
            shown(row.get("kib")),
            y + 2,
            measured,
            150.0 + length(limit_us(row)),
            y,
            156.0 + measured,
            y + 13,
            number(row, "measured_us") / 1e6
        );
    }
    svg += "</svg></div>\n<p class=\"key\"><span><i class=\"took\"></i> measured</span> <span><i class=\"limit\"></i> limit of wire or flash, whichever is later</span></p>\n";
    let ratios = || downloads.iter().map(|row| number(row, "measured_us") / limit_us(row));
    let slowest = ratios().fold(0.0, f64::max);
    let verdict = if downloads.is_empty() || !ratios().all(f64::is_finite) {
        Err("the record has a download without its duration or its limits, or none".into())
    } else {
        Ok(format!("at most {slowest:.2} times what wire or flash takes"))
    };
    let names = ["boards", "way", "block_size", "lost_one_in", "measured_us"];
    (verdict, svg + "<h3>Several boards</h3>\n" + &table(&names, record.get("fleets").items()))
}

fn size(record: &Value) -> (Result<String, String>, String) {
    let rows = record.get("images").items();
    let over = rows
        .iter()
        .filter(|row| number(row, "bytes").partial_cmp(&number(row, "budget")).is_none_or(Ordering::is_gt))
        .count();
    let fullest = rows.iter().map(|row| number(row, "bytes") / number(row, "budget")).fold(0.0, f64::max);
    let names = ["image", "board", "bytes", "budget"];
    let verdict = match over {
        0 if !rows.is_empty() => Ok(format!("at most {:.1} % of the budget", fullest * 100.0)),
        _ => Err(format!("{over} images are over their budget")),
    };
    let title = format!("<h3>By part, {}</h3>\n", shown(record.get("parts_of")));
    let parts = table(&["part", "raw", "packed"], record.get("parts").items());
    (verdict, table(&names, rows) + &title + &parts)
}

fn coverage(record: &Value) -> (Result<String, String>, String) {
    let words = format!("{} % of {} lines", shown(record.get("percent")), shown(record.get("lines")));
    let details = table(&["crate", "lines", "reached", "percent"], record.get("crates").items());
    // A measure of the tests, with no limit: the mutants have one.
    (
        if record.get("percent").number().is_some() {
            Ok(words)
        } else {
            Err("the record counts nothing".into())
        },
        details,
    )
}

fn mutants(record: &Value) -> (Result<String, String>, String) {
    let groups = record.get("groups").items();
    let words = groups.iter().map(|group| {
        format!(
            "{} % of {} ({})",
            shown(group.get("percent")),
            shown(group.get("viable")),
            shown(group.get("group"))
        )
    });
    let words = format!("noticed: {}", words.collect::<Vec<_>>().join(", "));
    let is_low = |group: &Value| {
        number(group, "percent").partial_cmp(&number(group, "least")).is_none_or(Ordering::is_lt)
    };
    let left = record.get("left").items();
    let words = if left.is_empty() {
        words
    } else {
        format!("{words}; not measured: {}", left.iter().map(shown).collect::<Vec<_>>().join(", "))
    };
    let is_good = !groups.is_empty()
        && !groups.iter().any(is_low)
        && number(record, "missed") == 0.0
        && left.is_empty();
    let names = ["group", "viable", "caught", "percent", "least"];
    let of_files = ["file", "caught", "named", "missed", "unviable", "commit"];
    let files = record.get("files").items();
    let mut details = table(&names, groups) + &table(&of_files, files);
    details += "<h3>What no test notices, and why</h3>\n";
    let _ = write!(details, "<div class=\"{LONG}\"><table>");
    for file in files {
        let name = file.get("file").text().unwrap_or_default();
        for row in file.get("unnoticed").items() {
            let (change, why) = (shown(row.get("change")), row.get("why").text());
            let why = text(why.unwrap_or("no reason is given"));
            let _ = writeln!(details, "<tr><td>{}</td><td>{change}</td><td>{why}</td></tr>", text(name));
        }
    }
    details += "</table></div>\n";
    (if is_good { Ok(words) } else { Err(words) }, details)
}

/// A record that says `failed` itself, and what it has counted.
fn plain(record: &Value, counted: &str) -> (Result<String, String>, String) {
    let own = ["commit", "toolchain", "date", "reads"];
    let members: Vec<(&str, &Value)> = record.members().filter(|(name, _)| !own.contains(name)).collect();
    let mut details = String::from("<div class=\"wide\"><table>");
    let mut lists = String::new();
    for (name, value) in &members {
        let title = text(&name.replace('_', " "));
        match value.items() {
            [first @ Value::Object(_), ..] => {
                let mut names: Vec<&str> = first.members().map(|(name, _)| name).collect();
                // What it is stands before the numbers, and a sentence behind them.
                names.sort_by_key(|&name| (name == WHY, first.get(name).text().is_none()));
                let _ = writeln!(lists, "<h3>{title}</h3>");
                lists += &table(&names, value.items());
            }
            _ => drop(writeln!(details, "<tr><th>{title}</th><td>{}</td></tr>", shown(value))),
        }
    }
    details += "</table></div>\n";
    details += &lists;
    let words = format!("{} {}", shown(record.get(counted)), text(counted));
    let verdict = match record.get(counted) {
        Value::Number(_) => none(record, "failed", words),
        _ => Err("the record counts nothing".into()),
    };
    (verdict, details)
}

const STYLE: &str = "
:root{color-scheme:light dark;--fg:#1f2937;--bg:#fff;--line:#d1d5db;--good:#15803d;--bad:#b91c1c;--old:#b45309;--none:#6b7280}
@media(prefers-color-scheme:dark){:root{--fg:#e5e7eb;--bg:#111827;--line:#374151;--good:#4ade80;--bad:#f87171;--old:#fbbf24;--none:#9ca3af}}
body{font:16px/1.5 system-ui,sans-serif;color:var(--fg);background:var(--bg);max-width:72rem;margin:0 auto;padding:1rem}
code{font-family:ui-monospace,monospace;font-size:.9em;overflow-wrap:anywhere}
nav{display:grid;grid-template-columns:repeat(auto-fill,minmax(13rem,1fr));gap:.75rem;margin:1.5rem 0}
.card{display:flex;flex-direction:column;border:1px solid var(--line);border-left:.35rem solid var(--mark);border-radius:.4rem;padding:.6rem .8rem;color:inherit;text-decoration:none}
.card span{font-size:.9rem}
.good{--mark:var(--good)}.bad{--mark:var(--bad)}.old{--mark:var(--old)}.none{--mark:var(--none)}
.verdict{border-left:.35rem solid var(--mark);padding-left:.6rem;font-weight:600}
.origin,.key{color:var(--none);font-size:.85rem;overflow-wrap:anywhere}
.wide{overflow-x:auto}
table{border-collapse:collapse;margin-bottom:.8rem;font-variant-numeric:tabular-nums}
th,td{border-bottom:1px solid var(--line);padding:.2rem .6rem;text-align:left;vertical-align:top}th{white-space:nowrap}
@media(max-width:40rem){.long td{display:block;border:0;overflow-wrap:anywhere}.long th{display:none}.long td[data-name]::before{content:attr(data-name) \": \";color:var(--none)}.long tr{display:block;border-bottom:1px solid var(--line)}}
svg{width:100%;min-width:34rem;font-size:12px}
svg text{fill:var(--fg)}
.key span{white-space:nowrap}.key i{display:inline-block;width:.8rem;height:.8rem;margin:0 .2rem 0 .8rem}
.new{fill:#15803d;background:#15803d}.was{fill:#2563eb;background:#2563eb}.boot{fill:#d97706;background:#d97706}
.same{fill:#c4b5fd;background:#c4b5fd}.wrong{fill:#dc2626;background:#dc2626}.uncut{fill:#9ca3af55;background:#9ca3af55}
.took{fill:#2563eb;background:#2563eb}.limit{fill:#dc2626;background:#dc2626}
section{border-top:1px solid var(--line);margin-top:1.5rem}
";

#[cfg(test)]
mod tests {
    use super::*;

    const COMMIT: &str = "0123abcd";

    /// The page with one record, the tests'.
    fn with(record: Option<&str>) -> String {
        let read = |name: &str| record.filter(|_| name == "tests").map(|text| Value::parse(text).unwrap());
        page(COMMIT, read, |_| false)
    }

    fn class(page: &str) -> &str {
        let card = page.split("href=\"#tests\"").next().unwrap().rsplit("class=\"card ").next().unwrap();
        card.split('"').next().unwrap()
    }

    #[test]
    fn only_a_good_result_of_these_sources_is_green() {
        for (record, expected) in [
            (None, "none"),
            (Some(r#"{"unfinished": true, "commit": "0123abcd"}"#), "bad"),
            (Some(r#"{"passed": 3, "failed": 0, "commit": "0123abcd"}"#), "good"),
            (Some(r#"{"passed": 3, "failed": 1, "commit": "0123abcd"}"#), "bad"),
            (Some(r#"{"passed": 3, "commit": "0123abcd"}"#), "bad"),
            (Some(r#"{"passed": 3, "failed": 0, "commit": "4567"}"#), "old"),
            (Some(r#"{"passed": 3, "failed": 0, "commit": "0123abcd-dirty"}"#), "old"),
            (Some(r#"{"passed": 3, "failed": 0}"#), "old"),
        ] {
            assert_eq!(class(&with(record)), expected, "{record:?}");
        }
        // Sources that are no commit's give no green mark, whatever was measured of them.
        let record = |_: &str| Some(Value::parse(r#"{"failed": 0, "commit": "1-dirty"}"#).unwrap());
        assert!(!page("1-dirty", record, |_| false).contains("class=\"card good\""));
    }

    #[test]
    fn fuzzing_is_good_with_enough_inputs_for_every_target() {
        for (record, good) in [
            (r#"{"of": 2, "least": 10, "targets": {"a": {"inputs": 10}, "b": {"inputs": 11}}}"#, true),
            (r#"{"of": 2, "least": 10, "targets": {"a": {"inputs": 9}, "b": {"inputs": 99}}}"#, false),
            (r#"{"of": 3, "least": 10, "targets": {"a": {"inputs": 10}, "b": {"inputs": 11}}}"#, false),
            (r#"{"of": 2, "targets": {"a": {"inputs": 10}, "b": {"inputs": 11}}}"#, false),
            (r#"{"of": 2, "least": 10, "targets": {"a": {"inputs": 10}, "b": {}}}"#, false),
            (r#"{"of": 0, "least": 10, "targets": {}}"#, false),
        ] {
            let (verdict, _) = fuzz(&Value::parse(record).unwrap());
            assert_eq!(verdict.is_ok(), good, "{record}: {verdict:?}");
        }
    }

    #[test]
    fn speed_is_good_if_each_download_has_its_limits() {
        let rows = [
            (r#"{"measured_us": 30, "wire_limit_us": 20, "flash_limit_us": 9}"#, Some("1.50")),
            (r#"{"measured_us": 30, "wire_limit_us": 9, "flash_limit_us": 24}"#, Some("1.25")),
            (r#"{"measured_us": 30, "wire_limit_us": 20}"#, None),
            (r#"{"measured_us": 30, "flash_limit_us": 20}"#, None),
            (r#"{"wire_limit_us": 20, "flash_limit_us": 20}"#, None),
            (r#"{"measured_us": 30, "wire_limit_us": 0, "flash_limit_us": 0}"#, None),
        ];
        for (row, times) in rows {
            let good = rows[0].0;
            let (verdict, _) = bench(&Value::parse(&format!(r#"{{"downloads": [{row}, {row}]}}"#)).unwrap());
            let expected = times.map(|times| format!("at most {times} times what wire or flash takes"));
            assert_eq!(verdict.ok(), expected, "{row}");
            let (verdict, _) = bench(&Value::parse(&format!(r#"{{"downloads": [{good}, {row}]}}"#)).unwrap());
            assert_eq!(verdict.is_ok(), times.is_some(), "{row}");
        }
    }

    /// What a job writes and what the page reads are the same names.
    #[test]
    fn of_the_kept_results_no_number_is_missing() {
        let kept = |name: &str| {
            let file = crate::workspace::root().join("docs/evidence").join(name).with_extension("json");
            Value::parse(&std::fs::read_to_string(file).ok()?).ok()
        };
        assert!(names().all(|name| kept(name).is_some()));
        let page = page(COMMIT, kept, |_| true);
        for missing in ["NaN", "inf ", "the record", "–"] {
            assert!(!page.contains(missing), "{missing}: {}", page.split(missing).next().unwrap_or_default());
        }
    }

    #[test]
    fn a_result_of_another_commit_is_green_while_it_holds() {
        let old = |_: &str| Some(Value::parse(r#"{"frames": 5, "failed": 0, "commit": "4567"}"#).unwrap());
        let green = |holds: bool| page(COMMIT, old, |_| holds).matches("class=\"card good").count();
        assert_eq!(green(false), 0);
        assert!(green(true) > 0);
        let of_them = |record: &Value| record.get("commit").text() == Some("4567");
        assert_eq!(class(&page(COMMIT, old, of_them)), "good");
    }

    #[test]
    fn records_of_any_contents_make_a_page() {
        for record in [
            "{}",
            "[]",
            "3",
            r#"{"boards": [{"scenarios": [{"scenario": "update", "map": {"after": "", "torn": "B!"}}]}]}"#,
            r#"{"targets": {"a": 3}}"#,
            r#"{"downloads": [{}], "images": [{}]}"#,
            r#"{"a": "<b>", "commit": "<i>"}"#,
            r#"{"commit": "0123abcd"}"#,
            r#"{"commit": "0123abcd", "boards": [], "targets": {}, "downloads": [], "images": [], "groups": []}"#,
            r#"{"commit": "0123abcd", "boards": [{}], "targets": {"a": {}}, "downloads": [{}], "images": [{}], "groups": [{}]}"#,
        ] {
            let record = Value::parse(record).unwrap();
            let page = page(COMMIT, |_| Some(record.clone()), |_| false);
            assert!(page.ends_with("</html>\n") && !page.contains("<b>\"") && !page.contains("<i>,"));
            assert!(!page.contains("class=\"card good\""), "{record:?}");
        }
    }

    #[test]
    fn a_sentence_stands_behind_the_numbers_of_a_list() {
        let record =
            r#"{"words": 1, "failed": 0, "explained": [{"a": 5, "why": "so", "z": "what"}], "found": []}"#;
        let (verdict, details) = plain(&Value::parse(record).unwrap(), "words");
        assert_eq!(verdict, Ok("1 words".into()));
        assert!(details.contains("<th>z</th><th>a</th><th>why</th>"), "{details}");
        assert!(details.contains("<th>found</th><td>none</td>"), "{details}");
    }

    #[test]
    fn the_map_shows_the_worst_of_a_column() {
        let wide = "N".repeat(1439) + "!";
        let record = Value::parse(&format!(r#"{{"torn": "{wide}"}}"#)).unwrap();
        let map = map(&record);
        assert_eq!(map.matches("<rect class=\"wrong\"").count(), 1, "{map}");
        assert!(map.contains("<rect class=\"new\" x=\"110.0\" y=\"0\" width=\"719.0\""), "{map}");
    }
}
