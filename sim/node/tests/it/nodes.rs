//! `coboot-node` as its users run it: over real sockets, with `coflash` as the host, and with the
//! file read from outside.

use std::fs;
use std::io::{Read, Write};
use std::net::TcpStream;

use crate::bus::{self, node, Coflash, Folder, Nodes, FLASH, VECTORS};

fn program() -> Vec<u8> {
    let mut bytes: Vec<u8> = (0..300 * 1024_u32).map(|i| (i * 7 + (i >> 8) * 13) as u8).collect();
    bytes[..8].copy_from_slice(&VECTORS);
    bytes
}

/// zlib's crc32 over [`program`].
const CRC: &str = "69669422h";

/// The flash after the parameters of a device with the program at 0802_0000h.
fn flashed() -> Vec<u8> {
    let mut bytes = program();
    bytes.resize(0xE_0000, 0xFF);
    bytes
}

fn folder(test: &str) -> Folder {
    Folder::with_program(test, &program())
}

/// Nodes with these arguments in such a folder, and the host tool on their bus.
fn start(test: &str, arguments: &[&str]) -> (Folder, Nodes, Coflash) {
    bus::start(folder(test), arguments)
}

#[test]
fn the_file_holds_the_program_and_nothing_else() {
    let folder = folder("holds");
    let nodes = Nodes::start(&folder, &["--node", "5", "--flash", "instant"]);
    nodes.await_line("serial 1, node 5: bootloader (NoProgram)");
    let flash = folder.read("1.flash");
    assert_eq!(flash, vec![0xFF; 1 << 20], "erased by default");

    let coflash = Coflash::new(&folder, &nodes);
    let said = coflash.done(&[FLASH, &["-N", "5", "--no-start"]].concat());
    assert!(said.contains(&format!("verified: CRC {CRC}")), "{said}");
    assert!(said.contains("not released for autostart"), "{said}");
    coflash.done(&["more", "release", "-N", "5"]);
    let flash = folder.read("1.flash");
    assert!(flash[..0x4000].iter().all(|byte| *byte == 0xFF), "where the chip has its bootloader");
    assert!(flash[0x4000..0x8000].iter().any(|byte| *byte != 0xFF), "the parameters");
    assert!(flash[0x2_0000..] == flashed());
    assert!(coflash.done(&["info", "-N", "5"]).contains(&format!("CRC             {CRC}")));

    // The state survives: after a kill without notice, the device starts like a chip.
    drop(nodes);
    let nodes = Nodes::start(&folder, &["--node", "5"]);
    nodes.await_line("serial 1, node 5: would start program 1");
    // Without a CPU there is no answer.
    let coflash = Coflash::new(&folder, &nodes);
    assert_eq!(coflash.run(&["more", "status", "-N", "5", "--sdo-timeout", "50"]).exit, 5);
    drop(nodes);
    let nodes = Nodes::start(&folder, &["--node", "5", "--stay"]);
    nodes.await_line("serial 1, node 5: bootloader (Strap)");
    assert!(Coflash::new(&folder, &nodes).done(&["info", "-N", "5"]).contains(CRC));
    assert!(folder.read("1.flash")[0x2_0000..] == flashed());
}

/// The checks that install a program send it with the CRC of the product.
#[test]
fn conform_installs_into_a_node_with_crc_16() {
    let folder = folder("crc16-conform");
    let nodes = Nodes::start(&folder, &["--node", "7", "--flash", "instant", "--stand-in", "--crc16"]);
    let image = ["--install", "--image", "program.bin", "-I", "binary", "--board", "stm32f407g-disc1"];
    let done = Coflash::new(&folder, &nodes).run(&[&["more", "conform", "-N", "7"], &image[..]].concat());
    let updates = done.out.lines().filter(|line| line.starts_with("UPD-"));
    let bad: Vec<_> = updates.filter(|line| line.contains("FAILED")).collect();
    assert!(bad.is_empty() && done.out.contains("UPD-011   passed"), "{bad:?}\n{}", done.out);
}

