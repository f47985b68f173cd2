//! `cargo xtask docs`: makes a site of the pages.
//!
//! mdBook renders a copy of the pages in which every file has its path of the repository. So a link
//! is the same in the site, in the repository, and on a server that shows Markdown.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::args::Args;
use crate::{files, links, process, setup, workspace, Outcome};

pub const HELP: &str = "\
usage: cargo xtask docs

Makes the site of README.md and docs/ in target/book; open target/book/index.html. The order of the
pages stands in docs/SUMMARY.md. Fails on every warning, on a link that leads nowhere, and on a page
that the summary does not have.

mdBook is installed into target/tools where it is missing, which takes some minutes once.
";

const MDBOOK: &str = "mdbook";
const VERSION: &str = "0.5.4";
/// The only feature of mdBook that is useful for readers.
const FEATURES: [&str; 3] = ["--no-default-features", "--features", "search"];

/// The order of the pages; its links start at `docs/`.
const SUMMARY: &str = "docs/SUMMARY.md";

pub fn run(args: Args) -> Outcome {
    args.none_left()?;
    let mut faults = links::faults()?;
    faults.extend(not_in(&files::ours(SUMMARY)?, &links::pages()?));
    refuse("the pages", &faults)?;

    let mdbook = setup::tool(MDBOOK, VERSION, &FEATURES)?;
    let copy = workspace::target_dir().join("book-source");
    let book = workspace::target_dir().join("book");
    files::remove(&copy)?;
    files::remove(&book)?;
    gather(&copy)?;
    let mut build = Command::new(mdbook);
    build.arg("build").arg("--dest-dir").arg(&book).arg(&copy);
    let said = process::messages(&mut build)?;
    refuse("mdBook", &warnings(&said))?;
    refuse("the site", &broken(&book)?)?;
    println!("{}", workspace::shown(&book.join("index.html")));
    Ok(())
}

fn refuse(what: &str, faults: &[String]) -> Outcome {
    if faults.is_empty() {
        return Ok(());
    }
    Err(format!("{what}: {} to be mended:\n    {}", faults.len(), faults.join("\n    ")))
}

/// The pages that are missing in the summary, as messages.
fn not_in(summary: &str, pages: &[PathBuf]) -> Vec<String> {
    let targets: BTreeSet<PathBuf> =
        links::of_page(Path::new(SUMMARY), summary).into_iter().map(|link| link.file).collect();
    pages
        .iter()
        .filter(|page| **page != Path::new(SUMMARY) && !targets.contains(*page))
        .map(|page| {
            format!("{SUMMARY} does not have {}: enter it where a reader looks for it", page.display())
        })
        .collect()
}

/// Copies pages, pictures, the files that they link to, and mdBook's configuration.
fn gather(to: &Path) -> Outcome {
    let mut files: BTreeSet<PathBuf> = links::pages()?.into_iter().collect();
    files.extend(links::all()?.into_iter().map(|link| link.file));
    for file in files {
        files::copy(&workspace::root().join(&file), &to.join("src").join(&file))?;
    }
    for (file, place) in [("docs/book.toml", "book.toml"), ("docs/site.css", "site.css")] {
        files::copy(&workspace::root().join(file), &to.join(place))?;
    }
    files::write(&to.join("src/SUMMARY.md"), from_the_root(&files::ours(SUMMARY)?))
}

/// The summary with links from the root of the repository.
fn from_the_root(summary: &str) -> String {
    summary.replace("](", "](docs/").replace("](docs/../", "](")
}

/// The warnings and errors in mdBook's output.
fn warnings(said: &str) -> Vec<String> {
    let is_good = |line: &str| line.trim_start().starts_with("INFO") || line.trim().is_empty();
    said.lines().filter(|line| !is_good(line)).map(str::to_owned).collect()
}

/// The broken references of the site: to a missing file, or to a missing place of a page.
fn broken(book: &Path) -> Outcome<Vec<String>> {
    // Each reference is looked up among the paths of the pages.
    let book = book.canonicalize().unwrap_or_else(|_| book.to_owned());
    let mut pages = BTreeMap::new();
    for page in files::below(&book, &[])?.into_iter().filter(|file| files::is(file, "html")) {
        let html = files::text(&page)?;
        pages.insert(page, html);
    }
    let mut faults = BTreeSet::new();
    for (page, html) in &pages {
        for target in attributes(html, "href").chain(attributes(html, "src")) {
            if target.contains(':') || target.starts_with("//") {
                continue;
            }
            let (file, place) = target.split_once('#').unwrap_or((target, ""));
            let file = if file.is_empty() { page.clone() } else { page.with_file_name(file) };
            let Ok(file) = file.canonicalize() else {
                faults.insert(format!("{}: {target} is not there", workspace::shown(page)));
                continue;
            };
            let there = |html: &String| attributes(html, "id").any(|id| id == place);
            if !place.is_empty() && !pages.get(&file).is_some_and(there) {
                faults.insert(format!("{}: {target} has no such place", workspace::shown(page)));
            }
        }
    }
    Ok(faults.into_iter().collect())
}

/// The values of an attribute, as the page's text has them.
fn attributes<'h>(html: &'h str, name: &str) -> impl Iterator<Item = &'h str> {
    let opening = format!(" {name}=\"");
    let behind = html.match_indices(&opening).map(|(at, opening)| at + opening.len()).collect::<Vec<_>>();
    behind.into_iter().filter_map(|at| html[at..].split('"').next())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_summary_has_every_page() {
        let summary = files::ours(SUMMARY).unwrap();
        assert_eq!(not_in(&summary, &links::pages().unwrap()), Vec::<String>::new());
        let without = summary.replace("(protocol.md)", "(security.md)");
        let faults = not_in(&without, &links::pages().unwrap());
        assert!(faults.len() == 1 && faults[0].contains("docs/protocol.md"), "{faults:?}");
    }

    #[test]
    fn the_summary_leads_from_the_root_on() {
        assert_eq!(from_the_root("- [A](a.md)\n- [B](../B.md)\n"), "- [A](docs/a.md)\n- [B](B.md)\n");
    }

    /// Lines as mdBook 0.5 prints them.
    #[test]
    fn what_mdbook_warns_of_is_told() {
        let said = " INFO Book building has started\n WARN unclosed HTML tag `<n>` found in `docs/a.md`\n\n";
        assert_eq!(warnings(said), [" WARN unclosed HTML tag `<n>` found in `docs/a.md`"]);
        assert!(warnings(" INFO Running the html backend\n").is_empty());
    }

    #[test]
    fn a_reference_that_leads_nowhere_is_found_in_the_site() {
        let site = kit::folder::Folder::below(std::env::temp_dir(), "coboot-site");
        let index = r##"<a href="docs/a.html#there">a</a><a href="https://example.invalid/x">b</a>"##;
        let page = site.join("docs/a.html");
        files::write(&site.join("index.html"), index).unwrap();
        files::write(&page, r##"<h1 id="there"><img src="../index.html"></h1>"##).unwrap();
        assert_eq!(broken(&site), Ok(Vec::new()));
        files::write(&page, r##"<h1 id="here"><img src="b.png"><a href="#gone">c</a></h1>"##).unwrap();
        let faults = broken(&site).unwrap();
        let of = |words: &str| faults.iter().filter(|fault| fault.contains(words)).count();
        assert_eq!((faults.len(), of("a.html#there has"), of("b.png is not"), of("#gone has")), (3, 1, 1, 1));
    }
}
