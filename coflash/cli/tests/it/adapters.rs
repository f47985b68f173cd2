//! An update through every adapter, with the tool as a separate process.

use std::fs;
use std::io::Write;
use std::net::{SocketAddr, TcpListener};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use crate::tool::kernel::{converse, standard};
use crate::tool::{bootloader, coflash, data};
use canopen::Frame;
use embedded_can::{Frame as _, StandardId};
use kit::fake::{Fake, APPLICATION};

/// The adapter's side of SLCAN (CAN232 manual): it acknowledges commands and records them in
/// `said`.
fn slcan<S: Write>(text: &mut Vec<u8>, stream: &mut S, said: &mut Vec<String>) -> Vec<Frame> {
    let mut frames = Vec::new();
    while let Some(end) = text.iter().position(|byte| *byte == b'\r') {
        let line: Vec<u8> = text.drain(..=end).collect();
        let line = std::str::from_utf8(&line[..end]).unwrap();
        if let Some(frame) = line.strip_prefix('t') {
            let id = StandardId::new(u16::from_str_radix(&frame[..3], 16).unwrap()).unwrap();
            let data: Vec<u8> = (4..frame.len())
                .step_by(2)
                .map(|at| u8::from_str_radix(&frame[at..at + 2], 16).unwrap())
                .collect();
            assert_eq!(frame[3..4].parse::<usize>().unwrap(), data.len());
            frames.push(Frame::new(id, &data).unwrap());
            let _ = stream.write_all(b"z\r");
        } else {
            said.push(line.to_string());
            let _ = stream.write_all(b"\r");
        }
    }
    frames
}

fn slcan_text(frame: &Frame) -> Vec<u8> {
    let data: String = frame.data().iter().map(|byte| format!("{byte:02X}")).collect();
    format!("t{:03X}{}{data}\r", standard(frame), frame.dlc()).into_bytes()
}

fn flash(bus: &str) {
    let file = data("identity-110.blk");
    coflash(&["--bus", bus, "flash", "-N", "5", &file]).good();
}

fn check(fake: &Fake) {
    assert_eq!(fake.blocks.concat(), fs::read(data("identity-110.blk")).unwrap());
    assert_eq!(fake.running, Some(APPLICATION));
}

/// Serves `fake` through an SLCAN adapter on a TCP port. Gives its address, and at the end the device
/// and the commands that the adapter got.
pub fn serve_slcan(fake: Fake) -> (SocketAddr, JoinHandle<(Fake, Vec<String>)>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    let server = thread::spawn(move || {
        let (stream, _) = listener.accept().unwrap();
        stream.set_nodelay(true).unwrap();
        stream.set_read_timeout(Some(Duration::from_millis(1))).unwrap();
        let mut said = Vec::new();
        let fake = converse(stream, fake, |text, stream| slcan(text, stream, &mut said), slcan_text);
        (fake, said)
    });
    (address, server)
}

#[test]
fn slcan_over_tcp() {
    let (address, server) = serve_slcan(bootloader());
    flash(&format!("slcan:tcp://{address}@250k"));
    let (fake, said) = server.join().unwrap();
    check(&fake);
    // Closed before and after, 250 kbit/s is S5. No empty line: some adapters repeat their last
    // command for it.
    assert_eq!(said, ["C", "C", "V", "S5", "O", "C"]);
}

/// The serial port is one end of a pseudo-terminal; the adapter at its other end has a UART with one speed. Bytes
/// take their time, at the speed that the tool has set; if that is another one, they are noise.
#[cfg(target_os = "linux")]
#[test]
fn slcan_over_a_serial_port() {
    use serialport::{SerialPort, TTYPort};
    for (query, speed, is_right) in [
        ("", 115_200, true),
        ("?baud=57600", 57_600, true),
        ("?baud=1M", 1_000_000, true),
        ("?baud=3M", 3_000_000, true),
        ("", 57_600, false),
    ] {
        let (mut master, slave) = TTYPort::pair().unwrap();
        master.set_timeout(Duration::from_millis(1)).unwrap();
        let bus = format!("slcan:{}{query}", slave.name().unwrap());
        let server = thread::spawn(move || {
            let mut said = Vec::new();
            let adapter = |text: &mut Vec<u8>, uart: &mut TTYPort| {
                let set = uart.baud_rate().unwrap();
                // Start bit, eight data bits, stop bit.
                thread::sleep(Duration::from_secs(10 * text.len() as u64) / set);
                if set != speed {
                    text.fill(0xFF);
                }
                slcan(text, uart, &mut said)
            };
            (converse(master, bootloader(), adapter, slcan_text), said)
        });
        // The bit rate comes from the manual's option, because the URL contains none.
        let flashed = coflash(&["--bus", &bus, "flash", "-N", "5", "-B", "4", &data("identity-110.blk")]);
        // That the other end is closed ends the server.
        drop(slave);
        let (fake, said) = server.join().unwrap();
        if is_right {
            assert_eq!(flashed.exit, 0, "{bus}: {}{}", flashed.out, flashed.err);
            check(&fake);
            assert_eq!(said[1..5], ["C", "V", "S4", "O"], "{bus}");
        } else {
            assert!(said.is_empty(), "{said:?}");
            flashed.fails(4, &["at 115200 bit/s as an adapter does", "append, for example, ?baud=57600"]);
        }
    }
}

/// If the kernel has no CAN, a library replaces it: `shim/can.c`, which is compiled here.
#[cfg(target_os = "linux")]
#[test]
fn socketcan() {
    let folder = crate::tool::folder("socketcan");
    let library = crate::tool::kernel::library(&folder, "shim/can.c", "can.so", &[]);
    let (path, server) = crate::tool::kernel::serve(bootloader());
    let call = |interface: &str, path: &std::path::Path| {
        let mut command = crate::tool::command();
        let bus = format!("socketcan:{interface}");
        command.args(["--bus", &bus, "flash", "-N", "5", &data("identity-110.blk")]);
        crate::tool::run(command.env("LD_PRELOAD", &library).env("CAN_SHIM", path))
    };
    call("vcan0", &path).good();
    check(&server.join().unwrap());
    let done = call("can9", &path);
    let _ = fs::remove_file(&path);
    done.fails(4, &["CAN interface can9 cannot be opened"]);
}
