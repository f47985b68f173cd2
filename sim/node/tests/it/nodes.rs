//! `coboot-node` as its users run it: over real sockets, with `coflash` as the host, and with the
//! file read from outside.

use std::fs;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::Duration;

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

#[test]
fn many_nodes_take_their_programs_at_the_same_time() {
    let (folder, _nodes, coflash) =
        start("many", &["--node", "10", "--count", "5", "--stand-in", "--serial", "0x100"]);
    coflash.done(&[FLASH, &["-N", "10-14", "--at-once", "5"]].concat());
    for serial in 0x100..0x105 {
        assert!(folder.read(&format!("{serial}.flash"))[0x2_0000..] == flashed(), "{serial}");
    }
    let scan = coflash.json(&["scan", "-N", "9-15", "--sdo-timeout", "500"]);
    let found: Vec<_> = scan["nodes"].as_array().unwrap().iter().map(|found| &found["node"]).collect();
    assert_eq!(found, [10, 11, 12, 13, 14]);
    assert_eq!(scan["nodes"][4]["info"]["serial_number"], 0x104);
}

#[test]
fn the_power_is_cut_in_the_middle_and_the_program_is_none() {
    let (folder, nodes, coflash) = start("cut", &["--node", "5", "--stand-in"]);
    coflash.done(&[FLASH, &["-N", "5", "--no-start"]].concat());
    // Replaces the old program, which is lost with the first block.
    let flashing = coflash.spawn(&[FLASH, &["-N", "5"]].concat());
    let beginning = program()[..0x400].to_vec();
    while folder.read("1.flash")[0x2_0000..0x2_0400] == beginning {
        std::thread::sleep(Duration::from_millis(5));
    }
    drop(nodes);
    assert_eq!(flashing.wait().exit, 4, "the adapter is gone");
    let nodes = Nodes::start(&folder, &["--node", "5", "--stand-in"]);
    nodes.await_line("serial 1, node 5: bootloader (NoProgram)");
    Coflash::new(&folder, &nodes).done(&[FLASH, &["-N", "5"]].concat());
    assert!(folder.read("1.flash")[0x2_0000..] == flashed());
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

/// From the factory to a running program in one job: the node-ID that a device gets by its LSS
/// address survives the restart.
#[test]
fn a_device_without_node_id_is_given_one_and_flashed_in_one_job() {
    let folder = folder("lss-job");
    let nodes = Nodes::start(
        &folder,
        &["--unconfigured", "--serial", "77", "--product-code", "0x1234", "--flash", "instant", "--stand-in"],
    );
    folder.write(
        "job.toml",
        b"[[program]]\nimage = 'program.bin'\nnodes = [23]\n\
          lss = { vendor = 0, product = 0x1234, revision = 0x10000, serial = 77 }\n",
    );
    let coflash = Coflash::new(&folder, &nodes);
    let options = &FLASH[2..];
    coflash.done(&[&["flash", "--job", "job.toml"][..], options].concat());
    assert_eq!(coflash.json(&["read", "1018/4", "-N", "23"])["number"], 77);
    let said = coflash.done(&["info", "-N", "23"]);
    assert!(said.contains("application"), "{said}");
}

/// A device of another product: nothing is lost, and the exit code is the manual's number.
#[test]
fn a_program_for_another_product_is_refused() {
    let (folder, _nodes, coflash) =
        start("product", &["--node", "5", "--product-code", "99", "--flash", "instant"]);
    coflash.done(&[FLASH, &["-N", "5", "--no-start", "--vid", "0", "--pid", "99"]].concat());
    let before = folder.read("1.flash");
    let said = coflash.run(&[FLASH, &["-N", "5", "--vid", "0", "--pid", "98"]].concat());
    assert_eq!(said.exit, 6, "{}", said.err);
    assert!(said.err.contains("60000182"), "{}", said.err);
    assert!(said.err.contains("it was not changed"), "{}", said.err);
    assert!(folder.read("1.flash")[0x2_0000..] == before[0x2_0000..]);
}

/// A node has no identity unless it is given one, and takes any program: the first example of the page.
#[test]
fn a_node_without_identity_takes_a_program_with_one() {
    let (_folder, _nodes, coflash) = start("nobody", &["--node", "5", "--flash", "instant", "--stand-in"]);
    let named = ["-N", "5", "--vid", "0x3F", "--pid", "0x4007D151"];
    coflash.done(&[FLASH, &named].concat());
    coflash.done(&[FLASH, &named, &["--check-target"]].concat());
}

/// One of three devices that are updated together is another product: it refuses alone.
#[test]
fn another_product_among_the_devices_of_a_group_refuses_alone() {
    let folder = folder("group");
    let wanted = ["--node", "1", "--count", "2", "--product-code", "98", "--flash", "instant"];
    let nodes = Nodes::start(&folder, &wanted);
    let other = ["--node", "3", "--serial", "3", "--product-code", "99", "--flash", "instant"];
    let other = Nodes::join(&folder, nodes.url(), &other);
    other.await_line("serial 3, node 3: bootloader (NoProgram)");
    let coflash = Coflash::new(&folder, &nodes);
    let flash = ["-N", "1-3", "--together=always", "--no-start", "--vid", "0", "--pid", "98"];
    let said = coflash.run(&[FLASH, &flash].concat());
    assert_eq!(said.exit, 8, "{}{}", said.out, said.err);
    let refusal = "node 3: error: the program is for product code 00000062h, and node 3 has 00000063h";
    assert!(said.out.contains(refusal) && said.out.contains("2 of 3 devices are done"), "{}", said.out);
    assert!(said.out.contains("together"), "{}", said.out);
    for serial in 1..=2 {
        assert!(folder.read(&format!("{serial}.flash"))[0x2_0000..] == flashed(), "{serial}");
    }
    assert!(folder.read("3.flash")[0x2_0000..].iter().all(|byte| *byte == 0xFF));
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

/// A download in one transfer, then started: the first 80h confirms it, and coflash calls again;
/// the bootloader answers STOP.
#[test]
fn a_fresh_program_is_called_back_all_the_same() {
    let (_folder, nodes, coflash) = start("fresh", &["--node", "7", "--flash", "instant", "--stand-in"]);
    coflash.done(&[FLASH, &["-N", "7", "--dialect", "raw"]].concat());
    nodes.await_line("serial 1, node 7: would start program 1");
    assert!(coflash.done(&["enter", "-N", "7"]).contains("the bootloader is running"));
    nodes.await_line("serial 1, node 7: bootloader (Requested)");
    coflash.done(&[FLASH, &["-N", "7", "--dialect", "raw"]].concat());
    nodes.await_line("serial 1, node 7: would start program 1");
    // From the running program, by STOP.
    coflash.done(&[FLASH, &["-N", "7", "--dialect", "raw", "--no-start"]].concat());
    nodes.await_line("serial 1, node 7: bootloader (Requested)");
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

/// An abandoned block download: other clients get answers, and NMT reset node is carried out while
/// a client sends requests.
#[test]
fn an_abandoned_download_locks_nobody_out() {
    let folder = folder("abandoned");
    let nodes = Nodes::start(&folder, &["--node", "5", "--flash", "instant", "--heartbeat", "0"]);
    let mut stream = TcpStream::connect(nodes.address()).unwrap();
    stream.set_nodelay(true).unwrap();
    let say =
        |stream: &mut TcpStream, text: &str| stream.write_all(format!("< {text} >").as_bytes()).unwrap();
    assert_eq!(crate::bus::message(&mut stream), "< hi >");
    for mode in ["open can0", "rawmode"] {
        say(&mut stream, mode);
        assert_eq!(crate::bus::message(&mut stream), "< ok >");
    }
    // The next frame of the device, as identifier and data.
    let heard = |stream: &mut TcpStream| {
        let message = crate::bus::message(stream);
        let words: Vec<&str> = message.split_whitespace().collect();
        format!("{}#{}", words[2], words[4])
    };
    let abandon = |stream: &mut TcpStream| {
        say(stream, "send 605 8 C2 50 1F 01 00 10 00 00");
        while heard(stream) != "585#A4501F014A000000" {}
        for seqno in 1..4 {
            say(stream, &format!("send 605 8 {seqno} 0 0 0 0 0 0 0"));
        }
    };
    const ASK: &str = "send 605 8 40 00 10 00 00 00 00 00";
    abandon(&mut stream);
    say(&mut stream, ASK);
    let first = heard(&mut stream);
    // On a busy machine the request may arrive after the pause of the sub-block has ended.
    let answer = if first == "585#A2034A0000000000" { heard(&mut stream) } else { first };
    assert_eq!(answer, "585#4300100000000010");
    abandon(&mut stream);
    say(&mut stream, "send 0 2 81 05");
    let mut asker = stream.try_clone().unwrap();
    let asking = std::thread::spawn(move || {
        for _ in 0..20 {
            if asker.write_all(format!("< {ASK} >").as_bytes()).is_err() {
                return;
            }
            std::thread::sleep(Duration::from_millis(100));
        }
    });
    let mut answers = 0;
    while heard(&mut stream) != "705#00" {
        answers += 1;
    }
    // The reset takes 15 ms, so no request or, on a busy machine, a few requests are answered
    // before it; it would be twenty if the device waited for the end of the transfer.
    assert!(answers < 15, "{answers}");
    asking.join().unwrap();
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
