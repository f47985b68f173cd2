//! Common mistakes as a table: the command, the situation, the exit code, and the required words of
//! the message: what happened, and what to do.
//!
//! Every row runs the tool as a separate process.
#![cfg(target_os = "linux")]

use std::fs;
use std::io::{Read, Write as _};
use std::net::{TcpListener, TcpStream};
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::UnixListener;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use crate::tool::{data, folder, quick, run, Done};
use canopen::{CobId, Frame};
use kit::fake::{serve, Fake, Outcome, APPLICATION, BOOTLOADER};
use kit::folder::Folder;

/// The situation of the command.
#[derive(Clone, Copy, Debug)]
enum With {
    /// Normal.
    Nothing,
    /// A device on `{bus}`.
    Device(fn() -> Fake),
    /// A server on `{server}` that sends this to each client, and nothing else.
    Server(&'static [u8]),
    /// No server on `{server}`.
    NoServer,
    /// An `open` of `{port}` fails with this error number.
    Port(i32),
    /// No kernel with CAN: a CAN socket fails with this error number.
    Socket(i32),
    /// `vcan0` accepts no frame: this error number; and `ip` reports its controller in this state.
    Refuses(i32, &'static str),
    /// On `vcan0` each request brings error frames of this class, with these data; `ip` says that the
    /// controller is in this state.
    Errors(u32, [u8; 8], &'static str),
}
use With::*;

struct Mistake(&'static str, With, i32, &'static [&'static str]);

fn absent() -> Fake {
    let mut fake = Fake::new(BOOTLOADER);
    fake.running = None;
    fake
}

/// Only frames with these COB-IDs and this byte, as a heartbeat has its state.
fn heard(ids: &[u16], byte: u8) -> Fake {
    let mut fake = absent();
    fake.deaf_while_busy = true;
    for (time, id) in (0..100).flat_map(|time| ids.iter().map(move |id| (time, *id))) {
        fake.later(Duration::from_millis(50 * time), Frame::of(CobId::new(id).unwrap(), &[byte]));
    }
    fake
}

fn starts(what: Option<u32>) -> Fake {
    let mut fake = quick(BOOTLOADER);
    fake.starts = what;
    fake
}

fn refusing_blocks(status: u32) -> Fake {
    let mut fake = quick(BOOTLOADER);
    fake.on_block = Box::new(move |_| Outcome::Status(status));
    fake
}

fn refusing_command(command: u8, outcome: Outcome, running: u32) -> Fake {
    let mut fake = Fake::new(running);
    fake.on_command = Box::new(move |given| if given == command { outcome } else { Outcome::Accept });
    fake
}

#[rustfmt::skip]
const MISTAKES: &[Mistake] = &[
    // Common mistakes in the URL of the bus.
    Mistake("scan --bus slcan:/dev/ttyACM0@500", Nothing, 2,
        &["500 bit/s is not a bit rate", "did you mean 500k?"]),
    Mistake("flash {missing} --bus slcan:COM7@125", Nothing, 2, &["did you mean 125k?"]),
    Mistake("scan --bus slcan:", Nothing, 2, &["it names no serial port"]),
    Mistake("scan --bus slcan:tcp://host@500k", Nothing, 2, &["it must be slcan:tcp://HOST:PORT@BITRATE"]),
    Mistake("scan --bus slcan:/dev/ttyACM0@fast", Nothing, 2, &["its bit rate must be like 125k"]),
    Mistake("scan --bus slcan:/dev/ttyACM0@500kbit", Nothing, 2, &["did you mean 500k?"]),
    Mistake("scan --bus slcan:/dev/ttyACM0@1m", Nothing, 2, &["did you mean 1M?"]),
    Mistake("scan --bus slcan:/dev/ttyACM0@2M", Nothing, 2, &["must be like 125k, 500k or 1M"]),
    Mistake("scan --bus can0", Nothing, 2,
        &["it has no ':' after the adapter's name", "did you mean socketcan:can0?"]),
    Mistake("scan --bus /dev/ttyACM0", Nothing, 2, &["did you mean slcan:/dev/ttyACM0@500k?"]),
    Mistake("scan --bus COM7@500k", Nothing, 2, &["did you mean slcan:COM7@500k?"]),
    Mistake("scan --bus PCAN_USBBUS1@500k", Nothing, 2, &["did you mean peak:PCAN_USBBUS1@500k?"]),
    Mistake("scan --bus pcan:PCAN_USBBUS1@500k", Nothing, 2,
        &["there is no such adapter", "did you mean peak:PCAN_USBBUS1@500k?"]),
    Mistake("scan --bus candlelight:0@500k", Nothing, 2, &["did you mean gs_usb:0@500k?"]),
    Mistake("scan --bus SLCAN:COM7", Nothing, 2, &["did you mean slcan:COM7?"]),
    Mistake("scan --bus peak:USB1@500k", Nothing, 2, &["no channel of PCANBasic", "peak:PCAN_USBBUS1@500k"]),
    Mistake("scan --bus peak:PCAN_USBBUS1@123k", Nothing, 2, &["PEAK adapters support 1M, 800k, 500k"]),
    Mistake("scan --bus kvaser:can0@500k", Nothing, 2, &["no channel of CANlib", "kvaser:0@500k"]),
    Mistake("scan --bus gs_usb:@500k", Nothing, 2, &["by place or serial number", "gs_usb:0@500k"]),
    Mistake("scan --bus gs_usb:0", Nothing, 2, &["needs the bit rate of the bus", "gs_usb:0@125k"]),
    Mistake("scan --bus socketcan:can0@500k", Nothing, 2,
        &["sudo ip link set can0 up type can bitrate 500000"]),
    Mistake("scan --bus socketcand://192.0.2.1", Nothing, 2, &["it names no bus", "append /can0"]),
    Mistake("scan --bus socketcand://host/can0@500k", Nothing, 2, &["the server sets the bit rate"]),
    Mistake("scan --bus cia309://192.0.2.1/1", Nothing, 2, &["a gateway carries only SDO"]),
    Mistake("scan", Nothing, 2, &["no CAN bus is given", "no adapter was found", "coflash adapters"]),
    // What cannot be written at the end is said before a bus is needed.
    Mistake("read 1018/4 -o /dev/null/x", Nothing, 1, &["/dev/null/x: cannot be written"]),
    Mistake("more debug read 0 4 -o /dev/null/x", Nothing, 1, &["/dev/null/x: cannot be written"]),
    Mistake("more conform --junit /dev/null/x", Nothing, 1, &["/dev/null/x: cannot be written"]),
    Mistake("flash {blk} --report /dev/null/x", Nothing, 1, &["/dev/null/x: cannot be written"]),
    // Serial ports.
    Mistake("scan --bus slcan:/dev/there-is-none@500k", Nothing, 4,
        &["SLCAN adapter /dev/there-is-none cannot be opened", "no serial port has this name", "serial port",
        "plug the adapter in"]),
    Mistake("scan --bus slcan:{port}@500k", Port(13), 4,
        &["permission denied", "usermod -aG", "log out and in", "udev rule", "uaccess"]),
    Mistake("scan --bus slcan:{port}@500k", Port(16), 4,
        &["another program uses the port", "fuser -v", "close the other program"]),
    Mistake("scan --bus slcan:/dev/null@500k", Nothing, 4, &["it is not a serial port", "slcan:PORT@500k"]),
    Mistake("scan --bus slcan:{file}@500k", Nothing, 4, &["it is not a serial port"]),
    Mistake("scan --bus slcan:tcp://{server}@500k", Server(b""), 4,
        &["answered neither V (version) nor O", "not an SLCAN adapter", "serial port"]),
    Mistake("scan --bus slcan:tcp://{server}@500k", Server(b"$GPGGA,120000\r\n"), 4,
        &["answered neither V", "it sent '$GPGGA,120000'"]),
    Mistake("scan --bus slcan:tcp://{server}@500k", NoServer, 4,
        &["cannot be opened", "nothing listens on this port", "start the server"]),
    // Interfaces of the kernel.
    Mistake("scan --bus socketcan:can9", Refuses(0, "ERROR-ACTIVE"), 4,
        &["no interface has this name", "this computer has these CAN interfaces: vcan0"]),
    Mistake("scan --bus socketcan:can9", Nothing, 4,
        &["no interface has this name", "ip link", "type can bitrate 500000"]),
    Mistake("scan --bus socketcan:lo", Nothing, 4, &["it is not a CAN interface"]),
    Mistake("scan --bus socketcan:vcan0", Socket(97), 4,
        &["this kernel has no CAN", "sudo modprobe can_raw"]),
    Mistake("scan --bus socketcan:vcan0", Refuses(100, "STOPPED"), 4,
        &["accepts no more frames", "switched off", "ip link set"]),
    Mistake("scan --bus socketcan:vcan0", Refuses(105, "BUS-OFF"), 4,
        &["accepts no more frames", "bus-off", "500 kbit/s", "short circuit"]),
    Mistake("scan --bus socketcan:vcan0", Refuses(105, "ERROR-PASSIVE"), 4,
        &["accepts no more frames", "no other node acknowledges", "power"]),
    // Servers.
    Mistake("scan --bus socketcand://{server}/can0", NoServer, 4,
        &["cannot be opened", "nothing listens on this port"]),
    Mistake("scan --bus socketcand://{server}/can0", Server(b"<html><body>"), 4,
        &["'< html >' instead of '< hi >'", "check that the address"]),
    Mistake("scan --bus socketcand://{server}/can0", Server(b"< hi >< error unknown bus >"), 4,
        &["unknown bus", "has this bus"]),
    // The bus.
    Mistake("info {kernel}", Errors(0x88, [0, 0, 4, 0, 0, 0, 0, 0], "ERROR-ACTIVE"), 5,
        &["node 5 does not answer", "disturbed", "the bit rate is wrong (the adapter has 500 kbit/s)"]),
    Mistake("info {kernel}", Errors(0x20, [0; 8], "ERROR-PASSIVE"), 5,
        &["node 5 does not answer", "no other node acknowledges the adapter's frames", "power", "CAN-H"]),
    Mistake("info {kernel}", Errors(0x40, [0; 8], "BUS-OFF"), 5,
        &["node 5 does not answer", "bus-off", "ip link set can0 down"]),
    Mistake("info {kernel}", Errors(0x04, [0, 0x10, 0, 0, 0, 0, 0, 0], "ERROR-PASSIVE"), 5,
        &["node 5 does not answer", "no other node acknowledges", "bit rate"]),
    Mistake("info {kernel}", Errors(0x100, [0; 8], "ERROR-ACTIVE"), 5,
        &["another node acknowledges the adapter's frames", "check that node 5 is the right one",
        "coflash scan"]),
    Mistake("info -N 5 {node}", Device(absent), 5,
        &["node 5 does not answer", "nothing at all is heard", "bit rate", "coflash more catch", "strap"]),
    Mistake("info -N 5 {node}", Device(|| heard(&[0x701], 0x7F)), 5,
        &["node 5 does not answer", "node 1 is heard", "coflash scan"]),
    Mistake("info -N 5 {node}", Device(|| heard(&[0x705], 0x04)), 5,
        &["node 5 does not answer", "in state stopped", "coflash reset --node 5"]),
    Mistake("info -N 5 {node}", Device(|| heard(&[0x705], 0x05)), 5,
        &["heartbeats (operational)", "another tool may be using it"]),
    Mistake("info -N 5 {node}", Device(|| heard(&[0x185], 1)), 5, &["node 5 sends frames but does not answer"]),
    Mistake("info -N 5 {node}", Device(|| heard(&[0x703, 0x187], 5)), 5,
        &["the bus works, and nodes 3, 7 are heard"]),
    Mistake("info -N 5 {node}", Device(|| heard(&[0x7FF], 0)), 5, &["no CANopen node sends frames"]),
    Mistake("flash -N 5 {blk} {node}", Device(absent), 5,
        &["node 5 does not answer (reading 1000h/0) [0x60000013]"]),
    // The device.
    Mistake("flash -N 5 {blk} {node}", Device(|| starts(None)), 7,
        &["node 5 has not answered since the program was started", "switch the device off and on",
        "coflash more catch"]),
    Mistake("flash -N 5 {blk} {node}", Device(|| starts(Some(BOOTLOADER))), 7,
        &["the trial failed, and the program is not released for autostart: it does not start",
        "linked for this board"]),
    Mistake("flash -N 5 {blk} {node}", Device(|| refusing_blocks(0x0C)), 6,
        &["[0x60000006]\n  the device: its bootloader is running; it contains no complete program\n",
        "--board and --program"]),
    Mistake("flash -N 5 {blk} {node}", Device(|| refusing_blocks(0x80)), 6,
        &["check that file and device belong together"]),
    Mistake("enter -N 5 {node}",
        Device(|| refusing_command(0x80, Outcome::Abort(0x0609_0030), APPLICATION)), 7,
        &["refuses the call", "entry strap", "rescue window"]),
    Mistake("enter -N 5 {node}", Device(|| refusing_command(0x80, Outcome::Ignore, APPLICATION)), 7,
        &["node 5", "coflash more catch", "strap"]),
    Mistake("flash -N 5 {hex} --vid 0x40 --pid 1234 --check-target {node}",
        Device(|| Fake::new(APPLICATION)), 3,
        &["the program is for vendor-ID 00000040h", "it was not changed", "belong together"]),
    // The file.
    Mistake("flash {missing} --bus {bus}", Device(absent), 3,
        &["missing.blk", "No such file", "check the file's name"]),
    Mistake("flash {folder} --bus {bus}", Device(absent), 3, &["is a folder and not a file", "give a file"]),
    Mistake("flash {empty} --bus {bus}", Device(absent), 3, &["is empty", "build the program again"]),
    Mistake("flash {html} --bus {bus}", Device(absent), 3,
        &["not a firmware file but a page of the web", "fetch the file itself"]),
    Mistake("flash {top} --board nucleo-f446re --bus {bus}", Device(absent), 3,
        &["its stack begins at 20020000h, over the handoff (2001FFC0h)", "LENGTH = 128K - 64"]),
    Mistake("convert {top} {out} --board nucleo-f446re", Nothing, 3,
        &["its stack begins at 20020000h, over the handoff (2001FFC0h)", "LENGTH = 128K - 64"]),
    Mistake("flash {top} --bus {bus}", Device(absent), 3, &["does not contain its address", "--board"]),
    Mistake("flash {options} --bus {bus}", Device(absent), 3, &["line 4", "option bytes", "debug probe"]),
    Mistake("convert {options} {out} --board nucleo-f446re", Nothing, 3,
        &["line 4", "option bytes", "debug probe"]),
    Mistake("convert {eeprom} {out} --board nucleo-f446re", Nothing, 3,
        &["line 4", "EEPROM", "leave this section out"]),
    Mistake("convert {marked} {out}", Nothing, 3, &["byte order mark of UTF-8", "ASCII"]),
    Mistake("convert {cut} {out}", Nothing, 3, &["line 25", "cut off", "copy the file again"]),
    // The command.
    Mistake("flsh {blk}", Nothing, 2, &["unrecognized subcommand", "flash"]),
    Mistake("flash {blk} --nod 5", Nothing, 2, &["--nod", "--node"]),
    Mistake("info --sdo-timeout 0", Nothing, 2, &["at least 1 millisecond"]),
    Mistake("scan --search usb", Nothing, 2, &["kinds of adapters are serial, socketcan, peak"]),
    Mistake("convert {blk} {out} --board stm32f4", Nothing, 2, &["stm32f4"]),
];

/// Files, and the shim for the kernel.
struct Room {
    folder: Folder,
    shim: String,
}

impl Room {
    fn new() -> Self {
        let folder = folder("mistakes");
        let shim = crate::tool::kernel::library(&folder, "shim/can.c", "can.so", &[]);
        folder.file("empty.hex", b"");
        folder.file("page.html", b"<!DOCTYPE html><html><body>404 Not Found</body></html>");
        folder.file("port", b"");
        let hex = fs::read_to_string(data("program.hex")).unwrap();
        folder.file("cut.hex", &hex.as_bytes()[..hex.len() / 2 - 7]);
        // A program at 08010000h, whose stack begins at the end of an SRAM of 128 KiB.
        let mut top = vec![0x5A; 1024];
        top[..8].copy_from_slice(&[0x00, 0x00, 0x02, 0x20, 0x01, 0x02, 0x01, 0x08]);
        folder.file("top.bin", &top);
        // Its first words, and a record elsewhere. Checksums by hand: the two's complement of the sum.
        let and =
            |record: &str| format!(":020000040801F1\n:0800000000FF012001020108CC\n{record}\n:00000001FF\n");
        let options = and(":020000041FFFDC\n:02C00000FFAA95");
        folder.file("options.hex", options.as_bytes());
        folder.file("eeprom.hex", and(":020000040808EA\n:020000001234B8").as_bytes());
        folder.file("marked.hex", &[b"\xEF\xBB\xBF", options.as_bytes()].concat());
        Self { folder, shim }
    }

    /// The command, its placeholders replaced.
    fn words(&self, line: &str, bus: &str, server: &str) -> Vec<String> {
        let quick = "--sdo-timeout 60 --sdo-attempts 2 --boot-timeout 300";
        let at = |name: &str| self.folder.path(name);
        let all = [
            ("{kernel}", "-N 5 {quick} --bus socketcan:vcan0".to_string()),
            ("{node}", "{quick} --bus {bus}".to_string()),
            ("{quick}", quick.to_string()),
            ("{bus}", bus.to_string()),
            ("{server}", server.to_string()),
            ("{blk}", data("identity-110.blk")),
            ("{missing}", at("missing.blk")),
            ("{folder}", self.folder.path("")),
            ("{empty}", at("empty.hex")),
            ("{html}", at("page.html")),
            ("{cut}", at("cut.hex")),
            ("{hex}", data("program.hex")),
            ("{top}", at("top.bin")),
            ("{options}", at("options.hex")),
            ("{eeprom}", at("eeprom.hex")),
            ("{marked}", at("marked.hex")),
            ("{out}", at("out.blk")),
            ("{port}", at("port")),
            ("{file}", at("port")),
        ];
        let line = all.iter().fold(line.to_string(), |line, (name, value)| line.replace(name, value));
        line.split(' ').map(str::to_string).collect()
    }

    /// A folder with a program `ip` that says that `vcan0` is in this state.
    fn ip(&self, number: usize, state: &str) -> String {
        let folder = self.folder.path(&format!("bin{number}"));
        fs::create_dir_all(&folder).unwrap();
        let program = format!("{folder}/ip");
        let says = format!(
            r#"[{{"ifname":"vcan0","flags":["UP"],"link_type":"can","linkinfo":{{"info_kind":"can","info_data":{{"state":"{state}",
               "berr_counter":{{"tx":128,"rx":0}},"bittiming":{{"bitrate":500000}}}}}}}}]"#
        );
        fs::write(&program, format!("#!/bin/sh\ncat <<'EOF'\n{says}\nEOF\n")).unwrap();
        fs::set_permissions(&program, fs::Permissions::from_mode(0o755)).unwrap();
        folder
    }

    fn run(&self, number: usize, mistake: &Mistake) -> Done {
        let Mistake(line, with, ..) = mistake;
        let mut bus = "socketcand://127.0.0.1:1/can0".to_string();
        let mut server = String::new();
        let mut command = crate::tool::command();
        command.current_dir(&self.folder);
        match with {
            Nothing => {}
            Device(device) => bus = serve(device()).0,
            Server(says) => server = say(says),
            NoServer => {
                let listener = TcpListener::bind("127.0.0.1:0").unwrap();
                server = listener.local_addr().unwrap().to_string();
            }
            Port(error) => {
                let port = self.folder.path("port");
                command.env("SHIM_PATH", port).env("SHIM_OPEN", error.to_string());
            }
            Socket(error) => {
                command.env("CAN_SHIM", "/nowhere").env("CAN_SHIM_SOCKET", error.to_string());
            }
            Refuses(error, state) => {
                command.env("CAN_SHIM", errors(0, [0; 8])).env("CAN_SHIM_WRITE", error.to_string());
                // The script `ip` needs its `cat`.
                command.env("PATH", format!("{}:/usr/bin:/bin", self.ip(number, state)));
            }
            Errors(class, data, state) => {
                command.env("CAN_SHIM", errors(*class, *data));
                command.env("PATH", format!("{}:/usr/bin:/bin", self.ip(number, state)));
            }
        }
        if !matches!(with, Device(_) | Nothing) {
            command.env("LD_PRELOAD", &self.shim);
        }
        run(command.args(self.words(line, &bus, &server)))
    }
}

