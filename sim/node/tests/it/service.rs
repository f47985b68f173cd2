//! Typical work of a service technician, or of a program around `coflash`: single objects, network
//! management, events, logs and reports, against nodes over a real socket.

use std::fs;
use std::path::{Path, PathBuf};

use crate::bus::{self, Coflash, Folder, Nodes, FLASH};
use serde_json::Value;

fn folder(test: &str) -> Folder {
    Folder::with_program(test, &bus::program(0xA5, 20 * 1024))
}

/// Nodes with these arguments in such a folder, and the host tool on their bus.
fn start(test: &str, arguments: &[&str]) -> (Folder, Nodes, Coflash) {
    bus::start(folder(test), arguments)
}

fn eds() -> String {
    format!("{}/../../docs/eds/coboot-bootloader.eds", env!("CARGO_MANIFEST_DIR"))
}

/// The lines of standard output, each one JSON.
#[track_caller]
fn lines(out: &str) -> Vec<Value> {
    out.lines()
        .map(|line| serde_json::from_str(line).unwrap_or_else(|error| panic!("{error}: {line}")))
        .collect()
}

#[test]
fn objects_are_read_in_lists_and_by_their_names() {
    let (folder, _nodes, coflash) =
        start("objects", &["--node", "5", "--serial", "77", "--vendor-id", "0x3F"]);
    let said = coflash.done(&["read", "1000", "1018/1..4", "-N", "5"]);
    let said: Vec<&str> = said.lines().collect();
    assert_eq!(said.len(), 5, "{said:?}");
    assert_eq!(said[1], "node 5, 1018h/1: 63 (0000003Fh)");
    assert_eq!(said[4], "node 5, 1018h/4: 77 (0000004Dh)");
    // The option may come before the command, and the object may be named.
    let named = coflash.done(&["-N", "5", "read", "Identity object/4", "--eds", &eds()]);
    assert!(
        named.starts_with("node 5, 1018h/4 (Identity object/") && named.ends_with("): 77 (0000004Dh)\n"),
        "{named}"
    );
    // A list; an object that does not exist does not prevent the others, but gives the exit code.
    folder.write("list.txt", b"# identity\n1018/4  # serial\n\n2345/6\n1018/1\n");
    let mixed = coflash.run(&["read", "--file", "list.txt", "-N", "5", "--json"]);
    assert_eq!(mixed.exit, 6, "{}", mixed.err);
    let [all] = lines(&mixed.out).try_into().unwrap();
    let numbers: Vec<&Value> = all["objects"].as_array().unwrap().iter().map(|one| &one["number"]).collect();
    assert_eq!(numbers, [&Value::from(77), &Value::Null, &Value::from(63)]);
    assert!(all["objects"][1]["error"]["what"].as_str().unwrap().contains("2345h/6"), "{all}");
    let mixed = coflash.run(&["read", "1018/4", "2345", "-N", "5"]);
    assert!(mixed.err.contains("error: 1 of 2 objects could not be read"), "{}", mixed.err);
    // A single object has the same document as before.
    let one = coflash.json(&["read", "1018/4", "-N", "5"]);
    assert_eq!(
        (&one["command"], &one["number"], &one["hex"]),
        (&"read".into(), &77.into(), &"4D000000".into())
    );
    for (words, exit, why) in [
        (&["read", "Nothing", "--eds", &eds()][..], 2, "the EDS has no object 'Nothing'"),
        (&["read", "Nothing"], 2, "names need --eds FILE"),
        (&["read", "1018/4..1"], 2, "is not a range"),
        (&["read", "1018/4", "1000", "-o", "x"], 2, "one object at a time"),
        (&["read"], 2, "OBJECT"),
        (&["read", "1000", "--eds", "program.bin"], 3, "program.bin: it is not an EDS"),
        (&["read", "1000", "--eds", "none.eds"], 3, "none.eds: cannot be read"),
        (&["read", "1000", "--eds", "/dev/zero"], 3, "the limit for this file"),
        (&["read", "--file", "/dev/zero"], 3, "the limit for this file"),
    ] {
        let done = coflash.run(words);
        assert!(done.exit == exit && done.err.contains(why), "{words:?}: {} {}", done.exit, done.err);
    }
}

