//! `cargo xtask hil` with the emulated board behind it: gdb is the probe, the control socket the
//! relay, socketcand the bus.
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

    /// The command line for the control socket as the relay.
    fn relay(&self) -> String {
        let address = self.control.replace(':', "/");
        format!(
            "bash -c 'exec 3<>/dev/tcp/{address} && echo power {{state}} >&3 && read -r answer <&3 && \
             [[ $answer == ok* ]]'"
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
    let (probe, relay) = (board.probe(&folder), board.relay());
    let report = folder.join("report.json");
    let words = ["--bus", &board.bus, "--probe", &probe, "--power-command", &relay, "--json"];
    let (good, said) = hil(&[&words[..], &[report.to_str().unwrap()]].concat());
    assert!(good, "{said}");
    assert!(said.contains(" 0 failed"), "{said}");
    for step in ["flash the bootloader", "cut the power", "Ctrl-C", "another device", "damaged"] {
        assert!(said.lines().any(|line| line.contains(step) && line.contains("passed")), "{step}: {said}");
    }
    let report = fs::read_to_string(report).unwrap();
    assert!(report.contains("\"passed\": true"), "{report}");

    let bus = board.bus.as_str();
    let failing = "sh -c 'test {state} = never'";
    for (words, told) in [
        (vec!["--bus", bus, "--probe", "no-such-probe {elf}"], "\"no-such-probe\" is not there"),
        (vec!["--bus", "socketcand://127.0.0.1:1/can0", "--probe", "true"], "cannot be opened"),
        (vec!["--bus", bus, "--probe", "true", "--power-command", failing], "cannot be switched off"),
        (vec!["--bus", bus, "--node", "9", "--probe", "true"], "node 9 does not answer"),
        (vec!["--bus", bus, "--probe", "false {elf}"], "probe is plugged in"),
        (vec!["--probe", "true"], "--bus is missing"),
    ] {
        let (good, said) = hil(&words);
        assert!(!good && said.contains(told), "{words:?}: {said}");
    }
}
