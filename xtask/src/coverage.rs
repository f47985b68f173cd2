//! `cargo xtask coverage`: which lines of the device's crates the tests reach.

use std::path::Path;
use std::process::Command;

use serde_json::{json, Value};

use crate::args::Args;
use crate::process::list;
use crate::setup::{self, Part};
use crate::{evidence, files, outcome::Outcome, process, workspace};

pub const HELP: &str = "\
usage: cargo xtask coverage

Counts which lines of the crates without an operating system are reached by tests on the host: each
crate's own tests, those of the core with sealed images, and the tests of sealed images on the model
of the flash. What the built firmware does in the emulator is not counted. The result goes to
target/evidence/coverage.json, and the lines that no test reaches to target/coverage/missing.txt.

A line that is reached may still be wrong: `cargo xtask mutants` asks whether a test would notice.
cargo-llvm-cov is installed into target/tools, and llvm-tools by rustup, where they are missing.
";

/// The version to install if there is none.
const VERSION: &str = "0.9.1";
/// The crates, by package and by folder.
const CRATES: [(&str, &str); 5] = [
    ("coboot-abi", "shared-abi"),
    ("coboot-canopen", "core/canopen"),
    ("coboot-core", "core/boot-core"),
    ("coboot-app", "coboot-app"),
    ("coboot-seal", "core/seal"),
];
/// The tests of sealed images that need no built firmware, in the test program `sealed`.
pub const SEALED_TESTS: [&str; 5] = ["access::", "dictionary::", "model::", "pieces::", "strangers::"];

pub fn run(args: Args) -> Outcome {
    args.none_left()?;
    setup::prepare(&[Part::Emulator])?;
    process::run(Command::new("rustup").args(["component", "add", "llvm-tools"]))?;
    let program = setup::tool("cargo-llvm-cov", VERSION, &[])?;
    evidence::begin("coverage")?;
    let llvm_cov = |words: &[&str]| {
        let mut llvm_cov = Command::new(&program);
        llvm_cov.arg("llvm-cov").args(words).current_dir(workspace::root());
        llvm_cov
    };
    process::run(&mut llvm_cov(&["clean", "--workspace"]))?;
    let packages = CRATES.iter().flat_map(|(package, _)| ["--package", package]);
    process::run(llvm_cov(&["--no-report", "--quiet"]).args(packages))?;
    let core = ["--no-report", "--quiet", "--package", "coboot-core"];
    process::run(llvm_cov(&core).env("COBOOT_TAKES_SEALED", "1"))?;
    let sealed = ["--no-report", "--quiet", "--package", "coboot-tests", "--test", "sealed", "--"];
    process::run(llvm_cov(&sealed).args(SEALED_TESTS))?;

    let report = process::json(&process::output(&mut llvm_cov(&["report", "--json", "--summary-only"]))?)?;
    let missing = process::output(&mut llvm_cov(&["report", "--show-missing-lines"]))?;
    files::write(&workspace::target_dir().join("coverage/missing.txt"), missing)?;
    let rows: Vec<_> = CRATES.iter().filter_map(|(_, folder)| row(&report, folder)).collect();
    for row in &rows {
        println!("  {row}");
    }
    let sum = |name: &str| rows.iter().filter_map(|row| row[name].as_u64()).sum::<u64>();
    let (lines, reached) = (sum("lines"), sum("reached"));
    if lines == 0 {
        return Err("cargo-llvm-cov has counted no line of these crates.".into());
    }
    let percent = percent(lines, reached);
    evidence::record(
        "coverage",
        json!({"lines": lines, "reached": reached, "percent": percent, "crates": rows}),
    )
}

/// Lines and reached lines of the crate in a folder, if the report has it.
fn row(report: &Value, folder: &str) -> Option<Value> {
    let sources = workspace::root().join(folder).join("src");
    let files = list(report, "data").flat_map(|part| list(part, "files"));
    let own = files
        .filter(|file| file["filename"].as_str().is_some_and(|path| Path::new(path).starts_with(&sources)));
    let counts = own.map(|file| &file["summary"]["lines"]);
    let (lines, reached) = counts.fold((0, 0), |(lines, reached), counts| {
        (lines + counts["count"].as_u64().unwrap_or(0), reached + counts["covered"].as_u64().unwrap_or(0))
    });
    let percent = percent(lines, reached);
    (lines > 0).then(|| json!({"crate": folder, "lines": lines, "reached": reached, "percent": percent}))
}

/// With one digit behind the point.
fn percent(lines: u64, reached: u64) -> f64 {
    (reached as f64 / lines.max(1) as f64 * 1000.0).round() / 10.0
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The form of llvm-cov's export.
    #[test]
    fn lines_are_summed_by_crate_and_those_of_others_do_not_count() {
        let file = |name: &str, count, covered| {
            let path = workspace::root().join(name);
            json!({"filename": path, "summary": {"lines": {"count": count, "covered": covered}}})
        };
        let files = [
            file("core/canopen/src/a.rs", 10, 9),
            file("core/canopen/src/b/c.rs", 30, 21),
            file("core/canopen/tests/d.rs", 100, 100),
            file("/y/core/seal/src/lib.rs", 50, 50),
            file("coflash/cli/src/main.rs", 70, 0),
        ];
        let report = json!({"data": [{"files": files}]});
        let expected = json!({"crate": "core/canopen", "lines": 40, "reached": 30, "percent": 75.0});
        assert_eq!(row(&report, "core/canopen"), Some(expected));
        assert_eq!(row(&report, "core/seal"), None);
    }
}
