//! Every command as a separate process, over a real socket, against fake devices.

use std::fs;
use std::io::Write;
use std::process::{Command, Stdio};
use std::time::Duration;

use crate::several::unconfigured;
use crate::tool::{coflash, command, data, device, folder, quick, run, served, snapshot, Done};
use canopen::{CobId, Frame};
use coboot_can::candump::Line;
use kit::fake::{serve, Blocks, Bus, Fake, Outcome, APPLICATION, BOOTLOADER};
use serde_json::Value;

/// Runs a command on a device; returns its output as text and as JSON, and the device.
fn on(fake: impl Fn() -> Fake, arguments: &[&str]) -> (Done, Value, Fake) {
    let (words, _) = served(fake(), &[arguments, &["-N", "5"]].concat());
    let (json, fake) = served(fake(), &[arguments, &["-N", "5", "--json"]].concat());
    assert_eq!(words.exit, json.exit, "{}{}", words.err, json.out);
    (words, json.json(), fake)
}

/// The commit as git says it, from the folder of the sources.
#[test]
fn the_version_has_the_commit() {
    let git = Command::new("git").args(["rev-parse", "HEAD"]).output().unwrap();
    let commit = String::from_utf8(git.stdout).unwrap();
    let version = concat!("coflash ", env!("CARGO_PKG_VERSION"));
    assert_eq!(coflash(&["--version"]).out, format!("{version} ({})\n", &commit[..12]));
}

#[test]
fn the_steps_of_an_update_one_by_one() {
    let (said, json, fake) = on(|| quick(APPLICATION), &["enter"]);
    assert_eq!((said.exit, said.out.as_str()), (0, "node 5: the bootloader is running\n"));
    assert_eq!((&json["command"], &json["node"]), (&"enter".into(), &5.into()));
    assert_eq!((fake.writes(), fake.running), (vec!["command 80"], Some(BOOTLOADER)));
    let (said, _, fake) = on(|| quick(BOOTLOADER), &["enter"]);
    assert_eq!((said.out.as_str(), fake.writes().len()), ("node 5: the bootloader is running already\n", 0));

    // The application is called back before its program is erased.
    let erases = || device(APPLICATION, |fake| fake.had = Some((0x0BAD_CAFE, 1)));
    let (said, json, fake) = on(erases, &["erase"]);
    assert!(said.out.starts_with("node 5: program 1 is erased, in "), "{}", said.out);
    assert!(json["seconds"].is_number());
    assert_eq!(fake.writes(), ["command 80", "command 03"]);

    let (said, _, fake) = on(|| quick(BOOTLOADER), &["more", "release"]);
    assert_eq!(said.out, "node 5: program 1 is released for autostart\n");
    assert_eq!(fake.writes(), ["command 83"]);
    let (said, _, fake) = on(|| quick(BOOTLOADER), &["more", "withdraw"]);
    assert!(said.out.contains("is no longer released for autostart"), "{}", said.out);
    assert_eq!(fake.writes(), ["command 84"]);

    let (said, json, fake) = on(|| quick(BOOTLOADER), &["start"]);
    assert_eq!(said.out, "node 5: an application (device type 00020192h) is running\n");
    assert_eq!((&json["running"], fake.running), (&APPLICATION.into(), Some(APPLICATION)));
    let (said, _, fake) = on(|| quick(APPLICATION), &["start"]);
    assert!(said.out.contains("is running already") && fake.writes().is_empty(), "{}", said.out);
}

#[test]
fn a_step_that_fails_has_the_words_and_numbers_of_the_manual() {
    for (command, outcome, words, exit, number, begin) in [
        (
            0x83,
            Outcome::Status(0x10),
            &["more", "release"][..],
            6,
            "0x60000110",
            "error: releasing the program for autostart failed: ",
        ),
        (0x84, Outcome::AbortStatus(0x0800_0022, 0x84), &["more", "withdraw"], 6, "0x60000184", ""),
        (0x01, Outcome::AbortStatus(0x0800_0022, 2), &["start"], 7, "0x60000014", ""),
    ] {
        let judge = move |came| if came == command { outcome } else { Outcome::Accept };
        let (said, json, _) = on(|| device(BOOTLOADER, |fake| fake.on_command = Box::new(judge)), words);
        assert_eq!((said.exit, &json["error"]["number"]), (exit, &number.into()), "{words:?}");
        assert!(said.err.starts_with(begin), "{}", said.err);
    }
}