#[test]
fn a_stand_in_answers_for_the_program_and_lets_itself_be_called_back() {
    let (folder, nodes, coflash) = start("stand-in", &["--node", "7", "--flash", "instant", "--stand-in"]);
    let release = ["-N", "7", "--verify", "--vid", "0", "--pid", "0", "--ver", "0x00640A01"];
    // 2007h/10: program 1 starts by itself, as the node does when it is switched on.
    assert_eq!(coflash.json(&["read", "2007/10", "-N", "7"])["number"], 0x0001_0000);
    let said = coflash.done(&[FLASH, &release].concat());
    assert!(said.contains("running: an application") && !said.contains("by itself"), "{said}");
    nodes.await_line("serial 1, node 7: would start program 1, on trial");
    nodes.await_line("serial 1, node 7: bootloader (Requested)");
    nodes.await_line("serial 1, node 7: would start program 1");
    // CiA 302-3: it runs, and 1F56h has the same value as in the bootloader.
    assert_eq!(coflash.json(&["read", "1F51/1", "-N", "7"])["number"], 1);
    assert_eq!(coflash.json(&["read", "1F56/1", "-N", "7"])["hex"], "22946669");
    // The program's version is reported, running or stopped, in the format of the manual's figure
    // 13.
    let scan = || coflash.done(&["scan", "-N", "7"]);
    assert!(scan().contains("running, CRC 69669422h, V1.10r100"), "{}", scan());
    let said = coflash.done(&["enter", "-N", "7"]);
    assert!(said.contains("the bootloader is running"), "{said}");
    assert!(scan().contains("stopped, CRC 69669422h, V1.10r100"), "{}", scan());
    // The old program does not prevent the next one.
    coflash.done(&[FLASH, &["-N", "7", "--no-start"]].concat());
    coflash.done(&["reset", "-N", "7"]);
    nodes.await_line("serial 1, node 7: bootloader (Unsigned)");
    // Data are in the file when the bus reports them as stored.
    drop(nodes);
    let nodes = Nodes::start(&folder, &["--node", "7"]);
    nodes.await_line("serial 1, node 7: bootloader (Unsigned)");
}

/// A node of a product with CRC-16: it refuses blocks with the other CRC, and gets them with its own;
/// it accepts, releases and starts the program, also after a power-off.
#[test]
fn a_node_with_crc_16_starts_its_programs() {
    // Polynomial 1021h, start 0 (CiA 301 clause 7.2.4.3.16).
    let crc = program().iter().fold(0_u32, |crc, byte| {
        (0..8).fold(crc ^ u32::from(*byte) << 8, |crc, _| {
            (if crc & 0x8000 != 0 { crc << 1 ^ 0x1021 } else { crc << 1 }) & 0xFFFF
        })
    });
    let folder = folder("crc16");
    let options = ["--node", "7", "--flash", "instant", "--stand-in", "--crc16"];
    let nodes = Nodes::start(&folder, &options);
    let coflash = Coflash::new(&folder, &nodes);
    // Blocks with the other CRC arrive whole and cannot be right: the cable is not to blame.
    let refused = coflash.run(&[FLASH, &["-N", "7", "--block-repeats", "0"]].concat());
    assert_eq!(refused.exit, 6, "{}", refused.err);
    assert!(refused.err.contains("--crc16") && !refused.err.contains("terminators"), "{}", refused.err);
    // Of a program without blocks the device computes its own CRC.
    for dialect in ["raw", "hex"] {
        let said = coflash.done(&[FLASH, &["-N", "7", "--dialect", dialect, "--verify"]].concat());
        assert!(said.contains(&format!("verified: CRC {crc:08X}h")), "{said}");
    }
    for crc16 in [&[][..], &["--crc16"]] {
        let said = coflash.done(&[FLASH, &["-N", "7", "--verify"], crc16].concat());
        assert_eq!(said.contains("the device checks with CRC-16"), crc16.is_empty(), "{said}");
        assert!(said.contains(&format!("verified: CRC {crc:08X}h")), "{said}");
    }
    nodes.await_line("serial 1, node 7: would start program 1");
    assert_eq!(coflash.json(&["read", "1F56/1", "-N", "7"])["number"], crc);
    drop(nodes);
    let nodes = Nodes::start(&folder, &options);
    nodes.await_line("serial 1, node 7: would start program 1");
}

