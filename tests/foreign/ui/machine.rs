//! One machine of eight boards, updated with packages by the command line, by the page of a service station and by an
//! agent. One board is sealed, and two run applications in C.

use std::process::Output;

use canopen::BitRate;
use coboot_tests::bench::Bench;
use coboot_tests::endpoint::Endpoint;
use coboot_tests::firmware;
use coboot_tests::sealed_board::{provision, release, sealer, COUNTER};
use coboot_tests::tools;
use coflash_core::update::{flash, FlashOptions};
use kit::hawkbit::{Action, File, Server};
use serde_json::Value;

use super::{check, script};

const SEALED: u8 = 1;
const IN_C: [u8; 2] = [2, 3];
const DRIVES: [u8; 5] = [4, 5, 6, 7, 8];
/// A node that the packages do not name.
const STRANGER: u8 = 77;

const RECIPE: &str = "
name = 'Press 4'
board = 'stm32f407g-disc1'
[[program]]
image = 'SET-safety.sealed'
nodes = [1]
[[program]]
image = 'SET-panel.elf'
nodes = [2, 3]
[[program]]
image = 'SET-drive.elf'
nodes = [4, 5, 6, 7, 8]
";

/// The programs of a package, and the security counter of the sealed one.
struct Set {
    name: &'static str,
    counter: u32,
    safety: &'static str,
    panel: &'static str,
    drive: &'static str,
}

const OLD: Set = Set {
    name: "old",
    counter: COUNTER,
    safety: firmware::APP_V1,
    panel: firmware::APP_C,
    drive: firmware::APP_V1,
};
const NEW: Set = Set {
    name: "new",
    counter: COUNTER + 1,
    safety: firmware::APP_V2,
    panel: firmware::APP_C_PROBE,
    drive: firmware::APP_V2,
};

/// The boards, and the files of the tool, in a folder.
struct Machine {
    endpoint: Endpoint,
    folder: kit::folder::Folder,
}

impl Machine {
    fn new() -> Self {
        let mut bench = Bench::of_boards(9);
        let nodes = [SEALED].into_iter().chain(IN_C).chain(DRIVES).chain([STRANGER]);
        for (board, node) in bench.boards().into_iter().zip(nodes) {
            bench.commission(board, node, BitRate::K1000);
        }
        let first = bench.boards()[0];
        bench.world.machine_mut(first).load(&firmware::elf(firmware::BOOTLOADER_SEALED)).unwrap();
        provision(&mut bench);
        bench.set_host_bit_rate(1_000_000);
        bench.power_on();
        bench.run_ms(200);
        Self { endpoint: Endpoint::new(bench), folder: kit::folder!("ui-machine") }
    }

    /// Runs coflash on the bus, while the boards run.
    fn coflash(&mut self, words: &[&str]) -> Output {
        let mut command = tools::coflash();
        command.args(["--bus", &self.endpoint.url()]).args(words).current_dir(&*self.folder);
        self.endpoint.run(&mut command)
    }

    #[track_caller]
    fn done(&mut self, words: &[&str]) {
        let output = self.coflash(words);
        assert!(output.status.success(), "{words:?}: {}", String::from_utf8_lossy(&output.stderr));
    }

    /// Makes the signed package of these programs.
    fn package(&mut self, set: &Set) {
        let safety = sealer(set.counter).seal(&firmware::raw(set.safety), &release()).unwrap();
        self.folder.write(format!("{}-safety.sealed", set.name), &safety);
        self.folder.write(format!("{}-panel.elf", set.name), firmware::elf(set.panel));
        self.folder.write(format!("{}-drive.elf", set.name), firmware::elf(set.drive));
        let recipe = format!("{}.toml", set.name);
        self.folder.write(&recipe, RECIPE.replace("SET", set.name).as_bytes());
        self.done(&["package", &recipe, "--key", "root.pem"]);
    }

    /// `coflash flash` of a package: the exit code, and the outcome of each node.
    fn flash(&mut self, package: &str) -> (Option<i32>, Vec<(u64, String)>) {
        let output = self.coflash(&["flash", package, "--yes", "--json"]);
        let said = String::from_utf8_lossy(&output.stderr);
        let report: Value =
            serde_json::from_slice(&output.stdout).unwrap_or_else(|error| panic!("{error}: {said}"));
        let outcome = |device: &Value| {
            let state = device["error"]["number"].as_str().or(device["state"].as_str());
            (device["node"].as_u64().unwrap_or(0), state.unwrap_or_default().to_owned())
        };
        let mut outcomes: Vec<_> = report["devices"].as_array().unwrap().iter().map(outcome).collect();
        outcomes.sort();
        (output.status.code(), outcomes)
    }

