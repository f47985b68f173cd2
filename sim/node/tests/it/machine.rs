//! A machine of three types of nodes on one bus, updated by one package (`docs/machine-package.md`).

use std::process::Command;

use serde_json::Value;

use crate::bus::{program, Coflash, Folder, Nodes};

/// The recipe: the panel first, then the drives, then the valves.
const RECIPE: &str = r#"
name = "Press 4"
board = "stm32f407g-disc1"

[[program]]
image = "panel.bin"
nodes = [1]
vendor = 0x3F
product = 3

[[program]]
image = "drive.bin"
vendor = 0x3F
product = 1
count = 4

[[program]]
image = "valve.bin"
nodes = [21, 22, 23]
"#;

pub fn folder(test: &str) -> Folder {
    let folder = Folder::new(test);
    for (name, fill) in [("panel.bin", 1), ("drive.bin", 2), ("valve.bin", 3), ("older.bin", 4)] {
        folder.write(name, &program(fill, 40 * 1024));
    }
    folder.write("machine.toml", RECIPE.as_bytes());
    folder
}

pub const PANEL: &[&str] =
    &["--node", "1", "--vendor-id", "0x3F", "--product-code", "3", "--flash", "instant", "--stand-in"];

/// A node that the package does not name.
pub const STRANGER: &[&str] = &["--node", "77", "--serial", "77", "--vendor-id", "9", "--product-code", "9"];

/// So many drives, from this node-ID on.
pub fn drives(node: &'static str, count: &'static str) -> Vec<&'static str> {
    [&["--vendor-id", "0x3F", "--product-code", "1"], &valves(node, count)[..]].concat()
}

/// The same with flashes that take their time.
pub fn slow_drives(node: &'static str) -> Vec<&'static str> {
    drives(node, "4").into_iter().filter(|word| !["--flash", "instant"].contains(word)).collect()
}

pub fn valves(node: &'static str, count: &'static str) -> Vec<&'static str> {
    vec!["--node", node, "--serial", node, "--count", count, "--flash", "instant", "--stand-in"]
}

/// Node, program and outcome of each line of the result.
fn outcomes(document: &str) -> Vec<(u64, String, String)> {
    let value: Value = serde_json::from_str(document).unwrap_or_else(|error| panic!("{error}: {document}"));
    let text = |value: &Value| value.as_str().unwrap_or_default().to_owned();
    let of = |device: &Value| {
        let state = match device["error"]["number"].as_str() {
            Some(number) => number.to_owned(),
            None => text(&device["state"]),
        };
        (device["node"].as_u64().unwrap_or(0), text(&device["program"]), state)
    };
    value["devices"].as_array().unwrap().iter().map(of).collect()
}

/// Eight nodes and a stranger: nothing without a confirmation, then each device its program, and then nothing
/// more to do. A valve with another program in between gets its own again; a missing drive is said.
#[test]
fn eight_nodes_of_three_types_are_updated_by_one_package() {
    let folder = folder("machine");
    let panel = Nodes::start(&folder, PANEL);
    let url = panel.url().to_owned();
    let three = Nodes::join(&folder, &url, &drives("11", "4"));
    let _valves = Nodes::join(&folder, &url, &valves("21", "3"));
    let _stranger = Nodes::join(&folder, &url, STRANGER);
    for node in ["11", "12", "13", "14"] {
        three.await_line(&format!("serial {node}, node {node}: bootloader"));
    }
    let coflash = Coflash::new(&folder, &panel);
    coflash.done(&["package", "machine.toml"]);
    assert!(coflash
        .done(&["inspect", "machine.cpk"])
        .contains("for vendor 0000003Fh, product 00000001h, 4 devices"));

    let flash = ["flash", "machine.cpk"];
    let refused = coflash.run(&flash);
    assert_eq!(refused.exit, 2, "{}", refused.err);
    assert!(
        refused.err.contains("nobody can confirm the plan here, and nothing was changed"),
        "{}",
        refused.err
    );
    assert!(refused.out.contains("node 12: drive: no program -> CRC "), "{}", refused.out);
    assert!(refused.out.contains("node 77: not in the package, and left alone"), "{}", refused.out);
    let nodes = [1, 11, 12, 13, 14, 21, 22, 23];
    let names = ["panel", "drive", "drive", "drive", "drive", "valve", "valve", "valve"];
    let all = |state: &str| {
        let each = nodes.iter().zip(names);
        each.map(|(node, name)| (*node, name.to_owned(), state.to_owned())).collect::<Vec<_>>()
    };
    let yes = [&flash[..], &["--yes", "--json"]].concat();
    let done = coflash.run(&yes);
    assert_eq!((done.exit, outcomes(&done.out)), (0, all("updated")), "{}", done.err);
    let again = coflash.run(&yes);
    assert_eq!((again.exit, outcomes(&again.out)), (0, all("had")), "{}", again.err);
    let value: Value = serde_json::from_str(&again.out).unwrap();
    assert_eq!((&value["foreign"][0]["node"], value["foreign"].as_array().unwrap().len()), (&77.into(), 1));
    // Without anything to confirm nobody is asked.
    assert_eq!(coflash.run(&flash).exit, 0);

    // A valve with another program.
    let older = ["flash", "older.bin", "-I", "binary", "--board", "stm32f407g-disc1", "--node", "22"];
    coflash.done(&older);
    let done = coflash.run(&yes);
    let mut one = all("had");
    one[6].2 = "updated".to_owned();
    assert_eq!((done.exit, outcomes(&done.out)), (0, one), "{}", done.err);

    // Three drives in place of four.
    drop(three);
    let fewer = Nodes::join(&folder, &url, &drives("11", "3"));
    fewer.await_line("serial 13, node 13: would start program 1");
    let done = coflash.run(&[&yes[..], &["--report", "report.json"]].concat());
    assert_eq!(done.exit, 8, "{}{}", done.out, done.err);
    let report: Value = serde_json::from_slice(&folder.read("report.json")).unwrap();
    assert_eq!(report, serde_json::from_str::<Value>(&done.out).unwrap());
    let some = [
        (1, "panel", "had"),
        (0, "drive", "0x6000040a"),
        (11, "drive", "had"),
        (12, "drive", "had"),
        (13, "drive", "had"),
        (21, "valve", "had"),
        (22, "valve", "had"),
        (23, "valve", "had"),
    ];
    let some = some.map(|(node, program, state)| (node, program.to_owned(), state.to_owned()));
    assert_eq!(outcomes(&done.out), some);
}

