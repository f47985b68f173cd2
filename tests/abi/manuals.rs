//! The page that leads from the manuals' names to coboot's (docs/from-the-manuals.md): it has each name of
//! the list beside it, and what it names of coboot exists.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

const PAGE: &str = include_str!("../../docs/from-the-manuals.md");
/// The names, taken from the texts of the manuals.
const LIST: &str = include_str!("../../docs/from-the-manuals.txt");
const PRODUCT_PAGE: &str = include_str!("../../docs/product.md");
/// The help of coflash, which its tests record.
const HELP: &str = include_str!("../../coflash/cli/tests/snapshots/help.txt");

/// How the names of the manuals begin. Nothing of coboot begins in this way.
const PREFIXES: [&str; 20] = [
    "BLCOP_",
    "BL_",
    "FT_",
    "FLSDRV_",
    "CDRV_",
    "OBD_",
    "SDO_BLOCK",
    "SDOS_",
    "COP_USE_",
    "Tgt",
    "FlsDrv",
    "BlCop",
    "AppCb",
    "FtCop",
    "FtBin",
    "kBlCop",
    "kFlsDrv",
    "kCdrv",
    "tBlCop",
    "ERR_BL_",
];

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

/// The text in backticks.
fn code(text: &str) -> impl Iterator<Item = &str> {
    text.split('`').skip(1).step_by(2)
}

/// The cells of the tables' rows, without the heads, each row with its line number.
fn rows(page: &'static str) -> impl Iterator<Item = (usize, Vec<&'static str>)> {
    let row = |line: &'static str| line.strip_prefix("| ").map(|row| row.split(" | ").collect());
    (1..).zip(page.lines()).filter_map(move |(number, line)| Some((number, row(line)?)))
}

fn listed() -> BTreeSet<&'static str> {
    let names = LIST.lines().filter(|line| !line.starts_with('#'));
    names.map(|line| line.split(' ').next().unwrap()).collect()
}

/// The choices of a product: the rows of its page, with the text of each. (A test of `xtask` holds them against
/// the table of the choices.)
fn choices() -> BTreeMap<&'static str, (usize, &'static str)> {
    let rows = rows(PRODUCT_PAGE).filter(|(_, cells)| cells.len() == 3);
    rows.filter_map(|(number, cells)| Some((code(cells[0]).next()?, (number, cells[2])))).collect()
}

fn has_word(text: &str, word: &str) -> bool {
    text.split(|c: char| !c.is_alphanumeric() && c != '_').any(|found| found == word)
}

/// Both have the same names, and the page has each in one row.
#[test]
fn the_page_has_the_names_of_the_list() {
    let listed = listed();
    // The five documents have more than 150 names with the prefixes alone.
    assert!(listed.len() > 150, "{}", listed.len());
    let mut on_page = BTreeSet::new();
    for name in rows(PAGE).flat_map(|(_, cells)| code(cells[0])) {
        assert!(on_page.insert(name), "{name} is in two rows");
    }
    assert_eq!(on_page.symmetric_difference(&listed).collect::<Vec<_>>(), [] as [&&str; 0]);
}

/// No page and no comment has a name that no manual has: a misprint of ours.
#[test]
fn what_looks_like_a_name_of_the_manuals_is_one() {
    let listed = listed();
    let mut files = Vec::new();
    let folders =
        ["app-template", "bootloader", "bsp", "coboot-app", "coflash", "core", "docs", "shared-abi", "sim"];
    for folder in folders {
        find(&root().join(folder), &mut files);
    }
    let mut count = 0;
    for file in files {
        let text = fs::read_to_string(&file).unwrap();
        for line in text.lines() {
            for name in code(line).filter(|name| PREFIXES.iter().any(|prefix| name.starts_with(prefix))) {
                count += 1;
                assert!(listed.contains(name), "{}: no manual has {name}", file.display());
            }
        }
    }
    assert!(count > 220, "{count}");
}

/// The pages and the Rust sources below a folder.
fn find(folder: &Path, files: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            find(&path, files);
        } else if path.extension().is_some_and(|extension| extension == "md" || extension == "rs") {
            files.push(path);
        }
    }
}

/// A link to product.md is a field, and the two pages say the same about a name of the manual.
#[test]
fn the_choices_on_the_page_are_those_of_a_product() {
    let choices = choices();
    let links = |cell: &'static str| {
        cell.split("](product.md)").filter_map(|part| part.rsplit_once("[`")?.1.strip_suffix('`'))
    };
    let mut count = 0;
    for (number, cells) in rows(PAGE) {
        for field in cells.iter().flat_map(|cell| links(cell)) {
            count += 1;
            assert!(choices.contains_key(field), "line {number}: a product has no {field}");
        }
    }
    assert!(count > 20, "{count}");
    for (choice, (number, text)) in choices {
        for name in code(text).filter(|name| PREFIXES.iter().any(|prefix| name.starts_with(prefix))) {
            let (_, row) = rows(PAGE).find(|(_, cells)| code(cells[0]).any(|known| known == name)).unwrap();
            assert!(links(row[1]).any(|known| known == choice), "product.md:{number}: {name} and {choice}");
        }
    }
}

/// "`a` and `b` in `file`": the file has these words. `--option`: the help of coflash has it.
#[test]
fn what_the_page_names_of_coboot_is_there() {
    let (mut words, mut options) = (0, 0);
    for (number, cells) in rows(PAGE).filter(|(_, cells)| cells[0].starts_with('`')) {
        for option in cells[1..].iter().flat_map(|cell| code(cell)).filter(|word| word.starts_with("--")) {
            options += 1;
            let is_there = HELP.lines().any(|line| line.split([' ', ',']).any(|word| word == option));
            assert!(is_there, "line {number}: coflash has no {option}");
        }
    }
    for line in PAGE.lines() {
        let parts: Vec<&str> = line.split('`').collect();
        for file in (3..parts.len()).step_by(2).filter(|at| parts[at - 1] == " in ") {
            let text = fs::read_to_string(root().join(parts[file])).expect(parts[file]);
            let mut word = file - 2;
            loop {
                words += 1;
                assert!(has_word(&text, parts[word]), "{} has no {}", parts[file], parts[word]);
                if word < 2 || parts[word - 1] != " and " {
                    break;
                }
                word -= 2;
            }
        }
    }
    assert!(words > 60 && options > 10, "{words}, {options}");
}