/// The same file goes on where the device's power was cut; with `--from-start` it does not; another
/// file begins at its start.
#[test]
fn a_download_goes_on_where_the_power_was_cut() {
    let folder = folder("goes-on");
    let identity = ["-N", "8", "--no-start", "--vid", "0", "--pid", "0"];
    let flash = [FLASH, &identity].concat();
    let options = ["--node", "8"];
    // Progress is stored after each sixteenth of the program: that of 200 KiB stands for 187.5.
    let cut = || {
        let nodes = Nodes::start(&folder, &options);
        let flashing = Coflash::new(&folder, &nodes).spawn(&flash);
        folder.await_bytes("1.flash", 0x2_0000 + 200 * 1024);
        drop(nodes);
        assert_eq!(flashing.wait().exit, 4, "the adapter is gone");
        Nodes::start(&folder, &options)
    };
    let nodes = cut();
    let coflash = Coflash::new(&folder, &nodes);
    let begun = coflash.json(&["read", "2006/1", "-N", "8"]);
    assert_ne!(begun["hex"], "0000000000000000");
    let said = coflash.done(&flash);
    let (_, has) =
        said.split_once("going on with a download that was cut off: the device has ").expect(&said);
    let has: usize = has.split(' ').next().unwrap().parse().unwrap();
    // How much more has arrived before the node was gone is a matter of the machine; what the tool says
    // is what the device said: the address in the upper four bytes of 2006h, less the program's.
    let bytes = begun["hex"].as_str().unwrap();
    let address = u32::from_str_radix(&bytes[8..], 16).unwrap().swap_bytes();
    assert_eq!(has, address as usize - 0x0802_0000);
    assert!((180 * 1024..program().len()).contains(&has), "{has}");
    assert!(said.contains(&format!("verified: CRC {CRC}")), "{said}");
    assert!(folder.read("1.flash")[0x2_0000..] == flashed());
    drop(nodes);

    // A file that does not fit into the flash's data any more.
    fs::write(folder.path("1.flash"), vec![0xFF; 1 << 20]).unwrap();
    let nodes = cut();
    let coflash = Coflash::new(&folder, &nodes);
    let said = coflash.done(&[&flash[..], &["--from-start"]].concat());
    assert!(!said.contains("going on"), "{said}");
    assert!(said.contains(&format!("verified: CRC {CRC}")), "{said}");
    drop(nodes);
}

#[test]
fn nodes_are_commissioned_by_layer_setting_services() {
    let folder = folder("lss");
    let start = |folder: &Folder| {
        Nodes::start(
            folder,
            &["--unconfigured", "--count", "2", "--serial", "77", "--product-code", "0x1234"],
        )
    };
    let nodes = start(&folder);
    nodes.await_line("serial 77, no node-ID: bootloader (NodeId)");
    let coflash = Coflash::new(&folder, &nodes);
    let said = coflash.done(&["lss", "fastscan", "--assign", "40", "--store", "--lss-timeout", "60"]);
    assert!(said.contains("40") && said.contains("41"), "{said}");
    // The nodes report the node-IDs that were set.
    nodes.await_line("serial 77, node 40: node-ID set by LSS");
    nodes.await_line("serial 78, node 41: node-ID set by LSS");
    assert_eq!(coflash.json(&["read", "1018/2", "-N", "41"])["number"], 0x1234);
    drop(nodes);
    let nodes = start(&folder);
    nodes.await_line("serial 77, node 40: bootloader (NoProgram)");
    nodes.await_line("serial 78, node 41: bootloader (NoProgram)");
    let coflash = Coflash::new(&folder, &nodes);
    let device = ["--vendor", "0", "--product", "0x1234", "--revision", "0x10000", "--serial", "78"];
    let said = coflash.done(&[&["lss", "bit-rate", "500", "--store"][..], &device].concat());
    assert!(said.contains("500"), "{said}");
    let said = coflash.done(&[&["lss", "assign", "-N", "9", "--reset", "--store"][..], &device].concat());
    assert!(said.contains('9'), "{said}");
    nodes.await_line("serial 78, node 9: node-ID set by LSS");
    assert_eq!(coflash.json(&["read", "1018/4", "-N", "9"])["number"], 78);
    let said = coflash.done(&[&["lss", "inquire"][..], &device].concat());
    assert!(said.contains("serial 0000004Eh: node 9"), "{said}");
    coflash.done(&[&["lss", "store"][..], &device].concat());
}

