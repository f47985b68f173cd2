//! `cargo xtask mutants`: would the tests notice a mistake?

use std::fs;
use std::process::Command;

use serde_json::json;
use shared_abi::layout::DEFAULT;

use crate::args::Args;
use crate::attack::STORIES;
use crate::setup::{self, Part};
use crate::{build, coverage, evidence, files, outcome::Outcome, process, workspace};

pub const HELP: &str = "\
usage: cargo xtask mutants [--package NAME] [--in-diff BASE] [--shard K/N] [OPTIONS]
       cargo xtask mutants --silicon [NAME...]

Changes the code of the device's crates in one place at a time with cargo-mutants, and runs the
crate's tests: each change must make one fail. Fails if a change stays unnoticed that
.cargo/mutants.toml does not exclude with a reason. The results are in target/mutants.

  --package NAME  this crate alone: coboot-abi, coboot-canopen, coboot-core, coboot-app or coboot-seal
  --in-diff BASE  the changes alone in lines that differ from this commit
  --shard K/N     the K-th of N parts, from 0
  OPTIONS         for cargo-mutants, as --file '**/store/*.rs' or --list

  --silicon       in place of that: for each rule of the chip in tests/mutants-silicon builds the firmware of the last
                  commit without it; one of the first 24 chips of `cargo xtask attack --silicon` has to fail

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

/// How many chips play the stories.
const CHIPS: &str = "24";

/// Breaks one rule of the chip at a time, in a clone.
fn silicon(names: &[String]) -> Outcome {
    setup::prepare(&[Part::Firmware, Part::Emulator])?;
    let clone = workspace::target_dir().join("mutants/silicon");
    files::remove(&clone)?;
    let mut git = Command::new("git");
    process::run(git.args(["clone", "--quiet", "--local"]).arg(workspace::root()).arg(&clone))?;
    let git = |words: &[&str]| process::run(Command::new("git").current_dir(&clone).args(words));
    // Plays the stories; returns the seeds that fail.
    let play = || -> Outcome<Vec<String>> {
        let mut build = process::bare_cargo();
        build.args(["xtask", "build"]).args(STORIES.split(' ')).current_dir(&clone);
        process::output(build.env_remove("CARGO_TARGET_DIR").env_remove("CARGO_MANIFEST_DIR"))?;
        let mut attack = build::tests_program(DEFAULT, "attack");
        attack.env("COBOOT_FIRMWARE_DIR", clone.join("target/firmware").join(DEFAULT.board));
        attack.args(["--silicon", CHIPS, "--seed", "0"]);
        let done = attack.output().map_err(|error| process::not_started(&attack, &error))?;
        let text = String::from_utf8_lossy(&done.stdout);
        let seeds = text.lines().filter_map(|line| Some(line.split_once(" failed: ")?.0.to_owned()));
        let seeds: Vec<_> = seeds.collect();
        (done.status.success() == seeds.is_empty())
            .then_some(seeds)
            .ok_or_else(|| format!("the stories were not played: {}", String::from_utf8_lossy(&done.stderr)))
    };
    let failed = play()?;
    if !failed.is_empty() {
        return Err(format!("the firmware as it is fails with the chips {}.", failed.join(", ")));
    }
    let (mut tried, mut missed) = (0, Vec::new());
    for patch in files::within(&clone.join("tests/mutants-silicon"))? {
        let name = patch.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        if !names.is_empty() && !names.contains(&name) {
            continue;
        }
        let patch = patch.to_string_lossy().into_owned();
        git(&["apply", &patch])?;
        let failed = play()?;
        git(&["apply", "--reverse", &patch])?;
        println!("{name:<36} {:>2} of {CHIPS} chips fail", failed.len());
        tried += 1;
        missed.extend(failed.is_empty().then_some(name));
    }
    if names.is_empty() {
        evidence::record(
            "mutants-silicon",
            json!({"tried": tried, "failed": missed.len(), "missed": missed}),
        )?;
    }
    match missed.len() {
        0 if tried > 0 => Ok(()),
        0 => Err(format!("no patch in tests/mutants-silicon has the name {}.", names.join(", "))),
        count => Err(format!("no chip notices {count} mutants: {}.", missed.join(", "))),
    }
}

pub fn run(mut args: Args) -> Outcome {
    if args.flag("--silicon") {
        return silicon(&args.remaining());
    }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_rule_of_the_chip_applies_and_is_on_the_page() {
        let page = files::ours("docs/emulator.md").unwrap();
        let patches = files::within(&workspace::root().join("tests/mutants-silicon")).unwrap();
        for patch in &patches {
            let text = files::text(patch).unwrap();
            let [rule, source, without] = [0, 1, 2].map(|n| text.lines().nth(n).unwrap_or_default());
            let name = patch.file_stem().unwrap_or_default().to_string_lossy();
            let source = source.strip_prefix("Source: ").expect("the second line");
            let without = without.strip_prefix("Without: ").expect("the third line");
            let row = format!("| {name} | {rule} | {source} | {without} |\n");
            assert!(page.contains(&row), "docs/emulator.md does not have this row:\n{row}");
            let mut git = Command::new("git");
            git.current_dir(workspace::root()).args(["apply", "--check"]).arg(patch);
            process::run(&mut git).expect("it applies to the firmware as it is");
        }
        assert!(patches.len() >= 25);
    }
}
