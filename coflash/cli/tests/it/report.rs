//! `coflash more report bundle`, and what `report.json` says about a failed update.

use std::collections::HashSet;
use std::fs;
use std::io::{BufRead as _, BufReader, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::Duration;

use crate::tool::{bootloader, command, data, folder, run, within, Done};
use canopen::{CobId, Frame};
use coflash_core::machine::zip;
use kit::fake::{serve, Fake, Outcome, BOOTLOADER};
use kit::folder::Folder;
use kit::hawkbit::{Action, File, Server};
use kit::http::Page;
use serde_json::{json, Value};

/// A run in the folder, recorded in `reports`.
fn recorded(folder: &Folder, words: &[&str], variables: &[(&str, &str)]) -> Done {
    let variables = variables.iter().copied();
    run(command().current_dir(folder.path("")).envs(variables).args(words).args(["--report-dir", "reports"]))
}

/// A run in the folder that is not recorded.
fn run_in(folder: &Folder, words: &[&str]) -> Done {
    run(command().current_dir(folder.path("")).args(words))
}

/// The members of an archive.
fn members(path: &str) -> Vec<(String, Vec<u8>)> {
    let bytes = fs::read(path).unwrap();
    let members = zip::read(&bytes).unwrap();
    members.iter().map(|member| (member.name.to_owned(), member.bytes.to_vec())).collect()
}

fn text(members: &[(String, Vec<u8>)], end: &str) -> String {
    let (_, bytes) = members.iter().find(|(name, _)| name.ends_with(end)).unwrap();
    String::from_utf8(bytes.clone()).unwrap()
}

fn json(members: &[(String, Vec<u8>)], end: &str) -> Value {
    serde_json::from_str(&text(members, end)).unwrap()
}

fn runs(folder: &Folder) -> Vec<PathBuf> {
    let mut all: Vec<PathBuf> =
        fs::read_dir(folder.path("reports")).unwrap().map(|entry| entry.unwrap().path()).collect();
    all.sort();
    all
}

/// Finds seven bytes of a firmware, the data of one SDO segment, as bytes and as hexadecimal digits.
struct Firmware(HashSet<Vec<u8>>);

impl Firmware {
    fn new(firmware: &[u8]) -> Self {
        // Its texts may be words of a message, too.
        let is_text = |part: &[u8]| part.iter().all(|byte| matches!(byte, b' '..=b'~'));
        let is_distinct = |part: &&[u8]| part.iter().collect::<HashSet<_>>().len() > 3 && !is_text(part);
        let parts = firmware.windows(7).filter(is_distinct);
        let digits = |part: &[u8]| part.iter().flat_map(|byte| format!("{byte:02X}").into_bytes()).collect();
        Self(parts.flat_map(|part| [part.to_vec(), digits(part)]).collect())
    }

    fn is_in(&self, bytes: &[u8]) -> bool {
        [7, 14].into_iter().any(|size| bytes.windows(size).any(|part| self.0.contains(part)))
    }
}

/// A secret is planted in each place that one could come from: the command line, the environment, the
/// configuration, a URL, a frame, and key files, beside the recorded files and in their place.
#[test]
fn a_bundle_has_no_secret_and_no_firmware() {
    const PLANT: &str = "PLANTED";
    let folder = folder("bundle");
    let image = data("plain-400.blk");
    let flash = ["flash", &image, "-N", "5", "--dialect", "block"];
    let (url, _device) = serve(bootloader());
    recorded(&folder, &[&flash[..], &["--bus", &url, "--unlock", "PLANTED-line"]].concat(), &[]).good();
    let (url, _device) = serve(bootloader());
    recorded(&folder, &flash, &[("COFLASH_UNLOCK", "PLANTED-env"), ("COFLASH_BUS", &url)]).good();
    folder.write("coflash.toml", b"unlock = \"PLANTED-config\"\n");
    let (url, _device) = serve(bootloader());
    recorded(&folder, &[&flash[..], &["--bus", &url, "--segmented"]].concat(), &[]).good();
    // Its frames: a password in segments.
    let (url, _device) = serve(bootloader());
    let write = ["write", "6005/1", "PLANTED-frame", "--type", "string", "-N", "5", "--bus", &url];
    recorded(&folder, &write, &[]);
    let bad = "socketcand://me:PLANTED-user@127.0.0.1:1/can0?token=PLANTED-query";
    assert_ne!(recorded(&folder, &[&flash[..], &["--bus", bad]].concat(), &[]).exit, 0);
    let key = b"-----BEGIN PRIVATE KEY-----\nPLANTED-key\n-----END PRIVATE KEY-----\n";
    folder.write("release.pem", key);
    let last = runs(&folder).pop().unwrap();
    fs::write(last.join("release.pem"), key).unwrap();
    let false_run = Path::new(&folder.path("reports")).join("20000101T000000-flash");
    fs::create_dir(&false_run).unwrap();
    fs::write(false_run.join("report.json"), "{\"bus\": \"http://host/a/PLANTED/?PLANTED\"}").unwrap();
    for name in ["events.jsonl", "log.txt", "trace.log"] {
        fs::write(false_run.join(name), key).unwrap();
    }
    // The firmware is in what was recorded, so that its absence means something.
    let firmware = Firmware::new(&fs::read(&image).unwrap());
    let first = runs(&folder).into_iter().nth(1).unwrap();
    for name in ["trace.log", "log.txt"] {
        assert!(firmware.is_in(&fs::read(first.join(name)).unwrap()), "{name}");
    }
    let words = ["more", "report", "bundle", "-o", "fault.zip", "-N", "5"];
    let (url, _device) = serve(bootloader());
    let query = format!("{url}?PLANTED-now");
    for bus in [&query, &url] {
        recorded(&folder, &words, &[("COFLASH_BUS", bus), ("COFLASH_UNLOCK", "PLANTED-env")]).good();
        let members = members(&folder.path("fault.zip"));
        for (name, bytes) in &members {
            let text = String::from_utf8(bytes.clone()).unwrap();
            assert!(!text.contains(PLANT), "{name}: {text}");
            // The same in a frame.
            assert!(!text.contains("504C414E544544"), "{name}: {text}");
            assert!(!firmware.is_in(bytes), "{name}");
        }
    }
    // Everything else is there.
    let members = members(&folder.path("fault.zip"));
    let readme = text(&members, "README.txt");
    assert_eq!(members[0].0, "README.txt");
    for (name, _) in &members[1..] {
        assert!(readme.contains(&format!("\n{name}: ")), "{name} is not in {readme}");
    }
    let first = first.file_name().unwrap().to_string_lossy().into_owned();
    assert_eq!(json(&members, &format!("{first}-report.json"))["result"]["size"], 4001);
    assert!(text(&members, &format!("{first}-events.jsonl")).contains("\"event\":\"done\""));
    assert!(text(&members, &format!("{first}-log.txt")).contains("  said     "));
    assert!(text(&members, &format!("{first}-trace.log")).contains(" 605#C6501F01"));
    assert_eq!(text(&members, "20000101T000000-flash-log.txt"), "");
}

/// Wherever the value stands among the words, with a sheet that names the object, and in the refusal of a value.
#[test]
fn a_password_that_write_sends_is_in_no_record() {
    let folder = folder("written-password");
    for words in [
        &["6005/1", "PLANTED-value"][..],
        &["6005/1", "--type", "string", "PLANTED-value"],
        &["--type", "string", "0x6005/1", "PLANTED-value"],
        &["Access code/Code", "PLANTED-value", "--eds", "none.eds"],
        &["7F50/1", "--type", "u32", "PLANTED-value"],
    ] {
        let bus = ["--bus", "socketcand://127.0.0.1:1/can0", "-N", "5"];
        let done = recorded(&folder, &[&["write"], &bus[..], words].concat(), &[]);
        assert_ne!(done.exit, 0);
        let run = runs(&folder).pop().unwrap();
        let texts = fs::read_dir(&run).unwrap().map(|file| fs::read_to_string(file.unwrap().path()).unwrap());
        let texts: Vec<_> = texts.collect();
        assert!(texts.iter().any(|text| text.contains("***")), "{words:?}: {texts:?}");
        assert!(!texts.iter().any(|text| text.contains("PLANTED")), "{words:?}: {texts:?}");
        fs::remove_dir_all(run).unwrap();
    }
}

/// What the parser does not understand may be a key after a misspelled option, or the value of the
/// right one. Its words are on the terminal alone.
#[test]
fn an_error_of_a_line_of_the_shell_has_no_secret_in_the_records() {
    let folder = folder("shell-secrets");
    for line in [
        "flash a.blk --unlok PLANTED-value",
        "convert a.hex b.cbs --key PLANTED-value",
        "PLANTED-value",
        "writes 6005/1 PLANTED-value",
        "write PLANTED-value 6005/1 --type string",
        "more conform --answer-timeout PLANTED-value",
    ] {
        folder.write("line", format!("{line}\n").as_bytes());
        let input = fs::File::open(folder.path("line")).unwrap();
        let words = "more shell --report-dir reports --log-file all.log --bus socketcand://127.0.0.1:1/can0";
        let done = run(command().current_dir(folder.path("")).args(words.split(' ')).stdin(input));
        assert!(done.exit == 2 && !done.err.is_empty(), "{line}: {}", done.err);
        let run = runs(&folder).pop().unwrap();
        let files = fs::read_dir(&run).unwrap().map(|file| file.unwrap().path());
        let files = files.chain([folder.path("all.log").into()]);
        let texts: Vec<_> = files.map(|path| fs::read_to_string(path).unwrap()).collect();
        assert!(!texts.iter().any(|text| text.contains("PLANTED")), "{line}: {texts:#?}");
        assert!(texts.iter().filter(|text| text.contains("  error    ")).count() == 2, "{line}: {texts:#?}");
        fs::remove_dir_all(run).unwrap();
    }
}

/// A shell that waits for a line, and a service station in the middle of an update, when their
/// service is stopped.
#[cfg(unix)]
#[test]
fn what_is_stopped_leaves_its_reports() {
    let folder = folder("stopped");
    let start = |words: &[&str]| {
        let mut command = command();
        command.current_dir(folder.path("")).args(words).args(["--report-dir", "reports"]);
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap()
    };
    let stop = |mut child: Child| {
        // Its input stays open meanwhile.
        let _input = child.stdin.take();
        assert!(Command::new("kill").args(["-TERM", &child.id().to_string()]).status().unwrap().success());
        child.wait().unwrap().code()
    };
    let mut shell = start(&["more", "shell", "--bus", "socketcand://127.0.0.1:1/can0"]);
    shell.stdin.as_mut().unwrap().write_all(b"adapters --search none\n").unwrap();
    let mut line = String::new();
    BufReader::new(shell.stdout.as_mut().unwrap()).read_line(&mut line).unwrap();
    assert_eq!(stop(shell), Some(130), "{line}");
    let report = fs::read_to_string(runs(&folder)[0].join("report.json")).unwrap();
    assert!(serde_json::from_str::<Value>(&report).unwrap()["ended"].is_string(), "{report}");
    fs::remove_dir_all(&runs(&folder)[0]).unwrap();

    let mut device = bootloader();
    device.erase_time = Duration::from_secs(3600);
    let (url, _device) = serve(device);
    fs::copy(data("plain-400.blk"), folder.path("a.blk")).unwrap();
    folder.write("job.toml", b"[[program]]\nimage = 'a.blk'\nnodes = [5]\n");
    let mut station = start(&["ui", "--service", "job.toml", "--no-open", "--bus", &url, "--json"]);
    let mut line = String::new();
    BufReader::new(station.stdout.as_mut().unwrap()).read_line(&mut line).unwrap();
    let page: Value = serde_json::from_str(&line).unwrap();
    let page = Page::at(page["url"].as_str().unwrap());
    let until = |what: &str, is_so: &dyn Fn() -> bool| {
        let is_so_now = |_: &usize| {
            thread::sleep(Duration::from_millis(10));
            is_so()
        };
        assert!((0..2000).find(is_so_now).is_some(), "{what} never comes");
    };
    until("the search", &|| page.post("search", &json!({})).status == 200);
    let order = json!({ "plan": 1, "nodes": [5], "operator": "", "order": "", "device_number": "", "language": "en" });
    until("the update", &|| page.post("update", &order).status == 200);
    let of_device =
        |ending: &str| runs(&folder).into_iter().find(|path| path.to_string_lossy().ends_with(ending));
    until("its beginning", &|| of_device("_begun.csv").is_some());
    assert_eq!(stop(station), Some(0));
    assert!(of_device("_begun.csv").is_none());
    let report = fs::read_to_string(of_device(".csv").unwrap()).unwrap();
    assert!(report.contains(",failed,5,"), "{report}");
}

/// `monitor` begins while another tool sends a password in segments: what names its object has passed before.
#[test]
fn a_record_that_begins_within_a_password_does_not_have_it() {
    let folder = folder("within-password");
    let mut fake = bootloader();
    let frames: [(u16, [u8; 8]); 5] = [
        (0x605, *b"\x00PLANTED"),
        (0x585, [0x20, 0, 0, 0, 0, 0, 0, 0]),
        (0x605, *b"\x15PLAN\0\0\0"),
        (0x605, [0x23, 0x0A, 0x10, 1, b's', b'h', b'o', b'w']),
        (0x605, [0x40, 0x57, 0x1F, 1, 0, 0, 0, 0]),
    ];
    for (id, data) in frames {
        fake.inject(Frame::of(CobId::new(id).unwrap(), &data));
    }
    let (url, _device) = serve(fake);
    let words = ["monitor", "--bus", &url, "--count", "5", "--for", "20000", "--log-file", "all.log"];
    recorded(&folder, &words, &[]).good();
    let run = runs(&folder).pop().unwrap();
    run_in(&folder, &["more", "report", "bundle", "reports", "-o", "fault.zip"]).good();
    let members = members(&folder.path("fault.zip"));
    let read = |path: PathBuf| fs::read_to_string(path).unwrap();
    let trace = read(run.join("trace.log"));
    let lines = ["605#0000000000000000", "605#1500000000000000", "605#230A100173686F77"];
    for text in [&trace, &text(&members, "-trace.log")] {
        assert!(lines.iter().all(|line| text.contains(line)), "{text}");
    }
    for text in [trace, read(run.join("log.txt")), read(folder.path("all.log").into())] {
        assert!(!text.is_empty() && !text.contains("PLAN"), "{text}");
        assert!(!text.contains("504C414E") && !text.contains("50 4C 41 4E"), "{text}");
    }
}

/// What the device says now, and the versions; a run of `read` keeps its frames alone, without what was
/// read from 1F50h.
#[test]
fn a_bundle_has_what_the_device_says_and_no_values_of_read() {
    let folder = folder("bundle-device");
    let mut device = bootloader();
    device.readable = Some(b"FIRMWARE of the device".to_vec());
    let (url, _device) = serve(device);
    recorded(&folder, &["read", "1F50/1", "-N", "5", "--bus", &url], &[]).says(&["FIRMWARE"]);
    let of_run = runs(&folder).pop().unwrap().display().to_string();
    let (url, _device) = serve(bootloader());
    let words = ["more", "report", "bundle", &of_run, "-N", "5", "--bus", &url, "--json"];
    let said = run_in(&folder, &words).json();
    assert_eq!((&said["runs"], &said["answer"]), (&1.into(), &"the device has answered".into()));
    let members = members(&folder.path("coflash-report.zip"));
    assert_eq!(json(&members, "device.json")["device_type"], BOOTLOADER);
    assert_eq!(json(&members, "adapters.json")["in_use"], url.as_str());
    let version = run(command().arg("--version")).out;
    assert_eq!(
        format!("coflash {}\n", json(&members, "versions.json")["coflash"].as_str().unwrap()),
        version
    );
    assert!(json(&members, "-report.json")["result"].is_null());
    assert!(text(&members, "-trace.log").contains(" 585#"), "{}", text(&members, "-trace.log"));
    let contents_stay = |members: &[(String, Vec<u8>)]| {
        for (name, bytes) in members {
            let text = String::from_utf8(bytes.clone()).unwrap();
            assert!(!text.contains("FIRMWARE") && !text.contains("4649524D"), "{name}: {text}");
        }
    };
    contents_stay(&members);
    // The other commands that show what is in a device.
    for command in ["more debug read", "more shell"] {
        let report = Path::new(&of_run).join("report.json");
        let mut document: Value = serde_json::from_slice(&fs::read(&report).unwrap()).unwrap();
        document["command"] = command.into();
        document["result"] = "FIRMWARE".into();
        fs::write(&report, document.to_string()).unwrap();
        fs::remove_file(folder.path("coflash-report.zip")).unwrap();
        run_in(&folder, &["more", "report", "bundle", &of_run]).good();
        contents_stay(&self::members(&folder.path("coflash-report.zip")));
    }
}

#[test]
fn a_silent_device_or_no_bus_is_in_the_bundle_and_no_failure() {
    let folder = folder("bundle-silent");
    let (url, _device) = serve(bootloader());
    let quick = ["--sdo-timeout", "50", "--boot-timeout", "50"];
    let silent = [&["more", "report", "bundle", "-N", "9", "--bus", &url][..], &quick].concat();
    for (words, why) in [
        (silent, "node 9 does not answer"),
        (vec!["more", "report", "bundle"], "no CAN bus is given"),
        (vec!["more", "report", "bundle", "--bus", "nonsense:1"], "nonsense"),
    ] {
        run_in(&folder, &words).says(&[why]);
        let members = members(&folder.path("coflash-report.zip"));
        assert!(json(&members, "device.json")["error"]["what"].as_str().unwrap().contains(why));
        assert!(text(&members, "README.txt").contains(why));
    }
    run_in(&folder, &["more", "report", "bundle", "none"]).fails(3, &["none: cannot be read"]);
    fs::create_dir(folder.path("empty")).unwrap();
    run_in(&folder, &["more", "report", "bundle", "empty"]).fails(2, &["has no recorded run"]);
}

/// A device to which block 1 never comes whole.
fn refuses_block_1() -> Fake {
    let mut device = bootloader();
    device.on_block = Box::new(|block| if block == 1 { Outcome::Status(0x06) } else { Outcome::Accept });
    device
}

/// A block with a wrong CRC is sent again, and again: the report has each attempt, what the device
/// answered, and the frames with that answer, without the program.
#[test]
fn a_report_of_a_failed_update_has_attempts_frames_and_answers() {
    let folder = folder("failed-update");
    let (url, _device) = serve(refuses_block_1());
    let image = data("plain-400.blk");
    let done = recorded(&folder, &["flash", &image, "-N", "5", "--bus", &url, "--block-repeats", "2"], &[]);
    assert_eq!(done.exit, 6, "{}", done.err);
    let path = runs(&folder).pop().unwrap().join("report.json");
    let bytes = fs::read(&path).unwrap();
    let report: Value = serde_json::from_slice(&bytes).unwrap();
    let [update] = report["failed_updates"].as_array().unwrap().as_slice() else { panic!("{report:#}") };
    assert_eq!(update["node"], 5);
    let tried = update["tried"].to_string();
    for attempt in ["sending block 1 again, 1 of 2: the CRC", "sending block 1 again, 2 of 2: the CRC"] {
        assert!(tried.contains(attempt), "{tried}");
    }
    // CiA 302-3: the answer to the read of 1F57h/1 with the error 3 in bits 1 to 7.
    let frames = update["frames"].as_array().unwrap();
    let decided = |frame: &Value| frame.as_str().unwrap().contains("  585#43571F0106000000  ");
    assert!(frames.iter().any(decided) && frames.len() <= 32, "{update:#}");
    assert_eq!(update["answers"], report["error"]["answers"]);
    let answers = report["error"]["answers"].as_array().unwrap();
    assert!(answers[0].as_str().unwrap().starts_with("1F57h reads 06h"), "{answers:?}");
    assert!(!Firmware::new(&fs::read(&image).unwrap()).is_in(&bytes));
    // A refusal by abort.
    let mut device = bootloader();
    device.on_command = Box::new(|_| Outcome::Abort(0x0800_0022));
    let (url, _device) = serve(device);
    let said = recorded(&folder, &["erase", "-N", "5", "--bus", &url, "--json"], &[]).json();
    let answer = said["error"]["answers"][0].as_str().unwrap();
    assert!(answer.starts_with("SDO abort ") && answer.contains("08000022h"), "{said}");
    // A program that does not start: 2007h/2 says that the program is not released (docs/protocol.md).
    let mut device = bootloader();
    device.starts = Some(BOOTLOADER);
    device.state = Some([5, 0, 0]);
    let (url, _device) = serve(device);
    let said = recorded(&folder, &["start", "-N", "5", "--bus", &url, "--json"], &[]).json();
    let answers = said["error"]["answers"].to_string();
    for words in ["1F57h reads ", "2007h: it stays in the bootloader: its program is not released"] {
        assert!(answers.contains(words), "{said}");
    }
}

/// The report of the beginning stays when there is no room for that of the end.
#[cfg(unix)]
#[test]
fn a_folder_that_fills_up_keeps_the_report_that_it_has() {
    let folder = folder("full");
    let (url, _device) = serve(refuses_block_1());
    // POSIX: the limit of a file's size, in units of 512 bytes.
    let mut limited = within("sh", &["-c", r#"trap '' XFSZ; ulimit -f 2; exec "$@""#, "sh"]);
    let image = data("plain-400.blk");
    let words = ["flash", &image, "-N", "5", "--bus", &url, "--report-dir", "reports"];
    let done = run(limited.current_dir(folder.path("")).args(words));
    let path = runs(&folder).pop().unwrap().join("report.json");
    let report: Value = serde_json::from_slice(&fs::read(path).unwrap()).unwrap();
    assert!(report["ended"].is_null() && done.err.contains("report.json: cannot be written"), "{}", done.err);
}

/// The agent's failed update is in its report as that of `flash` is, and the server gets the device's answer. The
/// report is there while the agent goes on.
#[test]
fn a_failed_update_of_the_agent_is_in_its_report_too() {
    let folder = folder("failed-agent");
    let (url, _device) = serve(refuses_block_1());
    let server = Server::start(&["door"]);
    let image = fs::read(data("plain-400.blk")).unwrap();
    server.assign("door", Action::new(1, &File::new("app.blk", &image)));
    server.state().targets.get_mut("door").unwrap().wants_attributes = false;
    folder.write("agent.toml", b"[[device]]\ncontroller-id = 'door'\nnode = 5\ntoken-env = 'TOKEN'\n");
    let words = ["agent", "--once", "--bus", &url, "--hawkbit", &server.url];
    let done = recorded(&folder, &words, &[("TOKEN", "t-door")]);
    assert_eq!(done.exit, 8, "{}{}", done.out, done.err);
    let bytes = fs::read(runs(&folder).pop().unwrap().join("report.json")).unwrap();
    let report: Value = serde_json::from_slice(&bytes).unwrap();
    let [update] = report["failed_updates"].as_array().unwrap().as_slice() else { panic!("{report:#}") };
    assert_eq!((&update["controller"], &update["node"]), (&"door".into(), &5.into()));
    assert!(update["tried"].to_string().contains("sending block 1 again, 3 of 3: the CRC"), "{update:#}");
    // CiA 302-3: the answer to the read of 1F57h/1 with the error 3 in bits 1 to 7.
    assert!(update["frames"].to_string().contains("  585#43571F0106000000  "), "{update:#}");
    assert!(update["answers"][0].as_str().unwrap().starts_with("1F57h reads 06h"), "{update:#}");
    assert!(!Firmware::new(&image).is_in(&bytes));
    let reported = server.action("door").details("closed");
    assert!(reported.contains("it answered: 1F57h reads 06h"), "{reported}");
}
