//! `coboot-node --run`: the downloaded program runs as a process of the host.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::thread;
use std::time::Duration;

use crate::bus::{self, node, Coflash, Folder, Nodes, FLASH, VECTORS};

/// Runs what follows the vector table of a program (512 bytes, with what is between).
const RUNNER: &str = "#!/bin/sh\ntail -c +513 \"$1\" > \"$1.sh\"\nexec /bin/sh \"$1.sh\"\n";

/// A program for [`RUNNER`]: it writes into the file `ran`, and waits for the end of its input.
fn program(version: u8, script: &str) -> Vec<u8> {
    let mut bytes = [0xFF; 512].to_vec();
    bytes[..8].copy_from_slice(&VECTORS);
    let before = format!("say() {{ echo \"version {version}: $1\" >> ran; }}\n");
    bytes.extend(format!("{before}{script}\nwhile read line; do :; done\nsay 'end of input'\n").into_bytes());
    bytes
}

/// It says which node it is, and ends when it is asked to.
const OBEYS: &str = "say \"node $COBOOT_NODE_ID, serial $COBOOT_SERIAL_NUMBER, program $COBOOT_PROGRAM\"\n\
                     trap 'say ended; exit 0' TERM";

fn command(folder: &Folder, name: &str, text: &[u8]) {
    folder.write(name, text);
    fs::set_permissions(folder.path(name), fs::Permissions::from_mode(0o755)).unwrap();
}

fn folder(test: &str, script: &str) -> Folder {
    let folder = Folder::with_program(test, &program(1, script));
    command(&folder, "run.sh", RUNNER.as_bytes());
    folder
}

fn start(folder: Folder) -> (Folder, Nodes, Coflash) {
    bus::start(folder, &["--node", "7", "--flash", "instant", "--run", "./run.sh"])
}

/// Waits until the condition holds; a program of the host has two minutes for it.
#[track_caller]
fn wait_for(what: &str, condition: impl Fn() -> bool) {
    for _ in 0..24_000 {
        if condition() {
            return;
        }
        thread::sleep(Duration::from_millis(5));
    }
    panic!("this never comes: {what}");
}

fn ran(folder: &Folder) -> String {
    fs::read_to_string(folder.path("ran")).unwrap_or_default()
}

#[test]
fn the_downloaded_program_runs_and_is_ended_on_the_call_back() {
    let (folder, nodes, coflash) = start(folder("hosted", OBEYS));
    coflash.done(&[FLASH, &["-N", "7", "--watch", "0"]].concat());
    // The trial, which ends with the call back (1F51h = 80h), and the start after the release.
    for line in [
        "serial 1, node 7: starts program 1, on trial",
        "serial 1: program 1 was ended",
        "serial 1, node 7: bootloader (Requested)",
        "serial 1, node 7: starts program 1",
    ] {
        nodes.await_line(line);
    }
    let says = "version 1: node 7, serial 1, program 1\n";
    // On a slow host the first one may end before it says anything.
    wait_for("the second start", || ran(&folder).ends_with(says));
    // It has what was downloaded, byte for byte.
    assert!(folder.read("1.program1") == folder.read("program.bin"));

    // The next version: the running one is called back, and ends.
    folder.write("program.bin", &program(2, OBEYS));
    coflash.done(&[FLASH, &["-N", "7", "--watch", "0", "--no-trial"]].concat());
    wait_for("the start of version 2", || ran(&folder).contains(&says.replace("version 1", "version 2")));
    let said = ran(&folder);
    assert!(said.find("version 1: ended") < said.find("version 2: node"), "{said}");
    assert!(folder.read("1.program1") == folder.read("program.bin"));

    // STOP (1F51h = 0) leads into the bootloader, too, which then answers it.
    coflash.done(&["write", "1F51/1", "0", "--type", "u8", "-N", "7"]);
    nodes.await_line("serial 1: program 1 was ended");
    nodes.await_line("serial 1, node 7: bootloader (Requested)");
    assert!(ran(&folder).ends_with("version 2: ended\n"), "{}", ran(&folder));
    coflash.done(&["start", "-N", "7"]);
    nodes.await_line("serial 1, node 7: starts program 1");
    wait_for("the start by 1F51h = 1", || ran(&folder).ends_with("version 2: node 7, serial 1, program 1\n"));
    // The end of the node is that of the program's standard input.
    drop(nodes);
    wait_for("the end of the input", || ran(&folder).ends_with("version 2: end of input\n"));
}

