//! Every command of `coflash` that talks to a device, against nodes over a real socket. (`nodes.rs`
//! uses some commands itself; `convert`, `inspect`, `completions` and `man` talk to no device.)

use std::io::Write;
use std::net::TcpStream;
use std::process::Command;
use std::sync::mpsc::RecvTimeoutError;
use std::time::Duration;

use boot_core::store::{Journal, Parameters as _};
use coboot_node::file_flash::{FileFlash, Speed};
use shared_abi::layout::DEFAULT;

use crate::bus::{self, Coflash, Folder, Nodes, FLASH};
use serde_json::{json, Value};

fn program(byte: u8) -> Vec<u8> {
    bus::program(byte, 200 * 1024)
}

fn folder(test: &str) -> Folder {
    Folder::with_program(test, &program(0xA5))
}

/// Nodes with these arguments in such a folder, and the host tool on their bus.
fn start(test: &str, arguments: &[&str]) -> (Folder, Nodes, Coflash) {
    bus::start(folder(test), arguments)
}

/// Bytes of the program's region that are not erased.
fn programmed(folder: &Folder) -> usize {
    folder.read("1.flash")[0x2_0000..].iter().filter(|byte| **byte != 0xFF).count()
}

#[test]
fn the_steps_of_an_update_one_by_one() {
    let (folder, nodes, coflash) = start("steps", &["--node", "5", "--flash", "instant", "--stand-in"]);
    let on = |words: &[&str]| coflash.done(&[words, &["-N", "5"]].concat());
    // No program yet: the manual's "no valid program" (1F57h = 02h), with coflash's number.
    let refused = coflash.run(&["start", "-N", "5"]);
    assert_eq!(refused.exit, 7, "{}", refused.err);
    assert!(refused.err.contains("60000014"), "{}", refused.err);
    on(FLASH);
    assert!(on(&["more", "status"]).contains("running"));
    assert_eq!(on(&["enter"]), "node 5: the bootloader is running\n");
    // The call ends a program by a reset of software.
    assert_eq!(coflash.json(&["read", "2007/3", "-N", "5"])["number"], 3);
    assert_eq!(on(&["enter"]), "node 5: the bootloader is running already\n");
    assert!(on(&["more", "withdraw"]).contains("no longer released for autostart"));
    // START is then a trial, and after the next reset the device stays in the bootloader.
    assert!(on(&["start"]).contains("an application"));
    nodes.await_line("serial 1, node 5: would start program 1, on trial");
    on(&["reset"]);
    nodes.await_line("serial 1, node 5: bootloader (Unsigned)");
    assert_eq!(on(&["more", "release"]), "node 5: program 1 is released for autostart\n");
    assert!(on(&["start"]).contains("an application"));
    // The application is called back before the erase; then nothing is left of it.
    assert!(programmed(&folder) > 190 * 1024);
    assert!(on(&["erase"]).starts_with("node 5: program 1 is erased, in "));
    assert_eq!(programmed(&folder), 0, "erased, not only marked");
    let status = coflash.json(&["more", "status", "-N", "5"]);
    assert_eq!((&status["crc"], &status["bootloader"]), (&json!(0), &json!(true)));
    let refused = coflash.run(&["more", "release", "-N", "5"]);
    assert_eq!(refused.exit, 6, "{}", refused.err);
    assert_ne!(coflash.json(&["more", "status", "-N", "5"])["status"]["error"], Value::Null);
    assert_eq!(coflash.json(&["more", "status", "--clear", "-N", "5"])["status"]["error"], Value::Null);
    assert_eq!(on(&["reset"]), "back on the bus: node 5\n");
}

/// A chip holds the program back for its bootloader to make room; a node makes room itself.
#[test]
fn a_node_whose_journal_is_nearly_full_starts_its_program() {
    let folder = folder("full");
    let options = ["--node", "5", "--flash", "instant", "--stand-in"];
    let nodes = Nodes::start(&folder, &options);
    Coflash::new(&folder, &nodes).done(&[FLASH, &["-N", "5"]].concat());
    drop(nodes);
    let mut flash = FileFlash::open(&folder.path("1.flash"), DEFAULT, Speed::Instant).unwrap();
    while !Journal::open(&flash, DEFAULT.parameters).is_nearly_full() {
        kit::rig::fill_journal(&mut flash, DEFAULT, 2);
    }
    flash.save().unwrap();
    let nodes = Nodes::start(&folder, &options);
    nodes.await_line("serial 1, node 5: would start program 1");
}

