//! gdb with the emulated board: it stops in the application's 1F51h callback and in the bootloader
//! after it, while a host calls the bootloader.
use std::fs::{self, File};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use coboot_tests::bench::{Bench, NODE};
use coboot_tests::firmware;
use coboot_tests::tools::coflash;
use emulator::gdb::Door;
use emulator::pacing::{Pacer, Speed};
use emulator::socketcand::Server;

/// The time after which the test counts as hanging, on the wall clock.
const PATIENCE: Duration = Duration::from_secs(120);

/// The board with its servers for gdb and for the host.
struct Desk {
    bench: Bench,
    door: Door,
    server: Server,
    pacer: Pacer,
    since: Instant,
}

impl Desk {
    fn new(bench: Bench) -> Self {
        let since = Instant::now();
        let pacer = Pacer::new(Speed::Times(1.0), since, bench.time());
        let door = Door::bind("127.0.0.1:0").expect("a free port");
        let server = Server::bind("127.0.0.1:0", "can0").expect("a free port");
        Self { bench, door, server, pacer, since }
    }

    /// Runs the board until `reached` is true.
    fn live_until(&mut self, what: &str, mut reached: impl FnMut(&mut Self) -> bool) {
        while !reached(self) {
            assert!(self.since.elapsed() < PATIENCE, "{what}: it hangs");
            self.door.exchange(self.bench.machine());
            let (wall, now) = (Instant::now(), self.bench.time());
            if self.bench.machine().halted().is_some() {
                self.pacer = Pacer::new(Speed::Times(1.0), wall, now);
                self.bench.serve(&mut self.server, now);
                assert_eq!(self.bench.time(), now, "time stands still");
                thread::park_timeout(Duration::from_millis(1));
                continue;
            }
            let target = self.pacer.target(wall, now);
            self.bench.serve(&mut self.server, target);
        }
    }

    fn halted(&mut self) -> bool {
        self.bench.machine().halted().is_some()
    }
}

fn spawn(command: &mut Command, out: &Path) -> Child {
    let file = File::create(out).unwrap();
    let errors = file.try_clone().unwrap();
    let child = command.stdin(Stdio::null()).stdout(file).stderr(errors).spawn();
    child.unwrap_or_else(|error| panic!("{command:?}: {error}. `cargo xtask test` installs what is missing"))
}

fn ended(child: &mut Child) -> bool {
    child.try_wait().unwrap().is_some()
}

#[test]
fn gdb_stops_in_the_callback_of_the_application_and_in_the_bootloader() {
    let mut bench = Bench::new().switched_on();
    bench.install(firmware::APP_V1);
    bench.confirm_program();
    let mut desk = Desk::new(bench);

    let folder = kit::folder!("gdb-door");
    let (gdb_output, coflash_output) = (folder.join("gdb.txt"), folder.join("coflash.txt"));
    let bootloader = firmware::dir().join(firmware::BOOTLOADER);
    let mut gdb = Command::new("gdb-multiarch");
    gdb.args(["-nx", "-batch"]);
    for command in [
        "set pagination off",
        &format!("target remote {}", desk.door.address()),
        "break app_template::objects::{impl#1}::write_with_reply",
        "continue",
        "backtrace 1",
        "delete",
        // The bootloader's code is not in RAM yet: this is RAM of the application now.
        &format!("symbol-file {}", bootloader.display()),
        "hbreak main",
        "continue",
        "info symbol $pc",
        "stepi",
        "detach",
    ] {
        gdb.args(["-ex", command]);
    }
    let mut gdb = spawn(gdb.arg(firmware::dir().join(firmware::APP_V1)), &gdb_output);
    desk.live_until("gdb connects", Desk::halted);
    desk.live_until("gdb lets it go on", |desk| !desk.halted());

    let mut enter = coflash();
    enter.args(["enter", "-N", &NODE.to_string(), "--bus"]);
    enter.arg(format!("socketcand://{}/can0", desk.server.address()));
    let mut enter = spawn(&mut enter, &coflash_output);
    desk.live_until("gdb ends", |_| ended(&mut gdb));
    desk.live_until("coflash ends", |_| ended(&mut enter));

    let [said, coflash] = [gdb_output, coflash_output].map(|file| fs::read_to_string(file).unwrap());
    let mut output = said.as_str();
    for words in
        ["Breakpoint 1", "#0  app_template::objects::{impl#1}::write_with_reply", "Breakpoint 2", "main + "]
    {
        let at = output.find(words).unwrap_or_else(|| panic!("{words:?} is missing:\n{said}"));
        output = &output[at + words.len()..];
    }
    assert!(output.contains("detached"), "{said}");
    // The host's own time goes on while the board is halted, so the host may have given up.
    assert!(desk.bench.is_bootloader(NODE), "{coflash}\n{said}");
}
