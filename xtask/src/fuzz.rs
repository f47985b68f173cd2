//! `cargo xtask fuzz`: runs all fuzz targets, as many at a time as there are cores.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Instant;
use std::{fs, iter, thread};

use serde_json::{json, Value};

use crate::args::Args;
use crate::{evidence, files, outcome::Outcome, process, setup, workspace};

pub const HELP: &str = "\
usage: cargo xtask fuzz [--seconds N | --inputs N] [--target NAMES] [--replay]

Runs the fuzz targets of tests/fuzz/fuzz_targets, as many at a time as there are cores. What they find
in this run is built upon in the next one. The counts of a run of all targets go to
target/evidence/fuzz.json.

  --seconds N     how long each target runs (default: 30)
  --inputs N      how many inputs each target tries, in place of a time
  --target NAMES  these alone, with commas between them
  --replay        runs no fuzzer: every input of tests/fuzz/corpus and target/fuzz/corpus once, with
                  the Rust that builds the rest; it needs no nightly toolchain

Without --replay, it needs a nightly toolchain of Rust and a C++ compiler. cargo-fuzz is installed into target/tools
where it is missing. What it has found is kept, as small as it may be for the same coverage, by
  rustup run nightly target/tools/bin/cargo-fuzz fuzz cmin --sanitizer none --fuzz-dir tests/fuzz NAME target/fuzz/corpus/NAME
  tar -C target/fuzz/corpus/NAME -czf tests/fuzz/corpus/NAME.tar.gz .
";

/// The version to install if there is none.
const CARGO_FUZZ: &str = "0.13.2";
/// The longest time for one input of a target, in seconds. They need microseconds.
const TOO_LONG: u32 = 10;
/// The longest input, in bytes.
const LONGEST_INPUT: u32 = 4096;
/// The targets whose bytes are commands or numbers, each with its longest input: many short lives find
/// more than a few long ones. To show the fuzzer what each comparison compares, which finds the words
/// of texts and files, would take three quarters of their time.
const COMMANDS: [(&str, u32); 6] = [
    ("conform", 512),
    ("debugger", 512),
    ("journal", 512),
    ("lives", 512),
    ("lzma", 1024),
    ("signature", 512),
];
/// The longest input of a target whose bytes are commands.
fn longest_commands(target: &str) -> Option<u32> {
    COMMANDS.iter().find(|(name, _)| *name == target).map(|(_, longest)| *longest)
}

/// Runs every kept input once, without the fuzzer. The programs are built as the tests are, so that
/// nothing of others is compiled again.
fn replay_all(targets: &[String]) -> Outcome {
    let mut build = process::cargo("build");
    build.current_dir(workspace::root()).args(workspace::on_host());
    process::run(build.args(targets.iter().map(|target| format!("--bin={target}"))))?;
    for target in targets {
        let mut program = Command::new(workspace::target_dir().join("debug").join(target));
        // They are unpacked anew: a name may have gone.
        let kept = target_dir().join("kept").join(target);
        files::remove(&kept)?;
        program.arg(unpack(target, kept)?);
        let found = found(target);
        program.args(found.is_dir().then_some(found));
        let output = process::output(&mut program)?;
        println!("  {target:<16} {:>10} inputs, no fault", output.trim());
    }
    Ok(())
}

/// Puts the kept inputs of a target, if there are any, into a folder, which it makes; returns the folder.
fn unpack(target: &str, folder: PathBuf) -> Outcome<PathBuf> {
    files::make(&folder)?;
    let archive = workspace::root().join("tests/fuzz/corpus").join(format!("{target}.tar.gz"));
    if archive.exists() {
        files::unpack(&archive, &folder)?;
    }
    Ok(folder)
}

/// The folder of what the fuzzer has found in this clone, and of what it has begun with.
fn found(target: &str) -> PathBuf {
    target_dir().join("corpus").join(target)
}

/// The folder of the targets.
fn folder() -> PathBuf {
    workspace::root().join("tests/fuzz")
}