/// A server that sends this text.
fn say(says: &'static [u8]) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap().to_string();
    thread::spawn(move || {
        let (mut stream, _): (TcpStream, _) = listener.accept().unwrap();
        let mut bytes = [0; 64];
        // A device on a serial line sends all the time, before the connection and after it.
        while stream.write_all(says).is_ok() && stream.read(&mut bytes).is_ok_and(|len| len > 0) {}
    });
    address
}

/// A bus on which each request causes an error frame of Linux, and no other frame.
fn errors(class: u32, data: [u8; 8]) -> std::path::PathBuf {
    static COUNT: AtomicUsize = AtomicUsize::new(0);
    let name = format!("coflash-err-{}-{}", std::process::id(), COUNT.fetch_add(1, Ordering::Relaxed));
    let path = std::env::temp_dir().join(name);
    let _ = fs::remove_file(&path);
    let listener = UnixListener::bind(&path).unwrap();
    let gone = path.clone();
    thread::spawn(move || {
        let Ok((mut stream, _)) = listener.accept() else { return };
        let _ = fs::remove_file(gone);
        let mut frame = [0; 16];
        // CAN_ERR_FLAG.
        frame[..4].copy_from_slice(&(0x2000_0000 | class).to_ne_bytes());
        frame[4] = 8;
        frame[8..].copy_from_slice(&data);
        let mut request = [0; 16];
        while stream.read_exact(&mut request).is_ok() && stream.write_all(&frame).is_ok() {}
    });
    path
}

