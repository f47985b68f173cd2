//! The module graph of a crate, from its sources: which file uses which.
//!
//! A use is a path that names a module: in a `use` item, nested groups included, or in code, with
//! `crate::`, `super::`, `self::` or the name of a child module. `mod x;` declares a module, but
//! does not use it. Uses in tests do not count.

use std::collections::{BTreeMap, BTreeSet};

/// A module by its path below the crate's root: `device::session`. The root is the empty path.
pub type Module = Vec<String>;

/// For each file, the files that it uses.
pub type Graph = BTreeMap<Module, BTreeSet<Module>>;

/// Reads the graph from the sources of a crate: the path of each below `src/`, and its text.
/// `krate` is the name of the library in the code of a binary beside it.
pub fn graph(krate: &str, sources: &[(String, String)]) -> Graph {
    let has_library = sources.iter().any(|(path, _)| path == "lib.rs");
    let mut modules: Vec<(Module, &str)> =
        sources.iter().filter_map(|(path, text)| Some((module(path, has_library)?, text.as_str()))).collect();
    modules.retain(|(module, _)| module.last().is_none_or(|name| name != "tests"));
    let known: BTreeSet<Module> = modules.iter().map(|(module, _)| module.clone()).collect();
    // Without `lib.rs` the name is that of another file, or of nothing.
    let krate = if has_library { krate.replace('-', "_") } else { String::new() };
    let programs: Vec<Module> = sources.iter().filter_map(|(path, _)| program(path)).collect();
    let mut graph = Graph::new();
    for (own, text) in &modules {
        let uses = graph.entry(own.clone()).or_default();
        let root = programs.iter().find(|folder| own.starts_with(folder)).map_or(&[][..], Vec::as_slice);
        for path in paths(&code(text)) {
            let Some(target) = resolve(&path, own, root, &krate, &known) else { continue };
            if target != *own {
                uses.insert(target);
            }
        }
    }
    graph
}

/// The folder of a program beside the crate's own, from the path of its `main.rs`: `crate::` is this
/// folder in its files.
fn program(path: &str) -> Option<Module> {
    Some(path.strip_suffix("/main.rs")?.split('/').map(str::to_owned).collect())
}

/// The module of a file; `None` for the root of a program beside a library, and of a program in one
/// file: no other file can use it.
fn module(path: &str, has_library: bool) -> Option<Module> {
    let path = path.strip_suffix(".rs")?;
    let mut parts: Module = path.split('/').map(str::to_owned).collect();
    let is_in_bin = parts.len() == 2 && parts[0] == "bin";
    if is_in_bin || path == "main" && has_library {
        return None;
    }
    if path == "lib" || parts.last().is_some_and(|last| ["main", "mod"].contains(&last.as_str())) {
        parts.pop();
    }
    Some(parts)
}

/// A source without its comments, which may name what is not there.
pub fn without_comments(text: &str) -> String {
    text.lines().map(|line| line.split("//").next().unwrap_or_default()).collect::<Vec<_>>().join("\n")
}

/// A source without comments, strings and tests.
pub fn code(text: &str) -> String {
    let mut code = String::new();
    let mut lines = text.lines().filter(|line| !line.trim_start().starts_with("//"));
    while let Some(line) = lines.next() {
        if line == "#[cfg(test)]" {
            match lines.next() {
                // The last item of a file; a module of tests in a file of its own is only declared.
                Some(tests) if tests.starts_with("mod ") && tests.ends_with('{') => break,
                _ => continue,
            }
        }
        // Text between quotation marks is not a path.
        code.extend(line.split('"').step_by(2));
        code.push('\n');
    }
    code
}

/// All paths of two or more segments, with groups resolved: `a::{b, c::d}` is `a::b` and `a::c::d`.
pub fn paths(code: &str) -> Vec<Vec<String>> {
    let tokens = tokens(code);
    let mut found = Vec::new();
    let mut at = 0;
    while at < tokens.len() {
        let next = tokens.get(at + 1).map(String::as_str);
        if tokens[at] == "pub" && next == Some("(") {
            // It skips the visibility.
            at += tokens[at..].iter().position(|token| token == ")").unwrap_or(1);
        } else if is_name(&tokens[at]) && next == Some("::") {
            at = tree(&tokens, at, &mut Vec::new(), &mut found);
        } else if ["use", "crate"].contains(&&*tokens[at]) && next.is_some_and(is_name) {
            // A single name is a path, too: `use x;`, `extern crate x;`.
            at = tree(&tokens, at + 1, &mut Vec::new(), &mut found);
        } else {
            at += 1;
        }
    }
    found
}

/// Reads one path from a name on; returns its end.
fn tree(tokens: &[String], from: usize, before: &mut Vec<String>, found: &mut Vec<Vec<String>>) -> usize {
    let is = |at: usize, word: &str| tokens.get(at).is_some_and(|token| token == word);
    let (mut at, depth) = (from, before.len());
    let mut goes_on = true;
    while goes_on && tokens.get(at).is_some_and(|token| is_name(token)) {
        before.push(tokens[at].clone());
        goes_on = is(at + 1, "::");
        at += if goes_on { 2 } else { 1 };
    }
    if goes_on && is(at, "{") {
        at += 1;
        while at < tokens.len() && !is(at, "}") {
            // A comma, the star of a glob, or `as` with its name.
            let is_other = !is_name(&tokens[at]) || is(at, "as");
            at = if is_other { at + 1 } else { tree(tokens, at, before, found) };
        }
        at += 1;
    } else {
        found.push(before.clone());
    }
    before.truncate(depth);
    at
}

