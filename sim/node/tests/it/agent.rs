//! coflash's agent from end to end: a server, the agent, and nodes on a bus, each over a real
//! socket.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::Duration;

use crate::bus::{self, Coflash, Folder, Nodes};
use crate::machine;
use coboot_can::Link;
use coflash_agent::{run, Buses, Config, Ended, Message, Options, Times};
use kit::hawkbit::{Action, File, Server};

const IDS: [&str; 3] = ["door-1", "door-2", "door-3"];

/// A program with this byte in it, as a raw image.
fn program(byte: u8) -> Vec<u8> {
    bus::program(byte, 40 * 1024)
}

fn file(byte: u8) -> File {
    File::new("program.bin", &program(byte))
}

/// The configuration for these devices on a bus: nodes 5, 6 and 7.
fn config(server: &Server, bus: &str, folder: &Folder, ids: &[&str]) -> Config {
    let mut text =
        format!("bus = '{bus}'\nboard = 'stm32f407g-disc1'\ngateway-token-file = 'token'\npoll-least = 1\n");
    folder.write("token", b"g\n");
    for (number, id) in ids.iter().enumerate() {
        text += &format!("[[device]]\ncontroller-id = '{id}'\nnode = {}\n", number + 5);
    }
    let path = folder.path("agent.toml");
    Config::parse(&text, path.parent().unwrap_or(Path::new("")), Some(&server.url), None).unwrap()
}

pub fn options() -> Options {
    let ms = Duration::from_millis;
    Options::default()
        .once(true)
        .times(Times::default().backoff_first(ms(50)).backoff_most(ms(200)).progress(ms(1)))
}

pub fn serve(config: &Config, options: &Options) -> (Ended, String) {
    let said = Mutex::new(String::new());
    let show = |message: &Message| {
        *said.lock().unwrap() += &format!("{}: {}\n", message.controller, message.text);
    };
    let open = |url: &str| Link::open(url, None).map_err(|error| error.to_string());
    let buses = Buses::new(&open, options.cancelled.clone());
    // A child that another test has just begun may still hold the lock of an agent that has ended.
    let mut attempts = (0..1_000).map(|_| run(config, options, &buses, &show));
    let ended = attempts.find(|ended| {
        let is_locked = ended.as_ref().is_err_and(|error| error.to_string().contains("another agent"));
        thread::sleep(Duration::from_millis(if is_locked { 10 } else { 0 }));
        !is_locked
    });
    let ended = ended.expect("the lock of an agent that has ended is free").unwrap();
    (ended, said.into_inner().unwrap())
}

/// Node 5 with these arguments, a server with an action for it, and the configuration for the two.
fn assigned(test: &str, arguments: &[&str]) -> (Folder, Nodes, Server, Config) {
    let folder = Folder::new(test);
    let nodes = Nodes::start(&folder, &[&["--node", "5", "--stand-in"], arguments].concat());
    let server = Server::start(&IDS);
    server.assign(IDS[0], Action::new(1, &file(0xA5)));
    let config = config(&server, nodes.url(), &folder, &IDS[..1]);
    (folder, nodes, server, config)
}

#[test]
fn two_devices_are_updated_and_the_third_ones_silence_is_told() {
    let folder = Folder::new("agent");
    let nodes = Nodes::start(&folder, &["--node", "5", "--count", "2", "--flash", "instant", "--stand-in"]);
    let server = Server::start(&IDS);
    for (number, id) in IDS.iter().enumerate() {
        server.assign(id, Action::new(number as u64 + 1, &file(0xA5)));
    }
    let (ended, said) = serve(&config(&server, nodes.url(), &folder, &IDS), &options());
    assert_eq!((ended.updated, ended.failed, ended.unserved), (2, 1, 0), "{said}");
    for id in &IDS[..2] {
        let action = server.action(id);
        assert_eq!(action.result.as_deref(), Some("success"), "{action:?}");
        assert!(action.details("proceeding").contains("erase the old program"), "{action:?}");
        assert!(action.details("closed").contains("done in"), "{action:?}");
        assert_eq!(server.state().targets[*id].attributes["program_1_crc"].as_str().unwrap().len(), 9);
    }
    let action = server.action(IDS[2]);
    assert_eq!(action.result.as_deref(), Some("failure"));
    let details = action.details("closed");
    assert!(
        details.contains("node 7 does not answer") && details.contains("it was not changed"),
        "{details}"
    );
    assert!(details.contains("what to do: "), "{details}");
    // What is in the flash is the file, byte for byte.
    for serial in ["1.flash", "2.flash"] {
        let flash = folder.read(serial);
        assert!(flash[0x2_0000..0x2_0000 + 40 * 1024] == program(0xA5), "{serial}");
    }
}

