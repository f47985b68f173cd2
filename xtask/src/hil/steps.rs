//! The steps, in their order: the set-up, the conformance checks, the main job, the update suite.

use std::process::Command;
use std::thread;
use std::time::{Duration, Instant};

use serde_json::Value;

use super::bench::{switch, Bench, Done};
use super::coflash::{self, Answer};
use crate::{files, process, Outcome};

/// A step.
pub struct Step {
    /// Its name in the report.
    pub name: &'static str,
    /// Whether the steps after it make no sense without it.
    pub others_need_it: bool,
    /// Carries it out. The error says why it failed and what to do.
    pub run: fn(&mut Bench) -> Outcome<Done>,
}

const fn needed(name: &'static str, run: fn(&mut Bench) -> Outcome<Done>) -> Step {
    Step { name, others_need_it: true, run }
}

const fn step(name: &'static str, run: fn(&mut Bench) -> Outcome<Done>) -> Step {
    Step { name, others_need_it: false, run }
}

/// All steps after the build.
pub const STEPS: &[Step] = &[
    needed("open the bus", open_bus),
    needed("flash the bootloader by the probe", flash_bootloader),
    needed("power off and on, or reset", restart),
    needed("the device answers", device_answers),
    step("conformance: coflash conform", conform),
    // The main job, as `cargo xtask demo` shows it.
    needed("install version 1", |bench| install(bench, V1, &[])),
    step("call the application back: 1F51h = 80h", call_back),
    step("update to version 2", |bench| install(bench, V2, &[])),
    step("start version 2 by itself after a restart", starts_by_itself),
    step("cut the power in mid-update, and recover", power_cut),
    // The update suite.
    step("block file by block transfers", |bench| install(bench, V1, &[])),
    step("block file by segments", |bench| install(bench, V2, &["--segmented"])),
    step("raw image (CiA 302-3)", |bench| install(bench, V1, &["--dialect", "raw"])),
    step("refuse a damaged file", damaged_file),
    step("refuse a program for another device", wrong_identity),
    step("interrupt an update by Ctrl-C, and repeat it", interrupted),
];

const V1: &str = "app-v1.elf";
const V2: &str = "app-v2.elf";

/// The time for the device to answer after its power is on or it was reset.
const START: Duration = Duration::from_secs(15);
/// The exit codes of coflash (`coflash --help`).
const BAD_FILE: i32 = 3;
const NO_BUS: i32 = 4;
const REFUSED: i32 = 6;
const CANCELLED: i32 = 130;

fn passed(text: impl Into<String>) -> Outcome<Done> {
    Ok(Done::Passed(text.into()))
}

fn open_bus(bench: &mut Bench) -> Outcome<Done> {
    // The device need not answer yet.
    let answer = bench.coflash.call(&["info"])?;
    if answer.code == Some(NO_BUS) {
        return Err(answer.problem());
    }
    passed("")
}

fn flash_bootloader(bench: &mut Bench) -> Outcome<Done> {
    bench.probe("download", &image(bench, "bootloader.elf"))?;
    passed("")
}

fn restart(bench: &mut Bench) -> Outcome<Done> {
    bench.restart().and_then(passed)
}

fn device_answers(bench: &mut Bench) -> Outcome<Done> {
    let info = info_after_start(bench).map_err(|error| {
        format!("{error} The probe has flashed the bootloader: look at bit rate, termination and node-ID.")
    })?;
    let word = |key: &str| info[key].as_str().unwrap_or("?").to_owned();
    passed(format!("\"{}\", version \"{}\"", word("name"), word("software_version")))
}

fn conform(bench: &mut Bench) -> Outcome<Done> {
    let answer = bench.coflash.call(&["conform"])?;
    bench.conform = process::json(&answer.said).ok();
    match (answer.code, &bench.conform) {
        (Some(0), _) => passed(""),
        (_, Some(_)) if answer.value["error"].is_null() => {
            Err("checks failed: `coflash conform` tells which, and so does the report of --json.".into())
        }
        _ => Err(answer.problem()),
    }
}

/// Flashes a program, compares its CRC with the file, and sees it run.
fn install(bench: &mut Bench, image: &str, options: &[&str]) -> Outcome<Done> {
    let answer = flash(bench, image, options)?.good()?;
    let crc = number(&answer.value["crc"]).ok_or("coflash told no CRC of the program.")?;
    bench.installed = Some(crc);
    runs_installed(bench)?;
    let seconds = number(&answer.value["seconds"]).unwrap_or_default();
    passed(format!("{image} in {seconds} s"))
}

fn flash(bench: &Bench, image: &str, options: &[&str]) -> Outcome<Answer> {
    bench.coflash.call(&[&flash_words(bench, &self::image(bench, image)), options].concat())
}

/// The words of a download with a comparison at its end.
fn flash_words<'w>(bench: &Bench, file: &'w str) -> [&'w str; 5] {
    ["flash", file, "--board", bench.board.board, "--verify"]
}