/// The words of 2007h in the message of a start that failed: of a device without a program after
/// power-on, and of one whose program was ended by its watchdog.
#[test]
fn a_start_that_fails_is_told_with_the_device_s_reason() {
    for (state, words, advice) in [
        ([6, 1, 0], "(1F57h reads 02h); it has no program [", "flash a program"),
        // Its other program was called back.
        ([0, 1, 0], "(1F57h reads 02h)", "flash a program, and release it"),
        (
            [5, 4, 1],
            "(1F57h reads 02h); its program is not released for autostart; the program was ended by the independent \
             watchdog [",
            "does not feed its watchdog",
        ),
    ] {
        let stays = |fake: &mut Fake| (fake.starts, fake.state) = (Some(BOOTLOADER), Some(state));
        let (said, json, _) = on(|| device(BOOTLOADER, stays), &["start", "--boot-timeout", "300"]);
        assert_eq!((said.exit, &json["error"]["number"]), (7, &"0x60000014".into()));
        assert!(said.err.contains(words) && said.err.contains(advice), "{}", said.err);
    }
}

/// 2007h/6 and 7 in words, with what to do. 0FFFAAEDh is the factory's value (RM0090 section 3.9.10).
#[test]
fn info_says_what_is_wrong_with_option_bytes_and_supply() {
    let info = |options, supply| {
        let with = |fake: &mut Fake| (fake.state, fake.chip) = (Some([6, 1, 0]), Some((options, supply)));
        on(|| device(BOOTLOADER, with), &["info"])
    };
    let (said, json, _) = info(0x0FFF_AAED, 2);
    said.says(&[
        "  supply            too low to write its flash\n",
        "  option bytes      brown-out reset off, no sector protected, read-out protection level 0 (0FFFAAEDh)\n",
        "    warning         the brown-out reset is off",
        "    warning         the bootloader is not write-protected",
    ]);
    assert_eq!((&json["state"]["option_bytes"], &json["state"]["supply"]), (&0x0FFF_AAED.into(), &2.into()));
    let (said, ..) = info(0x0FFE_AAE1, 1);
    assert!(said.out.contains("  supply            good\n") && !said.out.contains("warning"), "{}", said.out);
    // A device without a chip, or that does not watch its supply, has neither.
    let (said, ..) = info(0, 0);
    assert!(!said.out.contains("supply") && !said.out.contains("option bytes"), "{}", said.out);
}

/// 1F57h is 84h with 1 in its upper half: the supply is too low (docs/protocol.md).
#[test]
fn a_supply_that_is_too_low_is_named_with_the_cure() {
    let low = || device(BOOTLOADER, |fake| fake.on_command = Box::new(|_| Outcome::Status(0x0001_0084)));
    let (said, json, _) = on(low, &["more", "release"]);
    assert_eq!((said.exit, &json["error"]["number"]), (6, &"0x60000184".into()));
    assert!(said.err.contains("the supply of the device is too low to write its flash"), "{}", said.err);
    assert!(said.err.contains("check the supply") && !said.err.contains("detail"), "{}", said.err);
}

#[test]
fn status_shows_and_clears() {
    let failed = || device(BOOTLOADER, |fake| fake.status(0x0000_000C));
    let (said, json, _) = on(failed, &["more", "status"]);
    snapshot("status", &said.out);
    assert_eq!((&json["status"]["error"], &json["bootloader"]), (&0x0C.into(), &true.into()));
    assert_eq!(json["status"]["word"], 0x0C);
    let (_, json, fake) = on(failed, &["more", "status", "--clear"]);
    assert_eq!((&json["status"]["error"], fake.writes()), (&Value::Null, vec!["command 02"]));
}

