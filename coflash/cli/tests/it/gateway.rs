//! Devices behind a gateway of CiA 309-3. The gateway is played from the standard's text: a line for
//! each command, `[number] network node command`, and one for each answer.

use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::Duration;

use base64::engine::general_purpose::STANDARD as BASE64;
use base64::Engine as _;
use canopen::{Address, NodeId};
use coboot_can::gateway::{Ask, Gateway, GatewayError};
use coboot_can::Cia309;
use coflash_core::device::{Doing, Session, Timing};
use coflash_core::Error;

use crate::tool::{coflash, data, device, quick, served, NOWHERE};
use kit::fake::{Blocks, Deed, Fake, Maker, Outcome, APPLICATION, BOOTLOADER, NODE};

/// The gateway's answer to a line, or none. The gateway adds `[7]` to the answer itself.
type Play = Box<dyn FnMut(&str) -> Option<String> + Send>;

/// The lines that a gateway has received.
type Lines = Arc<Mutex<Vec<String>>>;

/// A gateway for one client; returns its address, and every received line.
fn gateway(mut play: Play) -> (String, Lines, thread::JoinHandle<()>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap().to_string();
    let lines = Arc::new(Mutex::new(Vec::new()));
    let heard = lines.clone();
    let server = thread::spawn(move || {
        let (stream, _) = listener.accept().unwrap();
        stream.set_nodelay(true).unwrap();
        let mut reader = BufReader::new(stream.try_clone().unwrap());
        let mut stream: TcpStream = stream;
        loop {
            let mut line = String::new();
            if reader.read_line(&mut line).unwrap_or(0) == 0 {
                return;
            }
            assert!(line.ends_with("\r\n"), "{line:?}");
            heard.lock().unwrap().push(line.trim_end().to_string());
            if let Some(answer) = play(line.trim_end()) {
                if stream.write_all(answer.as_bytes()).is_err() {
                    return;
                }
            }
        }
    });
    (address, lines, server)
}

/// A gateway to network 3 with this device: it has its own SDO client on the bus.
struct Behind {
    fake: Fake,
    timeout: u64,
}

impl Behind {
    fn line(&mut self, line: &str) -> String {
        // Text over TCP takes longer than frames.
        self.fake.now += Duration::from_millis(50);
        let mut words: Vec<&str> = line.split_ascii_whitespace().collect();
        let sequence = words.remove(0);
        let answer = match words.as_slice() {
            [net, ..] if *net != "3" => "ERROR:106".to_string(),
            ["3", "set", "sdo_timeout", ms] => {
                self.timeout = ms.parse().unwrap();
                "OK".to_string()
            }
            ["3", node, "reset", "node"] => {
                self.session(node).reset_node().unwrap();
                "OK".to_string()
            }
            ["3", node, "r", index, sub, "d"] => {
                let at = address(index, sub);
                match self.session(node).read_once(at) {
                    Ok(value) => BASE64.encode(value),
                    Err(error) => failure(&error),
                }
            }
            ["3", node, "w", index, sub, kind, value] => {
                let number = || u32::from_str_radix(value.strip_prefix("0x").unwrap(), 16).unwrap();
                let value = match *kind {
                    "u8" => vec![u8::try_from(number()).unwrap()],
                    "u16" => u16::try_from(number()).unwrap().to_le_bytes().to_vec(),
                    "u32" => number().to_le_bytes().to_vec(),
                    "d" => BASE64.decode(value).unwrap(),
                    other => panic!("{other}"),
                };
                let at = address(index, sub);
                match self.session(node).write(at, &value, Doing::Write(at), &mut |_| {}) {
                    Ok(()) => "OK".to_string(),
                    Err(error) => failure(&error),
                }
            }
            _ => "ERROR:101".to_string(),
        };
        format!("{sequence} {answer}\r\n")
    }

    fn session(&mut self, node: &str) -> Session<'_> {
        let timing = Timing::default().sdo(Duration::from_millis(self.timeout)).attempts(1);
        Session::new(&mut self.fake, NodeId::new(node.parse().unwrap()).unwrap(), timing)
    }
}

