//! The main job as a demonstration: `cargo xtask demo`, with `--sealed` the sealed device, and with `--renew`
//! a new bootloader.
//!
//! Host tool, bus and chip run in this process, in virtual time; the firmware is the firmware for
//! the board.

mod renew;
mod sealed;

use std::fs::File;
use std::io::BufWriter;
use std::process::ExitCode;

use canopen::program::{ProgramControl, DEVICE_NAME, PROGRAM_ID, SOFTWARE_VERSION};
use canopen::Address;
use coboot_tests::bench::{Bench, BIT_RATE, NODE};
use coboot_tests::firmware;
use coboot_tests::sealed_board::open_board;
use coflash_core::file::block_file::BlockFile;
use coflash_core::file::Program;
use coflash_core::update::{flash, Event, FlashOptions};
use emulator::candump;
use emulator::time::Time;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

type Outcome<T> = Result<T, Box<dyn std::error::Error>>;

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
        Story::Sealed => sealed::tell(&mut bench)?,
        Story::Renewal => renew::tell(&mut bench)?,
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

fn chapter(title: &str) {
    println!("\n{title}");
}

fn print_line(at: Time, what: &str) {
    println!("  {:>9.3} s  {what}", at.0 as f64 / 1e12);
}

/// The device's information.
fn introduce(bench: &mut Bench) -> Outcome<()> {
    let mut session = bench.session();
    let Some(running) = session.device_type()? else { return Err("the device does not answer".into()) };
    let name = session.read_text(Address::new(DEVICE_NAME, 0))?;
    let version = session.read_text(Address::new(SOFTWARE_VERSION, 0))?;
    let crc = session.read_number(Address::new(PROGRAM_ID, 1))?;
    let what = if running.is_bootloader() { "the bootloader answers" } else { "the application answers" };
    print_line(bench.time(), &format!("{what}: \"{name}\", version \"{version}\", program CRC {crc:08X}h"));
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

/// An application's ELF file as the blocks for the device.
fn convert(image: &str) -> Program {
    let file = firmware::blocks(image);
    let (size, crc) = (file.size(), file.crc());
    println!(
        "               {image} converted: {size} bytes in {} blocks, CRC {crc:08X}h",
        BlockFile::of(&file).blocks().len()
    );
    file
}

/// The whole procedure, printed step by step.
fn install(bench: &mut Bench, file: &Program) -> Outcome<()> {
    let bar = ProgressBar::with_draw_target(None, ProgressDrawTarget::stdout());
    // The rate and the remaining time use the wall clock.
    let style = ProgressStyle::with_template(
        "               {bar:36} {bytes} of {total_bytes}, {bytes_per_sec}, {eta} left",
    )?;
    bar.set_style(style.progress_chars("=> "));
    let clock = bench.clock();
    let mut complete = false;
    let outcome = flash(&mut bench.session(), file, &FlashOptions::default(), &mut |event| match event {
        Event::Progress { done, total } => {
            bar.set_length(total as u64);
            bar.set_position(done as u64);
            if done == total && !complete {
                complete = true;
                bar.finish();
                print_line(clock.get(), &format!("all {total} bytes are in the device"));
            }
        }
        // The report below shows the end.
        Event::Done(_) => {}
        event => print_line(clock.get(), &event.to_string()),
    });
    let report = outcome?;
    let rate = f64::from(report.program_size) / report.took.as_secs_f64() / 1024.0;
    print_line(
        bench.time(),
        &format!("the update took {:.1} s on the bus ({rate:.1} KiB/s)", report.took.as_secs_f64()),
    );
    Ok(())
}