#[test]
fn an_update_in_all_its_ways() {
    let (folder, _nodes, coflash) = start("ways", &["--node", "5", "--flash", "instant", "--stand-in"]);
    let board = ["--board", "stm32f407g-disc1"];
    let region = ["--start-address", "0x08020000", "--end-address", "0x0802FFFF"];
    let ways: [(&[&str], &[&str]); 6] = [
        (&board, &["--segmented", "--no-start"]),
        (&board, &["--no-trial", "--verify", "--check-target"]),
        // The spellings of the manual's tools.
        (
            &board,
            &["--prog_no", "1", "--chk_run", "--sdo_timeout", "1000", "--repeats", "5", "--delay", "50"],
        ),
        (&board, &["--block-size", "0x4000", "--block-repeats", "2"]),
        (&board, &["--chk_tgt", "1", "--timeout", "700", "--verify"]),
        (&region, &["--block-size", "64"]),
    ];
    for (number, (place, way)) in (1..).zip(ways) {
        folder.write("program.bin", &program(number));
        let update = ["flash", "program.bin", "-I", "binary", "--vid", "0", "--pid", "0", "-N", "5"];
        coflash.done(&[&update[..], place, way].concat());
        let file = folder.read("1.flash");
        assert_eq!(file[0x2_0000..0x2_1000], program(number)[..0x1000], "{way:?}");
    }
    // The last one was cut off at the given address.
    assert!(folder.read("1.flash")[0x3_0000..].iter().all(|byte| *byte != 6));
}

#[test]
fn a_job_file_serves_its_devices_and_reports() {
    let (folder, _nodes, coflash) =
        start("job", &["--node", "5", "--count", "3", "--flash", "instant", "--stand-in"]);
    coflash.done(&["convert", "program.bin", "program.blk", "-I", "binary", "--board", "stm32f407g-disc1"]);
    folder.write(
        "job.toml",
        b"[[program]]\nimage = 'program.blk'\nnodes = [5, 99]\n\
          [[program]]\nimage = 'program.blk'\nnodes = [6]\nstart = false\n\
          [[program]]\nimage = 'program.blk'\nnodes = [20]\nstart = false\n\
          lss = { vendor = 0, product = 0, revision = 0x10000, serial = 3 }\n",
    );
    let words = ["flash", "--job", "job.toml", "--report", "report.json", "--sdo-timeout", "200"];
    let done = coflash.run(&words);
    assert_eq!(done.exit, 8, "one is not there: {}{}", done.out, done.err);
    let report: Value = serde_json::from_slice(&folder.read("report.json")).unwrap();
    let of = |node: u8| {
        let devices = report["devices"].as_array().unwrap();
        devices.iter().find(|device| device["node"] == node).unwrap_or_else(|| panic!("{report}"))
    };
    for node in [5, 6, 20] {
        assert!(of(node)["error"].is_null(), "{report}");
    }
    assert!(!of(99)["error"].is_null(), "{report}");
    for serial in [1, 2, 3] {
        assert_eq!(folder.read(&format!("{serial}.flash"))[0x2_0000..0x2_1000], program(0xA5)[..0x1000]);
    }
    assert_eq!(coflash.json(&["read", "1F51/1", "-N", "5"])["number"], 1);
    assert_eq!(coflash.json(&["read", "1F51/1", "-N", "6"])["number"], 0);
}

/// Ctrl-C at any point of the update; the same command again, at once, completes it.
#[cfg(unix)]
#[test]
fn an_interrupted_update_is_started_again_at_once() {
    let (folder, _nodes, coflash) = start("interrupt", &["--node", "5", "--stand-in"]);
    let update = [FLASH, &["-N", "5", "-v"]].concat();
    // At the beginning, while blocks are written and sectors erased, and near the end.
    for (version, until) in (1..).zip(["erase the old program", "10 %", "40 %", "90 %"]) {
        folder.write("program.bin", &program(version));
        let running = coflash.spawn(&update);
        running.await_text(until);
        let interrupted = Command::new("kill").args(["-INT", &running.id().to_string()]).status().unwrap();
        assert!(interrupted.success());
        let done = running.wait();
        assert_eq!(done.exit, 130, "{until}: {}{}", done.out, done.err);
        assert!(done.err.contains("run the same command again"), "{}", done.err);
        coflash.done(&update);
        assert_eq!(folder.read("1.flash")[0x2_0000..0x5_2000], program(version), "{until}");
    }
}