fn address(index: &str, sub: &str) -> Address {
    let index = u16::from_str_radix(index.strip_prefix("0x").unwrap(), 16).unwrap();
    Address::new(index, sub.parse().unwrap())
}

/// "SDO-abort-code" or "internal error-code"; 103 is a time-out.
fn failure(error: &Error) -> String {
    match error {
        Error::Refused { code, .. } | Error::Protocol { code, .. } => {
            format!("ERROR:0x{:08X} #in words", code.0)
        }
        Error::NoAnswer { .. } => "ERROR:103 #Time-out.".to_string(),
        other => panic!("{other}"),
    }
}

/// A device behind a gateway: the URL of its network, its lines, and the device.
fn behind(fake: Fake) -> (String, Lines, Arc<Mutex<Behind>>) {
    let device = Arc::new(Mutex::new(Behind { fake, timeout: 500 }));
    let play = device.clone();
    let (address, lines, _) = gateway(Box::new(move |line| Some(play.lock().unwrap().line(line))));
    (format!("cia309://{address}/3"), lines, device)
}

#[test]
fn block_files_go_through_a_gateway() {
    let file = data("identity-110.blk");
    for blocks in [Blocks::Refused(0x0504_0001), Blocks::Known(127)] {
        let (bus, lines, device) = behind(device(APPLICATION, |fake| fake.knows_blocks = blocks));
        coflash(&["--bus", &bus, "flash", "-N", "5", &file, "--sdo-timeout", "50"]).good();
        let device = device.lock().unwrap();
        assert_eq!(device.fake.blocks.concat(), fs::read(&file).unwrap());
        assert_eq!(device.fake.running, Some(APPLICATION));
        let mut log = device.fake.writes();
        log.retain(|entry| entry.starts_with("command"));
        assert_eq!(log[0], "command 80", "{log:?}");
        assert_eq!(log[log.len() - 4..], ["command 01", "command 80", "command 83", "command 01"]);
        // By the standard: number, network, node, command, index, sub-index, type, value.
        let lines = lines.lock().unwrap();
        assert_eq!(lines[..2], ["[1] 3 set sdo_timeout 50", "[2] 3 5 r 0x1000 0 d"]);
        assert!(lines.iter().any(|line| line.ends_with("] 3 5 w 0x1F51 1 u8 0x80")), "{lines:?}");
    }
}

/// The data for CiA 302-3 devices: an image in one download.
struct Standard(Arc<Mutex<Vec<u8>>>);

impl Maker for Standard {
    fn value(&mut self, at: (u16, u8), running: u32) -> Option<Result<Vec<u8>, u32>> {
        match at {
            (0x1F51, 1) => Some(Ok(vec![u8::from(running == APPLICATION)])),
            (0x1F57 | 0x1F56 | 0x6005, _) => Some(Err(0x0602_0000)),
            _ => None,
        }
    }

    fn write(&mut self, at: (u16, u8), data: &[u8], running: u32) -> Option<Result<Deed, u32>> {
        Some(Ok(match (at, data) {
            ((0x1F51, 1), [0]) => Deed::Restart(NODE, 0x1234),
            ((0x1F51, 1), [1]) if running != APPLICATION => Deed::Restart(NODE, APPLICATION),
            ((0x1F50, 1), image) => {
                *self.0.lock().unwrap() = image.to_vec();
                Deed::Nothing
            }
            _ => Deed::Nothing,
        }))
    }
}

/// Such a device, and the image that it gets.
fn standard() -> (Fake, Arc<Mutex<Vec<u8>>>) {
    let image = Arc::default();
    let maker = Box::new(Standard(Arc::clone(&image)));
    (device(APPLICATION, |fake| fake.maker = Some(maker)), image)
}

#[test]
fn images_go_through_a_gateway() {
    let (fake, image) = standard();
    let (bus, _, _) = behind(fake);
    let board = ["--board", "nucleo-f446re", "--dialect", "raw"];
    coflash(&[&["--bus", &bus, "flash", "-N", "5", &data("program.elf")][..], &board].concat()).good();
    assert!(*image.lock().unwrap() == fs::read(data("program.bin")).unwrap());
}