#[test]
fn what_is_no_program_changes_nothing() {
    let (folder, _nodes, server, config) = assigned("agent-lies", &["--flash", "instant"]);
    server.assign(IDS[0], Action::new(1, &File::new("program.bin", &[0; 4096])));
    let (ended, said) = serve(&config, &options());
    assert_eq!((ended.updated, ended.failed), (0, 1), "{said}");
    assert!(folder.read("1.flash") == vec![0xFF; 1 << 20], "it was changed");
    let action = server.action(IDS[0]);
    assert!(action.details("closed").contains("what to do"), "{action:?}");
    // What 2007h says, in the words of `coflash info`.
    let stays = server.state().targets[IDS[0]].attributes.get("stays").cloned();
    assert_eq!(stays, Some("it has no program".into()));
}

/// Ends the agent when `act` has ended.
fn while_it_runs(config: &Config, act: impl FnOnce()) {
    let cancelled = Arc::new(AtomicBool::new(false));
    let endless = options().once(false).cancelled(cancelled.clone());
    thread::scope(|scope| {
        let agent = scope.spawn(|| serve(config, &endless));
        act();
        cancelled.store(true, Ordering::Relaxed);
        agent.join().unwrap();
    });
}

/// Waits until the action of the first target has a result.
fn await_result(server: &Server) {
    server.wait("the end", |state| {
        state.targets[IDS[0]].action.as_ref().is_some_and(|action| action.result.is_some())
    });
}

/// The state file of the first device.
fn record(folder: &Folder) -> std::path::PathBuf {
    let state = std::fs::read_dir(folder.path("agent-state")).unwrap().flatten().map(|entry| entry.path());
    let is_record = |path: &std::path::PathBuf| {
        path.to_string_lossy().contains("door-1-") && path.extension().is_some_and(|end| end == "json")
    };
    state.into_iter().find(is_record).unwrap()
}

/// Leaves the state of an agent that died between the end of action 1 and its report.
fn leave_begun(record: &std::path::Path, kept: bool) {
    let mut value: serde_json::Value = serde_json::from_slice(&std::fs::read(record).unwrap()).unwrap();
    value["ended"] = serde_json::json!([]);
    value["begun"] = serde_json::json!({ "action": "1", "kept": kept });
    std::fs::write(record, value.to_string()).unwrap();
}

/// The agent died between the end of the update and the report: its state is that of a moment
/// before. A device that runs the program is not flashed again.
#[test]
fn a_device_that_has_kept_the_program_is_not_flashed_again() {
    let (folder, _nodes, server, config) = assigned("agent-kept", &["--flash", "instant"]);
    assert_eq!(serve(&config, &options()).0.updated, 1);
    let record = record(&folder);
    for (kept, byte, starts) in [(true, 0xA5, 0), (false, 0xA5, 1), (true, 0x5A, 1)] {
        leave_begun(&record, kept);
        server.assign(IDS[0], Action::new(1, &file(byte)));
        let (ended, said) = serve(&config, &options());
        assert_eq!(ended.updated, 1, "{said}");
        let erased = said.matches("erase the old program").count();
        assert_eq!(erased, starts, "{kept} {byte:X}: {said}");
        assert_eq!(server.action(IDS[0]).result.as_deref(), Some("success"));
        assert!(folder.read("1.flash")[0x2_0100] == byte);
    }
}

/// The same for a product with CRC-16 and a file that has none: the device tells the CRC of its own.
#[test]
fn a_program_that_was_kept_is_known_by_a_crc_16_too() {
    let product = ["--flash", "instant", "--profile", "esacademy", "--crc16"];
    let (folder, _nodes, server, config) = assigned("agent-kept-crc-16", &product);
    assert_eq!(serve(&config, &options()).0.updated, 1);
    let record = record(&folder);
    leave_begun(&record, true);
    server.assign(IDS[0], Action::new(1, &file(0xA5)));
    let (ended, said) = serve(&config, &options());
    assert_eq!(ended.updated, 1, "{said}");
    let action = server.action(IDS[0]);
    assert!(action.details("closed").contains("since before the agent was restarted"), "{action:?}");
}