/// The device may be named before and after the subcommand of `debug`.
#[test]
fn debug_knows_its_device_wherever_it_is_named() {
    let words = ["more", "debug", "read", "0x20000000", "64", "--node", "5"];
    for place in [2, 5] {
        let mut words = words.to_vec();
        let option: Vec<&str> = words.drain(5..).collect();
        words.splice(place..place, option);
        served(quick(APPLICATION), &words).0.fails(6, &["node 5 refuses", "no debugger interface"]);
    }
}

#[test]
fn info_shows_the_device() {
    let (said, json, _) = on(|| quick(APPLICATION), &["info"]);
    snapshot("info", &said.out);
    assert_eq!((&json["product_code"], &json["serial_number"]), (&1234.into(), &Value::Null));
    assert_eq!(json["programs"][0]["control"], 1);
}

#[test]
fn read_shows_values_as_what_they_are() {
    let (said, json, _) = on(|| quick(APPLICATION), &["read", "1018/2"]);
    assert_eq!(said.out, "node 5, 1018h/2: 1234 (000004D2h)\n");
    assert_eq!((&json["number"], &json["hex"]), (&1234.into(), &"D2040000".into()));
    // Longer than four bytes, with and without blocks.
    for knows in [Blocks::Refused(0x0504_0001), Blocks::Known(127)] {
        let fake = || device(APPLICATION, |fake| fake.knows_blocks = knows);
        let (said, json, _) = on(fake, &["read", "1008"]);
        assert_eq!(said.out, "node 5, 1008h/0: \"a device with a long name\"\n");
        assert_eq!(json["text"], "a device with a long name");
    }
    let folder = folder("read");
    on(|| quick(APPLICATION), &["read", "100A", "-o", &folder.path("version")]).0.good();
    assert_eq!(fs::read(folder.path("version")).unwrap(), b"v1\x1B\0junk");
    let (said, json, _) = on(|| quick(APPLICATION), &["read", "2000/1"]);
    assert_eq!((said.exit, &json["error"]["number"]), (6, &"0x60000025".into()));
    assert!(said.err.contains("node 5 refuses reading 2000h/1: abort 06020000h"), "{}", said.err);
}

#[test]
fn a_program_is_read_back_where_the_device_allows_it() {
    let folder = folder("read-back");
    // Each value of a byte, and an end inside a segment of 7.
    let program: Vec<u8> = (0..=513_u32).map(|i| (i ^ i >> 8) as u8).collect();
    for knows in [Blocks::Refused(0x0504_0001), Blocks::Known(127)] {
        let fake = |fake: &mut Fake| (fake.readable, fake.knows_blocks) = (Some(program.clone()), knows);
        let words = ["read", "1F50/1", "-o", &folder.path("back.bin")];
        let (said, json, _) = on(|| device(BOOTLOADER, fake), &words);
        assert!(said.out.starts_with("node 5, 1F50h/1: 514 bytes to "), "{}{}", said.out, said.err);
        assert_eq!((&json["size"], &json["hex"]), (&514.into(), &Value::Null));
        assert!(fs::read(folder.path("back.bin")).unwrap() == program);
    }
    // CiA 301: 06010001h, attempt to read a write only object.
    let (said, json, _) = on(|| quick(BOOTLOADER), &["read", "1F50/1"]);
    assert_eq!((said.exit, &json["error"]["number"]), (6, &"0x60000025".into()));
    assert!(said.err.contains("abort 06010001h"), "{}", said.err);
    let none = folder.path("none.bin");
    let (said, ..) = on(|| quick(BOOTLOADER), &["read", "1F50/1", "-o", &none]);
    assert!(said.exit == 6 && !std::path::Path::new(&none).exists(), "{}", said.err);
}