/// A set of parameters has no addresses (CiA 814-1 clause 6.4): any bytes, sent unchanged.
#[test]
fn a_binary_without_an_address_goes_to_devices_that_have_none() {
    let file = data("identity-110.blk");
    let binary = ["flash", "-N", "5", &file, "-I", "binary", "--dialect"];
    // This file is not a program, and is refused with a message.
    let nowhere = |dialect| coflash(&[&["--bus", NOWHERE], &binary[..], &[dialect]].concat());
    nowhere("raw").fails(3, &["is not a program: its first word"]);
    let (fake, image) = standard();
    served(fake, &[&binary[..], &["raw", "--force"]].concat()).0.good();
    assert!(*image.lock().unwrap() == fs::read(&file).unwrap());
    // Blocks and Intel HEX have addresses.
    for dialect in ["block", "hex", "esacademy", "auto"] {
        nowhere(dialect).fails(3, &["give --start-address or --board"]);
    }
}

#[test]
fn what_reads_and_writes_objects_works_through_a_gateway() {
    let (bus, lines, _) = behind(quick(BOOTLOADER));
    let done = coflash(&["--bus", &bus, "read", "-N", "5", "1008", "--sdo-timeout", "700"]);
    assert_eq!((done.exit, done.out.as_str()), (0, "node 5, 1008h/0: \"a device with a long name\"\n"));
    assert_eq!(*lines.lock().unwrap(), ["[1] 3 set sdo_timeout 700", "[2] 3 5 r 0x1008 0 d"]);
    let (bus, ..) = behind(quick(BOOTLOADER));
    coflash(&["--bus", &bus, "info", "-N", "5"]).says(&["vendor-ID         0000003Fh"]);
    let (bus, _, device) = behind(quick(APPLICATION));
    coflash(&["--bus", &bus, "enter", "-N", "5"]).good();
    assert_eq!(device.lock().unwrap().fake.running, Some(BOOTLOADER));
    // Several devices: one after the other, and one that is missing does not stop the others.
    let (bus, _, device) = behind(quick(BOOTLOADER));
    let file = data("plain-400.blk");
    let quick = ["--boot-timeout", "50", "--sdo-timeout", "20"];
    let done = coflash(&[&["--bus", &bus, "flash", "-N", "4,5", &file][..], &quick].concat());
    assert_eq!(done.exit, 8, "{}", done.err);
    assert!(done.out.contains("node 4: error: node 4 does not answer"), "{}", done.out);
    assert!(done.out.contains("1 of 2 devices are done"), "{}", done.out);
    assert_eq!(device.lock().unwrap().fake.blocks.concat(), fs::read(&file).unwrap());
}

#[test]
fn what_the_device_refuses_has_the_same_words_as_on_the_bus() {
    let refuse = |fake: &mut Fake| fake.on_block = Box::new(|_| Outcome::AbortStatus(0x0800_0020, 0x0E));
    let (bus, ..) = behind(device(BOOTLOADER, refuse));
    coflash(&["--bus", &bus, "flash", "-N", "5", &data("plain-400.blk")]).fails(6, &["[0x60000007]"]);
    let (bus, ..) = behind(quick(BOOTLOADER));
    coflash(&["--bus", &bus, "read", "-N", "5", "2000"])
        .fails(6, &["node 5 refuses reading 2000h/0: abort 06020000h"]);
    let (bus, ..) = behind(quick(BOOTLOADER));
    // The bus was not observed.
    coflash(&["--bus", &bus, "read", "-N", "6", "1000"])
        .fails(5, &["node 6 does not answer", "what to do: check that node 6 is the right one"]);
}

