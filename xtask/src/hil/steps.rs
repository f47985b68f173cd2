//! The steps, in their order: the set-up, the conformance checks with the update suite, the ways back, and
//! what only a board can show. The first one that fails ends the job.

use std::path::Path;
use std::thread::{self, sleep};
use std::time::{Duration, Instant};

use serde_json::Value;

use super::bench::{Bench, Done, Hand};
use super::coflash::{between, Answer, TracedFrame};
use crate::{files, outcome::Outcome, process, ram_image};

/// A step: its name in the report, and what carries it out. The error says why it failed and what to do.
pub type Step = (&'static str, fn(&mut Bench) -> Outcome<Done>);

/// All steps after the build.
pub const STEPS: [Step; 21] = [
    ("open the bus", open_bus),
    ("flash the bootloader by the probe", |bench| flash_bootloader(bench, "bootloader.elf")),
    ("power off and on, or reset: the boot-up", boot_up),
    ("the device answers, by its crystal, with what was flashed", device_answers),
    ("conformance: coflash more conform --reset", conform),
    ("option bytes: 2007h/6", option_bytes),
    ("the update suite: coflash more conform UPD --install", update_suite),
    // The main job, as `cargo xtask demo` shows it.
    ("install the program of the tests", |bench| install(bench, TEST)),
    ("way back by a reset", |bench| way_back(bench, "0")),
    ("way back by the watchdog", |bench| way_back(bench, "1")),
    ("way back by a jump", |bench| way_back(bench, "2")),
    ("update to version 2", |bench| install(bench, V2)),
    ("start version 2 by itself after a restart", starts_by_itself),
    ("LSS: store a node-ID", store_node_id),
    ("entry strap", strap),
    ("LSS: bit rates", bit_rates),
    ("find the bit rate by listening", auto_bit_rate),
    ("bus-off: CAN_H and CAN_L shorted", bus_off),
    ("the crystal stopped", crystal),
    ("a jump that leaves the clocks wrong", leftovers),
    ("a program that hangs, with watchdog.program_ms", hung_program),
];

const V1: &str = "app-v1.elf";
const V2: &str = "app-v2.elf";
/// The template with 2000h, the way back.
const TEST: &str = "app-test.elf";
/// The bootloader of the product with `watchdog.program_ms: Some(1000)`.
const WITH_WATCHDOG: &str = "bootloader-watchdog.elf";

/// The time for the device to answer after its power is on or it was reset.
const START: Duration = Duration::from_secs(15);
/// The exit code of coflash for a bus that cannot be opened (`coflash --help`).
const NO_BUS: i32 = 4;
/// The LSI has 17 to 47 kHz (DS8626, LSI oscillator characteristics): a second of its nominal 32 kHz, in
/// seconds.
const SECOND: (f64, f64) = (32.0 / 47.0, 32.0 / 17.0);
/// What host and adapter add to a time between two frames, at most, in seconds.
const LATE: f64 = 0.2;

fn passed(text: impl Into<String>) -> Outcome<Done> {
    Ok(Done::Passed(text.into()))
}

fn not_run(why: impl Into<String>) -> Outcome<Done> {
    Ok(Done::NotRun(why.into()))
}

fn open_bus(bench: &mut Bench) -> Outcome<Done> {
    // The device need not answer yet.
    let answer = bench.coflash.call(&["info"])?;
    if answer.code == Some(NO_BUS) {
        return Err(answer.problem());
    }
    passed("")
}

fn flash_bootloader(bench: &mut Bench, name: &str) -> Outcome<Done> {
    let file = if name == "bootloader.elf" { bench.bootloader.clone() } else { bench.image(name) };
    bench.probe("download", &file)?;
    passed("")
}

/// A command that ends well proves nothing: it may have been for another board, or for none. The boot-up does.
fn boot_up(bench: &mut Bench) -> Outcome<Done> {
    let bench = &*bench;
    let (frames, how) = thread::scope(|scope| {
        let listens = scope.spawn(|| bench.coflash.traced(&["monitor", "--for", "8000"], &bench.work));
        sleep(Duration::from_secs(1));
        let how = bench.restart();
        (listens.join().expect("it does not panic"), how)
    });
    let ((_, frames), how) = (frames?, how?);
    let up = format!("{:X}#00", 0x700 + bench.coflash.node);
    if frames.iter().any(|one| one.frame == up) {
        return passed(how);
    }
    let why = match frames.is_empty() {
        true => "The bus is silent: look at pins, transceiver, bit rate and termination, and at the crystal",
        false => "The device has not restarted: look at the command, and whether it reaches this board",
    };
    Err(format!("no boot-up ({up}) after this: {how}. {why}."))
}

/// That the device has the bootloader of the file: by 100Ah, and by the CRC of its RAM image where it reports one.
fn is_flashed(bench: &Bench, info: &Value) -> Outcome<String> {
    let not_flashed = |what: &str, held: &str| {
        let file = &bench.bootloader;
        format!(
            "{what} of the device is {held}, not that of {file}: the probe said that all is well, and has not \
             flashed it."
        )
    };
    let file = files::bytes(Path::new(&bench.bootloader))?;
    let version = info["software_version"].as_str().unwrap_or_default();
    if version.is_empty() || !file.windows(version.len()).any(|text| text == version.as_bytes()) {
        return Err(not_flashed("100Ah", &format!("\"{version}\"")));
    }
    let Some(number) = info["renewal"]["number"].as_u64() else {
        return Ok("no CRC, since it has no renewal".into());
    };
    let answer = bench.coflash.call(&["read", &format!("1F56/{number}")])?.good()?;
    let crc = answer.value["number"].as_u64();
    if crc != Some(ram_image::crc(&file)?.into()) {
        let held = crc.map_or("unknown".into(), |crc| format!("{crc:08X}h"));
        return Err(not_flashed("the CRC (1F56h)", &held));
    }
    Ok(format!("CRC {:08X}h", crc.unwrap_or_default()))
}

fn device_answers(bench: &mut Bench) -> Outcome<Done> {
    let info = bootloader(bench)
        .map_err(|error| format!("{error} Look at pins, transceiver, bit rate and termination."))?;
    let crc = is_flashed(bench, &info)?;
    if info["state"]["clock"] == 2 {
        return Err(
            "it runs from its internal oscillator: look at the crystal, and at `hse` of the board file."
                .into(),
        );
    }
    // The conformance checks reset the device, and have more to check in its bootloader.
    bench.coflash.call(&["erase"])?.good()?;
    let word = |key: &str| info[key].as_str().unwrap_or("?").to_owned();
    passed(format!("\"{}\", version \"{}\", {crc}", word("name"), word("software_version")))
}

fn option_bytes(bench: &mut Bench) -> Outcome<Done> {
    let answer = bench.coflash.call(&["read", "2007/6"])?;
    match answer.code {
        Some(0) => {
            // `coflash more conform`, the step before, judges them.
            let document = bench.conform.last().into_iter();
            let warnings = document.flat_map(|document| process::list(document, "warnings"));
            let warnings: Vec<_> = warnings.filter_map(Value::as_str).collect();
            passed(if warnings.is_empty() { "as a product has them".into() } else { warnings.join("; ") })
        }
        _ => not_run("this bootloader has no 2007h/6; read them by the probe"),
    }
}

fn conform(bench: &mut Bench) -> Outcome<Done> {
    run_conform(bench, &["more", "conform", "--reset"])
}

fn update_suite(bench: &mut Bench) -> Outcome<Done> {
    let image = bench.image(V1);
    let mut words =
        vec!["more", "conform", "UPD", "--install", "--image", &image, "--board", bench.board.board];
    let power = bench.power_line.clone();
    words.extend(power.iter().flat_map(|line| ["--power-command", line]));
    let done = run_conform(bench, &words)?;
    Ok(if power.is_some() {
        done
    } else {
        Done::Passed("without a power cut: there is no --power-command".into())
    })
}

fn run_conform(bench: &mut Bench, words: &[&str]) -> Outcome<Done> {
    // A board answers in milliseconds; the host may have other things to do.
    let answer = bench.coflash.call(&[words, &["--answer-timeout", "2000"]].concat())?;
    let Some(document) = process::json(&answer.stdout).ok().filter(|value| value["checks"].is_array()) else {
        return Err(answer.problem());
    };
    let failed: Vec<_> =
        process::list(&document, "checks").filter(|check| check["outcome"] == "failed").collect();
    let first = failed.first().map(|check| format!("{} {}: {}", check["id"], check["title"], check["why"]));
    let passed = format!("{} checks", document["passed"]);
    bench.conform.push(document);
    match first {
        Some(first) => Err(format!("checks failed, first {first}. docs/conform.md has their documents.")),
        None => Ok(Done::Passed(passed)),
    }
}

/// Flashes a program, and sees it run.
fn install(bench: &mut Bench, image: &str) -> Outcome<Done> {
    let file = bench.image(image);
    let words = ["flash", &file, "--board", bench.board.board, "--verify"];
    let answer = bench.coflash.call(&words)?.good()?;
    bench.installed = answer.value["crc"].as_number().map(ToString::to_string);
    runs_installed(bench)?;
    passed(format!("{image} in {} s", answer.value["seconds"]))
}

/// Checks that the application runs, and that it is the last one that was installed.
fn runs_installed(bench: &Bench) -> Outcome {
    let info = info_after_start(bench)?;
    if info["bootloader"] != Value::Bool(false) {
        return Err("the bootloader answers where the application should run.".into());
    }
    let held = info["programs"][0]["crc"].as_number().map(ToString::to_string);
    if held == bench.installed {
        return Ok(());
    }
    Err(format!("the program in the device has CRC {held:?}, and the installed one {:?}.", bench.installed))
}

/// Calls the application back by this way (its 2000h), and measures it. The answer is on the bus
/// 10 ms before the device leaves, and the bootloader comes within milliseconds by each way (docs/bench.md); the watchdog's time after a reset, 349 to 964 ms, would be a mistake.
fn way_back(bench: &mut Bench, way: &str) -> Outcome<Done> {
    bench.coflash.call(&["write", "2000", way, "--type", "u8"])?.good()?;
    let (answer, frames) = bench.coflash.traced(&["enter", "--within", "10000"], &bench.work)?;
    answer.good()?;
    let node = bench.coflash.node;
    let (confirmed, up) = (format!("{:X}#60511F01", 0x580 + node), format!("{:X}#00", 0x700 + node));
    let seconds = between(&frames, &confirmed, &up)
        .ok_or("the trace has no answer to 1F51h = 80h with a boot-up after it.")?;
    if !(0.008..=0.05 + LATE).contains(&seconds) {
        return Err(format!("{seconds:.3} s from the answer to the boot-up: it must be 0.010 to 0.05 s."));
    }
    bench.coflash.call(&["start"])?.good()?;
    passed(format!("{:.0} ms from the answer to the boot-up", seconds * 1000.0))
}

fn starts_by_itself(bench: &mut Bench) -> Outcome<Done> {
    let how = bench.restart()?;
    runs_installed(bench)?;
    passed(how)
}

/// Gives the device another node-ID, which it keeps over a restart, and its own one back.
fn store_node_id(bench: &mut Bench) -> Outcome<Done> {
    let own = bench.coflash.node;
    let other = if own == 127 { 126 } else { own + 1 };
    for node in [other, own] {
        bench.coflash.node = node;
        let stored = bench.coflash.call(&["lss", "assign", "--store", "--reset"])?.good().map(drop);
        let kept = stored.and_then(|()| bench.restart()).and_then(|_| info_after_start(bench));
        if let Err(error) = kept {
            bench.coflash.node = own;
            return Err(format!("node-ID {node}: {error} `coflash lss fastscan` finds the device."));
        }
    }
    passed(format!("{other}, and {own} again"))
}

fn strap(bench: &mut Bench) -> Outcome<Done> {
    if !bench.hand(Hand::Strap, true)? {
        return not_run("nobody holds the strap: --strap-command, or a terminal to ask at");
    }
    // The strap is let go whatever comes.
    let info = bench.restart().and_then(|_| info_after_start(bench));
    bench.hand(Hand::Strap, false)?;
    if info?["state"]["reason"] != 1 {
        return Err(
            "the strap did not keep it in the bootloader: look at `entry_strap` of the board file.".into()
        );
    }
    bench.restart()?;
    runs_installed(bench)?;
    passed("")
}

/// Changes the bit rate of device and adapter until the next restart.
fn bit_rates(bench: &mut Bench) -> Outcome<Done> {
    if !bench.coflash.can_change_rate() {
        return not_run("--bus has no {rate}: write it in the place of the bit rate, gs_usb:0@{rate}k");
    }
    let tried = [1000, 500, 250, 50, 20, 125].into_iter().try_for_each(|rate| {
        let changed = bench.coflash.call(&["lss", "bit-rate", &rate.to_string(), "--activate"])?.good();
        bench.coflash.rate = rate;
        changed
            .and_then(|_| info_after_start(bench))
            .map(drop)
            .map_err(|error| format!("{rate} kbit/s: {error}"))
    });
    bench.coflash.rate = 125;
    tried.and_then(|()| passed("1000, 500, 250, 50 and 20 kbit/s"))
}

fn auto_bit_rate(bench: &mut Bench) -> Outcome<Done> {
    if !bench.coflash.can_change_rate() {
        return not_run("--bus has no {rate}");
    }
    bench.coflash.rate = 250;
    let found = bench.restart().and_then(|_| info_after_start(bench));
    bench.coflash.rate = 125;
    bench.restart()?;
    info_after_start(bench)?;
    match found {
        Ok(_) => passed("250 kbit/s, and 125 again"),
        Err(_) => not_run("it has a bit rate of its own: only `bit_rate: 0` of the board file listens"),
    }
}

/// A short for three seconds: 200 ms, 400, 800 and 1600 after it went off the device tries again. So its
/// heartbeat (1 s) is back within some three seconds after the end of the short, and 8140h with it.
fn bus_off(bench: &mut Bench) -> Outcome<Done> {
    bootloader(bench)?;
    if !bench.hand(Hand::Short, true)? {
        return not_run("nobody shorts the bus: --short-command, or a terminal to ask at");
    }
    sleep(Duration::from_secs(3));
    bench.hand(Hand::Short, false)?;
    let (_, frames) = bench.coflash.traced(&["monitor", "--for", "6000"], &bench.work)?;
    let node = bench.coflash.node;
    let emergency = format!("{:03X}#4081", 0x80 + node);
    if !frames.iter().any(|one| one.frame.starts_with(&emergency)) {
        return Err("no emergency 8140h within 6 s after the short. On SocketCAN the adapter may be off the bus itself: \
                    `ip link set can0 type can restart-ms 100`."
            .into());
    }
    info_after_start(bench)?;
    passed("")
}

/// After a restart: nothing if the device is silent for five seconds, otherwise what it says of itself.
fn silent_or_info(bench: &mut Bench) -> Outcome<Value> {
    bench.restart()?;
    let (_, frames) = bench.coflash.traced(&["monitor", "--for", "5000"], &bench.work)?;
    if frames.is_empty() {
        return Ok(Value::Null);
    }
    info_after_start(bench)
}

/// A bootloader without its crystal only listens, or says that it runs from the internal oscillator.
fn crystal(bench: &mut Bench) -> Outcome<Done> {
    bootloader(bench)?;
    bench.coflash.call(&["erase"])?.good()?;
    if !bench.hand(Hand::Crystal, true)? {
        return not_run("nobody stops the crystal: --crystal-command, or a terminal to ask at");
    }
    // The crystal runs again whatever comes.
    let result = silent_or_info(bench);
    bench.hand(Hand::Crystal, false)?;
    let info = result?;
    bench.restart()?;
    info_after_start(bench)?;
    match info["state"]["clock"].as_u64() {
        None if info.is_null() => passed("it is silent"),
        Some(2) => passed("2007h/5 = 2: it runs from the internal oscillator"),
        _ => Err("it speaks and does not say that its crystal has failed (2007h/5).".into()),
    }
}

/// A program that switches its interrupts off and loops is reset by the watchdog each time, and given up
/// after three resets. Between two boot-ups are the rescue window of 300 ms and a second of the LSI.
fn hung_program(bench: &mut Bench) -> Outcome<Done> {
    if !std::path::Path::new(&bench.image(WITH_WATCHDOG)).exists() {
        return not_run(format!("there is no {WITH_WATCHDOG} beside --elf"));
    }
    bench.coflash.call(&["erase"])?.good()?;
    flash_bootloader(bench, WITH_WATCHDOG)?;
    bench.restart()?;
    info_after_start(bench)?;
    // `cpsid i` and a branch to itself (ARMv7-M A7.7.29 and A7.7.12).
    install_code(bench, &[0xB672, 0xE7FE])?;
    bench.coflash.call(&["more", "release"])?.good()?;
    bench.coflash.call(&["write", "1F51/1", "1", "--type", "u8"])?.good()?;
    let (_, frames) = bench.coflash.traced(&["monitor", "--for", "9000"], &bench.work)?;
    let node = bench.coflash.node;
    let ups: Vec<&TracedFrame> =
        frames.iter().filter(|one| one.frame == format!("{:X}#00", 0x700 + node)).collect();
    let given_up = format!("{:03X}#00600102", 0x80 + node);
    if ups.len() != 3 || !frames.iter().any(|one| one.frame.starts_with(&given_up)) {
        return Err(format!(
            "{} boot-ups in 9 s, and not three with an emergency 6000h/02h: the watchdog is late, or does not bite.",
            ups.len()
        ));
    }
    for pair in ups.windows(2) {
        let seconds = pair[1].seconds - pair[0].seconds - 0.3;
        if !(SECOND.0 - LATE..=SECOND.1 + LATE).contains(&seconds) {
            return Err(format!(
                "it was reset after {seconds:.2} s; 1000 ms are {:.2} to {:.2} s.",
                SECOND.0, SECOND.1
            ));
        }
    }
    let seconds = ups[1].seconds - ups[0].seconds - 0.3;
    bench.coflash.call(&["erase"])?.good()?;
    flash_bootloader(bench, "bootloader.elf")?;
    bench.restart()?;
    info_after_start(bench)?;
    passed(format!("reset after {seconds:.2} s, given up after three"))
}

/// Takes all clocks of the sleep mode away, spreads that of the PLL by 3 % (RM0090 sections 7.3.15 to 7.3.23),
/// and jumps; tests/device/leftovers.rs has it with the instructions beside it.
const LEFTOVERS: [u16; 22] = [
    0x4808, 0x2100, 0x6501, 0x6541, 0x6581, 0x6601, 0x6641, 0x4A06, 0xF8C0, 0x2080, 0xF04F, 0x6000, 0x6801,
    0xF381, 0x8808, 0x6841, 0x4708, 0xBF00, 0x3800, 0x4002, 0x60FA, 0xC010,
];

fn leftovers(bench: &mut Bench) -> Outcome<Done> {
    install_code(bench, &LEFTOVERS)?;
    bench.coflash.call(&["write", "1F51/1", "1", "--type", "u8"])?.good()?;
    (0..20).try_for_each(|_| bootloader(bench).map(drop))?;
    passed("it answers")
}

/// Puts a vector table and this code, the reset handler, into the place of the program.
fn install_code(bench: &Bench, code: &[u16]) -> Outcome {
    const CODE: usize = 0x200;
    let mut bytes = vec![0; CODE];
    bytes[..4].copy_from_slice(&bench.board.ram.end().to_le_bytes());
    bytes[4..8].copy_from_slice(&(bench.board.programs[0].base + CODE as u32 + 1).to_le_bytes());
    bytes.extend(code.iter().flat_map(|half| half.to_le_bytes()));
    let file = bench.work.join("code.bin");
    files::write(&file, bytes)?;
    let file = file.display().to_string();
    let words = ["flash", &file, "-I", "binary", "--board", bench.board.board, "--no-trial", "--no-start"];
    bench.coflash.call(&words)?.good().map(drop)
}

/// The bootloader's answer: a program is called back.
fn bootloader(bench: &Bench) -> Outcome<Value> {
    let info = info_after_start(bench)?;
    if info["bootloader"] == Value::Bool(true) {
        return Ok(info);
    }
    bench.coflash.call(&["enter", "--within", "10000"])?.good()?;
    info_after_start(bench)
}

/// What runs on the device, as soon as it answers.
fn info_after_start(bench: &Bench) -> Outcome<Value> {
    let started = Instant::now();
    loop {
        let answer: Answer = bench.coflash.call(&["info"])?;
        if answer.code == Some(0) || answer.code == Some(NO_BUS) || started.elapsed() > START {
            return Ok(answer.good()?.value);
        }
        sleep(Duration::from_millis(100));
    }
}

#[cfg(test)]
mod tests {
    use super::super::bench::HANDS;
    use super::super::{coflash::Coflash, command::CommandLine};
    use super::*;
    use crate::elf::tests::with_section;
    use crate::workspace;

    /// A coflash that answers with the files of the folder, and a probe that does nothing and ends well.
    fn bench(folder: &Path, answers: &[(&str, &str)]) -> Bench {
        for (word, answer) in answers {
            files::write(&folder.join(word), answer).unwrap();
        }
        // A header whose CRC is 12345678h, and the text of 100Ah.
        let header = [&[0; 4][..], &[0x78, 0x56, 0x34, 0x12], &[0; 56], b"coboot 9.9.9"].concat();
        let elf = folder.join("bootloader.elf");
        files::write(&elf, with_section(".ram_image", &header)).unwrap();
        Bench {
            board: shared_abi::layout::BOARDS[0],
            probe: CommandLine::new("--probe", "true {action} {elf}").ok().unwrap(),
            hands: [const { None }; HANDS.len()],
            power_line: None,
            coflash: Coflash {
                program: workspace::root().join("xtask/src/hil/answers.sh"),
                bus: folder.display().to_string(),
                node: 1,
                rate: 125,
            },
            bootloader: elf.display().to_string(),
            images: folder.into(),
            work: folder.join("work"),
            installed: None,
            conform: Vec::new(),
        }
    }

    /// How the three steps after the bus end: the bootloader is flashed, the device restarts, it answers.
    fn played(name: &str, trace: &str, info: &str) -> Outcome<String> {
        let folder = std::env::temp_dir().join(format!("hil-{name}-{}", std::process::id()));
        files::make(&folder).unwrap();
        let crc = r#"{"number": 305419896}"#;
        let answers = [("trace", trace), ("monitor", "{}"), ("info", info), ("erase", "{}"), ("read", crc)];
        let mut bench = bench(&folder, &answers);
        let mut last = String::new();
        let ended = STEPS[1..4].iter().try_for_each(|(_, run)| {
            if let Done::Passed(text) = run(&mut bench)? {
                last = text;
            }
            Ok(())
        });
        files::remove(&folder).unwrap();
        ended.map(|()| last)
    }

    /// 100Ah is in the file, the CRC of the RAM image is 305419896 = 12345678h.
    #[test]
    fn the_exit_code_of_a_probe_is_not_believed() {
        const UP: &str = "(1.0) can0 701#7F\n(2.0) can0 701#00\n";
        let info = |version: &str, number: &str| {
            format!(
                r#"{{"bootloader": true, "software_version": "{version}", "state": {{}}, "renewal": {number}}}"#
            )
        };
        let good = info("coboot 9.9.9", r#"{"number": 2}"#);
        let text = played("good", UP, &good).unwrap();
        assert!(text.contains("coboot 9.9.9") && text.ends_with("CRC 12345678h"), "{text}");
        let without = played("without", UP, &info("coboot 9.9.9", "null")).unwrap();
        assert!(without.ends_with("no renewal"), "{without}");
        // It flashed nothing, and reset nothing: the old bootloader goes on with its heartbeat.
        let error = played("goes-on", "(1.0) can0 701#7F\n", &good).unwrap_err();
        assert!(error.contains("701#00") && error.contains("has not restarted"), "{error}");
        let error = played("silent", "", &good).unwrap_err();
        assert!(error.contains("silent"), "{error}");
        // It flashed nothing, and has reset the board.
        let error = played("older", UP, &info("coboot 0.0.1", "null")).unwrap_err();
        assert!(error.contains("coboot 0.0.1") && error.contains("has not flashed"), "{error}");
        let error = played("nameless", UP, r#"{"bootloader": true, "state": {}}"#).unwrap_err();
        assert!(error.contains("has not flashed"), "{error}");
    }

    #[test]
    fn another_build_of_the_same_version_is_found_by_its_crc() {
        let folder = std::env::temp_dir().join(format!("hil-crc-{}", std::process::id()));
        files::make(&folder).unwrap();
        let bench = bench(&folder, &[("read", r#"{"number": 305419897}"#)]);
        let info = serde_json::json!({"software_version": "coboot 9.9.9", "renewal": {"number": 2}});
        let error = is_flashed(&bench, &info).unwrap_err();
        files::remove(&folder).unwrap();
        assert!(error.contains("12345679h") && error.contains("has not flashed"), "{error}");
    }
}
