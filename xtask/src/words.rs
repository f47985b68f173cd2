//! The words of comments and pages: for a few phrases there is an exact word.

use std::fs;
use std::process::Command;

use crate::{outcome::Outcome, process, workspace};

/// Pages about the past, which keep their words.
const PAST: [&str; 2] = ["CHANGELOG.md", "docs/adr/"];

/// Words that are wrong in front of certain words, and what to write.
struct Rule {
    words: &'static [&'static str],
    before: &'static [&'static str],
    write: &'static str,
}

const RULES: [Rule; 4] = [
    // Time and order; a router and a trait have a place behind them.
    Rule {
        words: &["behind"],
        before: &[
            "abort", "answer", "boot-up", "burst", "bus-off", "cut", "download", "erase", "frame", "frames",
            "header", "message", "power", "program", "request", "reset", "restart", "table", "vectors",
        ],
        write: "after",
    },
    Rule { words: &["tell", "tells", "told"], before: &["apart"], write: "distinguish" },
    Rule {
        words: &["tell", "tells", "told"],
        before: &["how", "what", "which", "whether", "why", "where", "when", "who"],
        write: "say, report, show or print",
    },
    Rule { words: &["stand", "stands"], before: &["at", "beside", "in", "there"], write: "is or are" },
];

/// Words that may be between the two of a rule.
const ARTICLES: [&str; 6] = ["a", "an", "the", "each", "every", "its"];

/// The phrases in the comments of all Rust sources and on all pages of the repository, as messages.
///
/// # Errors
/// When git does not list the files.
pub fn faults() -> Outcome<Vec<String>> {
    let mut git = Command::new("git");
    git.arg("-C").arg(workspace::root()).args(["ls-files", "-z", "--", "*.rs", "*.md"]);
    let mut faults = Vec::new();
    for file in process::output(&mut git)?.split_terminator('\0') {
        if PAST.iter().any(|past| file.starts_with(past)) {
            continue;
        }
        // A file that is listed may have been deleted since the last commit.
        let Ok(text) = fs::read_to_string(workspace::root().join(file)) else { continue };
        let found = faults_of(&text, file.ends_with(".md"));
        faults.extend(found.into_iter().map(|(line, fault)| format!("{file}:{line}: {fault}")));
    }
    Ok(faults)
}

/// The faults of a file, each with the number of its line.
fn faults_of(text: &str, is_page: bool) -> Vec<(usize, String)> {
    let words = words(text, is_page);
    let is_mark = |c: char| !c.is_alphanumeric();
    let bare = |at: usize| words.get(at).map_or("", |(_, word)| word.trim_end_matches(is_mark));
    let is = |at: usize, known: &[&str]| known.iter().any(|known| bare(at).eq_ignore_ascii_case(known));
    let mut faults = Vec::new();
    for (at, (line, word)) in words.iter().enumerate() {
        let next = if is(at + 1, &ARTICLES) { at + 2 } else { at + 1 };
        // Whatever stands for another thing takes its place.
        let takes_its_place = is(next, &["in"]) && is(next + 1, &["for"]);
        for rule in &RULES {
            // After a word with a punctuation mark, another phrase begins.
            let is_word = rule.words.iter().any(|known| known.eq_ignore_ascii_case(word));
            if is_word && is(next, rule.before) && !takes_its_place {
                faults.push((*line, format!("\"{word} {}\": write {}", bare(next), rule.write)));
            }
        }
    }
    faults
}

/// The words of the comments of a source, or of a page without its blocks of code, each with the
/// number of its line and without punctuation marks in front. An empty word ends a phrase.
fn words(text: &str, is_page: bool) -> Vec<(usize, &str)> {
    let (mut words, mut is_code) = (Vec::new(), false);
    for (number, line) in (1..).zip(text.lines()) {
        let is_fence = is_page && line.trim_start().starts_with("```");
        is_code ^= is_fence;
        let read = if is_page { (!is_code && !is_fence).then_some(line) } else { comment(line) };
        let read = read.unwrap_or_default().trim_start_matches(['/', '!']);
        let is_mark = |c: char| !c.is_alphanumeric();
        words.extend(read.split_whitespace().map(|word| (number, word.trim_start_matches(is_mark))));
        if read.trim().is_empty() {
            words.push((number, ""));
        }
    }
    words
}

/// The comment in a line of Rust.
fn comment(line: &str) -> Option<&str> {
    let line = line.trim_start();
    if line.starts_with("//") {
        return Some(line);
    }
    line.split_once(" // ").map(|(_code, comment)| comment)
}

#[test]
fn comments_and_pages_use_the_exact_words() {
    assert_eq!(faults().unwrap(), Vec::<String>::new());
}

#[test]
fn a_phrase_is_found_in_comments_and_on_pages_also_across_lines() {
    let lines = |text: &str, is_page: bool| {
        faults_of(text, is_page).into_iter().map(|(line, _)| line).collect::<Vec<usize>>()
    };
    let source = "/! Asked behind\n/! each Frame.\nlet behind = tells(which);\nx(); / (Tells how) it\n\
                  /\n/ behind a gateway, it stands in for a reset\n/ it stands. In front\n/ behind\n\n/ a cut\n";
    assert_eq!(lines(&source.replace('/', "//"), false), [1, 4]);
    let page = "It `tells` how.\n```\nbehind the reset\n```\n| stands | in |\nIt stands\nin *the* list.\n";
    assert_eq!(lines(page, true), [6]);
    assert_eq!(
        faults_of("to tell them, to tell apart", true),
        [(1, "\"tell apart\": write distinguish".to_owned())]
    );
}