/// Commands that need frames report that they do.
#[test]
fn what_listens_to_the_bus_is_refused_in_words() {
    let (bus, ..) = behind(quick(BOOTLOADER));
    for command in [&["scan"][..], &["monitor"], &["lss", "fastscan"], &["reset", "--all"]] {
        coflash(&[&["--bus", &bus][..], command].concat()).fails(2, &["a gateway carries only SDO"]);
    }
    let file = data("plain-400.blk");
    coflash(&["--bus", &bus, "flash", &file, "--ser_num", "1"]).fails(2, &["LSS address"]);
    // The gateway on the CAN bus of the manual's tool is a different one.
    for option in ["--gateway_id", "--network_id"] {
        coflash(&["--bus", &bus, "flash", &file, option, "3"]).fails(2, &["CiA 302-7", "cia309://"]);
    }
    for (url, words) in [
        ("cia309:1.2.3.4", "it must be cia309://HOST:PORT/NET"),
        ("cia309:///1", "it must be cia309://HOST:PORT/NET"),
        ("cia309://127.0.0.1:1/x", "from 0 to 65535"),
        ("cia309://127.0.0.1:1/65536", "from 0 to 65535"),
        ("cia309://127.0.0.1:1/+1", "from 0 to 65535"),
        ("cia309://127.0.0.1:1/", "from 0 to 65535"),
    ] {
        coflash(&["--bus", url, "info"]).fails(2, &[words]);
    }
}

/// Reads 1000h of node 5 in network 1 through a gateway with these answers, with a short time
/// limit.
fn asked(
    mut play: impl FnMut(&str) -> Option<String> + Send + 'static,
) -> (Result<Vec<u8>, GatewayError>, Cia309) {
    let set = move |line: &str| match line.split_once("] 1 set sdo_timeout ") {
        Some((number, _)) => Some(format!("{number}] OK\r\n")),
        None => play(line),
    };
    let (address, ..) = gateway(Box::new(set));
    let mut gateway = Cia309::connect(&address, 1).unwrap();
    let result = ask(&mut gateway);
    (result, gateway)
}

fn request(at: Address) -> Ask<'static> {
    Ask {
        node: NodeId::new(5).unwrap(),
        at,
        sdo: Duration::from_millis(100),
        patience: Duration::from_millis(300),
        longest: 4096,
        cancelled: &|| false,
    }
}

fn ask(gateway: &mut Cia309) -> Result<Vec<u8>, GatewayError> {
    gateway.upload(&request(Address::new(0x1000, 0)), &mut |_| {})
}

fn words(result: Result<Vec<u8>, GatewayError>) -> String {
    match result {
        Err(GatewayError::Adapter(error)) => error.to_string(),
        other => format!("{other:?}"),
    }
}

/// Notes how long it may be silent, and does not answer.
struct Patient(Duration);

impl Gateway for Patient {
    fn upload(&mut self, ask: &Ask<'_>, _: &mut dyn FnMut(u32)) -> Result<Vec<u8>, GatewayError> {
        self.0 = ask.patience;
        Err(GatewayError::NoAnswer)
    }

    fn download(&mut self, _: &Ask<'_>, _: &[u8], _: &mut dyn FnMut(u32)) -> Result<(), GatewayError> {
        Err(GatewayError::NoAnswer)
    }

    fn reset_node(&mut self, _: NodeId) -> Result<(), GatewayError> {
        Ok(())
    }

    fn greet(&mut self, _: Duration) -> Result<(), coboot_can::AdapterError> {
        Ok(())
    }

    fn wait(&mut self, _: Duration) -> Result<Option<NodeId>, GatewayError> {
        Ok(None)
    }

    fn now(&self) -> Duration {
        Duration::ZERO
    }
}