#[test]
fn every_mistake_is_told_with_what_to_do() {
    assert!(MISTAKES.len() >= 42, "42 were tried");
    let room = Room::new();
    let (next, wrong) = (AtomicUsize::new(0), Mutex::new(Vec::new()));
    // Most of the time is waiting, so several run at the same time.
    thread::scope(|scope| {
        for _ in 0..4 {
            scope.spawn(|| loop {
                let number = next.fetch_add(1, Ordering::Relaxed);
                let Some(mistake) = MISTAKES.get(number) else { return };
                let Mistake(line, with, exit, words) = mistake;
                let done = room.run(number, mistake);
                let missing: Vec<&&str> = words.iter().filter(|words| !done.err.contains(**words)).collect();
                if done.exit != *exit || !missing.is_empty() {
                    let fault = format!(
                        "coflash {line}\n  with {with:?}\n  ended with {} and not {exit}, and its words lack {missing:?}:\n{}",
                        done.exit, done.err
                    );
                    wrong.lock().unwrap_or_else(PoisonError::into_inner).push(fault);
                }
            });
        }
    });
    let wrong = wrong.into_inner().unwrap();
    assert!(wrong.is_empty(), "{} of {}:\n{}", wrong.len(), MISTAKES.len(), wrong.join("\n"));
}
