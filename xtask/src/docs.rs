//! Compares the quotes in the documents with their sources.

use std::sync::LazyLock;

use kit::pages::{self, Shown};
use serde_json::Value;
use shared_abi::layout::BOARDS;

use crate::build::{C_APPLICATION, VARIANTS};
use crate::{files, process, workspace, JOBS};

/// The marker before a quoted block: `<!-- from FILE -->`, followed by a fence.
const MARKER: &str = "<!-- from ";
/// A line that stands for omitted lines.
const GAP: &str = "// …";

/// Lines for the comparison: without indentation and without empty lines.
fn bare(text: &str) -> Vec<String> {
    text.lines().map(|line| line.trim().to_owned()).filter(|line| !line.is_empty()).collect()
}

/// The blocks of code in a document that name their source files: the file, and the lines.
fn quotes(document: &str) -> Vec<(String, Vec<String>)> {
    let quote = |behind: &str| {
        let (file, rest) = behind.split_once(" -->").expect("a marker ends with -->");
        let (_, rest) = rest.split_once("```").expect("code follows a marker");
        let (block, _) = rest.split_once("```").expect("the code ends");
        let (_language, code) = block.split_once('\n').expect("the code has lines");
        (file.to_owned(), bare(code))
    };
    document.split(MARKER).skip(1).map(quote).collect()
}

/// The first part of the quote that is not in the source, contiguous and after the previous part.
fn missing(quote: &[String], source: &str) -> Option<String> {
    let source = bare(source);
    let mut rest = source.as_slice();
    for part in quote.split(|line| line == GAP) {
        match rest.windows(part.len()).position(|window| window == part) {
            Some(at) => rest = &rest[at + part.len()..],
            None => return Some(part.join("\n")),
        }
    }
    None
}

#[test]
fn the_guides_show_code_as_it_is() {
    for name in "application can-driver first-hour flash-driver operating-system porting product".split(' ') {
        let found = quotes(&files::ours(format!("docs/{name}.md")).unwrap());
        assert!(!found.is_empty(), "{name}: no quotes");
        for (file, lines) in found {
            let gone = missing(&lines, &files::ours(&file).unwrap());
            assert_eq!(gone, None, "{name} quotes what {file} does not have: copy it from there");
        }
    }
}

#[test]
fn a_quote_that_has_changed_is_found() {
    let source = "fn a() {\n    one();\n    two();\n    three();\n}\n";
    let quote = |code: &str| bare(code);
    assert_eq!(missing(&quote("one();\ntwo();"), source), None);
    assert_eq!(missing(&quote("one();\n// …\nthree();"), source), None);
    assert_eq!(missing(&quote("one();\nthree();"), source).as_deref(), Some("one();\nthree();"));
    assert_eq!(missing(&quote("three();\n// …\none();"), source).as_deref(), Some("one();"));
}

/// Commands that are not part of this repository: of a shell, of the system, of other projects.
const FOREIGN: &str =
    "cd export ip apt sh probe-rs openocd STM32_Programmer_CLI base64 candump canopend cmake cocomm curl dcfgen npm node openssl pip pipx sha256sum tar tshark unzip west";
/// Cargo's own jobs on pages; their arguments name packages of the workspace.
const CARGO: [&str; 5] = ["build", "check", "install", "run", "test"];

/// Checks every command of every page. It must be a job of this crate with options that it has, a
/// program of the workspace (the tests of `coflash` and `coboot-node` check their arguments), an
/// existing file, or one of the few foreign commands.
#[test]
fn every_command_of_the_pages_is_one() {
    let commands = pages::commands();
    let wrong: Vec<String> =
        commands.iter().filter_map(|shown| Some(format!("{}: {}", shown.place, check(shown)?))).collect();
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    let jobs =
        commands.iter().filter(|shown| shown.words.starts_with(&["cargo".into(), "xtask".into()])).count();
    assert!(commands.len() > 120 && jobs > 50, "{} commands, {jobs} jobs", commands.len());
}

