//! The words of sources and pages: for a few phrases there is an exact word.

use std::path::Path;
use std::process::Command;

use crate::{outcome::Outcome, process, workspace};

/// The files that are read: not the pages about the past, which keep their words.
const FILES: [&str; 4] = ["*.rs", "*.md", ":!CHANGELOG.md", ":!docs/adr"];

/// Words that are wrong in front of certain words, as regular expressions of Perl, and what to write.
const RULES: [(&str, &str, &str); 4] = [
    // Time and order; a router and a trait have a place behind them.
    (
        "behind",
        "abort|answer|boot-up|burst|bus-off|cut|download|erase|frames?|header|message|power|program|request|reset|\
         restart|table|vectors",
        "after",
    ),
    ("tells?|told", "apart", "distinguish"),
    ("tells?|told", "how|what|which|whether|why|where|when|who", "say, report, show or print"),
    // What takes the place of another thing may.
    ("stands?", "at|beside|in(?! for)|there", "is or are"),
];
/// What may be between the two: blanks or the end of a line, with the beginning of a comment in the next one, and an
/// article.
const BETWEEN: &str = r"(?<gap>\h*\n\h*(//[/!]?\h+)?|\h+)((an?|the|each|every|its)(?&gap))?";

/// The phrases in all Rust sources and on all pages of the repository, as messages.
///
/// # Errors
/// When git does not list the files.
pub fn faults() -> Outcome<Vec<String>> {
    let files = process::git(&[&["ls-files", "-z", "--"], &FILES[..]].concat())?;
    faults_of(workspace::root(), &files.split_terminator('\0').collect::<Vec<_>>())
}

fn faults_of(folder: &Path, files: &[&str]) -> Outcome<Vec<String>> {
    let mut faults = Vec::new();
    for (words, before, write) in RULES {
        // A file is one line for it, so that a phrase may have two; a listed file may have been deleted.
        let mut grep = Command::new("grep");
        grep.args(["-Pzois", "--with-filename"]).arg(format!(r"\b({words}){BETWEEN}({before})\b"));
        let found = grep.args(files).current_dir(folder).output();
        let found = found.map_err(|error| process::not_started(&grep, &error))?;
        if !found.stderr.is_empty() {
            return Err(format!("grep has not read all: {}", String::from_utf8_lossy(&found.stderr)));
        }
        let found = String::from_utf8_lossy(&found.stdout).into_owned();
        faults.extend(found.split_terminator('\0').map(|phrase| format!("{phrase:?}: write {write}")));
    }
    Ok(faults)
}

#[test]
fn sources_and_pages_use_the_exact_words() {
    assert_eq!(faults().unwrap(), Vec::<String>::new());
}

#[test]
fn a_phrase_is_found_also_across_lines() {
    let folder = kit::folder::Folder::below(std::env::temp_dir(), "coboot-words");
    let text = "//! Asked b~ehind\n//! each Frame.\nlet behind = tells(which);\nx(); // (T~ells how) it\n\
                // behind a gateway, it stands in for a reset\n// it stands. In front\n// behind\n\n// a cut\n\
                | stands | in |\nIt `tells` how, and s~tands\nin *the* list.\n";
    std::fs::write(folder.join("a.rs"), text.replace('~', "")).unwrap();
    let expected = [
        r#""a.rs:behind\n//! each Frame": write after"#,
        r#""a.rs:T~ells how": write say, report, show or print"#,
        r#""a.rs:stands\nin": write is or are"#,
    ]
    .map(|fault| fault.replace('~', ""));
    assert_eq!(faults_of(&folder, &["a.rs"]).unwrap(), expected);
}