/// The device is silent: the agent has not changed it, and cannot say so of one with which an earlier agent has begun.
#[test]
fn what_an_earlier_agent_has_begun_is_not_said_to_be_unchanged() {
    let folder = Folder::new("agent-begun");
    let (nodes, server) = (Nodes::start(&folder, machine::STRANGER), Server::start(&IDS));
    let config = config(&server, nodes.url(), &folder, &IDS[..1]);
    for words in
        ["it was not changed", "it does not answer; last known: an earlier attempt has begun with it"]
    {
        server.assign(IDS[0], Action::new(1, &file(0xA5)));
        serve(&config, &options());
        let details = server.action(IDS[0]).details("closed");
        assert!(details.contains(words), "{details}");
        leave_begun(&record(&folder), false);
    }
}

#[test]
fn a_bus_that_is_not_there_is_waited_for() {
    let folder = Folder::new("agent-bus");
    let server = Server::start(&IDS);
    server.assign(IDS[0], Action::new(1, &file(0xA5)));
    // A port that nobody serves.
    let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let url = format!("socketcand://127.0.0.1:{port}/can0");
    let config = config(&server, &url, &folder, &IDS[..1]);
    while_it_runs(&config, || {
        let waits = |state: &kit::hawkbit::State| {
            let action = state.targets[IDS[0]].action.as_ref();
            action.is_some_and(|action| action.details("proceeding").contains("the update waits"))
        };
        server.wait("a message", waits);
        let listen = format!("127.0.0.1:{port}");
        let arguments = ["--listen", &listen, "--node", "5", "--flash", "instant", "--stand-in"];
        let _node = crate::bus::node(&folder, &arguments);
        await_result(&server);
    });
    assert_eq!(server.action(IDS[0]).result.as_deref(), Some("success"));
}

/// A folder with the signed package of the machine, and the configuration of an agent for it.
fn of_machine(
    test: &str,
    server: &Server,
    first: &dyn Fn(&Folder) -> Nodes,
) -> (Folder, Nodes, Config, File) {
    let folder = machine::folder(test);
    let nodes = first(&folder);
    let coflash = Coflash::new(&folder, &nodes);
    coflash.done(&["seal", "keys", "new", "--role", "root", "-o", "root.pem"]);
    coflash.done(&["package", "machine.toml", "--key", "root.pem"]);
    folder.write("token", b"g\n");
    let text = format!(
        "gateway-token-file = 'token'\npoll-least = 1\n[[machine]]\ncontroller-id = '{}'\nbus = '{}'\ntrust = ['root.pub']\n",
        IDS[0],
        nodes.url()
    );
    let path = folder.path("agent.toml");
    let config = Config::parse(&text, path.parent().unwrap(), Some(&server.url), None).unwrap();
    let file = File::new("machine.cpk", &folder.read("machine.cpk"));
    (folder, nodes, config, file)
}

/// Eight nodes of three types, and a stranger: each gets its program, then none a second time. A valve that is
/// absent is a failure with its name, and the others are as before.
#[test]
fn a_machine_is_updated_by_one_package_and_each_outcome_is_told() {
    let server = Server::start(&IDS);
    let start = |folder: &Folder| Nodes::start(folder, machine::PANEL);
    let (folder, panel, config, file) = of_machine("agent-machine", &server, &start);
    let drives = Nodes::join(&folder, panel.url(), &machine::drives("11", "4"));
    let valves = Nodes::join(&folder, panel.url(), &machine::valves("21", "3"));
    let _stranger = Nodes::join(&folder, panel.url(), machine::STRANGER);
    drives.await_line("serial 14, node 14: bootloader");
    valves.await_line("serial 23, node 23: bootloader");
    for (number, what) in [(1, "updated"), (2, "had it before")] {
        server.assign(IDS[0], Action::new(number, &file));
        let (ended, said) = serve(&config, &options());
        assert_eq!((ended.updated, ended.failed), (1, 0), "{said}");
        let action = server.action(IDS[0]);
        assert_eq!(action.result.as_deref(), Some("success"), "{action:?}");
        let details = action.details("closed");
        assert!(details.contains("8 of 8 programs are in their devices"), "{details}");
        for program in ["panel: {}: node 1", "drive: {}: node 11, 12, 13, 14", "valve: {}: node 21, 22, 23"] {
            let line = program.replace("{}", what);
            assert!(details.lines().any(|shown| shown == line), "{line}: {details}");
        }
        let plan = action.details("proceeding");
        assert!(number == 2 || plan.contains("node 77: not in the package, and left alone"), "{plan}");
    }
    // What is in the flash is the file of each, byte for byte.
    for (serial, program) in [("1", "panel.bin"), ("13", "drive.bin"), ("22", "valve.bin")] {
        let flash = folder.read(&format!("{serial}.flash"));
        assert!(flash[0x2_0000..0x2_0000 + 40 * 1024] == folder.read(program), "{serial}");
    }
    assert!(folder.read("77.flash").iter().all(|byte| *byte == 0xFF), "the stranger was changed");
    drop(valves);
    let two = Nodes::join(&folder, panel.url(), &machine::valves("21", "2"));
    two.await_line("serial 22, node 22: would start program 1");
    server.assign(IDS[0], Action::new(3, &file));
    let (ended, said) = serve(&config, &options());
    assert_eq!((ended.updated, ended.failed), (0, 1), "{said}");
    let action = server.action(IDS[0]);
    assert_eq!(action.result.as_deref(), Some("failure"));
    let details = action.details("closed");
    for words in [
        "7 of 8 programs are in their devices",
        "node 23: valve: node 23 is not on the bus [0x60000013]; what to do: ",
        "valve: had it before: node 21, 22",
    ] {
        assert!(details.contains(words), "{words}: {details}");
    }
    // Nothing is written by this action: its plan is told nevertheless.
    let plan = action.details("proceeding");
    assert!(plan.contains("node 77: not in the package, and left alone"), "{plan}");
}