/// A lift is known by its own objects, and does nothing without its password.
#[test]
fn a_lift_wants_its_password() {
    use kit::fake::lift::{Lift, PHRASE};
    let folder = folder("lift");
    let (file, back) = (data("plain-400.blk"), folder.path("back.bin"));
    let lift = || Lift::fake(APPLICATION, |_| {}).0;
    let (_, json, _) = on(lift, &["info"]);
    assert_eq!(json["dialect"], "lift");
    for (words, exit, why) in [
        (&["read", "1F50/1"][..], 6, "refuses reading 1F50h/1"),
        (&["flash", &file], 2, "--unlock"),
        (&["flash", &file, "--unlock", "wrong"], 6, "password"),
        // That one's password would erase the program that is to be read.
        (&["read", "1F50/1", "--dialect", "esacademy", "--unlock", "INIT"], 2, ""),
    ] {
        let (said, _, fake) = on(lift, words);
        said.fails(exit, &[why]);
        assert_eq!(fake.running, Some(APPLICATION), "{words:?}");
    }
    let (_, json, _) = on(lift, &["flash", &file, "--unlock", PHRASE]);
    assert_eq!((&json["dialect"], &json["running"]), (&"lift".into(), &APPLICATION.into()));
    on(lift, &["read", "1F50/1", "--unlock", PHRASE, "-o", &back]).0.good();
    assert_eq!(fs::read(back).unwrap(), b"what was stored");
}

#[test]
fn reset_waits_for_the_boot_up() {
    let (said, json, fake) = on(|| quick(APPLICATION), &["reset"]);
    assert_eq!(said.out, "back on the bus: node 5\n");
    assert_eq!((&json["booted"], fake.log.last().unwrap().as_str()), (&serde_json::json!([5]), "nmt 81"));
    let words = ["reset", "--all", "--communication", "--boot-timeout", "700"];
    let (done, fake) = served(quick(APPLICATION), &words);
    assert_eq!((done.exit, done.out.as_str()), (0, "back on the bus: node 5\n"));
    assert_eq!(fake.log, ["nmt 82"]);
    // A node that is not there.
    let (done, _) = served(quick(APPLICATION), &["reset", "-N", "6", "--boot-timeout", "50"]);
    done.fails(5, &["node 6 has sent no boot-up message"]);
    for (words, heard) in [(&["reset"][..], "booted"), (&["nmt", "reset"], "heard")] {
        let words = [words, &["-N", "6", "--boot-timeout", "50", "--json"]].concat();
        let json = served(quick(APPLICATION), &words).0.json();
        assert_eq!((&json[heard], &json["error"]["exit"]), (&serde_json::json!([]), &5.into()));
    }
}

#[test]
fn scan_finds_who_answers_and_who_is_heard() {
    let devices = || {
        let mut bootloader = quick(BOOTLOADER).at(9, 1);
        bootloader.status(0x02);
        let mut application = quick(APPLICATION);
        // Node 20 has no SDO server, or its SDO server uses other COB-IDs.
        application.inject(Frame::of(CobId::new(0x714).unwrap(), &[5]));
        application.inject(Frame::of(CobId::new(0x705).unwrap(), &[0x7F]));
        Bus(vec![application, bootloader])
    };
    let scan = |options: &[&str]| {
        let words = ["scan", "--listen", "50", "--sdo-timeout", "500"];
        let (done, bus) = served(devices(), &[&words[..], options].concat());
        (done.good(), bus)
    };
    snapshot("scan", &scan(&[]).0.out);
    let json = scan(&["--json"]).0.json();
    let nodes: Vec<&Value> = json["nodes"].as_array().unwrap().iter().map(|node| &node["node"]).collect();
    assert_eq!(nodes, [5, 9, 20]);
    assert_eq!(
        (&json["nodes"][1]["info"]["bootloader"], &json["nodes"][2]["answers"]),
        (&true.into(), &false.into())
    );
    let (done, bus) = scan(&["--listen-only"]);
    done.says(&["20    not asked"]);
    assert!(bus.0.iter().all(|fake| fake.sent.is_empty()));
    scan(&["-N", "9,11-12"]).0.says(&["\n9     bootloader", "\n20    not asked"]);
    assert_eq!(scan(&["-N", "9", "--json"]).0.json()["nodes"][2]["answers"], Value::Null);
    // An unfinished transfer of another tool is aborted first: within a block download, a request
    // can be taken for a segment.
    let folder = folder("scan");
    let trace = folder.path("scan.log");
    scan(&["-N", "9", "--trace", &trace]);
    assert_eq!(frames(&trace)[..2], ["609#8000100000000008", "609#4000100000000000"]);
    let (done, _) = served(Bus(vec![]), &["scan", "--listen", "10", "--sdo-timeout", "10"]);
    assert!(done.exit == 0 && done.out.starts_with("no node answers, and no node was heard"), "{}", done.out);
}