#[test]
fn a_value_is_written_if_its_type_has_room_for_it() {
    let (folder, nodes, coflash) = start("write", &["--node", "5", "--flash", "instant", "--stand-in"]);
    coflash.done(&[FLASH, &["-N", "5", "--no-start"]].concat());
    // A written value takes effect: in program control of CiA 302-3, 1 starts and 80h calls back.
    let said = coflash.done(&["write", "1F51/1", "1", "--type", "u8", "-N", "5"]);
    assert_eq!(said, "node 5, 1F51h/1: written, 1 byte\n");
    nodes.await_line("serial 1, node 5: would start program 1");
    coflash.done(&["reset", "-N", "5"]);
    // The type comes from the data sheet.
    coflash.done(&["enter", "-N", "5"]);
    coflash.done(&["write", "Program control/1", "0x84", "--eds", &eds(), "-N", "5"]);
    coflash.done(&["reset", "-N", "5"]);
    nodes.await_line("serial 1, node 5: bootloader (Unsigned)");
    folder.write("value.bin", &[0x83]);
    coflash.done(&["write", "1F51/1", "value.bin", "--type", "domain-from-file", "-N", "5"]);
    coflash.done(&["reset", "-N", "5"]);
    nodes.await_line("serial 1, node 5: would start program 1");
    for (words, exit, why) in [
        (&["write", "1F51/1", "256", "--type", "u8"][..], 2, "256 is out of the range of u8: 0 to 255"),
        (&["write", "1F51/1", "-1", "--type", "u8"], 2, "-1 is out of the range of u8"),
        (&["write", "1F51/1", "0x100", "--eds", &eds()], 2, "out of the range of u8"),
        (&["write", "1F51/1", "1"], 2, "the type of 1F51h/1 is unknown"),
        (&["write", "1017", "1", "--eds", &eds()], 2, "is read-only by the EDS"),
        (&["write", "1F51/1..2", "1", "--type", "u8"], 2, "is more than one object"),
        (&["write", "1F51/1", "none.bin", "--type", "domain-from-file"], 3, "none.bin: cannot be read"),
        (&["write", "1F51/1", "/dev/zero", "--type", "domain-from-file"], 3, "the limit for this file"),
        // A refusal of the device is shown with its reason.
        (&["write", "1000", "1", "--type", "u32"], 6, "read"),
        (&["write", "1F51/1", "1", "--type", "u32"], 6, "length"),
    ] {
        let done = coflash.run(&[words, &["-N", "5"]].concat());
        let err = done.err.to_lowercase();
        assert!(
            done.exit == exit && err.contains(&why.to_lowercase()),
            "{words:?}: {} {}",
            done.exit,
            done.err
        );
    }
}

#[test]
fn network_management_tells_what_the_heartbeat_says() {
    let (_folder, _nodes, coflash) = start("nmt", &["--node", "5", "--count", "2"]);
    // A bootloader is pre-operational and stays in this state.
    let said = coflash.done(&["nmt", "stop", "-N", "5"]);
    assert_eq!(said, "node 5: command sent; node 5 has not carried out the command and is pre-operational\n");
    let all = coflash.json(&["nmt", "pre-operational", "--node", "all"]);
    let heard = all["heard"].as_array().unwrap();
    assert_eq!(heard.len(), 2, "{all}");
    assert!(heard.iter().all(|one| one["confirmed"] == true), "{all}");
    coflash.done(&["info", "-N", "5"]);
    assert_eq!(coflash.done(&["nmt", "reset", "-N", "6"]), "back on the bus: node 6\n");
    assert_eq!(coflash.done(&["nmt", "reset-communication", "-N", "6"]), "back on the bus: node 6\n");
    let nobody = coflash.run(&["nmt", "reset", "-N", "9", "--boot-timeout", "300"]);
    assert!(nobody.exit == 5 && nobody.err.contains("node 9 has sent no boot-up message"), "{}", nobody.err);
    assert_eq!(coflash.run(&["nmt", "fly"]).exit, 2);
    assert!(coflash.run(&["nmt", "stop", "-N", "0"]).err.contains("node-IDs are 1 to 127, or all"));
}

#[test]
fn events_are_one_object_a_line() {
    let (_folder, _nodes, coflash) =
        start("events", &["--node", "5", "--count", "2", "--flash", "instant", "--stand-in"]);
    let said = coflash.done(&[FLASH, &["-N", "5", "--json-events"]].concat());
    let all = lines(&said);
    let kinds: Vec<&str> = all.iter().map(|line| line["event"].as_str().unwrap()).collect();
    assert_eq!(
        (kinds[0], kinds[kinds.len() - 2], kinds[kinds.len() - 1]),
        ("found", "done", "result"),
        "{kinds:?}"
    );
    let progress: Vec<&Value> = all.iter().filter(|line| line["event"] == "progress").collect();
    assert!((2..=101).contains(&progress.len()), "{}", progress.len());
    for line in &progress {
        assert!(
            line["bytes_per_second"].is_u64() && line["seconds_left"].is_number() == (line["done"] != 0),
            "{line}"
        );
    }
    let last = progress.last().unwrap();
    assert_eq!((&last["done"], last["seconds_left"].as_f64()), (&last["total"], Some(0.0)), "{last}");
    assert!(all.iter().any(|line| line["phase"] == "verified"), "{kinds:?}");
    assert_eq!(all.last().unwrap()["size"], 20 * 1024);
    // With several devices, each line names its device.
    let said = coflash.run(&[FLASH, &["-N", "5,6,9", "--json-events", "--boot-timeout", "500"]].concat());
    assert_eq!(said.exit, 8);
    let all = lines(&said.out);
    for node in [5, 6, 9] {
        let done = all.iter().filter(|line| line["event"] == "done" && line["node"] == node);
        assert_eq!(done.count(), 1, "node {node}: {}", said.out);
    }
    assert_eq!(
        (&all.last().unwrap()["event"], &all.last().unwrap()["failed"]),
        (&"result".into(), &1.into())
    );
    // A failure, and wrong usage.
    for (words, exit, what) in [
        (&["info", "-N", "9", "--boot-timeout", "200", "--json-events"][..], 5, "node 9 does not answer"),
        (&["info", "--node", "200", "--json-events"], 2, "node-IDs are 1 to 127"),
        (&["fly", "--json-events"], 2, "fly"),
    ] {
        let done = coflash.run(words);
        let [line] = lines(&done.out).try_into().unwrap();
        assert_eq!((done.exit, &line["event"]), (exit, &"error".into()), "{line}");
        assert!(line["error"]["what"].as_str().unwrap().contains(what), "{line}");
        assert_eq!(done.err, "");
    }
    let done = coflash.run(&["info", "--node", "200", "--json"]);
    let [line] = lines(&done.out).try_into().unwrap();
    assert_eq!((done.exit, &line["error"]["exit"], done.err.as_str()), (2, &2.into(), ""));
}

