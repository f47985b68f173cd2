//! The notices for the parts of the program by other authors: each crate with its licence, and the
//! texts of the licences.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::{files, outcome::Outcome, process};

/// Parts that are not crates, by name, with the file of the licence.
const OTHERS: [(&str, &str); 1] =
    [("uPlot 1.6.32: MIT (https://github.com/leeoniya/uPlot)", "coflash/ui/src/page/uPlot.LICENSE")];
/// The first letters of the names of files that must go with a copy.
const NOTICES: [&str; 6] = ["LICENSE", "LICENCE", "COPYING", "COPYRIGHT", "NOTICE", "UNLICENSE"];

/// The notices of all crates that are linked into `coflash`, of every system. The same Cargo.lock
/// gives the same text.
pub fn text() -> Outcome<String> {
    let linked = process::tree(&["--package", "coflash", "--edges", "normal", "--target", "all"])?;
    let metadata = process::output(&mut process::cargo("metadata --locked --format-version 1"))?;
    let mut crates = BTreeMap::new();
    for package in process::list(&process::json(&metadata)?, "packages") {
        if let Some((line, folder)) = of(package, &linked) {
            crates.insert(line, notices_in(&folder)?);
        }
    }
    for (line, file) in OTHERS {
        crates.insert(line.to_owned(), vec![files::ours(file)?]);
    }
    Ok(page(&crates))
}

/// The entry of another author's crate that is linked, and its folder.
fn of(package: &Value, linked: &BTreeSet<String>) -> Option<(String, PathBuf)> {
    package["source"].as_str()?;
    let name = format!("{} {}", package["name"].as_str()?, package["version"].as_str()?);
    let folder = Path::new(package["manifest_path"].as_str()?).parent()?.to_owned();
    let licence = package["license"].as_str().unwrap_or("its own, see below");
    let home = package["repository"].as_str().map(|home| format!(" ({home})")).unwrap_or_default();
    linked.contains(&name).then(|| (format!("{name}: {licence}{home}"), folder))
}

/// The texts in a crate's folder that must go with a copy.
fn notices_in(folder: &Path) -> Outcome<Vec<String>> {
    let is_notice = |path: &&PathBuf| {
        let name = path.file_name().unwrap_or_default().to_string_lossy().to_uppercase();
        path.is_file() && NOTICES.iter().any(|start| name.starts_with(start))
    };
    files::within(folder)?.iter().filter(is_notice).map(|file| files::text(file)).collect()
}

/// The page: all names with their licences, then every text once, with the names of its crates.
fn page(crates: &BTreeMap<String, Vec<String>>) -> String {
    let mut page = String::from(
        "coflash contains the work of others, listed here with licences and notices. The sources of each crate\n\
         are at https://crates.io, under its name and version.\n\n",
    );
    let mut texts: BTreeMap<String, Vec<&str>> = BTreeMap::new();
    for (line, notices) in crates {
        let _ = writeln!(page, "{line}");
        for notice in notices {
            let text: Vec<&str> = notice.lines().map(str::trim_end).collect();
            let name = line.split(": ").next().unwrap_or_default();
            texts.entry(text.join("\n").trim().to_owned()).or_default().push(name);
        }
    }
    for (text, names) in texts {
        let _ = write!(page, "\n{}\n{}:\n\n{text}\n", "-".repeat(78), names.join(", "));
    }
    page
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_text_stands_once_under_all_names_that_have_it() {
        let crates = BTreeMap::from([
            ("a 1.0.0: MIT".to_owned(), vec!["Take it.\r\n".to_owned()]),
            ("b 2.0.0: MIT".to_owned(), vec!["Take it.".to_owned(), "Or that.".to_owned()]),
        ]);
        let page = page(&crates);
        assert_eq!(page.matches("Take it.").count(), 1, "{page}");
        assert!(page.contains("a 1.0.0, b 2.0.0:\n\nTake it."), "{page}");
        assert!(page.contains("b 2.0.0:\n\nOr that."), "{page}");
    }

    /// Cargo's data about the program itself: crates of each system, no tools of tests, none of our
    /// crates, and a text for the licences that require one.
    #[test]
    fn every_linked_crate_is_named() {
        let text = text().unwrap();
        let names: BTreeSet<&str> = text
            .lines()
            .take_while(|line| !line.starts_with("---"))
            .filter_map(|line| line.split(' ').next())
            .collect();
        for name in ["clap", "serialport", "socketcan", "nusb", "windows-sys", "uPlot"] {
            assert!(names.contains(name), "{name}: {names:?}");
        }
        for name in ["coboot-abi", "proptest", "unicorn-engine", "rtic"] {
            assert!(!names.contains(name), "{name}");
        }
        assert!(text.contains("Leon Sorokin") && text.contains("Mozilla Public License"));
    }
}