#[test]
fn two_programs_have_their_places() {
    let (folder, nodes, coflash) =
        start("two", &["--board", "stm32f407g-disc1-two", "--flash", "instant", "--stand-in"]);
    // Vectors of program 2: reset at 0808_0200h.
    let mut second = program();
    second.truncate(1000);
    second[6] = 0x08;
    folder.write("second.bin", &second);
    let flash = ["-I", "binary", "--board", "stm32f407g-disc1-two"];
    coflash.done(&[&["flash", "second.bin", "-N", "1", "-P", "2", "--no-start"][..], &flash].concat());
    let file = folder.read("1.flash");
    assert_eq!(file[0x8_0000..0x8_03E8], second);
    assert!(file[0x2_0000..0x8_0000].iter().chain(&file[0x8_03E8..]).all(|byte| *byte == 0xFF));
    let said = coflash.done(&["start", "-N", "1", "-P", "2"]);
    assert!(said.contains("an application"), "{said}");
    nodes.await_line("serial 1, node 1: would start program 2");
    assert_eq!(coflash.json(&["read", "1F51/2", "-N", "1"])["number"], 1);
    assert_eq!(coflash.json(&["read", "1F51/1", "-N", "1"])["number"], 3, "there is none");
    // zlib's crc32 over the 1000 bytes.
    assert_eq!(coflash.json(&["read", "1F56/2", "-N", "1"])["hex"], "1BD5F407");
    // The first program is replaced while the second one runs, and the second while the first one
    // runs.
    folder.write("program.bin", &program());
    coflash.done(&[&["flash", "program.bin", "-N", "1"][..], &flash].concat());
    nodes.await_line("serial 1, node 1: would start program 1");
    assert_eq!(coflash.json(&["read", "1F51/2", "-N", "1"])["number"], 0, "stopped");
    coflash.done(&[&["flash", "second.bin", "-N", "1", "-P", "2", "--verify"][..], &flash].concat());
    nodes.await_line("serial 1, node 1: would start program 2");
    // Another program than the running one is started by way of the bootloader.
    coflash.done(&["start", "-N", "1", "-P", "1"]);
    nodes.await_line("serial 1, node 1: would start program 1");
}

/// A node on an existing bus: here the bus of other nodes.
#[test]
fn nodes_join_a_bus() {
    let folder = folder("join");
    let hosts = Nodes::start(&folder, &["--node", "1"]);
    let guests = Nodes::join(&folder, hosts.url(), &["--node", "2", "--serial", "2", "--flash", "instant"]);
    guests.await_line("serial 2, node 2: bootloader (NoProgram)");
    let coflash = Coflash::new(&folder, &hosts);
    coflash.done(&[FLASH, &["-N", "2", "--no-start"]].concat());
    assert!(folder.read("2.flash")[0x2_0000..] == flashed());
    assert_eq!(folder.read("1.flash"), vec![0xFF; 1 << 20]);
    // The bus is gone: the nodes end with a reason.
    drop(hosts);
    let said = guests.ended();
    assert_eq!(said.exit, 1);
    assert!(said.err.contains("is gone"), "{}", said.err);
}

