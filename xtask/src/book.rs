//! `cargo xtask docs`: makes a site of the pages.
//!
//! mdBook renders a copy of the pages in which every file has its path of the repository. So a link
//! is the same in the site, in the repository, and on a server that shows Markdown.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::args::Args;
use crate::{files, links, outcome::Outcome, process, setup, workspace};

pub const HELP: &str = "\
usage: cargo xtask docs

Makes the site of README.md and docs/ in target/book; open target/book/index.html. The order of the
pages is that of docs/SUMMARY.md. Fails on every warning, on a link that leads nowhere, and on a page
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
    let output = process::messages(&mut build)?;
    refuse("mdBook", &warnings(&output))?;
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
fn warnings(output: &str) -> Vec<String> {
    let is_good = |line: &str| line.trim_start().starts_with("INFO") || line.trim().is_empty();
    output.lines().filter(|line| !is_good(line)).map(str::to_owned).collect()
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
        let output =
            " INFO Book building has started\n WARN unclosed HTML tag `<n>` found in `docs/a.md`\n\n";
        assert_eq!(warnings(output), [" WARN unclosed HTML tag `<n>` found in `docs/a.md`"]);
        assert!(warnings(" INFO Running the html backend\n").is_empty());
    }
}
