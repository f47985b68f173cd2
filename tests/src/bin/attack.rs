//! `cargo xtask attack`: the standing attacker of the bus, for as many frames as you like; and the main
//! scenarios on as many chips as you like.

use std::panic::catch_unwind;
use std::process::ExitCode;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::Mutex;
use std::thread;
use std::time::Instant;

use coboot_tests::attacker::setup::Setup;
use coboot_tests::attacker::{run, Found, Summary};
use coboot_tests::silicon;
use serde_json::{json, Value};

/// The frames of an attack on one board, and many times as many on a node; then a new one is attacked
/// with the next seed.
const EACH: u64 = 50_000;

struct Options {
    frames: u64,
    seed: u64,
    /// Chips to play scenarios on, in place of the attack.
    silicon: Option<u64>,
    evidence: Option<String>,
}

fn options() -> Result<Options, String> {
    let mut options = Options { frames: 200_000, seed: 1, silicon: None, evidence: None };
    let mut words = std::env::args().skip(1);
    while let Some(word) = words.next() {
        let mut value = || words.next().ok_or_else(|| format!("{word} wants a value."));
        let number = |text: String| text.parse().map_err(|_| format!("{text:?} is no number."));
        match word.as_str() {
            "--frames" => options.frames = number(value()?)?,
            "--seed" => options.seed = number(value()?)?,
            "--silicon" => options.silicon = Some(number(value()?)?),
            "--evidence" => options.evidence = Some(value()?),
            other => {
                return Err(format!(
                    "{other:?} is no option; there are --frames, --seed, --silicon, --evidence."
                ))
            }
        }
    }
    Ok(options)
}

/// What came of the attacks.
struct Work {
    rows: Vec<Row>,
    found: Vec<Found>,
}

/// All attacks on a setup.
struct Row {
    name: &'static str,
    seeds: Vec<u64>,
    summary: Summary,
}

fn main() -> ExitCode {
    let options = match options() {
        Ok(options) => options,
        Err(why) => return refuse(&why),
    };
    if let Some(count) = options.silicon {
        return play_silicon(&options, count);
    }
    let setups = Setup::all();
    if setups.is_empty() {
        return refuse("there is nothing to attack: choose the board stm32f407g-disc1.");
    }
    let attacks = options.frames.div_ceil(EACH).max(setups.len() as u64);
    let frames = options.frames.div_ceil(attacks).max(1);
    let rows =
        setups.iter().map(|setup| Row { name: setup.name, seeds: Vec::new(), summary: Summary::default() });
    let work = Mutex::new(Work { rows: rows.collect(), found: Vec::new() });
    on_all_cores(attacks, |n| {
        // Each setup gets each seed in turn.
        let (at, seed) = (n as usize % setups.len(), options.seed + n / setups.len() as u64);
        let result = run(&setups[at], seed, frames * setups[at].pace());
        let mut work = work.lock().expect("no attack panics");
        match result {
            Ok(summary) => {
                work.rows[at].seeds.push(seed);
                work.rows[at].summary.add(&summary);
            }
            Err(found) => {
                println!("{found}");
                work.found.push(*found);
            }
        }
    });
    let work = work.into_inner().expect("no attack panics");
    println!("setup          frames   bursts  resets  cuts  updates  slowest answer   after bus-off  between feeds");
    for Row { name, summary, .. } in &work.rows {
        let Summary { frames, bursts, resets, cuts, updates, slowest_us, slowest_off_us, unfed_us, .. } =
            summary;
        println!(
            "{name:<12} {frames:>8} {bursts:>8} {resets:>7} {cuts:>5} {updates:>8} {:>12.1} ms {:>12.1} ms {:>11.1} ms",
            *slowest_us as f64 / 1e3,
            *slowest_off_us as f64 / 1e3,
            *unfed_us as f64 / 1e3
        );
    }
    let all = work.rows.iter().fold(Summary::default(), |mut all, row| {
        all.add(&row.summary);
        all
    });
    println!("\n{} frames, {} bursts, {} rules broken.", all.frames, all.bursts, work.found.len());
    ended(&options, as_json(&work, &all), work.found.is_empty())
}

/// Does this for each number below `count`, on all cores; so many they are.
fn on_all_cores(count: u64, play: impl Fn(u64) + Sync) -> usize {
    let next = AtomicU64::new(0);
    let threads = thread::available_parallelism().map_or(1, usize::from);
    thread::scope(|scope| {
        for _ in 0..threads {
            scope.spawn(|| loop {
                match next.fetch_add(1, Ordering::Relaxed) {
                    n if n < count => play(n),
                    _ => return,
                }
            });
        }
    });
    threads
}

/// Writes the facts, if they are wanted.
fn ended(options: &Options, facts: Value, is_good: bool) -> ExitCode {
    if let Some(path) = &options.evidence {
        if let Err(error) = std::fs::write(path, format!("{facts}\n")) {
            return refuse(&format!("{path}: {error}"));
        }
    }
    if is_good {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    }
}

/// Plays the scenarios with so many seeds, the first one given, on all cores. A failure was printed by its
/// panic; here is which seeds failed.
fn play_silicon(options: &Options, count: u64) -> ExitCode {
    let failed = Mutex::new(Vec::new());
    let began = Instant::now();
    let threads = on_all_cores(count, |n| {
        let seed = options.seed.wrapping_add(n);
        if catch_unwind(|| silicon::play(seed)).is_err() {
            failed.lock().expect("pushing does not panic").push(seed);
        }
    });
    let mut failed = failed.into_inner().expect("pushing does not panic");
    failed.sort_unstable();
    let each = began.elapsed().as_secs_f64() * threads as f64 / count.max(1) as f64;
    println!("{count} chips, {each:.1} s of a core each, {} failed", failed.len());
    for seed in &failed {
        println!("{seed} failed: see it again with --silicon 1 --seed {seed}");
    }
    let facts = json!({ "chips": count, "failed": failed.len(), "seeds": failed });
    ended(options, facts, failed.is_empty())
}

fn refuse(why: &str) -> ExitCode {
    eprintln!("attack: {why}");
    ExitCode::FAILURE
}

/// The counts, with these facts more.
fn counts(summary: &Summary, more: Value) -> Value {
    let ms = |us: u64| (us as f64 / 100.0).round() / 10.0;
    let mut counts = json!({
        "frames": summary.frames,
        "bursts": summary.bursts,
        "answers": summary.answers,
        "errors": summary.errors,
        "resets": summary.resets,
        "power_cuts": summary.cuts,
        "updates": summary.updates,
        "stores": summary.stores,
        "slowest_answer_ms": ms(summary.slowest_us),
        "slowest_answer_behind_bus_off_ms": ms(summary.slowest_off_us),
        "longest_between_feeds_ms": ms(summary.unfed_us),
    });
    if let (Value::Object(counts), Value::Object(more)) = (&mut counts, more) {
        counts.extend(more);
    }
    counts
}

fn as_json(work: &Work, all: &Summary) -> Value {
    let row = |row: &Row| counts(&row.summary, json!({ "setup": row.name, "seeds": row.seeds }));
    let found = |found: &Found| {
        let what = found.broken.to_string();
        json!({ "setup": found.setup, "seed": found.seed, "burst": found.burst, "what": what })
    };
    let rows: Vec<_> = work.rows.iter().map(row).collect();
    let all_found: Vec<_> = work.found.iter().map(found).collect();
    counts(all, json!({ "failed": all_found.len(), "setups": rows, "found": all_found }))
}