#[test]
fn clients_that_misbehave_harm_nobody() {
    let folder = folder("hostile");
    let nodes = Nodes::start(&folder, &["--node", "5", "--flash", "instant", "--heartbeat", "1"]);
    let connect = || {
        let mut stream = TcpStream::connect(nodes.address()).unwrap();
        let mut hi = [0; 6];
        stream.read_exact(&mut hi).unwrap();
        assert_eq!(&hi, b"< hi >");
        stream
    };
    // Not a message.
    let mut stream = connect();
    stream.write_all(&[b"<".to_vec(), vec![b'x'; 100_000]].concat()).unwrap();
    // The server ends the connection; a reset is an end, too.
    let mut rest = Vec::new();
    let _ = stream.read_to_end(&mut rest);
    // Invalid messages.
    let mut stream = connect();
    for message in ["rawmode", "send 605 0", "open can1", "fly", "\u{fffd}", ""] {
        stream.write_all(format!("< {message} >").as_bytes()).unwrap();
        let said = crate::bus::message(&mut stream);
        assert!(said.starts_with("< error "), "{message}: {said}");
    }
    stream.write_all(b"< open can0 >").unwrap();
    assert_eq!(crate::bus::message(&mut stream), "< ok >");
    for message in ["send 605", "send 605 2 1", "send 800 0", "sendrtr 605 0", "send 605 8 1 2 3 4 5 6 7 800"]
    {
        stream.write_all(format!("< {message} >").as_bytes()).unwrap();
        let said = crate::bus::message(&mut stream);
        assert!(said.starts_with("< error "), "{message}: {said}");
    }
    // A client that never reads (heartbeats every 1 ms fill its buffers) does not block the others.
    stream.write_all(b"< rawmode >").unwrap();
    let silent = [stream, connect(), connect()];
    let coflash = Coflash::new(&folder, &nodes);
    coflash.done(&[FLASH, &["-N", "5", "--no-start"]].concat());
    assert!(folder.read("1.flash")[0x2_0000..] == flashed());
    drop(silent);
}

#[test]
fn what_cannot_be_is_said() {
    let folder = folder("wrong");
    let refused = |arguments: &[&str], exit, why: &str| {
        let said = node(&folder, arguments).wait();
        assert_eq!(said.exit, exit, "{arguments:?}: {}", said.err);
        assert!(said.err.contains(why), "{arguments:?}: {}", said.err);
    };
    folder.write("9.flash", b"short");
    let listen = ["--listen", "127.0.0.1:0"];
    refused(
        &[&listen[..], &["--serial", "9"]].concat(),
        1,
        "9.flash: it has 5 bytes, and the flash of an stm32f407vg has 1048576",
    );
    assert_eq!(folder.read("9.flash"), b"short");
    refused(&[&listen[..], &["--folder", "nowhere"]].concat(), 1, "nowhere");
    refused(&[&listen[..], &["--node", "120", "--count", "9"]].concat(), 1, "exceed the node-IDs");
    refused(&[&listen[..], &["--serial", "0xFFFFFFFF", "--count", "2"]].concat(), 1, "serial numbers");
    refused(&["--listen", "nowhere.invalid:1"], 1, "listening at nowhere.invalid:1: ");
    refused(&["--bus", "socketcand://127.0.0.1:1/can0"], 1, "cannot be opened");
    refused(&["--bus", "rubbish"], 1, "it has no ':'");
    refused(&[], 2, "--bus <URL>");
    for [option, value] in [
        ["--node", "0"],
        ["--node", "128"],
        ["--count", "0"],
        ["--serial", "+1"],
        ["--serial", "0x+1"],
        ["--serial", "0x100000000"],
        ["--board", "none"],
        ["--flash", "slow"],
        ["--heartbeat", "65536"],
    ] {
        refused(&[&listen[..], &[option, value]].concat(), 2, "invalid value");
    }
    let url = "socketcand://127.0.0.1:1/can0";
    refused(&[&listen[..], &["--bus", url]].concat(), 2, "cannot be used with");
    fs::create_dir(folder.path("8.flash")).unwrap();
    refused(&[&listen[..], &["--serial", "8"]].concat(), 1, "8.flash: ");
}
