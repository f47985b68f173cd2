//! The links of the pages: each must lead to a file of the repository, and to an existing heading.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Component, Path, PathBuf};

use crate::{files, outcome::Outcome, process, workspace};

/// The pages, as git finds their files.
const PAGES: &str = "docs/*.md examples/*.md README.md CHANGELOG.md CONTRIBUTING.md LICENSES.md SECURITY.md \
                     coflash/python/README.md";

/// A link within the repository.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Link {
    /// The page and the line number.
    pub place: String,
    /// The file, as a path from the root of the repository.
    pub file: PathBuf,
    /// The heading's anchor.
    pub heading: Option<String>,
}

/// Every page, as a path from the root of the repository: those that are no part of a commit yet, too.
pub fn pages() -> Outcome<Vec<PathBuf>> {
    let list = ["ls-files", "--cached", "--others", "--exclude-standard", "--"].into_iter();
    Ok(process::git(&list.chain(PAGES.split(' ')).collect::<Vec<_>>())?.lines().map(PathBuf::from).collect())
}

/// All links of all pages that stay within the repository.
pub fn all() -> Outcome<Vec<Link>> {
    let mut links = Vec::new();
    for page in pages()? {
        links.extend(of_page(&page, &files::ours(&page)?));
    }
    Ok(links)
}

/// The faults of the pages' links, one a line.
pub fn faults() -> Outcome<Vec<String>> {
    let mut known: BTreeMap<PathBuf, BTreeSet<String>> = BTreeMap::new();
    for page in pages()? {
        let headings = headings(&files::ours(&page)?).into_iter().collect();
        known.insert(page, headings);
    }
    let fault = |link: &Link| {
        let shown = link.file.display();
        if !workspace::root().join(&link.file).is_file() {
            return Some(format!("{}: {shown} is not there, or is no file", link.place));
        }
        // The site has pages only.
        if files::is(&link.file, "md") && !known.contains_key(&link.file) {
            return Some(format!("{}: {shown} is no page of the site (xtask/src/links.rs)", link.place));
        }
        let heading = link.heading.as_ref()?;
        let there = known.get(&link.file).is_some_and(|headings| headings.contains(heading));
        (!there).then(|| format!("{}: {shown} has no heading #{heading}", link.place))
    };
    Ok(all()?.iter().filter_map(fault).collect())
}

/// The lines of a page outside code blocks, with their numbers, each cut at the backticks: the
/// second, fourth and so on of the parts are code.
pub fn prose(text: &str) -> Vec<(usize, Vec<&str>)> {
    let mut is_code = false;
    let mut prose = Vec::new();
    for (number, line) in (1..).zip(text.lines()) {
        if line.trim_start().starts_with("```") {
            is_code = !is_code;
        } else if !is_code {
            prose.push((number, line.split('`').collect()));
        }
    }
    prose
}

/// The links of a page within the repository. The target of a link must be in one line.
pub fn of_page(page: &Path, text: &str) -> Vec<Link> {
    let mut links = Vec::new();
    for (number, parts) in prose(text) {
        let line = parts.into_iter().step_by(2).collect::<Vec<_>>().join("``");
        for (at, _) in line.match_indices("](") {
            let Some((target, _)) = line[at + 2..].split_once(')') else { continue };
            if target.contains("://") || target.starts_with("mailto:") {
                continue;
            }
            let (file, heading) = match target.split_once('#') {
                Some((file, heading)) => (file, Some(heading.to_owned())),
                None => (target, None),
            };
            let file = if file.is_empty() { page.to_owned() } else { page.with_file_name(file) };
            let place = format!("{}:{number}", page.display());
            links.push(Link { place, file: plain(&file), heading });
        }
    }
    links
}

/// The path without `..`.
pub fn plain(path: &Path) -> PathBuf {
    let mut plain = PathBuf::new();
    for part in path.components() {
        match part {
            Component::ParentDir => drop(plain.pop()),
            part => plain.push(part),
        }
    }
    plain
}

/// The anchors of a page's headings. GitHub and mdBook make them in the same way: small letters,
/// digits, `_` and `-` stay, a blank becomes `-`, all else is removed; the second of two equal
/// names gets `-1` at its end.
fn headings(text: &str) -> Vec<String> {
    let mut names: Vec<String> = Vec::new();
    let mut seen: BTreeMap<String, usize> = BTreeMap::new();
    for line in prose(text).into_iter().map(|(_, parts)| parts.concat()) {
        let level = line.len() - line.trim_start_matches('#').len();
        if !(1..=6).contains(&level) || !line[level..].starts_with(' ') {
            continue;
        }
        let kept = line[level..].trim().to_lowercase();
        let kept = kept.chars().filter(|c| c.is_alphanumeric() || matches!(c, ' ' | '-' | '_'));
        let name: String = kept.map(|c| if c == ' ' { '-' } else { c }).collect();
        let count = seen.entry(name.clone()).or_insert(0);
        names.push(if *count == 0 { name } else { format!("{name}-{count}") });
        *count += 1;
    }
    names
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn links_are_found_outside_of_code_and_lead_from_their_page_on() {
        let page = "See [a](b.md), ![c](../d.svg) and [e](#f-g) or `[x](y)`.\n```\n[no](no)\n```\n\
                    [far](https://example.invalid/) [up](../adr/h.md#i)\n";
        let found = of_page(Path::new("docs/adr/page.md"), page);
        let shown: Vec<_> = found
            .iter()
            .map(|link| format!("{} {} {:?}", link.place, link.file.display(), link.heading))
            .collect();
        assert_eq!(
            shown,
            [
                "docs/adr/page.md:1 docs/adr/b.md None",
                "docs/adr/page.md:1 docs/d.svg None",
                "docs/adr/page.md:1 docs/adr/page.md Some(\"f-g\")",
                "docs/adr/page.md:5 docs/adr/h.md Some(\"i\")",
            ]
        );
    }

    /// The anchors on GitHub for these lines.
    #[test]
    fn headings_have_the_names_that_browsers_use() {
        let page = "# 1F51h: commands\n```sh\n# no heading\n```\n## `read` and write\n### CANopenNode's \
                    canopend\n## Read and write\n#hash\n";
        assert_eq!(
            headings(page),
            ["1f51h-commands", "read-and-write", "canopennodes-canopend", "read-and-write-1"]
        );
    }

    #[test]
    fn every_decision_is_in_their_list() {
        let page = Path::new("docs/decisions.md");
        let listed: Vec<_> =
            of_page(page, &files::ours(page).unwrap()).into_iter().map(|link| link.file).collect();
        let decisions = files::within(&workspace::root().join("docs/adr")).unwrap();
        let from_the_root = decisions.iter().map(|file| file.strip_prefix(workspace::root()).unwrap());
        assert_eq!(listed, from_the_root.collect::<Vec<_>>());
    }

    #[test]
    fn links_between_the_pages_lead_to_files_and_headings() {
        assert_eq!(faults().unwrap(), Vec::<String>::new());
        assert!(all().unwrap().len() > 100);
    }
}
