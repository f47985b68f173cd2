//! `cargo xtask mutants`: would the tests notice a mistake?

use std::fs;
use std::process::Command;

use serde_json::json;

use crate::args::Args;
use crate::setup::{self, Part};
use crate::{coverage, evidence, files, outcome::Outcome, process, workspace};

pub const HELP: &str = "\
usage: cargo xtask mutants [--package NAME] [--in-diff BASE] [--shard K/N] [OPTIONS]

Changes the code of the device's crates in one place at a time with cargo-mutants, and runs the
crate's tests: each change must make one fail. Fails if a change stays unnoticed that
.cargo/mutants.toml does not exclude with a reason. The results are in target/mutants.

  --package NAME  this crate alone: coboot-abi, coboot-canopen, coboot-core, coboot-app or coboot-seal
  --in-diff BASE  the changes alone in lines that differ from this commit
  --shard K/N     the K-th of N parts, from 0
  OPTIONS         for cargo-mutants, as --file '**/store/*.rs' or --list

It takes hours in all: nightly CI runs it in shards. cargo-mutants is installed into target/tools.
";

/// The version that the job installs.
const VERSION: &str = "27.1.0";
/// The changes in the files of coboot-core that only sealed images use.
const SEALED: &str = r"/(unseal|intake/sealed|control/(rights|sealed))\b";
/// The options for them. Their tests are in another crate, too, where cargo-mutants does not look for
/// them before the first change.
const WITH_SEALED: &str = "--features=coboot-core/sealed --test-package=coboot-core,coboot-tests \
                           --baseline=skip --timeout=300 --build-timeout=1200 \
                           --cargo-arg=--test=it --cargo-arg=--test=sealed \
                           --cargo-test-arg=-- --cargo-test-arg=objects::";

pub fn run(mut args: Args) -> Outcome {
    let (package, base, shard) = (args.value("--package")?, args.value("--in-diff")?, args.value("--shard")?);
    if let Some(name) = package.as_deref().filter(|name| !coverage::PACKAGES.contains(name)) {
        return Err(format!("there is no crate \"{name}\"; there is: {}.", coverage::PACKAGES.join(", ")));
    }
    // The tests of sealed images are in the crate that builds the emulator.
    setup::prepare(&[Part::Emulator])?;
    let program = setup::tool("cargo-mutants", VERSION, &[])?;
    let folder = workspace::target_dir().join("mutants");
    files::make(&folder)?;
    let mut options = args.remaining();
    // A choice of files or lines is no result of a commit.
    let is_result = options.is_empty() && base.is_none();
    options.extend(shard.iter().map(|shard| format!("--shard={shard}")));
    if let Some(base) = base {
        let change = folder.join("change.diff");
        files::write(&change, process::git(&["diff", &base, "--", "*.rs"])?)?;
        options.push(format!("--in-diff={}", change.display()));
    }
    // Runs cargo-mutants; counts the changes that a test has noticed, and returns the others.
    let mut caught = 0;
    let mut mutants = |package: &str, name: &str, words: &[String]| -> Outcome<Vec<String>> {
        // What an earlier run has left would count.
        files::remove(&folder.join(name))?;
        let mut mutants = Command::new(&program);
        mutants.args(["mutants", "--package", package, "--output"]).arg(folder.join(name)).args(words);
        // One crate is built again for each change, and nobody debugs it.
        mutants.envs([("CARGO_INCREMENTAL", "1"), ("CARGO_PROFILE_DEV_DEBUG", "0")]);
        let status = mutants.current_dir(workspace::root()).status();
        match status.map_err(|error| process::not_started(&mutants, &error))?.code() {
            // 2 and 3: a change was missed; or a test did not end, which notices the change, too.
            Some(0 | 2 | 3) => {}
            _ => return Err("cargo-mutants failed; what it printed above says why.".into()),
        }
        let list = |end: &str| {
            let list = folder.join(name).join("mutants.out").join(end);
            let list = fs::read_to_string(list).unwrap_or_default();
            list.lines().map(str::to_owned).collect::<Vec<_>>()
        };
        caught += list("caught.txt").len() + list("timeout.txt").len();
        Ok(list("missed.txt"))
    };
    let mut missed = Vec::new();
    for name in
        coverage::PACKAGES.iter().filter(|name| package.as_deref().is_none_or(|package| package == **name))
    {
        if *name != "coboot-core" {
            missed.extend(mutants(name, name, &options)?);
            continue;
        }
        // First without sealed images; then, with them, what no test has noticed, and the files that are
        // not built without.
        let tests = coverage::SEALED_TESTS.map(|test| format!("--cargo-test-arg={test}"));
        let sealed: Vec<_> = WITH_SEALED.split(' ').map(str::to_owned).chain(tests).collect();
        let left = mutants(name, name, &[&options[..], &[format!("--exclude-re={SEALED}")]].concat())?;
        let again: Vec<_> = left.iter().map(|line| format!("--re=^{}$", coverage::exactly(line))).collect();
        if !again.is_empty() {
            // cargo-mutants tries each deletion of a field or an arm in these files, whatever the pattern.
            let missed_again = mutants(name, "again", &[&sealed[..], &again].concat())?;
            missed.extend(missed_again.into_iter().filter(|line| left.contains(line)));
        }
        let within = [&options[..], &sealed, &[format!("--re={SEALED}")]].concat();
        missed.extend(mutants(name, "sealed", &within)?);
    }
    if is_result {
        let parts =
            ["mutants".into(), package.unwrap_or_default(), shard.unwrap_or_default().replace('/', "-")];
        let facts = json!({"tried": caught + missed.len(), "failed": missed.len(), "missed": missed});
        evidence::record(parts.join("-").trim_end_matches('-'), facts)?;
    }
    match missed.len() {
        0 => Ok(()),
        count => Err(format!("no test notices these {count} changes:\n{}", missed.join("\n"))),
    }
}