/// The path of an image of the board.
fn image(bench: &Bench, name: &str) -> String {
    bench.images.join(name).display().to_string()
}

/// Checks that the application runs, and that it is the last one that was installed.
fn runs_installed(bench: &Bench) -> Outcome {
    let info = info_after_start(bench)?;
    if info["bootloader"] != Value::Bool(false) {
        return Err("the bootloader answers where the application should run.".into());
    }
    holds_installed(bench, &info)
}

/// Checks that the device holds the last program that was installed.
fn holds_installed(bench: &Bench, info: &Value) -> Outcome {
    let Some(wanted) = &bench.installed else { return Ok(()) };
    let held = info["programs"].get(0).and_then(|program| number(&program["crc"]));
    if held.as_ref() == Some(wanted) {
        return Ok(());
    }
    let held = held.unwrap_or("none".into());
    Err(format!("the program in the device has CRC {held}, and the one that was installed {wanted}."))
}

fn call_back(bench: &mut Bench) -> Outcome<Done> {
    bench.coflash.call(&["enter", "--within", "10000"])?.good()?;
    let info = bench.coflash.call(&["info"])?.good()?.value;
    if info["bootloader"] != Value::Bool(true) {
        return Err("the application still answers: it has not gone back to the bootloader.".into());
    }
    passed("")
}

fn starts_by_itself(bench: &mut Bench) -> Outcome<Done> {
    let how = restart(bench)?;
    runs_installed(bench)?;
    Ok(how)
}

fn power_cut(bench: &mut Bench) -> Outcome<Done> {
    let Some(power) = &bench.power else {
        return Ok(Done::LeftOut("there is no --power-command".into()));
    };
    let image = image(bench, V1);
    let cut = bench.coflash.flash_until_middle(&flash_words(bench, &image), |_| switch(power, "off"));
    // The board gets its power back, whatever happened.
    switch(power, "on")?;
    if cut?.code == Some(0) {
        return Err("the update ended well without power: --power-command does not reach this board.".into());
    }
    let info = info_after_start(bench)?;
    if info["bootloader"] != Value::Bool(true) {
        return Err("after a cut update an application runs, where the bootloader should wait.".into());
    }
    install(bench, V1, &[])
}

fn damaged_file(bench: &mut Bench) -> Outcome<Done> {
    // A block file with one bit changed in its middle.
    files::make(&bench.work)?;
    let file = bench.work.join("damaged.blk");
    let mut convert = Command::new(coflash::program());
    convert.args(["convert", &image(bench, V2), "--board", bench.board.board]).arg(&file);
    process::output(&mut convert)?;
    let mut bytes = files::bytes(&file)?;
    let middle = bytes.len() / 2;
    *bytes.get_mut(middle).ok_or("the block file is empty.")? ^= 1;
    files::write(&file, bytes)?;
    let answer = bench.coflash.call(&["flash", &file.display().to_string()])?;
    refused(bench, &answer, BAD_FILE)
}

fn wrong_identity(bench: &mut Bench) -> Outcome<Done> {
    let answer = flash(bench, V2, &["--vid", "0x7FFFFFFF", "--pid", "1"])?;
    refused(bench, &answer, REFUSED)
}

/// Checks that a download was refused with this exit code, and that the device holds the old
/// program.
fn refused(bench: &Bench, answer: &Answer, code: i32) -> Outcome<Done> {
    match answer.code {
        Some(0) => return Err("it was accepted, and must not be.".into()),
        Some(found) if found == code => {}
        _ => return Err(format!("it ended for another reason: {}", answer.problem())),
    }
    holds_installed(bench, &bench.coflash.call(&["info"])?.good()?.value)?;
    passed(answer.value["error"]["what"].as_str().unwrap_or_default())
}

fn interrupted(bench: &mut Bench) -> Outcome<Done> {
    let ctrl_c = |process: u32| process::run(Command::new("kill").args(["-INT", &process.to_string()]));
    let answer = bench.coflash.flash_until_middle(&flash_words(bench, &image(bench, V2)), ctrl_c)?;
    if answer.code != Some(CANCELLED) {
        return Err(format!("Ctrl-C did not cancel the update: {}", answer.problem()));
    }
    let again = flash(bench, V2, &[])?.good()?;
    bench.installed = number(&again.value["crc"]);
    runs_installed(bench)?;
    passed("")
}

/// What runs on the device, as soon as it answers.
fn info_after_start(bench: &Bench) -> Outcome<Value> {
    let started = Instant::now();
    loop {
        let answer = bench.coflash.call(&["info"])?;
        if answer.code == Some(0) || answer.code == Some(NO_BUS) || started.elapsed() > START {
            return Ok(answer.good()?.value);
        }
        thread::sleep(Duration::from_millis(100));
    }
}

/// A number as its text.
fn number(value: &Value) -> Option<String> {
    value.as_number().map(ToString::to_string)
}