/// The frames of a trace.
fn frames(trace: &str) -> Vec<String> {
    let text = fs::read_to_string(trace).unwrap();
    text.lines().map(|line| Line::parse(line).unwrap().unwrap().frame.to_string()).collect()
}

#[test]
fn a_trace_is_shown_again_in_words() {
    let folder = folder("trace");
    let trace = folder.path("bus.log");
    served(quick(BOOTLOADER), &["read", "1018/2", "-N", "5", "--trace", &trace, "--segmented"]).0.good();
    assert_eq!(frames(&trace), ["605#4018100200000000", "585#43181002D2040000"]);
    let done = coflash(&["monitor", "--replay", &trace]);
    let words: Vec<&str> = done.out.lines().map(|line| line.get(35..).unwrap_or(line)).collect();
    assert_eq!(
        words,
        ["to node 5: read 1018h/2 (product code)", "node 5: 1018h/2 (product code) is 000004D2h"]
    );
}

/// A full disk does not stop an update, and is reported.
#[cfg(target_os = "linux")]
#[test]
fn a_trace_that_cannot_be_written_is_a_warning() {
    let read = |trace| served(quick(BOOTLOADER), &["read", "1018/2", "-N", "5", "--trace", trace]);
    let (done, _) = read("/dev/full");
    assert_eq!((done.exit, done.out.as_str()), (0, "node 5, 1018h/2: 1234 (000004D2h)\n"));
    assert!(done.err.starts_with("warning: /dev/full: writing failed: "), "{}", done.err);
    let (done, fake) = read("/there/is/none");
    done.fails(4, &["trace file /there/is/none cannot be opened"]);
    assert!(fake.sent.is_empty());
}

#[test]
fn monitor_shows_a_log() {
    let folder = folder("monitor");
    let log =
        folder.file("log", b"(100.000000) can0 000#8105\n\n(100.250000) can0 705#00\n(101.5) can0 706#7F\n");
    let done = coflash(&["monitor", "--replay", &log]);
    assert_eq!(
        done.out,
        "   0.000000  000#8105              NMT to node 5: reset node\n   \
         0.250000  705#00                node 5: boot-up\n   \
         1.500000  706#7F                node 6: heartbeat, pre-operational\n"
    );
    let done = coflash(&["monitor", "--replay", &log, "-N", "6", "--json"]);
    let lines: Vec<Value> = done.out.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(lines.len(), 2, "{}", done.out);
    assert_eq!((&lines[1]["time"], &lines[1]["frame"]), (&1.5.into(), &"706#7F".into()));
    assert_eq!(coflash(&["monitor", "--replay", &log, "--count", "1"]).out.lines().count(), 1);
    let bad = folder.file("bad", b"(1.0) can0 705#00\n(1.0) can0 705#0\n");
    coflash(&["monitor", "--replay", &bad]).fails(3, &["bad, line 2: its data are not pairs"]);
    // As other programs store it: a byte order mark, and CR at the end of lines.
    for end in ["\r\n", "\r"] {
        let text =
            format!("\u{FEFF}(1.0) can0 705#00{end}{end}(1.5) can0 706#7F T{end}(2.0) can0 707#05{end}");
        let done = coflash(&["monitor", "--replay", &folder.file("stored", text.as_bytes())]);
        assert!(done.exit == 0 && done.out.lines().count() == 3, "{end:?}: {}{}", done.out, done.err);
    }
    let binary = folder.file("binary", &[0xFF, 0xFE, 0]);
    coflash(&["monitor", "--replay", &binary]).fails(3, &["store it as UTF-8"]);
    assert_eq!(coflash(&["monitor", "--replay", &folder.path("none")]).exit, 3);
}