/// Splits code into names, `::`, and single other characters.
fn tokens(code: &str) -> Vec<String> {
    let mut tokens: Vec<String> = Vec::new();
    let mut letters = code.chars().peekable();
    while let Some(letter) = letters.next() {
        if letter.is_alphanumeric() || letter == '_' {
            let mut word = letter.to_string();
            while let Some(next) = letters.next_if(|next| next.is_alphanumeric() || *next == '_') {
                word.push(next);
            }
            tokens.push(word);
        } else if letter == ':' && letters.next_if_eq(&':').is_some() {
            tokens.push("::".to_owned());
        } else if !letter.is_whitespace() {
            tokens.push(letter.to_string());
        }
    }
    tokens
}

fn is_name(token: &str) -> bool {
    token.starts_with(|letter: char| letter.is_alphabetic() || letter == '_')
}

/// The file of a path: the longest part of the path that is a module. `root` is where `crate::` leads.
fn resolve(
    path: &[String],
    own: &[String],
    root: &[String],
    krate: &str,
    known: &BTreeSet<Module>,
) -> Option<Module> {
    let (mut at, rest) = match path.first().map(String::as_str)? {
        "self" => (own.to_vec(), &path[1..]),
        "super" => {
            let up = path.iter().take_while(|name| *name == "super").count();
            (own[..own.len().saturating_sub(up)].to_vec(), &path[up..])
        }
        "crate" => {
            let rest = &path[1..];
            let first = &rest[..rest.len().min(1)];
            // A program takes files of the folder above it by `#[path]`.
            let is_above = known.contains(first) && !known.contains(&[root, first].concat());
            (if is_above { Module::new() } else { root.to_vec() }, rest)
        }
        name if name == krate => (Module::new(), &path[1..]),
        // The name of a child; any other name is of another crate, or was imported by a `use`.
        _ if known.contains(&[own, &path[..1]].concat()) => (own.to_vec(), path),
        _ => return None,
    };
    for name in rest {
        at.push(name.clone());
        if !known.contains(&at) {
            at.pop();
            break;
        }
    }
    // A module without a file of its own is left out.
    known.contains(&at).then_some(at)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn uses(own: &str, text: &str) -> Vec<String> {
        let files = ["lib.rs", "main.rs", "a/mod.rs", "a/b.rs", "a/b/deep.rs", "a/c.rs", "d.rs", "e/mod.rs"];
        let sources: Vec<_> = files
            .iter()
            .map(|file| ((*file).to_owned(), if *file == own { text.to_owned() } else { String::new() }))
            .collect();
        let graph = graph("my-crate", &sources);
        graph[&module(own, true).unwrap()].iter().map(|module| module.join("::")).collect()
    }

    #[test]
    fn paths_lead_into_files() {
        assert_eq!(uses("a/b.rs", "use super::c::X;"), ["a::c"]);
        assert_eq!(uses("a/b.rs", "use super::X;"), ["a"]);
        assert_eq!(uses("a/b.rs", "use super::{c, X};"), ["a", "a::c"]);
        assert_eq!(uses("a/b.rs", "use crate::{a::{c::{Y, Z}, W}, d, e::V};"), ["a", "a::c", "d", "e"]);
        assert_eq!(uses("a/b/deep.rs", "use super::super::c;\nuse super::X;"), ["a::b", "a::c"]);
        assert_eq!(uses("a/b.rs", "fn f() { crate::d::g(&crate::e::H) }"), ["d", "e"]);
        assert_eq!(uses("d.rs", "use my_crate::a::b::X;"), ["a::b"]);
        assert_eq!(uses("d.rs", "use crate::X;\nuse std::a::b;"), [""]);
        assert_eq!(uses("a/b.rs", "use crate::d as f;"), ["d"]);
        assert_eq!(uses("a/b.rs", "use crate::a::c::*;"), ["a::c"]);
        assert_eq!(uses("a/b.rs", "pub(in crate::a) fn f(x: crate::d::X) {}"), ["d"]);
    }

    #[test]
    fn a_child_is_used_by_its_name_and_not_by_its_declaration() {
        assert_eq!(uses("a/mod.rs", "mod b;\npub mod c;"), [""; 0]);
        assert_eq!(uses("a/mod.rs", "pub use self::b::X;"), ["a::b"]);
        assert_eq!(uses("a/mod.rs", "mod b; fn f() { b::g() }"), ["a::b"]);
        assert_eq!(uses("lib.rs", "pub use a::X;\nuse d;"), ["a", "d"]);
    }

    #[test]
    fn comments_texts_and_tests_use_nothing() {
        let text = "//! crate::d\n// crate::d\nfn f() { \"crate::d\"; }\n#[cfg(test)]\nmod tests { use crate::d::X; }";
        assert_eq!(uses("a/b.rs", text), [""; 0]);
        let text = "#[cfg(test)]\nmod tests;\nuse crate::d::X;\n#[cfg(test)]\nuse crate::e::Y;";
        assert_eq!(uses("a/b.rs", text), ["d"]);
    }
}