/// A wrong bus or bit rate is no success.
#[test]
fn a_bus_without_any_device_of_the_package_is_an_error() {
    let folder = folder("machine-none");
    let nodes = Nodes::start(&folder, STRANGER);
    let recipe =
        b"board = 'stm32f407g-disc1'\n[[program]]\nimage = 'drive.bin'\nvendor = 0x3F\nproduct = 1\n";
    folder.write("line.toml", recipe);
    let coflash = Coflash::new(&folder, &nodes);
    coflash.done(&["package", "line.toml"]);
    let done = coflash.run(&["flash", "line.cpk", "--yes"]);
    assert_eq!(done.exit, 5, "{}{}", done.out, done.err);
    assert!(done.err.contains("no device on the bus is one that the package is for"), "{}", done.err);
    let json = coflash.run(&["flash", "line.cpk", "--yes", "--json"]);
    let value: Value = serde_json::from_str(&json.out).unwrap();
    assert_eq!((json.exit, &value["error"]["exit"]), (5, &5.into()));
}

/// Once the tool is killed, once it gets Ctrl-C, and once a device loses its power, each in the middle of the
/// drives. The next run goes on: the panel is not written again, and all end with their programs.
#[cfg(unix)]
#[test]
fn an_interrupted_update_goes_on_with_the_next_run() {
    let folder = folder("machine-interrupted");
    let panel = Nodes::start(&folder, PANEL);
    let url = panel.url().to_owned();
    let mut four = Some(Nodes::join(&folder, &url, &slow_drives("11")));
    let valves = Nodes::join(&folder, &url, &valves("21", "3"));
    four.as_ref().unwrap().await_line("serial 14, node 14: bootloader");
    valves.await_line("serial 23, node 23: bootloader");
    let coflash = Coflash::new(&folder, &panel);
    coflash.done(&["package", "machine.toml"]);
    let yes = ["flash", "machine.cpk", "--yes"];
    let json = ["flash", "machine.cpk", "--yes", "--json"];

    let running = coflash.spawn(&yes);
    running.await_text("node 11: receiving the program together");
    // The first bytes after the vectors, so that each drive has half a program.
    folder.await_bytes("11.flash", 0x2_0000);
    drop(running);

    let running = coflash.spawn(&yes);
    running.await_text("node 1: panel: it has CRC ");
    running.await_text("node 12: receiving the program together");
    let id = running.id().to_string();
    assert!(Command::new("kill").args(["-INT", &id]).status().unwrap().success());
    let done = running.wait();
    assert_eq!(done.exit, 130, "{}{}", done.out, done.err);
    assert!(done.out.contains("node 1: panel: it had this program"), "{}", done.out);
    assert!(done.out.contains("node 13: drive: error: cancelled"), "{}", done.out);
    assert!(done.out.contains("node 21: valve: error: cancelled"), "{}", done.out);

    let running = coflash.spawn(&[&yes[..], &["--report", "report.json"]].concat());
    running.await_text("node 14: receiving the program together");
    drop(four.take());
    let done = running.wait();
    assert_eq!(done.exit, 8, "{}{}", done.out, done.err);
    let states = outcomes(&String::from_utf8(folder.read("report.json")).unwrap());
    assert_eq!(states[0], (1, "panel".to_owned(), "had".to_owned()));
    assert!(
        states[1..5].iter().all(|(_, name, state)| name == "drive" && state == "0x60000013"),
        "{states:?}"
    );
    assert!(states[5..].iter().all(|(_, name, state)| name == "valve" && state == "updated"), "{states:?}");

    let four = Nodes::join(&folder, &url, &drives("11", "4"));
    four.await_line("serial 14, node 14: bootloader");
    let done = coflash.run(&json);
    assert_eq!(done.exit, 0, "{}{}", done.out, done.err);
    let states: Vec<String> = outcomes(&done.out).into_iter().map(|(.., state)| state).collect();
    assert_eq!(states, ["had", "updated", "updated", "updated", "updated", "had", "had", "had"]);
}
