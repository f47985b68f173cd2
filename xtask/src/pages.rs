//! The commands that the pages show: every line of a block that is for a shell, and every call in
//! running text.
//!
//! For tests alone. Those of `coflash` and `coboot-node`, which have the command lines' own readers,
//! take this file in by its path.

use std::fs;
use std::path::{Path, PathBuf};

/// A command on a page.
#[derive(Clone, Debug)]
pub struct Shown {
    /// Page and line.
    pub place: String,
    /// Its words, as a shell would take them apart.
    pub words: Vec<String>,
    /// Whether it stands in running text: there it may be a mention, without all that a call needs.
    pub inline: bool,
}

/// Calls in running text begin with one of these.
const CALLS: [&str; 3] = ["coflash ", "coboot-node ", "cargo xtask "];
/// The languages of blocks in which every line is a command. In other blocks those behind `$ ` are.
const SHELLS: [&str; 3] = ["sh", "bash", "shell"];
/// Folders without pages of ours.
const FOREIGN: [&str; 4] = ["target", ".git", "corpus", "node_modules"];

/// All of them.
pub fn commands() -> Vec<Shown> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("a crate lies in the workspace");
    let mut pages = Vec::new();
    find(root, &mut pages);
    pages.sort();
    assert!(pages.len() > 20, "{pages:?}");
    let mut found = Vec::new();
    for page in pages {
        let text = fs::read_to_string(&page).expect("a page is text");
        let name = page.strip_prefix(root).expect("below the root").display().to_string();
        // What was is told by its name of then: no calls in running text there.
        let history = name == "CHANGELOG.md" || name.contains("adr");
        found.extend(of_page(&name, &text, !history));
    }
    found
}

fn find(folder: &Path, pages: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).expect("a folder") {
        let path = entry.expect("an entry").path();
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if path.is_dir() && !FOREIGN.contains(&name.as_str()) {
            find(&path, pages);
        } else if path.extension().is_some_and(|extension| extension == "md") {
            pages.push(path);
        }
    }
}

fn of_page(name: &str, text: &str, inline_too: bool) -> Vec<Shown> {
    let mut found = Vec::new();
    // The language of the block that is open.
    let mut block: Option<String> = None;
    let mut lines = text.lines().enumerate();
    while let Some((number, line)) = lines.next() {
        let place = format!("{name}:{}", number + 1);
        if let Some(language) = line.trim_start().strip_prefix("```") {
            block = match block {
                None => Some(language.trim().to_string()),
                Some(_) => None,
            };
            continue;
        }
        let Some(language) = &block else {
            if inline_too {
                let calls = spans(line).filter(|span| CALLS.iter().any(|call| span.starts_with(call)));
                found.extend(calls.flat_map(|span| split(&place, span, true)));
            }
            continue;
        };
        let mut line = match line.trim_start().strip_prefix("$ ") {
            Some(command) => command.to_string(),
            None if SHELLS.contains(&language.as_str()) => line.trim_start().to_string(),
            None => continue,
        };
        while let Some(open) = line.strip_suffix('\\') {
            let more = lines.next().map(|(_, more)| more.trim()).unwrap_or_default();
            line = format!("{open}{more}");
        }
        found.extend(split(&place, &line, false));
    }
    found
}

/// The code in running text.
fn spans(line: &str) -> impl Iterator<Item = &str> {
    line.split('`').skip(1).step_by(2)
}

/// The commands of a line: what stands between `&&`, `|` and `;`, without redirection, comments and
/// variables in front.
fn split(place: &str, line: &str, inline: bool) -> Vec<Shown> {
    let mut all = vec![Vec::new()];
    let mut redirected = false;
    for word in words(line) {
        match word.as_str() {
            "&&" | "|" | ";" | "||" => all.push(Vec::new()),
            ">" | ">>" | "<" | "2>" => redirected = true,
            _ if redirected => redirected = false,
            "&" => {}
            _ => all.last_mut().expect("one at least").push(word),
        }
    }
    let is_variable = |word: &String| {
        word.split_once('=').is_some_and(|(name, _)| {
            !name.is_empty() && name.bytes().all(|byte| byte.is_ascii_uppercase() || byte == b'_')
        })
    };
    let bare = all.into_iter().map(|words| words.into_iter().skip_while(is_variable).collect::<Vec<_>>());
    let shown = |words| Shown { place: place.to_string(), words, inline };
    bare.filter(|words| !words.is_empty()).map(shown).collect()
}

/// The words of a line, quotes taken off; a comment ends it.
fn words(line: &str) -> Vec<String> {
    let (mut words, mut word, mut quote) = (Vec::new(), None::<String>, None);
    for character in line.chars() {
        match (quote, character) {
            (Some(end), _) if end == character => quote = None,
            (Some(_), _) => word.get_or_insert_default().push(character),
            (None, '\'' | '"') => {
                quote = Some(character);
                word.get_or_insert_default();
            }
            (None, '#') if word.is_none() => break,
            (None, ' ' | '\t') => words.extend(word.take()),
            (None, _) => word.get_or_insert_default().push(character),
        }
    }
    words.extend(word);
    words
}

/// What a program is given, if this runs it: by its name, or by `cargo run -p NAME --`.
// Not each of those who take this file in asks for it.
#[allow(dead_code)]
pub fn call_of<'w>(words: &'w [String], program: &str) -> Option<&'w [String]> {
    match words {
        [name, rest @ ..] if name == program => Some(rest),
        [cargo, run, option, name, dashes, rest @ ..]
            if [cargo, run, option, dashes] == ["cargo", "run", "-p", "--"] && name == program =>
        {
            Some(rest)
        }
        _ => None,
    }
}

/// What is written in capitals stands for something: a command, a board, a file.
// As above.
#[allow(dead_code)]
pub fn is_placeholder(word: &str) -> bool {
    !word.is_empty() && word.bytes().all(|byte| byte.is_ascii_uppercase() || byte == b'_')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn commands_are_found_as_a_reader_finds_them() {
        let page = "Call `coflash scan` or `coflash.toml`.\n```\n$ coflash read 100A > x # twice\n  node 5\n```\n\
                    ```sh\nA=b cargo xtask size && coflash info -N '5 6' | less\ncargo run -p coflash -- scan \\\n  \
                    --json\n# nothing\n```\n```toml\ncoflash = 1\n```\n";
        let found = of_page("page.md", page, true);
        let lines: Vec<String> = found
            .iter()
            .map(|shown| format!("{} {} {}", shown.place, u8::from(shown.inline), shown.words.join("|")))
            .collect();
        assert_eq!(
            lines,
            [
                "page.md:1 1 coflash|scan",
                "page.md:3 0 coflash|read|100A",
                "page.md:7 0 cargo|xtask|size",
                "page.md:7 0 coflash|info|-N|5 6",
                "page.md:7 0 less",
                "page.md:8 0 cargo|run|-p|coflash|--|scan|--json"
            ]
        );
        assert_eq!(call_of(&found[5].words, "coflash").unwrap(), ["scan", "--json"]);
        assert!(call_of(&found[5].words, "coboot-node").is_none());
    }
}