/// A program that dies is a crash: after three in a row the bootloader stays, as on the chip (2007h/2 = 2
/// and /4 = 3).
#[test]
fn a_program_that_dies_leads_into_the_bootloader() {
    let (folder, nodes, coflash) = start(folder("hosted-dies", "say begun\nexit 3"));
    // On trial, the first death is enough: it is not released.
    let trial = coflash.run(&[FLASH, &["-N", "7"]].concat());
    assert_eq!(trial.exit, 7, "{}{}", trial.out, trial.err);
    nodes.await_line("serial 1: program 1 has ended by itself: exit status: 3");
    nodes.await_line("serial 1, node 7: bootloader (Unsigned)");
    coflash.done(&["more", "release", "-N", "7"]);
    coflash.run(&["start", "-N", "7"]);
    for _ in 0..3 {
        nodes.await_line("serial 1: program 1 has ended by itself: exit status: 3");
    }
    nodes.await_line("serial 1, node 7: bootloader (CrashLoop)");
    assert_eq!(ran(&folder).matches("version 1: begun\n").count(), 1 + 3);
    assert_eq!(coflash.json(&["read", "2007/2", "-N", "7"])["number"], 2);
    assert_eq!(coflash.json(&["read", "2007/4", "-N", "7"])["number"], 3);
    // The device is there for the next program.
    folder.write("program.bin", &program(2, OBEYS));
    coflash.done(&[FLASH, &["-N", "7", "--watch", "0"]].concat());
    wait_for("the start of version 2", || ran(&folder).ends_with("version 2: node 7, serial 1, program 1\n"));
}

/// SIGTERM, and SIGKILL a second later, for the program and for what it has started.
#[test]
fn a_program_that_ignores_its_end_is_killed_with_all_that_it_started() {
    let (folder, nodes, coflash) =
        start(folder("hosted-ignores", "trap '' TERM\nsleep 1000 &\necho $! > child\nsay begun\nwait"));
    coflash.done(&[FLASH, &["-N", "7", "--watch", "0", "--no-trial"]].concat());
    wait_for("the start", || ran(&folder).ends_with("version 1: begun\n"));
    coflash.done(&["enter", "-N", "7"]);
    nodes.await_line("serial 1: program 1 was killed, as it was still there 1 s after SIGTERM");
    nodes.await_line("serial 1, node 7: bootloader (Requested)");
    let child = String::from_utf8(folder.read("child")).unwrap();
    // A zombie that its new parent has not waited for yet has no command line any more.
    let line = Path::new("/proc").join(child.trim()).join("cmdline");
    wait_for("the end of its child", || fs::read(&line).unwrap_or_default().is_empty());
}

#[test]
fn a_command_that_is_none_is_refused_by_name() {
    let folder = folder("hosted-none", OBEYS);
    folder.write("text", b"hello");
    for (name, words) in [
        ("./none", "there is no such file"),
        ("no-such-program-anywhere", "there is no such file in the folders of PATH"),
        ("./run.sh 1", "there is no such file"),
        ("./", "it is not a file"),
        ("./text", "it must not be executed"),
        ("", "there is no such file"),
    ] {
        let done = node(&folder, &["--listen", "127.0.0.1:0", "--run", name]).wait();
        assert_eq!(done.exit, 2, "{name}: {}", done.err);
        assert!(done.err.contains("--run <COMMAND>") && done.err.contains(words), "{name}: {}", done.err);
    }
    // A file that the system does not take as a program has no shell to read it.
    command(&folder, "run.sh", b"say hello >> ran\n");
    let (folder, nodes, coflash) = start(folder);
    let done = coflash.run(&[FLASH, &["-N", "7"]].concat());
    assert_eq!(done.exit, 7, "{}{}", done.out, done.err);
    // ENOEXEC.
    nodes.await_line("serial 1: program 1 did not start: Exec format error (os error 8)");
    nodes.await_line("serial 1, node 7: bootloader (Unsigned)");
    assert_eq!(ran(&folder), "");
}

/// Nothing is started, and no file is made, unless it was asked for.
#[test]
fn it_is_off_by_default() {
    let folder = folder("hosted-off", OBEYS);
    let nodes = Nodes::start(&folder, &["--node", "7", "--flash", "instant", "--stand-in"]);
    Coflash::new(&folder, &nodes).done(&[FLASH, &["-N", "7", "--watch", "0"]].concat());
    nodes.await_line("serial 1, node 7: would start program 1");
    assert_eq!((ran(&folder).as_str(), folder.path("1.program1").exists()), ("", false));
}
