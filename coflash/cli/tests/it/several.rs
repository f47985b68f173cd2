//! Several devices, interruption and diagnosis, with the tool as a separate process.

use std::collections::VecDeque;
use std::fs;
use std::process::{Command, Stdio};
use std::time::Duration;

use crate::tool::{bootloader, coflash, data, folder, quick, served, within, NOWHERE};
use canopen::{CobId, Frame};
use kit::fake::{serve, Blocks, Bus, Fake, Outcome, APPLICATION, BOOTLOADER};
use serde_json::Value;

fn device(node: u8, running: u32) -> Fake {
    let mut fake = quick(running);
    (fake.node, fake.knows_blocks) = (node, Blocks::Known(127));
    fake
}

#[test]
fn a_list_of_nodes_is_updated_and_a_failure_stops_no_other() {
    let bus = || {
        let mut refusing = device(9, BOOTLOADER);
        refusing.on_block = Box::new(|_| Outcome::Status(0x0E));
        Bus(vec![device(5, APPLICATION), refusing, device(10, BOOTLOADER)])
    };
    let folder = folder("several");
    let report = folder.path("report.json");
    let file = data("plain-400.blk");
    let (done, bus_after) = served(bus(), &["flash", &file, "--node", "5,9-10", "--report", &report]);
    assert_eq!(done.exit, 8, "{}", done.err);
    assert_eq!(bus_after.0[0].blocks.concat(), fs::read(&file).unwrap());
    assert_eq!(bus_after.0[2].blocks.concat(), fs::read(&file).unwrap());
    for words in [
        "node 5: calling the application back to the bootloader\n",
        "node 10: 100 %\n",
        "node 10: running: an application",
        "\nnode 9: error: writing block 0 failed: this part of the flash is protected (1F57h reads 0Eh) [0x60000007]\n  \
         the device: its bootloader is running; it contains no complete program\n",
        "\n2 of 3 devices are done\n",
    ] {
        assert!(done.out.contains(words), "{words} is not in\n{}", done.out);
    }
    assert_eq!(done.err, "error: 1 of 3 devices failed\n");
    let (json, _) = served(bus(), &["--json", "flash", &file, "--node", "5,9-10"]);
    assert_eq!((json.exit, json.err.as_str()), (8, ""));
    let written: Value = serde_json::from_str(&fs::read_to_string(&report).unwrap()).unwrap();
    for document in [&written, &json.json()] {
        assert_eq!((&document["failed"], &document["devices"][0]["ok"]), (&1.into(), &true.into()));
        assert_eq!(document["devices"][1]["error"]["number"], "0x60000007");
        assert_eq!(document["devices"][1]["error"]["device"], "erased");
        assert_eq!(document["devices"][2]["report"]["size"], 4001);
    }
}

/// A file for the results that cannot be written at the end: the results are told, with that, in one document.
#[test]
fn what_cannot_be_written_is_told_with_what_was_done() {
    let (folder, file) = (folder("gone"), data("plain-400.blk"));
    for nodes in ["5", "5,6"] {
        let gone = std::path::PathBuf::from(folder.path("gone"));
        fs::create_dir(&gone).unwrap();
        let report = gone.join("report.json").display().to_string();
        let mut removes = device(5, BOOTLOADER);
        removes.on_block = Box::new(move |_| {
            let _ = fs::remove_dir_all(&gone);
            Outcome::Accept
        });
        let bus = Bus(vec![removes, device(6, BOOTLOADER)]);
        let (done, _) = served(bus, &["flash", &file, "--node", nodes, "--report", &report, "--json"]);
        let json = done.json();
        let size = if nodes == "5" { &json["size"] } else { &json["devices"][1]["report"]["size"] };
        assert_eq!((done.exit, size, &json["error"]["exit"]), (1, &4001.into(), &1.into()));
    }
}

