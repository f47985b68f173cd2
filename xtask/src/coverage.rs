//! `cargo xtask coverage`: which lines of the device's crates the tests reach.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;
use std::{env, fs};

use crate::args::Args;
use crate::setup::{self, Part, Setup};
use crate::{evidence, process, workspace, Outcome};
use serde_json::{json, Value};

pub const HELP: &str = "\
usage: cargo xtask coverage [--yes]

Counts which lines of the crates without an operating system are reached by tests on the host: each
crate's own tests, those of the core with sealed images, and the tests of sealed images on the model
of the flash. What the built firmware does in the emulator is not counted. The result goes to
target/evidence/coverage.json, and the lines that no test reaches to target/coverage/missing.txt.

  --yes           installs what is missing with sudo

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
pub const SEALED_TESTS: [&str; 4] = ["access::", "dictionary::", "model::", "pieces::"];

pub fn run(mut args: Args) -> Outcome {
    let setup = Setup::from(&mut args);
    args.none_left()?;
    setup.prepare(&[Part::Emulator, Part::Coverage])?;
    let path = setup::tool("cargo-llvm-cov", VERSION)?;
    evidence::begin("coverage")?;
    let llvm_cov = |words: &[&str]| {
        let mut cargo = Command::new(env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
        cargo.arg("llvm-cov").args(words).env("PATH", &path).current_dir(workspace::root());
        cargo
    };
    process::run(&mut llvm_cov(&["clean", "--workspace"]))?;
    let packages = CRATES.iter().flat_map(|(package, _)| ["--package", package]);
    process::run(llvm_cov(&["--no-report", "--quiet"]).args(packages))?;
    let core = ["--no-report", "--quiet", "--package", "coboot-core", "--features", "sealed"];
    process::run(&mut llvm_cov(&core))?;
    let sealed = ["--no-report", "--quiet", "--package", "coboot-tests", "--test", "sealed", "--"];
    process::run(llvm_cov(&sealed).args(SEALED_TESTS))?;

    let folder = workspace::target_dir().join("coverage");
    let unwritable = |error| format!("{} cannot be written: {error}.", workspace::shown(&folder));
    fs::create_dir_all(&folder).map_err(unwritable)?;
    let report = process::output(&mut llvm_cov(&["report", "--json", "--summary-only"]))?;
    let missing = process::output(&mut llvm_cov(&["report", "--show-missing-lines"]))?;
    fs::write(folder.join("missing.txt"), missing).map_err(unwritable)?;
    let counts = by_crate(&process::json(&report)?, workspace::root());
    for (name, [lines, covered]) in &counts {
        println!("  {name:<12} {covered:>6} of {lines:>6} lines, {:.1} %", percent(*lines, *covered));
    }
    if counts.is_empty() {
        return Err("cargo-llvm-cov has counted no line of these crates.".into());
    }
    evidence::record("coverage", as_json(&counts))
}

/// Lines and reached lines, by the folder of the crate.
fn by_crate(report: &Value, root: &Path) -> BTreeMap<&'static str, [u64; 2]> {
    let mut counts = BTreeMap::<_, [u64; 2]>::new();
    for file in report["data"]
        .as_array()
        .into_iter()
        .flatten()
        .flat_map(|part| part["files"].as_array().into_iter().flatten())
    {
        let Some(path) = file["filename"].as_str().and_then(|path| Path::new(path).strip_prefix(root).ok())
        else {
            continue;
        };
        let is_of = |(_, folder): &&(&str, &str)| path.starts_with(Path::new(folder).join("src"));
        let Some((_, folder)) = CRATES.iter().find(is_of) else { continue };
        let lines = &file["summary"]["lines"];
        let sums = counts.entry(*folder).or_default();
        for (sum, name) in sums.iter_mut().zip(["count", "covered"]) {
            *sum += lines[name].as_u64().unwrap_or_default();
        }
    }
    counts
}

fn percent(lines: u64, covered: u64) -> f64 {
    covered as f64 / lines.max(1) as f64 * 100.0
}

fn as_json(counts: &BTreeMap<&str, [u64; 2]>) -> Value {
    let row = |[lines, reached]: [u64; 2]| {
        let percent = (percent(lines, reached) * 10.0).round() / 10.0;
        json!({"lines": lines, "reached": reached, "percent": percent})
    };
    let crates = counts.iter().map(|(name, counts)| {
        let mut row = row(*counts);
        row["crate"] = json!(name);
        row
    });
    let sum = |which: usize| counts.values().map(|counts| counts[which]).sum::<u64>();
    let mut record = row([sum(0), sum(1)]);
    record["crates"] = crates.collect();
    record
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The form of llvm-cov's export.
    #[test]
    fn lines_are_summed_by_crate_and_those_of_others_do_not_count() {
        let file = |name: &str, count, covered| json!({"filename": name, "summary": {"lines": {"count": count, "covered": covered}}});
        let files = [
            file("/x/core/canopen/src/a.rs", 10, 9),
            file("/x/core/canopen/src/b/c.rs", 30, 21),
            file("/x/core/canopen/tests/d.rs", 100, 100),
            file("/x/core/seal/src/lib.rs", 5, 5),
            file("/y/core/seal/src/lib.rs", 50, 50),
            file("/x/coflash/src/main.rs", 70, 0),
        ];
        let report = json!({"data": [{"files": files}]});
        let counts = by_crate(&report, Path::new("/x"));
        assert_eq!(counts, BTreeMap::from([("core/canopen", [40, 30]), ("core/seal", [5, 5])]));
        let record = as_json(&counts);
        assert_eq!(record["reached"].as_f64(), Some(35.0));
        assert_eq!(record["crates"][0]["percent"].as_f64(), Some(75.0));
    }

    #[test]
    fn the_crates_are_there() {
        for (package, folder) in CRATES {
            let manifest = fs::read_to_string(workspace::root().join(folder).join("Cargo.toml")).unwrap();
            assert!(manifest.contains(&format!("name = \"{package}\"")), "{folder}");
        }
    }
}