/// A gateway sends a value while it comes, so its first word is due after the time-out of the node
/// and its own, whatever the length of the value.
#[test]
fn a_read_waits_for_the_node_and_the_gateway_and_no_longer() {
    let at = Address::new(0x1000, 0);
    let timing = Timing::default().sdo(Duration::from_millis(700)).attempts(1);
    type Read = fn(&mut Session<'_>, Address) -> Result<Vec<u8>, Error>;
    let reads: [Read; 2] =
        [|session, at| session.upload(at, &mut |_| {}), |session, at| session.read_once(at)];
    for read in reads {
        let mut gateway = Patient(Duration::ZERO);
        read(&mut Session::through(&mut gateway, NodeId::new(5).unwrap(), timing), at).unwrap_err();
        assert_eq!(gateway.0, Duration::from_millis(5700));
    }
}

#[test]
fn answers_of_every_form_are_understood() {
    let ok = Ok(vec![0x92, 1, 2, 0]);
    for (answer, expected) in [
        ("[2] kgECAA==\r\n", ok.clone()),
        ("[2]kgECAA==\r\n", ok.clone()),
        // Events of the network come between, and answers in pieces.
        ("1 7 ERROR 205\r\n1 5 EMCY 8130 11 00 00 00 00 00\r\nSYNC\r\n[2] kgECAA==\r\n", ok.clone()),
        ("\r\n\n[2] kgECAA==\r\n", ok.clone()),
        ("[2] \r\n", Ok(Vec::new())),
        ("[2] ERROR:0x06020000 #Object does not exist.\r\n", Err(0x0602_0000)),
        ("[2] ERROR: 0x06020000\r\n", Err(0x0602_0000)),
        ("[2] ERROR: 100794368\r\n", Err(0x0602_0000)),
        ("[2] ERROR:0x06020000\n", Err(0x0602_0000)),
        // CANopenNode: an upload that breaks off in the middle.
        ("[2] kgEC\n...ERROR:0x05040005 #Out of memory.\r\n", Err(0x0504_0005)),
        ("[2] ERROR:103 #Time-out.\r\n", Err(0)),
        ("[2] ERROR:0x05040000 #SDO protocol timed out.\r\n", Err(0)),
    ] {
        let (result, _) = asked(move |_| Some(answer.to_string()));
        let found = match result {
            Ok(value) => Ok(value),
            Err(GatewayError::Abort(code)) => Err(code.0),
            Err(GatewayError::NoAnswer) => Err(0),
            Err(error) => panic!("{answer:?}: {error:?}"),
        };
        assert_eq!(found, expected, "{answer:?}");
    }
}

#[test]
fn a_gateway_that_answers_something_else_is_an_error_in_words() {
    for (answer, expected) in [
        ("[2] ERROR:106 #Unsupported net.\r\n", "it has no network 1 (error 106 of CiA 309-3)"),
        ("[2] ERROR:107\r\n", "it does not reach this node-ID (error 107"),
        ("[2] ERROR:600\r\n", "it has no memory left (error 600"),
        ("[2] ERROR:999\r\n", "it refuses the request (error 999"),
        ("[2] ERROR: what\r\n", "answered unexpectedly: ERROR: what"),
        ("[7] kgECAA==\r\n", "answered unexpectedly: '[7] kgECAA==', while command [2] waits for its answer"),
        ("[1] kgECAA==\r\n", "answered unexpectedly: '[1] kgECAA==', while command [2] waits"),
        ("[2] OK\r\n", "'OK', which is not a domain in base64"),
        ("[2] 131474\r\n", "which is not a domain in base64"),
        ("[two] kgECAA==\r\n", "answered unexpectedly: [two] kgECAA=="),
        ("[-2] kgECAA==\r\n", "answered unexpectedly: [-2]"),
        ("SSH-2.0-OpenSSH_9.6\r\n", "answered unexpectedly: SSH-2.0-OpenSSH_9.6"),
        ("HTTP/1.1 400 Bad Request\r\n", "answered unexpectedly: HTTP/1.1 400"),
        ("...ERROR:0x05040005\r\n", "answered unexpectedly: '...ERROR:0x05040005'"),
        ("[2] kgECAA==\n", "it has not answered for 0.3 s"),
        ("[2] kgECAA==", "s for the gateway); it sent '[2] kgECAA==', and no end of the line"),
    ] {
        let (result, _) = asked(move |_| Some(answer.to_string()));
        let found = words(result);
        assert!(found.contains(expected), "{answer:?}: {found}");
    }
    let (result, _) = asked(|_| None);
    let found = words(result);
    let expected = "it has not answered for 0.3 s (0.1 s for SDO with the node, and 0.2 s for the gateway)";
    assert!(found.contains(expected), "{found}");
}

/// A gateway for one command, which then sends this without end; returns its address.
fn flood(answer: &'static [u8], text: &'static [u8]) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap().to_string();
    thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        let mut line = String::new();
        BufReader::new(stream.try_clone().unwrap()).read_line(&mut line).unwrap();
        stream.write_all(answer).unwrap();
        // Lines come as fast as they can; bytes without an end would fill the memory.
        let pause = Duration::from_millis(u64::from(!text.ends_with(b"\n")));
        while stream.write_all(text).is_ok() {
            thread::sleep(pause);
        }
    });
    address
}