#[test]
fn a_job_file_says_who_gets_what() {
    let folder = folder("job");
    let small = folder.file(
        "small.hex",
        b":020000040801F1\n:080000000010002001020108BC\n:0402000001020304F0\n:00000001FF\n",
    );
    folder.file("plain.blk", &fs::read(data("plain-400.blk")).unwrap());
    let job = folder.file(
        "job.toml",
        b"[[program]]\nimage = 'plain.blk'\nnodes = [5]\n[[program]]\nimage = 'small.hex'\nnodes = [6]\n\
          start = false\n[[program]]\nimage = 'plain.blk'\nnodes = [7]\ntrial-run = false\n",
    );
    let bus = Bus(vec![device(5, BOOTLOADER), device(6, APPLICATION), device(7, BOOTLOADER)]);
    let (done, bus) = served(bus, &["flash", "--job", &job, "--at-once", "2"]);
    let done = done.good();
    let plain = fs::read(data("plain-400.blk")).unwrap();
    assert_eq!((bus.0[0].blocks.concat(), bus.0[2].blocks.concat()), (plain.clone(), plain));
    // Block 0 and the last one around one of 516 bytes, after whose header of 12 bytes they are.
    assert_eq!(
        (bus.0[1].blocks[1][12 + 0x200..][..4].to_vec(), bus.0[1].running),
        (vec![1, 2, 3, 4], Some(BOOTLOADER))
    );
    assert_eq!((bus.0[0].count("command 80"), bus.0[2].count("command 80")), (1, 0));
    assert!(done.out.ends_with("3 of 3 devices are done\n"), "{}", done.out);
    // With an invalid image, no device is changed.
    fs::write(&small, b":020000040801F1\n:050000000102030405EC\n:00000001FF\n").unwrap();
    let flash = ["--bus", NOWHERE, "flash", "--job", &job];
    coflash(&flash).fails(3, &["small.hex: is not a program: it does not begin"]);
    fs::write(small, b"hello").unwrap();
    coflash(&flash).fails(3, &["small.hex: is not a firmware file"]);
    coflash(&["flash", "--job", &job, "--node", "5"]).fails(2, &["cannot be used with"]);
}

/// A device without node-ID (CiA 305) that is a bootloader as soon as it has one.
pub struct Unconfigured {
    pub fake: Fake,
    node: u8,
    pub configured: bool,
    selected: usize,
    pub orders: Vec<[u8; 3]>,
    /// So many more devices without node-ID come after it, with the same address.
    pub more: u8,
}

const ADDRESS: [u32; 4] = [0x3F, 2, 0x10000, 7];

impl Unconfigured {
    fn answer(&mut self, command: u8, word: u32) {
        let [a, b, c, d] = word.to_le_bytes();
        self.fake.inject(Frame::of(CobId::LSS_RESPONSE, &[command, a, b, c, d, 0, 0, 0]));
    }
}

