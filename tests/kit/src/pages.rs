//! The commands on the pages: every line of a block for a shell, and every call in running text.
//!
//! The tests of `coflash`, `coboot-node` and `xtask` read them with the readers of their command
//! lines.

use std::fs;
use std::path::{Path, PathBuf};

/// A command on a page.
#[derive(Clone, Debug)]
pub struct Shown {
    /// The page and the line number.
    pub place: String,
    /// Its words, split as in a shell.
    pub words: Vec<String>,
    /// Whether it is in running text: there it may be an incomplete mention of a command.
    pub inline: bool,
}

/// The prefixes of calls in running text.
const CALLS: [&str; 3] = ["coflash ", "coboot-node ", "cargo xtask "];
/// The languages of blocks in which every line is a command. In other blocks a command follows `$
/// `.
const SHELLS: [&str; 3] = ["sh", "bash", "shell"];
/// Folders without our pages.
const FOREIGN: [&str; 4] = ["target", ".git", "corpus", "node_modules"];

/// The commands of all pages.
///
/// # Panics
/// When a page cannot be read.
pub fn commands() -> Vec<Shown> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().find(|folder| folder.join("docs").is_dir());
    let root = root.expect("a crate lies in the workspace");
    let mut pages = Vec::new();
    find(root, &mut pages);
    pages.sort();
    assert!(pages.len() > 20, "{pages:?}");
    let mut found = Vec::new();
    for page in pages {
        let text = fs::read_to_string(&page).expect("a page is text");
        let name = page.strip_prefix(root).expect("below the root").display().to_string();
        // Pages about the past use old names: their running text is not searched for calls.
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
    // The language of the open block.
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

/// The commands of a line: the parts between `&&`, `|` and `;`, without redirections, comments and
/// leading variables.
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

/// The words of a line, without quotes; a comment ends the line.
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

/// The arguments of a program, if the command runs it: by its name, or by `cargo run -p NAME --`.
pub fn call_of<'w>(words: &'w [String], program: &str) -> Option<&'w [String]> {
    match words {
        [name, arguments @ ..] if name == program => Some(arguments),
        [cargo, run, option, name, dashes, arguments @ ..]
            if [cargo, run, option, dashes] == ["cargo", "run", "-p", "--"] && name == program =>
        {
            Some(arguments)
        }
        _ => None,
    }
}

/// A word in capitals is a placeholder: for a command, a board, a file.
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