/// The only folder in a folder.
fn only(folder: &Path) -> PathBuf {
    let all: Vec<PathBuf> = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    let [one] = all.as_slice() else { panic!("{all:?}") };
    one.clone()
}

#[test]
fn a_report_has_what_service_needs_and_no_password() {
    let (folder, nodes, coflash) = start("report", &["--node", "5", "--flash", "instant", "--stand-in"]);
    let secret = ["--unlock", "sesame", "--dialect", "block"];
    coflash.done(&[FLASH, &["-N", "5", "--report-dir", "reports"], &secret].concat());
    let run = only(&folder.path("reports"));
    assert!(
        run.to_string_lossy().ends_with("Z-flash") || run.to_string_lossy().ends_with("-flash"),
        "{run:?}"
    );
    let text = |name: &str| fs::read_to_string(run.join(name)).unwrap();
    let report: Value = serde_json::from_str(&text("report.json")).unwrap();
    assert_eq!((&report["exit"], &report["bus"]), (&0.into(), &nodes.url().into()));
    assert_eq!(report["result"]["size"], 20 * 1024);
    assert!(report["ended"].is_string() && report["coflash"].is_string(), "{report}");
    let line = report["command_line"].to_string();
    assert!(line.contains("program.bin") && line.contains("\"--unlock\",\"***\""), "{line}");
    let events = lines(&text("events.jsonl"));
    assert!(events.iter().all(|line| line["time"].is_string()), "{events:?}");
    assert_eq!(events.last().unwrap()["event"], "done");
    // The tool itself can read the trace.
    let trace = run.join("trace.log").display().to_string();
    let words = coflash.done(&["monitor", "--replay", &trace]);
    assert!(words.contains("1F51h/1"), "{words}");
    // A failed run has its reason in the report, and the log has every frame in words.
    let failed =
        coflash.run(&["write", "7F50/1", "0x494E4954", "--type", "u32", "-N", "5", "--report-dir", "others"]);
    assert_eq!(failed.exit, 6, "{}", failed.err);
    let other = only(&folder.path("others"));
    let report: Value = serde_json::from_slice(&fs::read(other.join("report.json")).unwrap()).unwrap();
    assert!(report["exit"] == 6 && report["error"]["what"].as_str().unwrap().contains("7F50h/1"), "{report}");
    let log = fs::read_to_string(other.join("log.txt")).unwrap();
    assert!(log.contains("605#23507F0100000000") && log.contains("  error  "), "{log}");
    for file in ["report.json", "log.txt", "trace.log"] {
        let text = fs::read_to_string(other.join(file)).unwrap();
        assert!(!text.contains("494E4954") && !text.contains("54494E49"), "{file}: {text}");
    }
    // One folder for each run; and a separate log.
    coflash.done(&["info", "-N", "5", "--report-dir", "reports", "--log-file", "info.log"]);
    assert_eq!(fs::read_dir(folder.path("reports")).unwrap().count(), 2);
    let log = String::from_utf8(folder.read("info.log")).unwrap();
    assert!(
        log.contains("  frame  ") && log.contains("read 1000h/0") && log.ends_with("exit code 0\n"),
        "{log}"
    );
    let line = coflash.typed(&["more", "shell"], "info -N 5 --log-file line.log\n");
    assert!(line.exit == 2 && line.err.contains("apply only to the shell as a whole"), "{}", line.err);
    let nowhere = coflash.run(&["info", "-N", "5", "--log-file", "none/info.log"]);
    assert!(nowhere.exit == 1 && nowhere.err.contains("cannot be written"), "{}", nowhere.err);
}