impl coboot_can::Adapter for Unconfigured {
    fn send(&mut self, frame: &Frame) -> Result<(), coboot_can::AdapterError> {
        let bytes: Option<&[u8; 8]> = frame.exactly();
        let Some(bytes) = bytes.filter(|_| frame.cob_id() == Some(CobId::LSS_REQUEST)) else {
            return self.fake.send(frame);
        };
        let number = u32::from_le_bytes(bytes[1..5].try_into().unwrap());
        match bytes[0] {
            0x04 => {
                self.configured = bytes[1] == 1;
                if !self.configured && self.fake.running.is_none() && self.node != 0xFF {
                    self.fake.node = self.node;
                    self.fake.running = Some(BOOTLOADER);
                    self.fake.inject(Frame::of(CobId::new(0x700 + u16::from(self.node)).unwrap(), &[0]));
                }
                if !self.configured && self.node != 0xFF && self.more > 0 {
                    (self.node, self.more) = (0xFF, self.more - 1);
                }
            }
            0x51 if !self.configured && self.node == 0xFF => {
                let [bit, part, next] = [bytes[5], bytes[6], bytes[7]].map(usize::from);
                if bit == 0x80 {
                    self.selected = 0;
                } else if part != self.selected || (ADDRESS[part] ^ number) >> bit != 0 {
                    return Ok(());
                } else {
                    (self.selected, self.configured) = (next, next < part);
                }
                self.answer(0x4F, 0);
            }
            part @ 0x40..=0x43 => {
                let part = usize::from(part - 0x40);
                self.selected = if ADDRESS[part] == number && self.selected == part { part + 1 } else { 0 };
                if self.selected == 4 {
                    self.configured = true;
                    self.answer(0x44, 0);
                }
            }
            _ if !self.configured => {}
            part @ 0x5A..=0x5D => self.answer(part, ADDRESS[usize::from(part - 0x5A)]),
            0x5E => self.answer(0x5E, self.node.into()),
            command @ (0x11 | 0x13 | 0x15 | 0x17) => {
                self.orders.push([command, bytes[1], bytes[2]]);
                match command {
                    0x11 => self.node = bytes[1],
                    0x15 => return Ok(()),
                    _ => {}
                }
                self.answer(command, 0);
            }
            _ => {}
        }
        Ok(())
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, coboot_can::AdapterError> {
        self.fake.receive(timeout)
    }

    fn now(&self) -> Duration {
        self.fake.now
    }
}

pub fn unconfigured() -> Unconfigured {
    let mut fake = device(0x7F, BOOTLOADER);
    fake.running = None;
    Unconfigured { fake, node: 0xFF, configured: false, selected: 0, orders: Vec::new(), more: 0 }
}

#[test]
fn a_device_without_node_id_gets_one_by_its_lss_address() {
    let folder = folder("lss-job");
    let file = data("plain-400.blk");
    let job = |node: &str, serial: u32| {
        let text = format!(
            "[[program]]\nimage = '{file}'\n{node}\nlss = {{ vendor = 0x3F, product = 2, revision = 0x10000, serial = {serial} }}\n"
        );
        folder.file("job.toml", text.as_bytes())
    };
    let by_job = |nodes, serial| served(unconfigured(), &["flash", "--job", &job(nodes, serial)]);
    let (done, bus) = by_job("nodes = [9]", 7);
    done.good();
    assert_eq!((bus.fake.node, bus.fake.blocks.concat()), (9, fs::read(&file).unwrap()));
    // The manual's options (table 9).
    let legacy = ["--ser_num", "7", "--rev", "0x10000", "--pcode", "2", "--vendor", "0x3F"];
    let (done, bus) = served(unconfigured(), &[&["flash", "-N", "12", &file][..], &legacy].concat());
    done.good();
    assert_eq!(bus.fake.node, 12);
    let nobody = "node 9: error: no device answers (selecting the device by its LSS address) [0x60000013]";
    for (nodes, serial, words) in [
        ("", 7, "device with serial number 00000007h: error: the device has no node-ID [0x60000017]"),
        ("nodes = [9]", 5, nobody),
    ] {
        let (done, bus) = by_job(nodes, serial);
        assert!(done.exit == 8 && done.out.contains(words), "{}{}", done.out, done.err);
        assert!(bus.fake.blocks.is_empty());
    }
}

/// A bus that returns what it gets, and nothing else.
struct Mirror {
    fake: Fake,
    back: VecDeque<Frame>,
}

impl coboot_can::Adapter for Mirror {
    fn send(&mut self, frame: &Frame) -> Result<(), coboot_can::AdapterError> {
        self.back.push_back(*frame);
        Ok(())
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, coboot_can::AdapterError> {
        match self.back.pop_front() {
            None => self.fake.receive(timeout),
            frame => Ok(frame),
        }
    }

    fn now(&self) -> Duration {
        self.fake.now
    }
}

#[test]
fn a_bus_with_nobody_but_the_tool_is_told() {
    let file = data("plain-400.blk");
    let short = ["--sdo-timeout", "20", "--boot-timeout", "20"];
    let scan = ["scan", "--sdo-timeout", "20", "--listen", "20"];
    for (command, exit) in [
        ([&["info", "-N", "5"][..], &short].concat(), 5),
        ([&["flash", &file, "-N", "5"][..], &short].concat(), 5),
        ([&["flash", &file, "-N", "5,6"][..], &short].concat(), 8),
        (scan.to_vec(), 0),
    ] {
        let mut fake = device(5, BOOTLOADER);
        fake.running = None;
        let (done, _) = served(Mirror { fake, back: VecDeque::new() }, &command);
        let said = format!("{}{}", done.out, done.err);
        assert_eq!(done.exit, exit, "{said}");
        assert!(said.contains("the server returns our own frames, and no other node has sent any"), "{said}");
    }
}

/// Ctrl-C, the stop of a service, and a terminal that is closed, in the middle of the blocks: the
/// last one comes twice, by the system and by the shell. What is begun is in the reports before
/// that.
#[cfg(unix)]
#[test]
fn an_interruption_aborts_the_transfer_and_tells_how_the_device_is_left() {
    let folder = folder("interrupted");
    for signals in [&["-INT"][..], &["-TERM"], &["-HUP", "-HUP"]] {
        an_interruption_ends_in_order(&folder.path(signals[0]), signals);
    }
    // What nohup has started outlives its terminal (POSIX).
    #[cfg(target_os = "linux")]
    {
        let (slow, heard) = slow();
        let (url, server) = serve(slow);
        let mut command = within("nohup", &[]);
        command.args(["--bus", &url, "flash", "-N", "5", &data("identity-110.blk")]);
        let child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        while heard.recv().unwrap() != 1 {}
        signal("-HUP", &child);
        let done = child.wait_with_output().unwrap();
        assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
        assert_eq!(server.join().unwrap().running, Some(APPLICATION));
    }
}

/// A device that reports its blocks; the first takes some time, so that a signal comes meanwhile.
#[cfg(unix)]
fn slow() -> (Fake, std::sync::mpsc::Receiver<u32>) {
    let mut slow = bootloader();
    let (reported, heard) = std::sync::mpsc::channel();
    slow.on_block = Box::new(move |block| {
        let _ = reported.send(block);
        std::thread::sleep(Duration::from_millis(if block == 1 { 300 } else { 0 }));
        Outcome::Accept
    });
    (slow, heard)
}

#[cfg(unix)]
fn signal(signal: &str, child: &std::process::Child) {
    assert!(Command::new("kill").args([signal, &*child.id().to_string()]).status().unwrap().success());
}

#[cfg(unix)]
fn an_interruption_ends_in_order(folder: &str, signals: &[&str]) {
    fs::create_dir(folder).unwrap();
    let (slow, heard) = slow();
    let (url, server) = serve(slow);
    let child = crate::tool::command()
        .args(["--bus", &url, "flash", "-N", "5", &data("identity-110.blk")])
        .args(["--report", "of-device.json", "--report-dir", "reports"])
        .current_dir(folder)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    while heard.recv().unwrap() != 1 {}
    let reports = || {
        let run = fs::read_dir(format!("{folder}/reports")).unwrap().next().unwrap().unwrap().path();
        let read = |path| serde_json::from_slice(&fs::read(path).unwrap()).unwrap();
        let of_device: Value = read(format!("{folder}/of-device.json").into());
        let of_run: Value = read(run.join("report.json"));
        (of_device, of_run)
    };
    let (of_device, of_run) = reports();
    assert_eq!((&of_device["begun"][0]["node"], &of_device["ended"]), (&5.into(), &Value::Null));
    assert_eq!((&of_run["begun"], &of_run["ended"]), (&of_device["begun"], &Value::Null));
    signals.iter().for_each(|it| signal(it, &child));
    let done = child.wait_with_output().unwrap();
    let err = String::from_utf8(done.stderr).unwrap();
    assert_eq!(done.status.code(), Some(130), "{signals:?}: {err}");
    assert_eq!(
        err,
        "error: cancelled [0x60000011]\n  the device: its bootloader is running; it contains no complete program\n  \
         what to do: run the same command again to continue\n"
    );
    let (of_device, of_run) = reports();
    assert_eq!(of_device["devices"][0]["error"]["device"], "erased", "{of_device:#}");
    assert_eq!((&of_run["exit"], &of_run["failed_updates"][0]["node"]), (&130.into(), &5.into()));
    assert!(of_run["ended"].is_string(), "{of_run:#}");
    let mut fake = server.join().unwrap();
    assert!(
        fake.log.last().unwrap() == "abort 08000000" || fake.log.last().unwrap().starts_with("read"),
        "{:?}",
        fake.log
    );
    // The update can be repeated.
    fake.on_block = Box::new(|_| Outcome::Accept);
    let (done, fake) = served(fake, &["flash", "-N", "5", &data("identity-110.blk")]);
    done.good();
    assert_eq!(fake.running, Some(APPLICATION));
}
