//! The main job as a demonstration: `cargo xtask demo`, with `--sealed` the sealed device, and with `--renew`
//! a new bootloader.
//!
//! Host tool, bus and chip run in this process, in virtual time; the firmware is the firmware for
//! the board.

mod renew;
mod sealed;
mod steps;

use std::fs::File;
use std::io::BufWriter;
use std::process::ExitCode;

use canopen::program::ProgramControl;
use coboot_tests::bench::{Bench, BIT_RATE, NODE};
use coboot_tests::firmware;
use coboot_tests::sealed_board::open_board;
use emulator::candump;

use steps::{chapter, convert, install, introduce, print_line, Outcome};

const USAGE: &str =
    "usage: demo [--sealed | --renew] [--trace FILE]    (run it as `cargo xtask demo`, which builds everything first)";

fn main() -> ExitCode {
    let mut arguments: Vec<String> = std::env::args().skip(1).collect();
    let story = match arguments.first().map(String::as_str) {
        Some("--sealed") => Story::Sealed,
        Some("--renew") => Story::Renewal,
        _ => Story::MainJob,
    };
    if story != Story::MainJob {
        arguments.remove(0);
    }
    let trace = match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        [] => None,
        ["--trace", file] => Some(file.to_owned()),
        _ => {
            eprintln!("{USAGE}");
            return ExitCode::from(2);
        }
    };
    match demo(trace.as_deref(), story) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("the demonstration failed: {error}");
            ExitCode::FAILURE
        }
    }
}

/// What is shown.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Story {
    MainJob,
    Sealed,
    Renewal,
}

fn demo(trace: Option<&str>, story: Story) -> Outcome<()> {
    let board = firmware::board();
    println!("An emulated {} on a CAN bus at {} kbit/s. Times are virtual.\n", board.board, BIT_RATE / 1000);
    let mut bench = if story == Story::Sealed { open_board() } else { Bench::new() };
    let log = match trace {
        Some(path) => {
            let file = File::create(path).map_err(|error| format!("{path}: {error}"))?;
            let log = candump::Handle::new(BufWriter::new(file), "can0", candump::Lines::Frames);
            bench.world.add_sink(log.sink());
            Some((path, log))
        }
        None => None,
    };

    match story {
        Story::MainJob => main_job(&mut bench)?,
        Story::Sealed => sealed::run(&mut bench)?,
        Story::Renewal => renew::run(&mut bench)?,
    }

    let counters = bench.machine().counters();
    println!("\nDone: {} million instructions ran on the chip.", counters.instructions / 1_000_000);
    if let Some((path, log)) = log {
        log.flush()?;
        println!("The bus is in {path}, as candump logs it.");
    }
    Ok(())
}

/// Two versions, one after the other, and a power failure.
fn main_job(bench: &mut Bench) -> Outcome<()> {
    chapter("Power on: an empty board comes up in its bootloader");
    bench.power_on();
    print_line(bench.time(), "power on");
    let up = bench.await_boot_up(1000);
    print_line(up, &format!("boot-up of node {NODE}"));
    introduce(bench)?;

    chapter("Version 1 goes into the board");
    let v1 = convert(firmware::APP_V1);
    install(bench, &v1)?;
    introduce(bench)?;
    heartbeat(bench)?;

    chapter("The master calls the application back: 1F51h = 80h");
    bench.session().command(1, ProgramControl::StartBootloader)?;
    print_line(bench.time(), "the application acknowledged, and leaves");
    let up = bench.await_boot_up(1000);
    print_line(up, "boot-up: the bootloader is back");
    introduce(bench)?;

    chapter("Version 2 goes into the board");
    let v2 = convert(firmware::APP_V2);
    install(bench, &v2)?;
    introduce(bench)?;

    chapter("The power fails, and comes back");
    bench.power_off();
    print_line(bench.time(), "power off");
    bench.run_ms(1000);
    bench.power_on();
    print_line(bench.time(), "power on");
    let up = bench.await_boot_up(1000);
    print_line(up, "boot-up: the program started by itself, at once: it has passed its trial");
    introduce(bench)?;
    heartbeat(bench)?;
    bench.assert_nothing_unmodelled();
    Ok(())
}

/// Waits for a heartbeat and prints it.
fn heartbeat(bench: &mut Bench) -> Outcome<()> {
    let from = bench.time();
    bench.run_ms(1100);
    let id = 0x700 + u32::from(NODE);
    let frames = bench.frames_since(from);
    let beat = frames.iter().find(|(_, heard, _)| *heard == id).ok_or("no heartbeat within 1.1 s")?;
    let state = match beat.2[..] {
        [0x05] => "OPERATIONAL",
        [0x7F] => "PRE-OPERATIONAL",
        _ => "in an unexpected state",
    };
    print_line(beat.0, &format!("heartbeat: {state}"));
    Ok(())
}
