//! `cargo xtask hil` on the emulated board, with the worst chip that its manuals allow: gdb is
//! the probe, the control socket the relay and the hand at the strap, socketcand the bus.
#![cfg(unix)]

use std::fs;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::thread;

use kit::folder::Folder;

/// The seconds after which a run counts as hanging, on the wall clock. It may build everything.
const PATIENCE: &str = "1800";

/// The emulated board as a process, with a bootloader of another product in its flash.
struct Board {
    emulator: Child,
    bus: String,
    control: String,
    gdb: String,
}

impl Board {
    fn new() -> Self {
        let variable = |name| {
            std::env::var(name).unwrap_or_else(|_| panic!("{name} is not set: run `cargo xtask test`"))
        };
        let bootloader = Path::new(&variable("COBOOT_FIRMWARE_DIR")).join("bootloader-crc-16.elf");
        let mut cargo = Command::new(env!("CARGO"));
        cargo.args(["run", "-q", "-p", "coboot-emulator", "--bin", "emulate", "--", "--board"]);
        cargo.arg(variable("COBOOT_BOARD")).arg("--bootloader").arg(bootloader);
        cargo.args(["--silicon", "worst"]);
        cargo.args(["--socketcand", "127.0.0.1:0", "--control", "127.0.0.1:0", "--gdb", "127.0.0.1:0"]);
        let mut emulator = cargo.stdin(Stdio::null()).stdout(Stdio::piped()).spawn().expect("cargo starts");
        let mut lines = BufReader::new(emulator.stdout.take().expect("a pipe")).lines();
        let mut behind = |words: &str| {
            let line = lines.next().expect("the emulator tells its addresses").expect("text");
            line.split_once(words).unwrap_or_else(|| panic!("{line}")).1.trim_matches('`').to_owned()
        };
        let (bus, control, gdb) = (behind("bus at "), behind("taken at "), behind("target remote "));
        thread::spawn(move || lines.for_each(drop));
        Self { emulator, bus, control, gdb }
    }

    /// The command line for gdb as the probe.
    fn probe(&self, folder: &Path) -> String {
        for (action, load) in [("download", "load\n"), ("reset", "")] {
            let script = format!("target remote {}\n{load}monitor reset\ndetach\n", self.gdb);
            fs::write(folder.join(action).with_extension("gdb"), script).unwrap();
        }
        format!("gdb-multiarch -nx -batch -x '{}/{{action}}.gdb' {{elf}}", folder.display())
    }

    /// A command line for the control socket: this command, in which words stand for on and off.
    fn control(&self, command: &str, on: &str, off: &str) -> String {
        let address = self.control.replace(':', "/");
        format!(
            "bash -c 'declare -A word=([on]={on} [off]={off}); exec 3<>/dev/tcp/{address} && \
             echo {command} ${{word[{{state}}]}} >&3 && read -r answer <&3 && [[ $answer == ok* ]]'"
        )
    }
}

impl Drop for Board {
    fn drop(&mut self) {
        let _ = self.emulator.kill();
        let _ = self.emulator.wait();
    }
}

/// Runs the job; whether it succeeded, and what it printed.
fn hil(words: &[&str]) -> (bool, String) {
    let board = std::env::var("COBOOT_BOARD").expect("run `cargo xtask test`");
    let mut job = Command::new("timeout");
    job.args([PATIENCE, env!("CARGO_BIN_EXE_xtask"), "hil", "--board", &board]).args(words);
    let ended = job.stdin(Stdio::null()).output().unwrap();
    let said = [ended.stdout, ended.stderr].concat();
    (ended.status.success(), String::from_utf8(said).unwrap())
}

#[test]
fn a_board_goes_through_all_steps_and_a_faulty_bench_is_told() {
    let board = Board::new();
    let folder = Folder::below(env!("CARGO_TARGET_TMPDIR"), "hil");
    let (probe, relay) = (board.probe(&folder), board.control("power", "on", "off"));
    // The button of the board's strap (UM1472: PA0, high when pressed).
    let strap = board.control("pin PA0", "high", "open");
    let report = folder.join("report.json");
    let words =
        ["--bus", &board.bus, "--probe", &probe, "--power-command", &relay, "--strap-command", &strap];
    let (good, said) = hil(&[&words[..], &["--json", report.to_str().unwrap()]].concat());
    assert!(good, "{said}");
    let outcome = |step: &str| {
        let line = said.lines().find(|line| line.contains(step)).unwrap_or_else(|| panic!("{step}: {said}"));
        line.split("  ").next().unwrap().trim().to_owned()
    };
    for step in [
        "flash the bootloader",
        "by its crystal",
        "conformance",
        "update suite",
        "way back by a reset",
        "way back by the watchdog",
        "way back by a jump",
        "start version 2 by itself",
        "store a node-ID",
        "entry strap",
        "a jump that leaves",
        "a program that hangs",
    ] {
        assert_eq!(outcome(step), "passed", "{step}: {said}");
    }
    // Nobody shorts this bus, and its adapter has one bit rate.
    for step in ["LSS: bit rates", "by listening", "bus-off", "the crystal stopped"] {
        assert_eq!(outcome(step), "not run", "{step}: {said}");
    }
    let report = fs::read_to_string(report).unwrap();
    assert!(report.contains("\"passed\": true"), "{report}");

    let bus = board.bus.as_str();
    let failing = "sh -c 'test {state} = never'";
    for (words, reported) in [
        (vec!["--bus", bus, "--probe", "no-such-probe {elf}"], "\"no-such-probe\" is not there"),
        (vec!["--bus", bus, "--probe", "true", "--strap-command", "true"], "--strap-command needs {state}"),
        (vec!["--bus", bus, "--probe", "true", "--elf", "none.elf"], "--elf none.elf: there is no such file"),
        (vec!["--bus", "socketcand://127.0.0.1:1/can0", "--probe", "true"], "cannot be opened"),
        (vec!["--bus", bus, "--probe", "true", "--power-command", failing], "cannot be switched off"),
        (vec!["--bus", bus, "--node", "9", "--probe", "true"], "node 9 does not answer"),
        (vec!["--bus", bus, "--probe", "false {elf}"], "probe is plugged in"),
        (vec!["--probe", "true"], "--bus is missing"),
    ] {
        let (good, said) = hil(&words);
        assert!(!good && said.contains(reported), "{words:?}: {said}");
    }
}
