//! `cargo xtask test`: runs the tests of a tier, with one summary at the end.
//!
//! | file | what it does |
//! |---|---|
//! | `plan.rs` | the images of a tier, and what it needs on the machine |
//! | `runner.rs` | builds and runs tests by cargo-nextest, and sums up |

use std::sync::atomic::Ordering;
use std::time::Instant;

use shared_abi::layout::{Layout, BOARDS, DEFAULT};

use self::plan::{Tier, OF_EACH_CHIP};
use self::runner::{Summary, Variables};
use crate::args::Args;
use crate::{
    attack, build, chips, evidence, examples, files, fuzz, opinion, outcome::Outcome, powercut, process,
    reproduce, setup, workspace,
};

mod plan;
mod runner;

pub const HELP: &str = "\
usage: cargo xtask test [--all [--part NAME] | --board BOARD | WORDS]

Sets the machine up, builds firmware and test programs and runs the tests of the product on its default
board: device, host tool and a CANopen client of others. docs/testing.md says what runs where, and why.

  --all           every test: also on the other chips, with the tools of others, those that take minutes, and
                  jobs of the night; it says what it does not run
  --part NAME     with --all: this part alone; --all lists the names at its beginning. K/N is the K-th of N
  --board BOARD   every test that runs firmware, with that of this board; or those that WORDS choose
  WORDS           go to cargo test, after the images are built: `cargo xtask test -p coboot-tests line::`
";

/// A stage of a run: its name, what it is about, the minutes that it takes on two cores, and the tier of its tests.
type Stage = (&'static str, &'static str, u32, Tier, fn(&mut Summary) -> Outcome);

/// All stages, in the order in which they run.
const STAGES: [Stage; 6] = [
    ("product", "the default board, device and tool", 11, Tier::Product, product),
    ("chips", "other chips, two programs, sealed images", 5, Tier::Chips, chips),
    ("pages", "Chromium, tools of others, the pages", 5, Tier::Pages, pages),
    ("slow", "tests that take minutes", 30, Tier::Night, slow),
    ("boards", "every test with firmware, for each other chip", 30, Tier::Night, boards),
    ("jobs", "power cuts, attacker, QEMU, replay, all chips, two builds", 45, Tier::Night, jobs),
];

/// What `--all` does not run.
const NOT_RUN: &str = "not run, for they take hours: cargo xtask mutants, fuzz, powercut --full, attack --silicon\n\
    not run, jobs of their own: cargo xtask bench, coverage, package --check, examples template, and the gates of .ci/run";

/// The least free space for a run from an empty folder, in KiB.
const ROOM: u64 = 5 << 20;

/// What the command line chooses.
struct Chosen {
    board: Option<&'static Layout>,
    all: bool,
    part: Option<String>,
    stages: Vec<Stage>,
    /// The words for cargo test.
    words: Vec<String>,
}

impl Chosen {
    fn new(mut args: Args) -> Outcome<Self> {
        let board = workspace::chosen_board(&mut args)?;
        let (all, part) = (args.flag("--all"), args.value("--part")?);
        let words = args.remaining();
        if all && (board.is_some() || !words.is_empty()) {
            return Err("--all goes with --part alone.".into());
        }
        if part.is_some() && !all {
            return Err("--part goes with --all.".into());
        }
        let chosen = part.as_deref().or((!all).then_some("product"));
        let is_chosen = |(name, ..): &Stage| chosen.is_none_or(|chosen| is_part(chosen, name));
        let stages: Vec<Stage> = STAGES.into_iter().filter(is_chosen).collect();
        if stages.is_empty() {
            let names = STAGES.map(|(name, ..)| name);
            return Err(format!("--part takes one of {}; or K/N, such as 2/4.", names.join(", ")));
        }
        if all {
            for stage @ (name, about, minutes, ..) in STAGES {
                let word = if is_chosen(&stage) { "runs" } else { "in another part" };
                println!("{name:<8} {minutes:>3} min  {about:<54} {word}");
            }
            println!("{NOT_RUN}\n");
        }
        Ok(Self { board, all, part, stages, words })
    }

    /// The name of the record: each part of a run has one of its own, and the page adds them up.
    fn record(&self) -> String {
        match (&self.part, self.board) {
            (Some(part), _) => format!("tests-all-{}", part.replace('/', "-of-")),
            (None, Some(board)) => format!("tests-{}", board.board),
            _ if self.all => "tests-all".into(),
            _ => "tests".to_owned(),
        }
    }