pub fn run(mut args: Args) -> Outcome {
    // The fuzzer would run without end with 0.
    let most = i32::MAX as u64;
    let end = match (args.number("--seconds", 1..=most)?, args.number("--inputs", 1..=most)?) {
        (Some(_), Some(_)) => return Err("--seconds and --inputs do not go together.".into()),
        (None, Some(inputs)) => format!("-runs={inputs}"),
        (seconds, None) => format!("-max_total_time={}", seconds.unwrap_or(30)),
    };
    let only = args.value("--target")?;
    let replay = args.flag("--replay");
    args.none_left()?;
    let folder = folder();
    let mut targets = targets(&folder)?;
    let is_whole = only.is_none();
    if let Some(only) = only {
        let chosen: Vec<String> = only.split(',').map(str::to_owned).collect();
        if let Some(name) = chosen.iter().find(|name| !targets.contains(name)) {
            return Err(format!("there is no target \"{name}\"; there is: {}.", targets.join(", ")));
        }
        targets = chosen;
    }
    if replay {
        return replay_all(&targets);
    }
    // If there is none, rustup says how to get it.
    process::output(Command::new("rustup").args(["run", "nightly", "rustc", "--version"]))?;
    setup::prepare(&[setup::Part::Cpp])?;
    let cargo_fuzz = setup::tool("cargo-fuzz", CARGO_FUZZ, &[])?;
    println!("Building the fuzz targets ...");
    for target in &targets {
        process::run(&mut command(&cargo_fuzz, "build", target))?;
    }
    let next = AtomicUsize::new(0);
    let one = |target: &String| fuzz(&cargo_fuzz, target, &end);
    let work = || iter::from_fn(|| targets.get(next.fetch_add(1, Ordering::Relaxed))).map(one).collect();
    if is_whole {
        evidence::begin("fuzz")?;
    }
    // A target has one thread.
    let cores = thread::available_parallelism().map_or(1, usize::from);
    let mut ended = thread::scope(|scope| {
        let workers: Vec<_> = (0..cores).map(|_| scope.spawn(work)).collect();
        let broken_off = |_| Err("a part of the fuzzing broke off.".to_owned());
        let ended = workers.into_iter().map(|worker| worker.join().unwrap_or_else(broken_off));
        ended.collect::<Outcome<Vec<Vec<_>>>>()
    })?
    .concat();
    ended.sort_by_key(|row| row["target"].to_string());
    // A target that has failed has no row of counts.
    let failed = ended.iter().filter(|row| row["inputs"].is_null());
    let failed: Vec<_> = failed.map(|row| row["target"].to_string()).collect();
    if is_whole {
        evidence::record("fuzz", counted(&ended))?;
    }
    if failed.is_empty() {
        Ok(())
    } else {
        Err(format!(
            "{} failed. `cargo +nightly fuzz run --fuzz-dir tests/fuzz TARGET FILE` repeats one with the file named above; make a test of \
             it before you mend it.",
            failed.join(", ")
        ))
    }
}

/// What a run has counted: the facts of the evidence.
fn counted(rows: &[Value]) -> Value {
    let inputs: Vec<u64> = rows.iter().filter_map(|row| row["inputs"].as_u64()).collect();
    json!({
        "inputs": inputs.iter().sum::<u64>(),
        "fewest_of_a_target": inputs.iter().min(),
        "failed": rows.len() - inputs.len(),
        "targets": rows,
    })
}

/// The command of cargo-fuzz, with this word of its, for a target.
fn command(cargo_fuzz: &Path, word: &str, target: &str) -> Command {
    let mut command = Command::new("rustup");
    command.args(["run", "nightly"]).arg(cargo_fuzz).args(["fuzz", word]);
    // It looks for mistakes with pointers, which safe Rust cannot make, and takes half the time.
    command.arg("--sanitizer=none").arg("--fuzz-dir").arg(folder());
    // Each of the two is built with options of its own.
    let mut programs = target_dir();
    if longest_commands(target).is_some() {
        command.arg("--no-trace-compares");
        programs.push("without-compares");
    }
    command.arg(target).current_dir(workspace::root());
    command.env("CARGO_TARGET_DIR", programs).env_remove("CARGO");
    // The lines of a panic; and a wrapped number is a find, too.
    command.env("CARGO_PROFILE_RELEASE_DEBUG", "1").env("CARGO_PROFILE_RELEASE_OVERFLOW_CHECKS", "true");
    command
}