/// Checks the result of the first target's action, and that its details have these lines, or lines with these
/// beginnings and these numbers of errors.
#[track_caller]
fn assert_ended(server: &Server, result: &str, lines: &[&str], errors: &[(&str, &str)]) {
    let action = server.action(IDS[0]);
    let details = action.details("closed");
    assert_eq!(action.result.as_deref(), Some(result), "{details}");
    for line in lines {
        assert!(details.lines().any(|shown| shown == *line), "{line}: {details}");
    }
    for (whom, number) in errors {
        let is_it = |line: &str| line.starts_with(&format!("{whom}: ")) && line.contains(number);
        assert!(details.lines().any(is_it), "{whom}, {number}: {details}");
    }
    assert_eq!(details.matches("what to do: ").count(), errors.len(), "{details}");
}

/// The panel, and drives that take their time, each in its bootloader.
fn panel_and_drives(folder: &Folder, url: &str) -> (Nodes, Nodes) {
    let panel = Nodes::join(folder, url, machine::PANEL);
    let drives = Nodes::join(folder, url, &machine::slow_drives("11"));
    drives.await_line("serial 14, node 14: bootloader");
    panel.await_line("serial 1, node 1: bootloader");
    (panel, drives)
}

/// The adapter loses its plug in mid-update, and comes back: each device's outcome is told, and the next action goes
/// on, without the panel.
#[test]
fn an_adapter_that_is_unplugged_in_mid_update_costs_the_next_action_only_the_rest() {
    let server = Server::start(&IDS);
    let start = |folder: &Folder| Nodes::start(folder, &machine::valves("21", "3"));
    let (folder, bus, config, file) = of_machine("agent-machine-adapter", &server, &start);
    let (url, address) = (bus.url().to_owned(), bus.address().to_owned());
    let (panel, drives) = panel_and_drives(&folder, &url);
    server.assign(IDS[0], Action::new(1, &file));
    while_it_runs(&config, || {
        folder.await_bytes("11.flash", 0x2_0000);
        drop((bus, panel, drives));
        await_result(&server);
    });
    let whom = [11, 12, 13, 14].map(|node| format!("node {node}: drive"));
    let whom = whom.into_iter().chain([21, 22, 23].map(|node| format!("node {node}: valve")));
    let lost: Vec<_> = whom.collect();
    let lost: Vec<_> = lost.iter().map(|whom| (whom.as_str(), "[0x60000303]")).collect();
    let one = ["1 of 8 programs are in their devices", "panel: updated: node 1"];
    assert_ended(&server, "failure", &one, &lost);

    let again = [&["--listen", address.as_str()][..], &machine::valves("21", "3")].concat();
    let again = crate::bus::node(&folder, &again);
    again.await_text("bus: ");
    let panel = Nodes::join(&folder, &url, machine::PANEL);
    let drives = Nodes::join(&folder, &url, &machine::drives("11", "4"));
    drives.await_line("serial 14, node 14: bootloader");
    panel.await_line("serial 1, node 1: would start program 1");
    server.assign(IDS[0], Action::new(2, &file));
    serve(&config, &options());
    let all = [
        "8 of 8 programs are in their devices",
        "panel: had it before: node 1",
        "drive: updated: node 11, 12, 13, 14",
        "valve: updated: node 21, 22, 23",
    ];
    assert_ended(&server, "success", &all, &[]);
}