    /// Runs `cargo test` with the words. With a board: its images, and the programs that are compiled for it.
    fn cargo_test(&self) -> Outcome {
        match self.board {
            Some(board) => build::boards(&[(board, "")])?,
            None => build_images(Tier::Product)?,
        }
        programs_of_ours()?;
        let mut cargo = process::cargo("test");
        cargo.current_dir(workspace::root()).args(self.board.map(|_| "--package=coboot-tests"));
        cargo.args(&self.words).envs(variables(self.board.unwrap_or(DEFAULT)));
        process::run(&mut cargo)
    }

    /// Runs the stages, or every test with the firmware of the board.
    fn stages(&self) -> Outcome<Summary> {
        let mut summary = Summary::default();
        if let Some(board) = self.board {
            on_board(board, Tier::Night, &mut summary)?;
            return Ok(summary);
        }
        for (name, about, _, _, run) in &self.stages {
            println!("== {name}: {about}");
            if let Err(problem) = run(&mut summary) {
                println!("{problem}");
                summary.failed.push(format!("{name}: something did not build or broke off"));
            }
        }
        Ok(summary)
    }
}

pub fn run(args: Args) -> Outcome {
    let chosen = Chosen::new(args)?;
    // Before anything takes time: what is missing on this machine.
    let tier = chosen.stages.iter().map(|(_, _, _, tier, _)| *tier).max().unwrap_or(Tier::Product);
    room()?;
    setup::prepare(tier.needs())?;
    // No other run uses the build results of this clone.
    let _alone = files::lock("tests", "Another `cargo xtask test` runs in this clone.")?;
    if !chosen.words.is_empty() {
        return chosen.cargo_test();
    }
    let started = Instant::now();
    let name = chosen.record();
    evidence::begin(&name)?;
    let summary = chosen.stages()?;
    // What Ctrl-C has ended has not failed.
    while process::IS_ENDING.load(Ordering::Relaxed) {
        std::thread::park();
    }
    evidence::record(&name, summary.as_json())?;
    println!();
    for name in &summary.failed {
        println!("FAILED: {name}");
    }
    if chosen.all {
        println!("{NOT_RUN}");
    }
    println!("{} min", started.elapsed().as_secs().div_ceil(60));
    println!("{}", summary.line());
    match summary.failed.len() {
        0 if summary.is_empty() => Err("no test ran.".into()),
        0 => Ok(()),
        _ => std::process::exit(1), // The summary is the last line.
    }
}

/// Whether a part has a stage: by its name, or as the K-th of N.
fn is_part(part: &str, stage: &str) -> bool {
    let at = STAGES.iter().position(|(name, ..)| *name == stage).unwrap_or_default();
    let is_kth = |(k, n): (&str, &str)| Some(k.parse() == Ok(at.checked_rem(n.parse().ok()?)? + 1));
    part == stage || part.split_once('/').and_then(is_kth) == Some(true)
}

#[test]
fn a_part_is_a_stage_or_the_kth_of_n() {
    let of = |part| STAGES.map(|(name, ..)| u8::from(is_part(part, name)));
    assert_eq!(["slow", "1/4", "2/4"].map(of), [[0, 0, 0, 1, 0, 0], [1, 0, 0, 0, 1, 0], [0, 1, 0, 0, 0, 1]]);
    assert_eq!(["0/4", "5/4", "1/0", "2/", "x"].map(of), [[0; 6]; 5]);
}

/// Checks that the disk has room for a run from an empty folder, unless there are results already.
fn room() -> Outcome {
    let folder = workspace::target_dir();
    files::make(&folder)?;
    // POSIX: the fourth column of the second line is the free space in units of 1024 bytes.
    let output =
        process::output(std::process::Command::new("df").arg("-kP").arg(&folder)).unwrap_or_default();
    let free = output.lines().nth(1).and_then(|line| line.split_whitespace().nth(3)?.parse::<u64>().ok());
    let needed = if folder.join("firmware").exists() { ROOM / 8 } else { ROOM };
    match free {
        Some(free) if free < needed => Err(format!(
            "the disk of {} has {} MiB left, and the tests need {} MiB. Make room (`cargo clean` removes what older \
             runs have built), or name a folder on another disk in CARGO_TARGET_DIR.",
            workspace::shown(&folder),
            free >> 10,
            needed >> 10
        )),
        _ => Ok(()),
    }
}

/// Builds the programs that tests start. For the tests of their own packages cargo does it.
fn programs_of_ours() -> Outcome {
    let mut cargo = process::cargo("build --bin=coflash --bin=coboot-node --bin=emulate");
    // As for the default board: cargo builds what depends on the board again when the variable changes.
    process::run(cargo.args(workspace::on_host()).envs(variables(DEFAULT)).current_dir(workspace::root()))
}

/// Builds the images that a tier needs.
fn build_images(tier: Tier) -> Outcome {
    let rows: Vec<_> = tier.images().map(|row| (row.board, row.names)).collect();
    build::boards(&rows)
}