#[test]
fn monitor_shows_the_bus() {
    let mut fake = quick(APPLICATION);
    fake.inject(Frame::of(CobId::new(0x705).unwrap(), &[0x7F]));
    let (done, _) = served(fake, &["monitor", "--count", "1", "--for", "20000"]);
    assert!(done.exit == 0 && done.out.ends_with("node 5: heartbeat, pre-operational\n"), "{}", done.out);
    let (done, _) = served(quick(APPLICATION), &["monitor", "--for", "20"]);
    assert_eq!((done.exit, done.out.as_str()), (0, ""));
}

/// `coflash monitor | head`: it ends when standard output is closed.
#[test]
fn monitor_ends_with_its_reader() {
    let (bus, server) = serve(Heartbeats(Duration::ZERO));
    let mut child =
        crate::tool::command().args(["monitor", "--bus", &bus]).stdout(Stdio::piped()).spawn().unwrap();
    drop(child.stdout.take());
    assert_eq!(child.wait().unwrap().code(), Some(0));
    server.join().unwrap();
}

/// A bus with a heartbeat every ten milliseconds.
struct Heartbeats(Duration);

impl coboot_can::Adapter for Heartbeats {
    fn send(&mut self, _: &Frame) -> Result<(), coboot_can::AdapterError> {
        Ok(())
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, coboot_can::AdapterError> {
        let beat = Duration::from_millis(10);
        if timeout < beat {
            return Ok(None);
        }
        self.0 += beat;
        Ok(Some(Frame::of(CobId::new(0x705).unwrap(), &[5])))
    }

    fn now(&self) -> Duration {
        self.0
    }
}

#[test]
fn lss_says_what_it_does() {
    let lss =
        |options: &[&str]| served(unconfigured(), &[&["lss", "--lss-timeout", "30"][..], options].concat());
    let (done, device) = lss(&["inquire"]);
    assert_eq!(
        done.out,
        "vendor 0000003Fh, product 00000002h, revision 00010000h, serial 00000007h: no node-ID\n"
    );
    assert!(!device.configured, "it is left waiting");
    let address = ["--vendor", "0x3F", "--product", "2", "--revision", "0x10000", "--serial", "7"];
    let (done, device) = lss(&[&["assign", "-N", "9", "--store"][..], &address].concat());
    assert_eq!(
        (done.out.as_str(), device.orders),
        ("the device has node-ID 9 from now on\n", vec![[0x11, 9, 0], [0x17, 0, 0]])
    );
    let (done, device) = lss(&["bit-rate", "250", "--activate"]);
    assert_eq!(done.out, "the device is given 250 kbit/s and switches to it after 500 ms\n");
    assert_eq!(device.orders, [[0x13, 0, 3], [0x15, 0xF4, 1]]);
    let (done, device) = lss(&["--json", "bit-rate", "1000", "--store"]);
    let json = done.json();
    assert_eq!((&json["bit_rate"], &json["activated"]), (&1_000_000.into(), &false.into()));
    assert_eq!(device.orders, [[0x13, 0, 0], [0x17, 0, 0]]);
    let (done, device) = lss(&["store"]);
    assert_eq!((done.exit, device.orders), (0, vec![[0x17, 0, 0]]));
    // Of two devices the second one has no node-ID left: the first one is told all the same.
    let mut two = unconfigured();
    two.more = 1;
    let words = ["lss", "--lss-timeout", "50", "fastscan", "--assign", "127", "--json"];
    let (done, _) = served(two, &words);
    let json = done.json();
    assert_eq!((done.exit, &json["devices"][0]["node"]), (8, &127.into()));
    assert_eq!(json["devices"][1]["serial_number"], 7);
    assert!(json["error"]["what"].to_string().contains("no node-ID is left"), "{json}");
    // A device that does not exist.
    let (done, device) =
        lss(&["assign", "-N", "9", "--vendor", "1", "--product", "2", "--revision", "3", "--serial", "4"]);
    assert_eq!(device.orders.len(), 0);
    done.fails(5, &["no device answers (selecting the device by its LSS address) [0x60000013]"]);
    for (options, words) in [
        (&["assign", "-N", "9", "--vendor", "1"][..], "--product"),
        (&["assign"], "--node"),
        (&["bit-rate", "300"], "LSS knows 1000"),
    ] {
        coflash(&[&["lss"][..], options].concat()).fails(2, &[words]);
    }
}

/// Runs the shell with these lines on its standard input.
fn shell(arguments: &[&str], lines: &str) -> Done {
    let (input, mut typed) = std::io::pipe().unwrap();
    typed.write_all(lines.as_bytes()).unwrap();
    drop(typed);
    run(command().args(["more", "shell"]).args(arguments).stdin(input))
}

#[test]
fn the_shell_runs_one_command_after_the_other() {
    let file = data("release-110.blk");
    let (bus, server) = serve(quick(BOOTLOADER));
    let done = shell(
        &["--bus", &bus],
        &format!("# a comment\n\ninspect '{file}'\nread 1018/2 -N 5\nexit\nnot reached\n"),
    );
    assert_eq!((done.exit, done.err.as_str()), (0, ""));
    assert!(
        done.out.contains("V1.10r100") && done.out.ends_with("node 5, 1018h/2: 1234 (000004D2h)\n"),
        "{}",
        done.out
    );
    server.join().unwrap();
    // The first failure ends it, with that command's exit code.
    let done = shell(&[], &format!("inspect {file}x\ninspect {file}\n"));
    assert_eq!((done.exit, done.out.as_str()), (3, ""));
    for (line, words) in [
        ("nonsense", "unrecognized subcommand"),
        ("more shell", "already the shell"),
        ("release", "'coflash more release'"),
        ("info 'x", "not closed"),
    ] {
        shell(&[], line).fails(2, &[words]);
    }
    assert_eq!(shell(&["--json"], &format!("inspect {file}")).json()["bytes"], 803);
    shell(&[], "help flash").says(&["--check-target"]);
}

#[test]
fn completions_and_manual_pages_are_written() {
    for (shell, words) in [
        ("bash", "complete -F"),
        ("zsh", "#compdef coflash"),
        ("fish", "complete -c coflash"),
        ("powershell", "Register-ArgumentCompleter"),
    ] {
        coflash(&["more", "completions", shell]).says(&[words, "check-target"]);
    }
    coflash(&["more", "man"]).says(&[".TH coflash"]);
    let folder = folder("man");
    coflash(&["more", "man", "--out", &folder.path("pages")]).good();
    let page = fs::read_to_string(folder.path("pages/coflash-flash.1")).unwrap();
    assert!(page.contains("check\\-target"), "{page}");
    let mut rest = page.as_str();
    for (section, words) in [
        ("SYNOPSIS", "coflash"),
        ("EXAMPLES", "coflash flash app.elf \\-\\-board"),
        ("FILES", "coflash.toml"),
        ("ENVIRONMENT", "COFLASH_UNLOCK"),
        ("EXIT STATUS", "the device does not answer"),
    ] {
        let (_, behind) = rest
            .split_once(&format!(".SH \"{section}\""))
            .or_else(|| rest.split_once(&format!(".SH {section}")))
            .unwrap_or_else(|| panic!("{section}: {page}"));
        let own = behind.split(".SH ").next().unwrap_or_default();
        assert!(own.contains(words), "{section}: {own}");
        rest = behind;
    }
    // A tagged paragraph (man(7)) has its words, also for an option that the short help leaves out.
    for page in fs::read_dir(folder.path("pages")).unwrap().map(|page| page.unwrap().path()) {
        let text = fs::read_to_string(&page).unwrap();
        let lines: Vec<&str> = text.lines().collect();
        let is_empty = |at: &usize| {
            lines[*at] == ".TP"
                && lines.get(at + 2).is_none_or(|line| line.is_empty() || line.starts_with('.'))
        };
        let empty: Vec<&str> = (0..lines.len()).filter(is_empty).map(|at| lines[at + 1]).collect();
        assert_eq!(empty, Vec::<&str>::new(), "{}", page.display());
    }
    for command in ["", "-read", "-write", "-nmt", "-lss-assign", "-seal", "-seal-keys-new", "-more-release"]
    {
        assert!(fs::metadata(folder.path(&format!("pages/coflash{command}.1"))).is_ok(), "{command}");
    }
}

#[test]
fn the_configuration_gives_defaults_and_the_command_line_wins() {
    let folder = folder("config");
    let (bus, server) = serve(quick(BOOTLOADER));
    let config = format!("bus = '{bus}'\nnode = 5\nsdo-timeout = 400\n");
    let named = folder.file("named.toml", config.as_bytes());
    let done = coflash(&["info", "--config", &named]);
    assert!(done.exit == 0 && done.out.starts_with("node 5: "), "{}{}", done.out, done.err);
    server.join().unwrap();
    // The file in the current folder is used; the node of the command line takes precedence.
    let (bus, server) = serve(quick(BOOTLOADER));
    folder.file("coflash.toml", format!("bus = '{bus}'\nnode = 6\n").as_bytes());
    let done = run(command().current_dir(&folder).args(["info", "--node", "5"]));
    assert!(done.exit == 0 && done.out.starts_with("node 5: "), "{}{}", done.out, done.err);
    server.join().unwrap();
    // In the shell, too; but not with --all, and it is not assigned as a node-ID.
    let (bus, server) = serve(quick(BOOTLOADER));
    let config = folder.file("node.toml", b"node = 5\n");
    let done = shell(&["--bus", &bus, "--config", &config], "read 1018/2\n");
    assert!(done.out.starts_with("node 5, 1018h/2: 1234"), "{}{}", done.out, done.err);
    server.join().unwrap();
    let words = ["reset", "--all", "--config", &config, "--boot-timeout", "300"];
    let (done, fake) = served(quick(BOOTLOADER), &words);
    done.good();
    assert_eq!(fake.sent[0].to_string(), "000#8100");
    coflash(&["lss", "assign", "--bus", "socketcand://127.0.0.1:1/x", "--config", &config])
        .fails(2, &["--node"]);
    for (text, exit, words) in [
        ("bus = 'x\n", 3, "line 1: "),
        ("\n\n=\n", 3, "line 3: "),
        ("speed = 5\n", 2, "there is no setting 'speed'"),
        ("node = [1]\n", 2, "'node' must be a number or a text"),
        ("node = 200\n", 2, "node-IDs are 1 to 127"),
    ] {
        let file = folder.file("bad.toml", text.as_bytes());
        coflash(&["info", "--config", &file, "--bus", "socketcand://127.0.0.1:1/x"]).fails(exit, &[words]);
    }
    assert_eq!(coflash(&["info", "--config", &folder.path("none.toml")]).exit, 3);
}

/// The help text.
#[test]
fn help_is_complete() {
    let mut text = String::new();
    for command in
        [&["-h"][..], &["--help"], &["flash", "-h"], &["flash", "--help"], &["lss", "assign", "--help"]]
    {
        let done = run(crate::tool::command().args(command).env_remove("SOURCE_DATE_EPOCH")).good();
        text.push_str(&done.out);
        text.push_str("\n----\n");
    }
    snapshot("help", &text);
}
