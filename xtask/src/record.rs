//! `cargo xtask record`: makes the picture of the two windows from the output of the programs.

use std::fmt::Write as _;
use std::fs;
use std::io::{BufRead, BufReader};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{self, Receiver};
use std::thread;
use std::time::Duration;

use crate::args::Args;
use crate::setup::{Part, Setup};
use crate::{build, process, workspace, Outcome};

pub const HELP: &str = "\
usage: cargo xtask record [--yes]

Runs an emulated board and updates it with coflash, as docs/first-hour.md tells it, and writes what
both print into docs/pictures/two-windows.txt, and as a picture into two-windows.svg beside it. Both
are checked in; tests tell when the picture is older than the text, or the text than coflash.

  --yes           installs what is missing with sudo
";

/// The address of the board's bus.
const ADDRESS: &str = "127.0.0.1:29536";
/// The calls, in their order, in the folder of the board's images.
const CALLS: [&str; 3] = [
    "coflash flash app-v1.elf --board stm32f407g-disc1 --quiet",
    "coflash flash app-v2.elf --board stm32f407g-disc1",
    "coflash read 100A",
];
/// The prefix of a window's title in the text.
const WINDOW: &str = "== ";
/// A line that stands for omitted lines.
const GAP: &str = "   …";

pub fn run(mut args: Args) -> Outcome {
    let setup = Setup::from(&mut args);
    // The default board: the calls contain its name.
    let board = workspace::board(&mut args)?;
    args.none_left()?;
    setup.prepare(&[Part::Firmware, Part::Emulator])?;
    let images = build::images(board, &build::MAIN)?;
    process::run(process::cargo("build").args(["-p", "coboot-emulator", "-p", "coflash", "--bins"]))?;

    let mut emulate = Command::new(workspace::target_dir().join("debug/emulate"));
    emulate.args(["--board", board.board, "--socketcand", ADDRESS, "--bootloader"]);
    let (mut running, lines) = started(emulate.arg(images.join("bootloader.elf")))?;
    let recorded = record(&images, &lines);
    // It runs until it is ended; its last output is not needed.
    let _ = running.kill();
    let _ = running.wait();

    let text = recorded?;
    for (name, text) in [("two-windows.txt", &text), ("two-windows.svg", &drawn(&text))] {
        let file = picture(name);
        fs::write(&file, text)
            .map_err(|error| format!("{} cannot be written: {error}.", workspace::shown(&file)))?;
    }
    Ok(())
}

fn picture(name: &str) -> PathBuf {
    workspace::root().join("docs/pictures").join(name)
}

/// Starts a program that keeps running, and returns the lines of its output.
fn started(command: &mut Command) -> Outcome<(Child, Receiver<String>)> {
    let mut child = command
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .spawn()
        .map_err(|error| process::not_started(command, &error))?;
    let (sender, lines) = mpsc::channel();
    if let Some(out) = child.stdout.take() {
        thread::spawn(move || {
            // It ends with the program, or when the receiver is dropped.
            let _ = BufReader::new(out).lines().map_while(Result::ok).try_for_each(|line| sender.send(line));
        });
    }
    Ok((child, lines))
}

/// Updates the board, and returns both windows as text.
fn record(images: &PathBuf, board: &Receiver<String>) -> Outcome<String> {
    let first = board
        .recv_timeout(Duration::from_secs(30))
        .map_err(|_| "the emulated board does not come up; its own words above tell why.".to_owned())?;
    // Waits until the boot-up is over.
    thread::sleep(Duration::from_secs(2));
    let bus = format!("socketcand://{ADDRESS}/can0");
    let mut tool = format!("$ export COFLASH_BUS={bus}\n");
    for call in CALLS {
        let mut coflash = Command::new(workspace::target_dir().join("debug/coflash"));
        coflash.args(call.split(' ').skip(1)).env("COFLASH_BUS", &bus).current_dir(images);
        let _ = write!(tool, "$ {call}\n{}", shortened(&process::output(&mut coflash)?));
    }
    thread::sleep(Duration::from_secs(1));
    let mut text = format!("{WINDOW}the board\n$ cargo xtask emulate --socketcand {ADDRESS}\n{first}\n");
    while let Ok(line) = board.try_recv() {
        let _ = writeln!(text, "{line}");
    }
    Ok(format!("{text}{WINDOW}the tool\n{tool}"))
}