/// The same for the jobs in the workflows. (The forge itself refuses a workflow that it cannot read.) A variable of the
/// forge is a job that is in the list above it.
#[test]
fn every_job_of_the_workflows_is_one() {
    let mut jobs = Vec::new();
    for file in files::within(&workspace::root().join(".github/workflows")).unwrap() {
        let workflow = files::text(&file).unwrap();
        // rust-toolchain.toml chooses the compiler of the jobs.
        assert!(
            !workflow.contains("RUSTUP_TOOLCHAIN") && !workflow.contains("cargo +"),
            "{}",
            file.display()
        );
        let lists = workflow.lines().filter_map(|line| line.trim().strip_prefix("job: [")?.strip_suffix(']'));
        jobs.extend(lists.flat_map(|list| list.split(", ")).map(|job| job.trim_matches('"').to_owned()));
        let lines = workflow.lines().filter(|line| !line.trim_start().starts_with('#'));
        let called = lines.filter_map(|line| Some(line.split_once("cargo xtask ")?.1.trim_end_matches('"')));
        jobs.extend(called.filter(|job| !job.starts_with("${{")).map(str::to_owned));
    }
    let command = |job: &String| format!("cargo xtask {job}").split_whitespace().map(str::to_owned).collect();
    let shown = |job: &String| Shown { place: job.clone(), words: command(job), inline: false };
    let faults: Vec<_> = jobs.iter().filter_map(|job| check(&shown(job))).collect();
    assert_eq!(faults, Vec::<String>::new());
    assert!(jobs.len() > 20, "{jobs:?}");
}

/// The fault of a command, if it has one.
fn check(shown: &Shown) -> Option<String> {
    let words: Vec<&str> = shown.words.iter().map(String::as_str).collect();
    match words.as_slice() {
        ["coflash" | "coboot-node", ..] => None,
        ["cargo", "xtask"] => None,
        ["cargo", "xtask", job, rest @ ..] => match JOBS.iter().find(|known| known.name == *job) {
            None => Some(format!("there is no job {job}")),
            Some(known) => job_options(known.name, known.help, rest),
        },
        ["cargo", job, rest @ ..] if CARGO.contains(job) => {
            let package = rest.iter().position(|word| matches!(*word, "-p" | "--package"));
            let package = package.and_then(|at| rest.get(at + 1));
            let there = package.is_none_or(|name| is_package(name));
            (!there).then(|| format!("there is no package {}", package.unwrap_or(&"")))
        }
        ["cargo", "generate", "--path", folder, ..] => {
            let template = folder.strip_prefix("coboot/").unwrap_or(folder);
            let there = workspace::root().join(template).join("cargo-generate.toml").exists();
            (!there).then(|| format!("there is no template {folder}"))
        }
        [program, rest @ ..] if program.contains('/') || program.starts_with("python") => {
            // An interpreter or a script, and its script argument.
            let ours = |word: &&&str| word.ends_with(".py") || word.ends_with("/run");
            let all = [*program].into_iter().chain(rest.iter().copied()).collect::<Vec<_>>();
            let missing = all.iter().filter(ours).find(|file| !workspace::root().join(file).exists());
            missing.map(|file| format!("there is no {file}"))
        }
        [program, ..] if FOREIGN.split(' ').any(|known| known == *program) => None,
        words => Some(format!("nobody knows {words:?}")),
    }
}

/// Whether the workspace contains the package of this name.
fn is_package(name: &str) -> bool {
    static METADATA: LazyLock<Value> =
        LazyLock::new(|| process::metadata().expect("cargo knows the workspace"));
    process::list(&METADATA, "packages").any(|package| package["name"] == name)
}

/// The fault of a job's arguments, if there is one.
fn job_options(job: &str, help: &str, words: &[&str]) -> Option<String> {
    let is_option = |name: &str| help.split([' ', '[', '\n']).any(|known| known == name) || name == "--yes";
    let mut before = "";
    for word in words.iter().take_while(|word| **word != "--") {
        let (name, value) = word.split_once('=').unwrap_or((word, word));
        // What follows an option may be its value. A guide creates a board with this name.
        let is_board = [name, before].contains(&"--board") && !value.starts_with('-') && value != "my-board";
        if is_board && !pages::is_placeholder(value) && !BOARDS.iter().any(|layout| layout.board == value) {
            return Some(format!("there is no board {value}"));
        }
        if job == "test" {
            // Other arguments go to cargo test.
            let program = workspace::root().join("tests").join(name).join("main.rs");
            if before == "--test" && !program.is_file() {
                return Some(format!("there is no test {name}"));
            }
        } else if name.starts_with('-') && !is_option(name) {
            return Some(format!("cargo xtask {job} has no {name}"));
        } else if job == "build" && !name.starts_with('-') && !["--board", "--product"].contains(&before) {
            let is_image = name == C_APPLICATION || VARIANTS.iter().any(|variant| variant.name == name);
            if !is_image && !pages::is_placeholder(name) {
                return Some(format!("there is no image {name}"));
            }
        }
        before = name;
    }
    None
}
