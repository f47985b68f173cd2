//! The paths on the pages: a path in backticks is that of a file or a folder of the repository.

use std::path::{Path, PathBuf};

use crate::{files, links, workspace};

/// Folders without our files, and pages about the past, which use old names.
const FOREIGN: [&str; 4] = ["target", ".git", "node_modules", "adr"];
/// Files that are not in the repository: those of a user, of a package, and what a job makes.
const ELSEWHERE: [&str; 5] = [
    "docs/evidence.md",
    "coflash/coflash.toml",
    ".vscode/launch.json",
    "udev/70-coflash.rules",
    "build/app.elf",
];

/// The word as a path, if it is one: with a slash and a small letter, and without a blank. What
/// `cargo` and CMake build is none.
fn path_of(word: &str) -> Option<&str> {
    let word = word.trim_end_matches('/');
    let is_path = word.chars().all(|c| c.is_ascii_alphanumeric() || "_.-/".contains(c))
        && word.contains('/')
        && !word.starts_with('/')
        && word.contains(|c: char| c.is_ascii_lowercase());
    let is_built = word.starts_with("target/") || word.starts_with("build/");
    (is_path && !is_built).then_some(word)
}

/// Whether a file has this path, or is in this folder: from the root or from the page's folder on, or
/// from any folder on if it is as short as `intake/mod.rs`. `BOARD` and `my-board` are any name.
fn is_there(path: &str, page: &Path, files: &[PathBuf]) -> bool {
    let any = |name: &str| ["BOARD", "my-board"].contains(&name.split('.').next().unwrap_or(name));
    let names = |path: &Path| path.iter().map(|name| name.to_string_lossy().into_owned()).collect::<Vec<_>>();
    let same = |(name, wanted): (&String, &String)| name == wanted || any(wanted);
    let wanted = [names(Path::new(path)), names(&links::plain(&page.with_file_name(path)))];
    let is_short = !wanted[0].iter().any(|name| ["src", "tests"].contains(&name.as_str()));
    files.iter().any(|file| {
        let file = names(file);
        let is_at = |wanted: &[String], at: usize| {
            let part = file.get(at..at + wanted.len());
            part.is_some_and(|part| part.iter().zip(wanted).all(same))
        };
        wanted.iter().any(|wanted| is_at(wanted, 0))
            || is_short && (1..file.len()).any(|at| is_at(&wanted[0], at))
    })
}

#[test]
fn paths_on_the_pages_are_those_of_files() {
    let root = workspace::root();
    let files = files::below(root, &FOREIGN).unwrap();
    let files: Vec<_> = files.iter().map(|file| file.strip_prefix(root).unwrap().to_owned()).collect();
    let mut faults = Vec::new();
    let mut count = 0;
    for page in files.iter().filter(|file| files::is(file, "md")) {
        let text = files::ours(page).unwrap();
        for (number, parts) in links::prose(&text) {
            for path in parts.into_iter().skip(1).step_by(2).filter_map(path_of) {
                count += 1;
                if !ELSEWHERE.contains(&path) && !is_there(path, page, &files) {
                    faults.push(format!("{}:{number}: there is no {path}", page.display()));
                }
            }
        }
    }
    assert_eq!(faults, Vec::<String>::new());
    assert!(count > 100, "{count}");
}

#[test]
fn a_path_that_is_not_there_is_found() {
    let files = ["core/a/src/x/mod.rs", "boards/one.rs"].map(PathBuf::from);
    let is_there = |path: &str| is_there(path, Path::new("core/a/page.md"), &files);
    let good =
        ["core/a/src/x/mod.rs", "src/x", "../../boards/one.rs", "x/mod.rs", "core/a", "boards/BOARD.rs"];
    let bad = ["a/src/x/mod.rs", "a/x/mod.rs", "core/b", "core/a/src/x/y.rs", "board/BOARD.rs", "../src/x"];
    for (paths, there) in [(good, true), (bad, false)] {
        assert_eq!(paths.map(is_there), [there; 6]);
    }
    assert_eq!(["a/b.rs", "a/", "tests/x/"].map(path_of), [Some("a/b.rs"), None, Some("tests/x")]);
    assert_eq!(["1018/4", "target/x", "/dev/null", "a b/c", "https://a/b"].map(path_of), [None; 5]);
}