fn variables(board: &Layout) -> Variables {
    let built = |name: &str| {
        let path = workspace::target_dir().join("debug").join(name);
        path.with_extension(std::env::consts::EXE_EXTENSION).into_os_string()
    };
    vec![
        ("COBOOT_BOARD", board.board.into()),
        ("COBOOT_FIRMWARE_DIR", workspace::firmware_dir(board).into()),
        ("COBOOT_COFLASH", built("coflash")),
        ("COBOOT_NODE", built("coboot-node")),
        ("COBOOT_PYTHON", setup::python().into()),
    ]
}

/// The tests of the product on its default board.
fn product(summary: &mut Summary) -> Outcome {
    of_default(Tier::Product, &[], summary)
}

/// Tests of the default board that run from a tier on: ours, and those of more packages, which are built apart.
fn of_default(tier: Tier, more: &[&str], summary: &mut Summary) -> Outcome {
    let more = more.iter().map(|package| format!("--package={package}")).collect();
    let programs = [workspace::on_host(), more];
    let programs: Vec<_> = programs.into_iter().filter(|programs| !programs.is_empty()).collect();
    // The link of an image uses one core, and so does much of what cargo builds.
    std::thread::scope(|scope| {
        let images = scope.spawn(|| build_images(tier));
        let programs = programs.iter().try_for_each(|programs| runner::build(programs, &variables(DEFAULT)));
        images.join().map_err(|_| "a build broke off.".to_owned())??;
        programs
    })?;
    programs.iter().try_for_each(|of| runner::run(of, tier.filter(), "", &variables(DEFAULT), summary))
}

/// Other chips, two programs and sealed images.
fn chips(summary: &mut Summary) -> Outcome {
    of_default(Tier::Chips, &[], summary)?;
    // The product's tests once more, for a device that takes sealed images and has no keys yet.
    let core = format!(
        "(binary_id(coboot-core::it) + binary_id(coboot-attack::lives)) & {}",
        Tier::Product.filter()
    );
    let takes_sealed = [variables(DEFAULT), vec![("COBOOT_TAKES_SEALED", "1".into())]].concat();
    runner::run(&workspace::on_host(), &core, "[sealed] ", &takes_sealed, summary)?;
    other_chips().try_for_each(|board| on_board(board, Tier::Chips, summary))
}

/// The browser, tools of others and the repository's pages.
fn pages(summary: &mut Summary) -> Outcome {
    of_default(Tier::Pages, &["xtask"], summary)?;
    let mut doc = process::cargo("test --doc --quiet");
    doc.current_dir(workspace::root()).args(workspace::on_host());
    summary.count("documentation", process::run(&mut doc));
    Ok(())
}

/// The tests that take minutes.
fn slow(summary: &mut Summary) -> Outcome {
    examples::all()?;
    of_default(Tier::Night, &["xtask", "coboot-zencan"], summary)
}

/// Every test that runs firmware, for each other chip.
fn boards(summary: &mut Summary) -> Outcome {
    other_chips().try_for_each(|board| on_board(board, Tier::Night, summary))
}

/// A board of each other chip.
fn other_chips() -> impl Iterator<Item = &'static Layout> {
    BOARDS.iter().copied().filter(|other| other.chip.chip != DEFAULT.chip.chip)
}

/// Tests that run firmware, with that of a board: all, or those that show the mistakes of a port. The
/// programs are compiled for it.
fn on_board(board: &'static Layout, tier: Tier, summary: &mut Summary) -> Outcome {
    if tier == Tier::Night {
        build::boards(&[(board, "")])?;
        programs_of_ours()?;
    }
    let (programs, filter) = match tier {
        Tier::Night => ("device update sealed foreign port", "all()".to_owned()),
        _ => ("device update", format!("({OF_EACH_CHIP}) - {}", Tier::Night.filter())),
    };
    let programs = programs.split(' ').map(|name| format!("--test={name}"));
    let arguments: Vec<_> = workspace::on_host().into_iter().chain(programs).collect();
    runner::run(&arguments, &filter, &format!("[{}] ", board.board), &variables(board), summary)
}

/// Jobs of the night that end by themselves.
fn jobs(summary: &mut Summary) -> Outcome {
    type Run = fn(Args) -> Outcome;
    let all: [(&str, Run); 6] = [
        ("fuzz --replay", fuzz::run),
        ("powercut", powercut::run),
        ("attack", attack::run),
        ("opinion", opinion::run),
        ("reproduce", reproduce::run),
        ("chips", chips::run),
    ];
    for (name, run) in all {
        println!("== cargo xtask {name}");
        let words = name.split(' ').skip(1).map(str::to_owned);
        summary.count(&format!("cargo xtask {name}"), run(Args::new(words)));
    }
    Ok(())
}