/// What comes without end is no answer, and no reason to wait. The test ends, or it hangs.
#[test]
fn a_gateway_that_never_stops_is_given_up() {
    for (text, expected) in [
        (&b"1 5 EMCY 8130 11 00 00 00 00 00\r\n"[..], "it has not answered for 0.3 s"),
        (b"1 7 ERROR 205\r\n", "it has not answered for 0.3 s"),
        (b"\r\n", "it has not answered for 0.3 s"),
        // Bytes without LF: none, then more at once than an event has; and part of an answer.
        (b"", "it has not answered for 0.3 s"),
        (&[b'x'; 4096], "a line without an end: xxxx"),
        (b"[7] AAAAAAAAAAAAAAAAAAAAAAAAAAAA", "it has not answered for 0.3 s"),
    ] {
        let mut gateway = Cia309::connect(&flood(b"[1] OK\r\n", text), 1).unwrap();
        let found = words(ask(&mut gateway));
        assert!(found.contains(expected), "{text:?}: {found}");
    }
    // An answer that is longer than any that was asked for.
    for (first, text) in [(&b"[1] OK\r\n[2] "[..], &[b'A'; 64][..]), (b"[1] ", &[b'A'; 64])] {
        let mut gateway = Cia309::connect(&flood(first, text), 1).unwrap();
        let found = words(ask(&mut gateway));
        assert!(found.contains("that is longer than"), "{first:?}: {found}");
    }
    // The first word is awaited for 5 s in place of 0.3 s.
    let mut gateway = Cia309::connect(&flood(b"", b"1 7 ERROR 205\r\n"), 1).unwrap();
    let error = gateway.greet(Duration::from_millis(100)).unwrap_err().to_string();
    assert!(error.contains("it has not answered for 5.0 s"), "{error}");
    let mut gateway = Cia309::connect(&flood(b"[1] ERROR:100\r\n", b""), 1).unwrap();
    assert!(gateway.greet(Duration::from_millis(100)).is_ok(), "a refusal is a word");
}

/// A late answer belongs to a command that timed out, and to no other.
#[test]
fn a_late_answer_is_not_taken_for_another_ones() {
    let mut count = 0;
    let (result, mut gateway) = asked(move |line| {
        count += 1;
        let number = line.split_once(']').unwrap().0.to_string();
        // The first one is kept; with the second, both come.
        (count == 2).then(|| format!("[2] AAAAAA==\r\n{number}] kgECAA==\r\n"))
    });
    assert!(words(result).contains("has not answered"));
    assert_eq!(ask(&mut gateway).unwrap(), [0x92, 1, 2, 0]);
}

#[test]
fn a_gateway_that_goes_away_or_takes_nothing_ends_it() {
    // It closes the connection at once, and in the middle of a command.
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let mut gateway = Cia309::connect(&listener.local_addr().unwrap().to_string(), 1).unwrap();
    drop(listener.accept().unwrap());
    assert!(words(ask(&mut gateway)).contains("is gone"));

    // It reads nothing: an image does not fit into the buffers of the connection.
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let mut gateway = Cia309::connect(&listener.local_addr().unwrap().to_string(), 1).unwrap();
    let (mut stream, _) = listener.accept().unwrap();
    stream.write_all(b"[1] OK\r\n").unwrap();
    let image = vec![0x55; 24 << 20];
    let ask = request(Address::new(0x1F50, 1));
    let result = gateway.download(&ask, &image, &mut |_| {}).map(|()| Vec::new());
    let found = words(result);
    assert!(found.contains("it has accepted no data for 0.3 s"), "{found}");
    // The user cancels while it accepts nothing.
    let (address, ..) = self::gateway(Box::new(|_| None));
    let mut gateway = Cia309::connect(&address, 1).unwrap();
    let ask = Ask { cancelled: &|| true, patience: Duration::from_secs(600), ..ask };
    assert!(matches!(gateway.upload(&ask, &mut |_| {}), Err(GatewayError::Cancelled)));
}