/// Runs a target until this end: an option of the fuzzer. Prints and returns what it has counted;
/// why it failed, if it did.
fn fuzz(cargo_fuzz: &Path, target: &str, end: &str) -> Outcome<Value> {
    // The fuzzer puts only what is new there, and the smallest corpus is made of it alone.
    let corpus = unpack(target, found(target))?;
    let log = target_dir().join(target).with_extension("log");
    let file = fs::File::create(&log).map_err(|error| format!("{}: {error}.", log.display()))?;
    let mut command = command(cargo_fuzz, "run", target);
    command.arg(&corpus);
    let longest = longest_commands(target).unwrap_or(LONGEST_INPUT);
    command.args(["--", "-print_final_stats=1", end]);
    command.args([format!("-max_len={longest}"), format!("-timeout={TOO_LONG}")]);
    let started = Instant::now();
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(file);
    let status = command.status().map_err(|error| process::not_started(&command, &error))?;
    let output = fs::read(&log).unwrap_or_default();
    let output = String::from_utf8_lossy(&output);
    let runs = runs(&output).filter(|runs| status.success() && *runs > 0);
    if let Some(runs) = runs {
        let seconds = started.elapsed().as_secs();
        println!("  {target:<16} {runs:>10} inputs in {seconds} s, no fault");
        return Ok(json!({"target": target, "inputs": runs, "seconds": seconds}));
    }
    let words = if status.success() { "ran no input" } else { "FAILED" };
    println!("  {target:<16} {words}; all of it is in {}\n{}", workspace::shown(&log), excerpt(&output));
    Ok(json!({"target": target}))
}

/// The targets, from the names of their files.
fn targets(folder: &Path) -> Outcome<Vec<String>> {
    let mut sources = files::within(&folder.join("fuzz_targets"))?;
    sources.retain(|file| files::is(file, "rs"));
    Ok(sources.iter().filter_map(|path| Some(path.file_stem()?.to_str()?.to_owned())).collect())
}

fn target_dir() -> PathBuf {
    workspace::target_dir().join("fuzz")
}

/// The number of inputs in the fuzzer's output.
fn runs(output: &str) -> Option<u64> {
    output.lines().find_map(|line| line.strip_prefix("stat::number_of_executed_units:")?.trim().parse().ok())
}

/// The part of a failed run's output with the reason: the panic with its message, and the place of
/// the input.
fn excerpt(output: &str) -> String {
    let begin = ["panicked at", "ERROR: libFuzzer"];
    let lines = output.lines().skip_while(|line| !begin.iter().any(|words| line.contains(words)));
    let (text, rest): (Vec<_>, Vec<_>) = lines.enumerate().partition(|(number, _)| *number < 8);
    let input = rest.into_iter().filter(|(_, line)| line.contains("Test unit written to"));
    text.into_iter().chain(input).map(|(_, line)| format!("    {line}\n")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_target_is_declared() {
        let folder = folder();
        let manifest = fs::read_to_string(folder.join("Cargo.toml")).unwrap();
        let targets = targets(&folder).unwrap();
        assert!(targets.iter().any(|target| target == "lss"), "{targets:?}");
        for target in targets {
            let lines = format!("path = \"fuzz_targets/{target}.rs\"");
            assert!(manifest.contains(&lines), "{target} is not in Cargo.toml");
        }
        for (name, _) in COMMANDS {
            assert!(manifest.contains(&format!("name = \"{name}\"")), "{name}");
        }
    }

    #[test]
    fn the_kept_inputs_are_whole_and_few() {
        for file in files::within(&folder().join("corpus")).unwrap() {
            if file.file_name().is_some_and(|name| name != ".gitattributes") {
                let names = process::output(Command::new("tar").arg("--list").arg("--file").arg(&file));
                assert!(names.unwrap().lines().any(|name| name != "./"), "{}", file.display());
                assert!(file.metadata().unwrap().len() < 200_000, "{}", file.display());
            }
        }
    }

    /// Lines as libFuzzer prints them.
    #[test]
    fn the_fuzzers_words_are_understood() {
        let output = "#918484\tDONE   cov: 741 ft: 3053\nstat::number_of_executed_units: 918484\nstat::average_exec_per_sec:     57405\n";
        assert_eq!((runs(output), excerpt(output)), (Some(918_484), String::new()));
        let output = "INFO: seed\nthread '<unnamed>' panicked at src/x.rs:1:2:\nno room\n==1== ERROR: libFuzzer: deadly signal\n\
                    Test unit written to crash-1\n";
        assert_eq!(runs(output), None);
        let excerpt = excerpt(output);
        assert!(excerpt.contains("no room") && excerpt.contains("crash-1") && !excerpt.contains("seed"));
    }

    #[test]
    fn counts_add_up_over_the_targets() {
        let rows = [
            json!({"target": "lss", "inputs": 10}),
            json!({"target": "lzma"}),
            json!({"target": "ui", "inputs": 5}),
        ];
        let facts = counted(&rows);
        assert_eq!((&facts["inputs"], &facts["fewest_of_a_target"]), (&json!(15), &json!(5)));
        assert_eq!((&facts["failed"], &facts["targets"][0]["target"]), (&json!(1), &json!("lss")));
    }
}