/// The output of a call, with one line of progress instead of all.
fn shortened(said: &str) -> String {
    let mut lines: Vec<&str> = Vec::new();
    for line in said.lines() {
        let is_progress = |line: &str| line.contains(" % ");
        match lines.as_slice() {
            [.., before, last] if is_progress(before) && *last == GAP && is_progress(line) => {}
            [.., last] if is_progress(last) && is_progress(line) && !line.contains("100 %") => {
                lines.push(GAP)
            }
            _ => lines.push(line),
        }
        if line.contains("100 %") && lines.last() != Some(&line) {
            lines.push(line);
        }
    }
    lines.iter().map(|line| format!("{line}\n")).collect()
}

/// Sizes in pixels.
const WIDTH: usize = 800;
const LINE: usize = 17;
const TITLE: usize = 26;
const EDGE: usize = 10;

/// The windows as a picture, one below the other.
fn drawn(text: &str) -> String {
    let mut svg = String::new();
    let mut top = 4;
    for window in text.split(WINDOW).filter(|window| !window.is_empty()) {
        let (title, lines) = window.split_once('\n').unwrap_or((window, ""));
        let height = TITLE + 2 * EDGE + LINE * lines.lines().count();
        // Writing to a string cannot fail.
        let _ = writeln!(
            svg,
            r##"<rect x="4" y="{top}" width="{}" height="{height}" rx="8" fill="#1f2430"/>"##,
            WIDTH - 8
        );
        for (at, colour) in ["#f87171", "#fbbf24", "#4ade80"].iter().enumerate() {
            let _ =
                writeln!(svg, r#"<circle cx="{}" cy="{}" r="5" fill="{colour}"/>"#, 22 + 18 * at, top + 15);
        }
        let _ = writeln!(
            svg,
            r##"<text x="{}" y="{}" text-anchor="middle" fill="#9ca3af">{title}</text>"##,
            WIDTH / 2,
            top + 19
        );
        for (at, line) in lines.lines().enumerate() {
            let colour = if line.starts_with("$ ") { "#fde68a" } else { "#e5e7eb" };
            let line = line.replace('&', "&amp;").replace('<', "&lt;");
            let y = top + TITLE + EDGE + LINE * at + 12;
            let _ =
                writeln!(svg, r#"<text x="16" y="{y}" fill="{colour}" xml:space="preserve">{line}</text>"#);
        }
        top += height + 12;
    }
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{WIDTH}\" height=\"{top}\" viewBox=\"0 0 {WIDTH} {top}\" \
         font-family=\"DejaVu Sans Mono,Menlo,Consolas,monospace\" font-size=\"12\">\n{svg}</svg>\n"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_picture_is_that_of_its_text() {
        let read = |name| fs::read_to_string(picture(name)).unwrap();
        assert!(
            read("two-windows.svg") == drawn(&read("two-windows.txt")),
            "two-windows.svg is old: run `cargo xtask record`"
        );
    }

    #[test]
    fn progress_is_shortened_to_its_ends() {
        let line = |percent: u8| format!("{percent:4} %  of all\n");
        let said = format!("begin\n{}{}{}{}end\n", line(10), line(20), line(30), line(100));
        assert_eq!(shortened(&said), format!("begin\n{}{GAP}\n{}end\n", line(10), line(100)));
        let short = format!("begin\n{}{}end\n", line(50), line(100));
        assert_eq!(shortened(&short), short);
    }

    #[test]
    fn each_window_is_as_high_as_its_lines() {
        let svg = drawn("== one\n$ a <b>\nc\n== two\n");
        assert!(svg.contains(r#"height="80" rx"#) && svg.contains(r#"height="46" rx"#), "{svg}");
        assert!(svg.contains("$ a &lt;b>") && svg.contains(">two</text>"), "{svg}");
    }
}
