//! coflash's example of a production line, against a node over a real socket.

use crate::bus::{self, Folder, Nodes};
use coflash_core::file::{ihex, read, Firmware, Format};
use serde_json::Value;
use shared_abi::layout::stm32f407g_disc1::LAYOUT;

/// A program as Intel HEX.
fn program() -> String {
    let bytes = bus::program(0xA5, 20 * 1024);
    let Ok(Firmware::Image(image)) = read(&bytes, Some(Format::Raw), Some(LAYOUT.programs[0].base)) else {
        panic!("a raw image");
    };
    ihex::emit(&image)
}

/// Runs the station; returns its exit code and its lines.
fn station(url: &str, folder: &Folder, words: &[&str]) -> (i32, Vec<Value>) {
    let file = folder.path("program.hex").display().to_string();
    let done = bus::station(folder, &[&[url, LAYOUT.board, file.as_str()], words].concat());
    let line = |line| serde_json::from_str(line).unwrap_or_else(|error| panic!("{error}: {line}"));
    (done.exit, done.out.lines().map(line).collect())
}

#[test]
fn a_fresh_device_gets_its_node_id_and_its_program() {
    let folder = Folder::new("production-line");
    folder.write("program.hex", program().as_bytes());
    let nodes =
        Nodes::start(&folder, &["--unconfigured", "--serial", "77", "--flash", "instant", "--stand-in"]);
    let (exit, lines) = station(nodes.url(), &folder, &["23", "--lss"]);
    assert_eq!(exit, 0, "{lines:?}");
    nodes.await_line("serial 77, node 23: node-ID set by LSS");
    let [events @ .., record] = lines.as_slice() else { panic!("{lines:?}") };
    let done = events.last().unwrap();
    assert_eq!((&done["event"], &done["error"]), (&"done".into(), &Value::Null), "{done}");
    assert_eq!(done["report"]["size"], 20 * 1024);
    assert!(events.iter().any(|event| event["phase"] == "verified_again"), "{events:?}");
    let device = &record["device"];
    assert_eq!((&device["node"], &device["serial_number"]), (&23.into(), &77.into()), "{device}");
    assert_eq!(
        (&device["bootloader"], &device["programs"][0]["crc"]),
        (&false.into(), &done["report"]["crc"])
    );
    // Again, now that it has its node-ID: fastscan finds no device.
    assert_eq!(station(nodes.url(), &folder, &["23", "--lss"]).0, 1);
    assert_eq!(station(nodes.url(), &folder, &["23"]).0, 0);
}

#[test]
fn the_exit_code_says_whose_turn_it_is() {
    let folder = Folder::new("production-line-bad");
    folder.write("program.hex", program().as_bytes());
    let nodes = Nodes::start(&folder, &["--node", "5", "--flash", "instant"]);
    // Without a stand-in nothing answers for the started program: a defective device.
    let (exit, lines) = station(nodes.url(), &folder, &["5"]);
    let last = lines.last().unwrap();
    assert_eq!((exit, &last["error"]["number"]), (2, &"0x60000014".into()), "{lines:?}");
    for words in [&["0"][..], &["128"], &["5", "--lss", "6"], &[]] {
        assert_eq!(station(nodes.url(), &folder, words).0, 1, "{words:?}");
    }
    let nowhere = "socketcand://127.0.0.1:1/can0";
    assert_eq!(station(nowhere, &folder, &["5"]).0, 1);
    folder.write("program.hex", b":00000001");
    let (exit, lines) = station(nodes.url(), &folder, &["5"]);
    assert_eq!(exit, 1);
    assert!(lines[0]["station"].as_str().unwrap().contains("program.hex, line 1"), "{lines:?}");
}