#[test]
fn no_bus_no_node_no_sense() {
    let (_folder, nodes, coflash) = start("nobody", &["--node", "5", "--flash", "instant"]);
    // Each command talks to its own node: an update notices other clients of its node.
    let quick =
        |number: usize| ["--sdo-timeout".to_string(), "50".into(), "-N".into(), (9 + number).to_string()];
    let commands: [&[&str]; 8] = [
        &["info"],
        &["more", "status"],
        &["start"],
        &["enter"],
        &["erase"],
        &["more", "release"],
        &["more", "withdraw"],
        FLASH,
    ];
    let running = commands.iter().enumerate().map(|(number, command)| {
        let quick = quick(number);
        coflash.spawn(&[command, &quick.each_ref().map(String::as_str)[..]].concat())
    });
    let running: Vec<_> = running.collect();
    for (number, (running, command)) in running.into_iter().zip(commands).enumerate() {
        let done = running.wait();
        assert_eq!(done.exit, 5, "{command:?}: {}{}", done.out, done.err);
        assert!(done.err.contains(&format!("node {} does not answer", 9 + number)), "{}", done.err);
    }
    let done = coflash.run(&["info", "-N", "5", "--bus", "socketcand://127.0.0.1:1/can0"]);
    assert_eq!(done.exit, 4, "{}", done.err);
    let elsewhere = format!("socketcand://{}/can7", nodes.address());
    let done = coflash.run(&["info", "-N", "5", "--bus", &elsewhere]);
    assert_eq!(done.exit, 4, "{}", done.err);
    assert!(done.err.contains("the only bus is can0"), "{}", done.err);
    // A program number that the device does not have.
    let done = coflash.run(&[FLASH, &["-P", "1", "-N", "5", "--no-start"]].concat());
    assert_eq!(done.exit, 0, "{}", done.err);
    let done = coflash.run(&["start", "-N", "5", "-P", "2"]);
    assert_eq!(done.exit, 7, "{}{}", done.out, done.err);
}

/// Two hosts talk to one node, with an update or with a package: the second one notices before it changes anything,
/// by the lock of the first or by its requests, and the first one completes.
#[test]
fn a_second_host_on_the_same_node_leaves_it_alone() {
    let (folder, _nodes, coflash) = start("two-hosts", &["--node", "5", "--stand-in"]);
    let elsewhere = folder.path("elsewhere");
    std::fs::create_dir_all(&elsewhere).unwrap();
    let one = b"board = 'stm32f407g-disc1'\n[[program]]\nimage = 'program.bin'\nnodes = [5]\n";
    folder.write("one.toml", one);
    coflash.done(&["package", "one.toml"]);
    let update = [FLASH, &["-N", "5", "-v", "--from-start", "--command-timeout", "5000"]].concat();
    for (round, locks, how) in [
        (1, folder.path(""), "another coflash on this computer, process "),
        (2, elsewhere, "another tool is using node 5"),
    ] {
        let program = bus::program(round, 600 * 1024);
        folder.write("program.bin", &program);
        let first = coflash.spawn(&update);
        first.await_text("10 %");
        for (second, word) in [(&update[..], "erase"), (&["flash", "one.cpk", "--yes"], "node 5")] {
            let done = coflash.spawn_at(second, &locks).wait();
            assert_eq!(done.exit, 6, "{second:?}: {}{}", done.out, done.err);
            assert!(done.err.contains(how) && done.err.contains("[0x60000012]"), "{}", done.err);
            assert!(!done.out.contains(word), "{}", done.out);
        }
        let done = first.wait();
        assert_eq!(done.exit, 0, "{}{}", done.out, done.err);
        assert!(folder.read("1.flash")[0x2_0000..][..program.len()] == program);
    }
    // A process that has ended holds no lock.
    coflash.done(&update);
}

/// Another client fills the bus, also with frames that look like answers of other nodes, and with
/// invalid ones.
#[test]
fn frames_of_others_are_passed_over() {
    let (folder, nodes, coflash) = start("noise", &["--node", "5", "--flash", "instant", "--stand-in"]);
    let (stop, stopped) = std::sync::mpsc::channel::<()>();
    let address = nodes.address().to_owned();
    let noise = std::thread::spawn(move || {
        let mut stream = TcpStream::connect(address).unwrap();
        assert_eq!(crate::bus::message(&mut stream), "< hi >");
        stream.write_all(b"< open can0 >").unwrap();
        assert_eq!(crate::bus::message(&mut stream), "< ok >");
        // Answers of node 6; an SDO frame that is too short; a heartbeat of five bytes; a 29-bit
        // frame with an answer's number; PDOs.
        let frames = b"< send 586 8 60 50 1F 1 0 0 0 0 >< send 586 8 80 50 1F 1 0 0 0 8 >< send 585 3 60 50 1F >\
                       < send 705 5 0 0 0 0 0 >< send 00000585 8 80 50 1F 1 0 0 0 8 >< send 185 8 1 2 3 4 5 6 7 8 >";
        let mut rounds = 0;
        while stopped.recv_timeout(Duration::from_millis(1)) == Err(RecvTimeoutError::Timeout) {
            stream.write_all(frames).unwrap();
            rounds += 1;
        }
        rounds
    });
    coflash.done(&[FLASH, &["-N", "5", "--verify"]].concat());
    drop(stop);
    assert!(noise.join().unwrap() > 10);
    assert_eq!(folder.read("1.flash")[0x2_0000..0x5_2000], program(0xA5));
}