    /// Checks that each board has its program of this set, byte for byte, and runs it; and that the stranger has none.
    fn assert_has(&mut self, set: &Set) {
        let bench = &mut self.endpoint.bench;
        bench.run_ms(500);
        let boards = bench.boards();
        let nodes = [SEALED].into_iter().chain(IN_C).chain(DRIVES);
        for (board, node) in boards.iter().zip(nodes) {
            let image = match node {
                SEALED => set.safety,
                2 | 3 => set.panel,
                _ => set.drive,
            };
            let image = firmware::raw(image);
            let program = &bench.world.machine_mut(*board).flash()[firmware::program_offset()..];
            assert!(
                program[..image.len()] == image[..],
                "node {node} has another program than in {}",
                set.name
            );
            assert!(!bench.is_bootloader(node), "node {node} runs its program");
        }
        let stranger = bench.world.machine_mut(boards[8]);
        assert!(stranger.flash()[firmware::program_offset()..].iter().all(|byte| *byte == 0xFF));
    }
}

fn all_but(absent: Option<u8>, state: &str) -> Vec<(u64, String)> {
    let number = |node| if Some(node) == absent { "0x60000013" } else { state };
    (1..=8).map(|node| (u64::from(node), number(node).to_owned())).collect()
}

#[test]
fn a_sealed_device_programs_in_c_and_in_rust_are_updated_by_command_line_page_and_agent() {
    let mut machine = Machine::new();
    machine.done(&["seal", "keys", "new", "--role", "root", "-o", "root.pem"]);
    machine.package(&OLD);
    machine.package(&NEW);

    // The command line, first without the last drive, whose plug is pulled.
    let last = machine.endpoint.bench.boards()[7];
    machine.endpoint.bench.world.power_off(last);
    assert_eq!(machine.flash("old.cpk"), (Some(8), all_but(Some(8), "updated")));
    machine.endpoint.bench.world.power_on(last);
    machine.endpoint.bench.run_ms(200);
    let mut outcomes = all_but(None, "had");
    outcomes[7].1 = "updated".to_owned();
    assert_eq!(machine.flash("old.cpk"), (Some(0), outcomes));
    machine.assert_has(&OLD);

    // The page of a service station.
    let (mut command, _folder) = script("service_machine");
    command.args(["--bus", &machine.endpoint.url(), "--image"]).arg(machine.folder.join("new.cpk"));
    let output = machine.endpoint.run(&mut command);
    check("service_machine", &output);
    machine.assert_has(&NEW);

    // The agent, after two nodes have got other programs in between.
    for (node, old) in [(IN_C[0], OLD.panel), (DRIVES[1], OLD.drive)] {
        let mut session = machine.endpoint.bench.session_with(node);
        flash(&mut session, firmware::blocks(old), &FlashOptions::default(), &mut |_| {}).unwrap();
    }
    let server = Server::start(&["press-4"]);
    let package = std::fs::read(machine.folder.join("new.cpk")).unwrap();
    server.assign("press-4", Action::new(1, &File::new("new.cpk", &package)));
    machine.folder.write("token", b"g\n");
    let bus = machine.endpoint.url();
    let agent = format!(
        "gateway-token-file = 'token'\npoll-least = 1\n[[machine]]\ncontroller-id = 'press-4'\nbus = '{bus}'\n\
         trust = ['root.pub']\n"
    );
    machine.folder.write("agent.toml", agent.as_bytes());
    machine.done(&["agent", "--once", "--hawkbit", &server.url]);
    let action = server.action("press-4");
    assert_eq!(action.result.as_deref(), Some("success"), "{action:?}");
    let details = action.details("closed");
    for line in [
        "8 of 8 programs are in their devices",
        "new-safety: had it before: node 1",
        "new-panel: updated: node 2",
        "new-panel: had it before: node 3",
        "new-drive: updated: node 5",
        "new-drive: had it before: node 4, 6, 7, 8",
    ] {
        assert!(details.lines().any(|of_agent| of_agent == line), "{line}: {details}");
    }
    machine.assert_has(&NEW);
    machine.endpoint.bench.assert_nothing_unmodelled();
}
